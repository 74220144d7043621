"""The command `alidade`: parses, calls, prints.

The help asks for the options of all commands: annotations are objects, since strings would have to be compiled, and
what a command works with is imported by the command.
"""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperGroup

from alidade.pipelines import deadline, errors, parallel, progress
from alidade.pipelines.applications import CALIBRATED
from alidade.pipelines.errors import IndeterminateError, InputError, nearest_three, printable
from alidade.pipelines.files import plain_json, require_place, require_room, write_file, write_whole
from alidade.pipelines.solvers.window import parse_window

if TYPE_CHECKING:
    from alidade.pipelines.applications.session import Session
    from alidade.pipelines.recording.opening import Where
    from alidade.pipelines.reports.report import Report
    from alidade.pipelines.reports.result import Calibration


class _WithPlugins(TyperGroup):
    """Command group of the commands below and those of installed plug-ins."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *_of_plugins()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return super().get_command(ctx, cmd_name) or _of_plugins().get(cmd_name)

    def get_params(self, ctx: Any) -> Any:
        """Set the default of flags to False: for typer's own, None, the check of values imports pydantic."""
        params = super().get_params(ctx)
        for flag in params:
            flag.default = flag.default or False
        return params


@cache
def _of_plugins() -> Mapping[str, Any]:
    from alidade.pipelines import methods

    own = typer.Typer(rich_markup_mode=None)
    own.callback()(lambda: None)
    for word, command in methods.commands().items():
        own.command(word)(command)
    return typer.main.get_group(own).commands


app = typer.Typer(
    cls=_WithPlugins,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # boxes around the help would take three times as long to import as all else
    help="Calibrate sensor mounting (extrinsics), scale, bias and time offsets from a recording, with uncertainties.",
)


def _complete_method(incomplete: str) -> list[str]:
    from alidade.pipelines import methods

    return [name for name in methods.names() if name.startswith(incomplete)]


def _complete_scenario(incomplete: str) -> list[str]:
    from alidade.pipelines import methods

    return [name for known in methods.scenarios().values() for name in known if name.startswith(incomplete)]


_Solver = Annotated[
    Literal["batch", "incremental", "published"],
    typer.Option(
        help="batch: the whole recording at once; incremental: step by step, as live; published: the algorithm of the "
        "publication that the method is from."
    ),
]


_WHAT = "File, bag folder, or pattern in quotes, 'run_*.mcap'."
_RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help=_WHAT)]
_RecordingPaths = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help=f"{_WHAT} Several: one device, solved jointly."),
]
_ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML config; overrides the recording's own.")]
_Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars.")]
_Json = Annotated[bool, typer.Option("--json", help="Print JSON only.")]
_METHODS = (
    "What is calibrated: los (gimballed camera), indexer (rotation table), head (tracked helmet), cube (AprilTags or "
    "static poses), tumble (turned by hand), or a plug-in"
)
_MethodName = Annotated[
    str | None,
    typer.Option("--method", help=f"{_METHODS} [default: from the topics].", autocompletion=_complete_method),
]
_OfMethod = Annotated[str, typer.Argument(help=f"{_METHODS}.", autocompletion=_complete_method)]
_Scenario = Annotated[
    str | None,
    typer.Option(
        help="YAML file, or a name that `scenarios` lists [default: nominal].", autocompletion=_complete_scenario
    ),
]
_Scheduler = Annotated[
    str | None, typer.Option(help="Scheduler of a dask cluster, tcp://host:8786 [default: this machine].")
]
_Jobs = Annotated[int | None, typer.Option(help="Local worker processes [default: one per core].")]
_OwnJobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes [default: one per core].")]
_Strict = Annotated[bool, typer.Option("--strict", help="Fail if any part of the recording is damaged or missing.")]
_AutoTopics = Annotated[bool, typer.Option("--auto-topics", help="Use the topics that `info` proposes.")]
_AutoColumns = Annotated[bool, typer.Option("--auto-columns", help="Use the columns of tables that `info` proposes.")]
_NoCheck = Annotated[
    bool, typer.Option("--no-check", help="End with the incremental estimate, without a final batch solution.")
]
_Prior = Annotated[
    Path | None, typer.Option(help="Earlier calibration (result.json or calibration.yaml) used as prior.")
]
_Window = Annotated[
    str,
    typer.Option(help="The past that the incremental solver re-estimates: seconds, keyframes (50kf) or 'all'."),
]


def _version(wanted: bool) -> None:
    if wanted:
        from alidade.pipelines.reports.result import software_versions

        typer.echo(software_versions()["alidade"])
        raise typer.Exit


_TimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time-limit",
        min=0.1,
        help="Time for solving, s; then the best so far counts [default: a tenth of the recording, at least 60; "
        "incremental: its duration].",
    ),
]
_Version = Annotated[
    bool, typer.Option("--version", "-V", callback=_version, is_eager=True, help="Print the version and exit.")
]


_Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log what is tried and fails, with tracebacks.")]


@app.callback()
def _options(version: _Version = False, verbose: _Verbose = False) -> None:  # noqa: ARG001
    if verbose:
        import logging

        logging.basicConfig(level=logging.WARNING, format="%(message)s")
        logging.getLogger("alidade").setLevel(logging.DEBUG)


@app.command()
def calibrate(
    sessions: _RecordingPaths,
    method: _MethodName = None,
    config: _ConfigFile = None,
    solver: _Solver = "batch",
    window: _Window = "1",
    out: Annotated[Path | None, typer.Option(help="Folder for the results [default: RECORDING-SOLVER].")] = None,
    strict: _Strict = False,
    auto_topics: _AutoTopics = False,
    auto_columns: _AutoColumns = False,
    jobs: _OwnJobs = None,
    prior: _Prior = None,
    no_check: _NoCheck = False,
    engine: Annotated[
        Literal["auto", "chain", "gtsam"],
        typer.Option(help="Linear algebra of batch: chain elimination, or gtsam, with white noise alone."),
    ] = "auto",
    attitude_rate: Annotated[
        Literal["vision", "gyro"],
        typer.Option(help="Times of the attitudes in attitude.tum: of the pictures, or of all gyro samples."),
    ] = "vision",
    time_limit: _TimeLimit = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all tables of the report: parameters by name, findings, diagnostics.")
    ] = False,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Calibrate one recording, or several of one device.

    Exit code 0 calibrated, 2 unusable input, 3 weak or unobservable, 4 inconsistent.
    """
    from tempfile import TemporaryDirectory

    from alidade.pipelines.applications.joint import calibrate_together
    from alidade.pipelines.applications.session import open_session
    from alidade.pipelines.recording.opening import describe_recordings, group_recordings, naming_parts
    from alidade.pipelines.reports.write import adopt_parts, write_part, write_results

    how = {"auto_topics": auto_topics, "auto_columns": auto_columns, "prior": prior}

    def read(where: "Where") -> "Session":
        session = open_session(where, method, config, strict, **how)
        return replace(session, engine=engine, attitude_rate=attitude_rate)

    recordings, folder = group_recordings(sessions), out or _default_folder(sessions[0], solver)
    if len(recordings) > 1:
        if solver != "batch":
            raise InputError(f"--solver {solver}: several recordings are calibrated together by batch alone")
        if engine != "auto":
            raise InputError(f"--engine {engine}: with several recordings each uses the engine that fits it")
        folder = out or _default_folder(sessions[0], "device")
        if not as_json:
            _say(f"{len(recordings)} recordings of one device: {describe_recordings(recordings)}")
    require_room(folder)
    with (
        progress.shown(quiet or as_json),
        parallel.processes(jobs),
        deadline.within(time_limit),
        TemporaryDirectory(prefix="alidade-") as parts,
    ):
        if len(recordings) > 1:
            by_itself = partial(write_part, Path(parts))
            with naming_parts(recordings):
                calibration = calibrate_together([partial(read, each) for each in recordings], by_itself)
        else:
            session = read(recordings[0])
            calibration = session.calibrate(solver, parse_window(window), check=not no_check)
        with progress.doing("writing"):
            if len(recordings) > 1:
                adopt_parts(folder, Path(parts))
            written = write_results(folder, calibration)
    _show_result(calibration, folder, written, as_json, everything)


@app.command()
def compare(
    session: _RecordingPath,
    method: _MethodName = None,
    config: _ConfigFile = None,
    window: _Window = "1",
    prior: _Prior = None,
    out: Annotated[Path | None, typer.Option(help="Folder for compare.html; compares both halves too.")] = None,
    strict: _Strict = False,
    auto_topics: _AutoTopics = False,
    auto_columns: _AutoColumns = False,
    jobs: _OwnJobs = None,
    time_limit: _TimeLimit = None,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Compare the published, batch and incremental solver.

    Exit code 0 they agree, 2 unusable input, 4 they do not: incremental and batch differ by more than a sigma, or (with
    --out) both halves of the recording by more than chance.
    """
    from alidade.pipelines.applications.comparison import compared
    from alidade.pipelines.applications.session import open_session
    from alidade.pipelines.reports.comparison_report import comparison_report
    from alidade.pipelines.reports.result_json import results_json

    require_room(out)
    kept = parse_window(window)
    with progress.shown(quiet or as_json), parallel.processes(jobs), deadline.within(time_limit):
        how = {"auto_topics": auto_topics, "auto_columns": auto_columns, "prior": prior}
        opened = open_session(session, method, config, strict, **how)
        comparison = compared(opened, kept, halves=out is not None)
        written = None if out is None else comparison.write(out)
    lines = [] if written is None else [f"Comparison in {written}"]
    _show(as_json, partial(results_json, comparison.calibrations), partial(comparison_report, comparison), *lines)
    if comparison.answer == "no":
        raise typer.Exit(errors.EXIT_INCONSISTENT)


@app.command()
def follow(
    source: Annotated[
        str | None,
        typer.Argument(metavar="SOURCE", help="File or folder being written, ws://host:port, or - (standard input)."),
    ] = None,
    method: _MethodName = None,
    config: _ConfigFile = None,
    window: _Window = "1",
    patience: Annotated[
        float, typer.Option(help="Seconds without new data after which an unfinished file ends.", min=0.0)
    ] = 30.0,
    prior: _Prior = None,
    checkpoint: Annotated[Path | None, typer.Option(help="File that saves the run, and from which it resumes.")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve live estimates over Foxglove's WebSocket.")] = False,
    port: Annotated[int, typer.Option(help="Port of --serve, on this machine only.")] = 8765,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(help="Site that may read --serve beside Foxglove's, https://host; may be repeated."),
    ] = None,
    page: Annotated[
        bool, typer.Option("--page", help="Serve a live page with the motion that is needed, for a phone.")
    ] = False,
    host: Annotated[
        str, typer.Option(help="Address of the live page; 0.0.0.0 opens it to the network (token in the URL).")
    ] = "127.0.0.1",
    page_port: Annotated[int, typer.Option(help="Port of --page.")] = 8766,
    replay: Annotated[
        Path | None, typer.Option(help="In place of SOURCE: a finished MCAP file, played as if it were recorded now.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Speed of --replay, times real time.")] = 1.0,
    record: Annotated[
        Path | None, typer.Option(help="Folder that keeps what arrives by ws:// or -; a later run appends.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results [default: SOURCE-incremental].")] = None,
    auto_topics: _AutoTopics = False,
    auto_columns: _AutoColumns = False,
    no_check: _NoCheck = False,
    as_json: _Json = False,
) -> None:
    """Calibrate while recording.

    Shows the motion that is still needed. Ctrl-C finishes. To try it without a device: --replay RECORDING --speed 5.
    """
    from alidade.pipelines.applications.follow.follow import follow as run
    from alidade.pipelines.applications.follow.follower import Settings
    from alidade.pipelines.reports.write import write_results

    if source is not None and replay is not None:
        raise InputError(f"follow: --replay {replay} stands in place of SOURCE; leave out {source}")
    if source is None and replay is None:
        raise InputError("follow: give a SOURCE, or a finished recording with --replay")
    if replay is None and speed != 1.0:
        raise InputError(f"--speed {speed:g}: is that of --replay; {source} is followed as fast as it is written")
    source = source or str(replay)
    folder = out or _default_folder(Path(_file_name(source)), "incremental")
    for place in (folder, checkpoint and checkpoint.parent):
        require_room(place)
    settings = Settings(
        method, config, parse_window(window), patience, checkpoint, not no_check, prior, auto_topics, auto_columns
    )
    page_at = (host, page_port) if page else None
    pace = None if replay is None else speed
    calibration = run(source, settings, port if serve else None, record, as_json, page_at, allow_origin or (), pace)
    written = write_results(folder, calibration)
    _show_result(calibration, folder, written, as_json)


@app.command()
def validate(
    session: _RecordingPath,
    calibration: Annotated[Path, typer.Option(help="calibration.yaml or result.json to test.")],
    method: _MethodName = None,
    config: _ConfigFile = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the page [default: RECORDING-validation].")] = None,
    strict: _Strict = False,
    auto_topics: _AutoTopics = False,
    auto_columns: _AutoColumns = False,
    jobs: _OwnJobs = None,
    time_limit: _TimeLimit = None,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Test a calibration on another recording.

    Has the device changed, and what error remains? Exit code 0 valid, 2 unusable input, 3 not observable, 4 changed.
    """
    from alidade.pipelines.applications.validate import validate as run
    from alidade.pipelines.reports.html import render_html
    from alidade.pipelines.reports.validation_report import validation_json, validation_report

    folder = out or _default_folder(session, "validation")
    require_room(folder)
    how: dict[str, Any] = {"auto_topics": auto_topics, "auto_columns": auto_columns, "strict": strict}
    with progress.shown(quiet or as_json), parallel.processes(jobs), deadline.within(time_limit):
        with progress.doing("validating"):
            validated = run(session, calibration, method=method, config=config, **how)
        report = validation_report(validated)
        (written,) = write_whole(folder, {"validation.html": render_html(report)})
    _show(as_json, partial(validation_json, validated), lambda: report, f"Plots in {written}")
    raise typer.Exit(errors.EXIT_OF_VALIDATION[validated.verdict])


@app.command()
def simulate(
    method: _OfMethod,
    out: Annotated[Path, typer.Option(help="The recording to write.")],
    scenario: _Scenario = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated noise.", min=0)] = 0,
    images: Annotated[
        bool,
        typer.Option("--images", help="Write camera pictures in place of attitudes, LOS errors or tag detections."),
    ] = False,
    quiet: _Quiet = False,
) -> None:
    """Simulate a recording, with its truth."""
    from alidade.pipelines.methods import simulate as run

    require_place(out)
    with progress.shown(quiet), progress.doing("simulating"):
        run(method, scenario, seed, out, images)
    _say(f"Wrote {out}")


@app.command()
def scenarios(
    name: Annotated[
        str | None,
        typer.Argument(help="A scenario, to print its YAML; or a method.", autocompletion=_complete_scenario),
    ] = None,
    as_json: _Json = False,
) -> None:
    """List scenarios, or print one as YAML to edit.

    `simulate`, `plan` and `montecarlo` find them by name.
    """
    from alidade.pipelines import methods
    from alidade.pipelines.display.table import Column, Table
    from alidade.pipelines.reports import terminal
    from alidade.pipelines.simulation.scenario import summary

    known = methods.scenarios()
    files = {scenario: path for found in known.values() for scenario, path in found.items()}
    if name in files and not as_json:
        print(files[name].read_text(encoding="utf-8"), end="")
        return
    if name is not None and name not in (*files, *known):
        raise InputError(f"no scenario or method {name}; {nearest_three(name, [*known, *files])}")
    listed = [
        {"name": scenario, "method": method, "summary": summary(path), "file": str(path)}
        for method, found in known.items()
        for scenario, path in found.items()
        if name in (None, method, scenario)
    ]
    if as_json:
        _print_json(plain_json("scenarios", {"scenarios": listed}))
    else:
        rows = tuple((scenario["name"], scenario["summary"]) for scenario in listed)
        terminal.print_table(Table("", "", ("scenario", Column("what it shows", "prose")), rows))


@app.command()
def plan(
    method: _OfMethod,
    scenario: _Scenario = None,
    config: _ConfigFile = None,
    require: Annotated[list[str] | None, typer.Option(help="NAME=SIGMA required, SI; may be repeated.")] = None,
    out: Annotated[Path | None, typer.Option(help="File for the better motion, as a scenario.")] = None,
    page: Annotated[Path | None, typer.Option(help="HTML file for the plan.")] = None,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Predict the accuracy of a motion; propose a better one.

    Exit code 3 if the motion falls short of the requirements.
    """
    from alidade.pipelines.applications.planning import plan as planned_motion
    from alidade.pipelines.applications.planning import requirements
    from alidade.pipelines.reports.html import render_html
    from alidade.pipelines.reports.plan_report import plan_json, plan_report

    for place in (out, page):
        require_place(place)
    with progress.shown(quiet or as_json):
        planned = planned_motion(method, scenario, config=config, require=requirements(require or []))
    lines = []
    if out is not None:
        write_file(out, planned.scenario_text)
        lines.append(f"The better motion is in {out}")
    if page is not None:
        write_file(page, render_html(plan_report(planned)))
        lines.append(f"The page is {page}")
    _show(as_json, partial(plan_json, planned), partial(plan_report, planned), *lines)
    raise typer.Exit(errors.EXIT_OF_STATUS[planned.now.status])


@app.command()
def info(
    session: _RecordingPath,
    config: _ConfigFile = None,
    strict: _Strict = False,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Show what a recording can calibrate.

    With which topics, what is missing, and the contents of the recording.
    """
    from alidade.pipelines.applications.discovery import suggestions, unused
    from alidade.pipelines.applications.session import checked_facts
    from alidade.pipelines.applications.table_discovery import propose_columns
    from alidade.pipelines.config import configured
    from alidade.pipelines.recording.recording import open_recording
    from alidade.pipelines.reports import terminal

    with progress.shown(quiet), progress.doing("reading"):
        recording, settings = configured(open_recording(session, strict), config)
        columns = None if settings.columns else propose_columns(recording)
        if columns is not None and columns.columns:
            recording, settings = columns.applied(recording, settings)
        facts = checked_facts(recording, settings)
        found, left = suggestions(recording, settings), unused(recording, settings)
    if as_json:
        _print_json(terminal.facts_json(facts, found, left, columns))
    else:
        terminal.print_facts(session.name, facts, found, left, columns)


@app.command()
def noise(
    session: _RecordingPath,
    config: Annotated[Path | None, typer.Option(help="YAML with `topics` and `columns` of the recording.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for noise.html and noise.json.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print noise.json only.")] = False,
    strict: _Strict = False,
    auto_columns: _AutoColumns = False,
    time_limit: _TimeLimit = None,
    quiet: _Quiet = False,
) -> None:
    """Measure sensor noise at rest (Allan deviation).

    Gyros, accelerometers, magnetometers; prints the section `noise` of the config.
    """
    from alidade.pipelines.applications.noise import noise as measured
    from alidade.pipelines.reports.html import render_html
    from alidade.pipelines.reports.noise_report import noise_json, noise_report

    require_room(out)
    with progress.shown(quiet), deadline.within(time_limit):
        study = measured(session, config=config, strict=strict, auto_columns=auto_columns)
    lines, report, text = list[str](), noise_report(study), noise_json(study)
    if out is not None:
        lines.append(_results_in(out, write_whole(out, {"noise.html": render_html(report), "noise.json": text})))
    _show(as_json, lambda: text, lambda: report, *lines)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the recording and its results.")] = Path("alidade-demo"),
    quiet: _Quiet = False,
) -> None:
    """Simulate and calibrate a helmet tracker.

    With all three solvers; prints the path of the report.
    """
    from alidade.pipelines.applications.comparison import compared
    from alidade.pipelines.applications.session import open_session
    from alidade.pipelines.methods import simulate as simulated
    from alidade.pipelines.reports.comparison_report import comparison_report
    from alidade.pipelines.reports.write import write_results

    require_room(out)
    out.mkdir(parents=True, exist_ok=True)
    session = out / "head_mounts.mcap"
    with progress.shown(quiet):
        with progress.doing("simulating"):
            simulated("head", "head_mounts", 1, session, False)
        comparison = compared(open_session(session), halves=False)
        for calibration in progress.track(comparison.calibrations, "writing", len(comparison.calibrations)):
            write_results(out / calibration.estimate.solver, calibration)
    _show(False, str, partial(comparison_report, comparison), f"Report: {(out / 'batch' / 'report.html').resolve()}")


@app.command()
def montecarlo(
    method: _OfMethod,
    runs: Annotated[int, typer.Option(help="Number of simulated recordings, one per seed.")] = 200,
    scenario: _Scenario = None,
    seed: Annotated[int, typer.Option(help="Seed of the first run; the others follow.", min=0)] = 0,
    solvers: Annotated[str, typer.Option(help="'all', or a list of published,batch,incremental.")] = "all",
    window: _Window = "1",
    scheduler: _Scheduler = None,
    jobs: _Jobs = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results [default: METHOD-montecarlo].")] = None,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Monte Carlo study: are the sigmas consistent?

    Simulates and calibrates many recordings, and compares their errors with the sigmas (NEES, coverage). The same
    command resumes after an interruption.
    """
    from alidade.pipelines.applications.fleet.montecarlo import SOLVERS, run_study, study_json, write_study
    from alidade.pipelines.applications.fleet.pages import study_report

    folder = out or Path(f"{method}-montecarlo")
    chosen = SOLVERS if solvers == "all" else tuple(solvers.split(","))
    seeds = range(seed, seed + runs)
    require_room(folder)
    with progress.shown(quiet or as_json):
        study = run_study(method, scenario, seeds, chosen, folder, scheduler, jobs, parse_window(window))
    written, report = write_study(folder, study), study_report(study)
    if not as_json:
        _say(report.about)
    _show(as_json, partial(study_json, study), lambda: report, _results_in(folder, written))
    if study.interrupted:
        raise typer.Exit(errors.EXIT_INTERRUPTED)


@app.command()
def fleet(
    recordings: Annotated[list[str], typer.Argument(metavar="FILES", help="Paths or patterns, 'recordings/*.mcap'.")],
    method: _MethodName = None,
    config: _ConfigFile = None,
    solver: _Solver = "batch",
    window: _Window = "1",
    names: Annotated[str | None, typer.Option(help="Unit and date in the file names, '{unit}_{date}*'.")] = None,
    prior: Annotated[
        str | None, typer.Option(help="Earlier calibrations used as priors: 'last/{unit}/result.json'.")
    ] = None,
    scheduler: _Scheduler = None,
    jobs: _Jobs = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("alidade-fleet"),
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Calibrate many recordings; compare units and dates.

    The same command resumes after an interruption.
    """
    from alidade.pipelines.applications.fleet.fleet import fleet as run
    from alidade.pipelines.applications.fleet.fleet import fleet_json

    require_room(out)
    work = partial(run, recordings, out, method=method, config=config, solver=solver, window=parse_window(window))
    with progress.shown(quiet or as_json):
        found = work(names=names, prior=prior, scheduler=scheduler, jobs=jobs)
    _show(as_json, partial(fleet_json, found), None, *found.summary, _results_in(out, found.written))
    if found.outcome.interrupted:
        raise typer.Exit(errors.EXIT_INTERRUPTED)


@app.command()
def export(
    calibration: Annotated[Path, typer.Argument(metavar="CALIBRATION.yaml", help="The calibration.")],
    form: Annotated[
        str,
        typer.Option(
            "--format", help="px4, ardupilot, betaflight, inav, ros2, kalibr, openvins, realsense, oak; tf, urdf."
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="File to write [default: printed].")] = None,
    as_json: _Json = False,
) -> None:
    """Export to flight controllers, cameras, ROS 2, URDF, Kalibr.

    Each in the conventions of that program.
    """
    from alidade.pipelines.reports.calibration import load_calibration
    from alidade.pipelines.reports.export_formats import export as exported

    saved = load_calibration(calibration)
    text = exported(saved, form)
    if out is not None:
        write_file(out, text)
    if as_json:
        _print_json(plain_json("export", {"method": saved.method, "format": form, "text": text}))
    elif out is None:
        print(text, end="")
    else:
        _say(f"Wrote {out}")


@app.command()
def apply(
    recording: _RecordingPath,
    calibration: Annotated[Path, typer.Argument(metavar="CALIBRATION.yaml", help="The calibration.")],
    out: Annotated[Path, typer.Option(help="MCAP file to write.")],
    suffix: Annotated[str, typer.Option(help="Added to a topic's name for that of the corrected topic.")] = CALIBRATED,
    config: _ConfigFile = None,
    strict: _Strict = False,
    auto_columns: _AutoColumns = False,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Copy a recording with corrected topics added.

    Gyro, accelerometer, magnetometer: /imu/data becomes /imu/data_calibrated beside it.
    """
    from alidade.pipelines.applications.apply import applied_json
    from alidade.pipelines.applications.apply import apply as run

    require_place(out)
    with progress.shown(quiet or as_json):
        applied = run(
            recording, calibration, out, config=config, suffix=suffix, strict=strict, auto_columns=auto_columns
        )
    lines = (f"Wrote {out}", *(topic.text for topic in applied.topics), *applied.notes)
    _show(as_json, partial(applied_json, applied), None, *lines)


@app.command()
def certificate(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a calibration, or its result.json.")],
    fields: Annotated[
        Path | None, typer.Option(help="YAML with certificate fields: number, item, serial number, customer ...")
    ] = None,
    before: Annotated[Path | None, typer.Option(help="Earlier result.json or calibration.yaml of the item.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the certificate [default: that of the results].")] = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write certificate.pdf too.")] = False,
    digital: Annotated[bool, typer.Option("--dcc", help="Write certificate.xml too, after PTB's DCC 3.3.0.")] = False,
) -> None:
    """Write a calibration certificate (ISO/IEC 17025 items).

    certificate.html for printing, certificate.json for programs.
    """
    from alidade.pipelines.reports.certificate import certificate as write

    require_room(out)
    written, missing = write(results, fields, before=before, out=out, pdf=pdf, dcc=digital)
    _say(f"Wrote {', '.join(map(str, written))}", *([f"not stated: {', '.join(missing)}"] if missing else []))


@app.command("cube-layout")
def cube_layout(
    sessions: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="Recordings of one or several cameras.")
    ],
    out: Annotated[Path, typer.Option(help="Config to write, with the located tags; its page is beside it, .html.")],
    config: _ConfigFile = None,
    refine_camera: Annotated[
        bool, typer.Option("--refine-camera", help="Estimate focal length, centre and distortion too.")
    ] = False,
    as_json: _Json = False,
    quiet: _Quiet = False,
) -> None:
    """Locate the AprilTags of a cube.

    From pictures of all sides; ids and sizes come from the config.
    """
    from alidade.pipelines.config import configured
    from alidade.pipelines.methods.cube.tags import cube_layout as estimate
    from alidade.pipelines.methods.cube.tags import layout_yaml
    from alidade.pipelines.recording.recording import open_recording
    from alidade.pipelines.reports.html import render_html
    from alidade.pipelines.reports.layout_report import layout_json, layout_report

    page = out.with_suffix(".html")
    if page == out:
        raise InputError(f"{out}: --out names the config, and its page takes the name with .html; call it .yaml")
    for place in (out, page):
        require_place(place)
    with progress.shown(quiet), progress.doing("finding where the tags are"):
        layout = estimate([configured(open_recording(session), config) for session in sessions], refine_camera)
    write_file(out, layout_yaml(layout))
    report = layout_report(layout, [session.name for session in sessions])
    write_file(page, render_html(report))
    _show(as_json, partial(layout_json, layout), lambda: report, f"Wrote {out} for calibrate --config, and {page}")


@app.command("cube-print")
def cube_print(
    edge: Annotated[float, typer.Option(help="Edge of the cube, m.")],
    out: Annotated[Path, typer.Option(help="PDF to write; the config of the tags is beside it, .yaml.")],
    first_id: Annotated[int, typer.Option(help="Id of the tag on the top face; the others follow.")] = 16,
) -> None:
    """Print the six faces of an AprilTag cube, true to scale."""
    from alidade.pipelines.methods.cube.printing import print_cube

    print_cube(out, edge, first_id)
    config = out.with_suffix(".yaml")
    _say(f"Wrote {out}: print at 100 % and check the ruler")
    _say(f"Wrote {config}: ids and sizes for cube-layout --config; of a cube as drawn all tags")


def _default_folder(session: Path, what: str) -> Path:
    """Return the default folder of results: beside the recording, named after the recording."""
    session = session if session.name else session.resolve()
    name = "".join(letter for letter in session.stem if letter not in "*?[]").rstrip("_-.") or "recording"
    return session.with_name(f"{name}-{what}")


def _file_name(source: str) -> str:
    """Return a source as a file name: a stream's address by letters, digits and `-` alone."""
    if source == "-":
        return "stdin"
    return re.sub(r"\W+", "-", source.partition("://")[2]).strip("-") if "://" in source else source


def _show_result(
    calibration: "Calibration", folder: Path, written: Sequence[Path], as_json: bool, everything: bool = False
) -> NoReturn:
    """Show a calibration and the place of its files; exit with the code of its status."""
    from alidade.pipelines.reports.calibration_report import calibration_report, short_report
    from alidade.pipelines.reports.result_json import result_json

    report = partial(calibration_report if everything else short_report, calibration)
    _show(as_json, partial(result_json, calibration), report, _results_in(folder, written), everything=everything)
    raise typer.Exit(errors.EXIT_OF_STATUS[calibration.status])


def _show(
    as_json: bool, text: Callable[[], str], report: "Callable[[], Report] | None", *lines: str, everything: bool = False
) -> None:
    """Print a command's result: as JSON alone, or as its report, if any, followed by lines."""
    if as_json:
        _print_json(text())
        return
    if report is not None:
        from alidade.pipelines.reports.terminal import print_report

        print_report(report(), everything)
    _say(*lines)


def _print_json(text: str) -> None:
    """Print JSON; if the encoding of standard output lacks any of its characters, escape all that are not ASCII."""
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        import json

        text = re.sub(r"[^\x00-\x7f]", lambda found: json.dumps(found[0])[1:-1], text)
    print(text.removesuffix("\n"))


def _say(*lines: str) -> None:
    from alidade.pipelines.reports.terminal import say

    for line in lines:
        say(line)


def _results_in(folder: Path, written: Sequence[Path]) -> str:
    return f"Results in {folder}: {', '.join(path.name for path in written)}"


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused an error, also the ImportError of a module whose loading it interrupted."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def main() -> None:
    """Run the command; known trouble is one line on stderr."""
    # The matrices are small: threads that wait for each other cost more than they bring, most on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, TextIOWrapper):  # characters that its encoding lacks are question marks, but in JSON
        sys.stdout.reconfigure(errors="replace")
    try:
        app(prog_name="alidade")
    except BaseException as error:
        if _interrupted(error):
            sys.exit(errors.EXIT_INTERRUPTED)
        if not isinstance(error, InputError | IndeterminateError | OSError):
            raise
        print(f"alidade: {_os_error_line(error) if isinstance(error, OSError) else error}", file=sys.stderr)
        sys.exit(errors.EXIT_UNDETERMINED if isinstance(error, IndeterminateError) else errors.EXIT_BAD_INPUT)


def _os_error_line(error: OSError) -> str:
    """Describe in one line a file or folder that the system refuses, such as a full TMPDIR."""
    unnamed = f"standard output, or temporary files in {os.environ.get('TMPDIR', '/tmp')}"
    where = error.filename if isinstance(error.filename, str) else unnamed
    return f"{printable(where)}: {error.strerror or printable(str(error))}"


if __name__ == "__main__":
    main()
