"""What the command line prints: tables for people."""

from __future__ import annotations

import dataclasses
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from alidade.pipelines.errors import printable

if TYPE_CHECKING:
    from alidade.pipelines.applications.discovery import Suggestion
    from alidade.pipelines.applications.noise import NoiseStudy
    from alidade.pipelines.applications.planning import Plan
    from alidade.pipelines.applications.table_discovery import Columns
    from alidade.pipelines.estimation.finding import Finding
    from alidade.pipelines.recording.info import SessionFacts
    from alidade.pipelines.reports.result import Calibration, ParameterResult

_NARROWEST = 72
console = Console(highlight=False)
# In less, columns of tables would be left out, and at a width of 0 everything: lines are broken by the terminal then.
if console.width < _NARROWEST:
    console.width = _NARROWEST
_LONGEST = 10_000
# Sentences are broken at so many characters.
_WIDTH = 100
# The types of messages in what a method lacks: reference/messages.md has them.
_TYPE = re.compile(r" \(\w+/msg/\w+\)")

COLOURS = {
    "calibrated": "green",
    "observable": "green",
    "weak": "yellow",
    "prior": "yellow",
    "unobservable": "red",
    "inconsistent": "red",
    "fixed": "dim",
}


def say(text: str) -> None:
    """One line, never broken."""
    console.print(escape(printable(text, _LONGEST)), soft_wrap=True)


def show_scenarios(scenarios: Sequence[Mapping[str, str]]) -> None:
    """A row a scenario: its name and what it says of itself."""
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("scenario", no_wrap=True)
    table.add_column("what it shows")
    for scenario in scenarios:
        table.add_row(scenario["name"], escape(scenario["summary"]))
    console.print(table)


def show(calibrations: Sequence[Calibration]) -> None:
    """One table, a row a parameter: the truth where known, then value, sigma and error (in sigmas) of each solver."""
    from alidade.pipelines.display.units import human_unit, to_digits_of
    from alidade.pipelines.reports.result import truth_errors

    alone = len(calibrations) == 1
    errors = [truth_errors(c) for c in calibrations]
    found, verdicts = [c.parameters for c in calibrations], calibrations[0].verdicts
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("parameter", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    if any(errors):
        table.add_column("truth", justify="right", no_wrap=True)
    for c in calibrations:
        table.add_column("value ± sigma" if alone else c.estimate.solver, justify="right")
    if alone:
        table.add_column("verdict", no_wrap=True)
    for q in filter(lambda q: q.judged, calibrations[0].problem.quantities):
        unit, factor = human_unit(q)
        row = [q.name, unit]
        truth = next((e[q.name].value for e in errors if q.name in e), None)
        if any(errors):
            finest = min((f[q.name].sigma for f in found if q.name in f and f[q.name].sigma > 0.0), default=0.0)
            row.append("" if truth is None else to_digits_of(truth * factor, finest * factor))
        for parameters, known in zip(found, errors, strict=True):
            error = known[q.name].error_sigmas if q.name in known else None
            row.append(_cell(parameters[q.name], factor, error, alone) if q.name in parameters else "-")
        if alone and q.name in found[0]:
            verdict = verdicts[q.name]
            row.append(f"[{COLOURS[verdict]}]{verdict}[/]")
        table.add_row(*row)
    console.print(table)
    if any(errors):
        say("In brackets: error / sigma.")
    for c in calibrations:
        _verdict(c, name=not alone)


def as_text(calibrations: Sequence[Calibration]) -> str:
    """What `show` prints, as plain text."""
    with console.capture() as capture:
        show(calibrations)
    return Text.from_ansi(capture.get()).plain.rstrip()


def show_json(calibrations: Sequence[Calibration]) -> None:
    """The result of a calibration as result.json has it; of several a list of them."""
    from alidade.pipelines.reports.result import result_json

    texts = [result_json(calibration).rstrip() for calibration in calibrations]
    print(texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]")


def facts_json(
    facts: SessionFacts, found: Sequence[Suggestion], unused: Sequence[str], columns: Columns | None = None
) -> str:
    """What `info` tells, as JSON."""
    from alidade.pipelines.reports.plain_json import plain_json

    suggested = {suggestion.method: suggestion for suggestion in found}
    told = dataclasses.asdict(facts)
    proposed = told.pop("proposed")
    told["methods"] = {
        name: {
            "served": not missing,
            "missing": missing,
            "proposed": proposed.get(name, ()),
            "suggested": {key: source.model_dump() for key, source in suggested[name].topics.items()}
            if name in suggested
            else {},
            "reasons": suggested[name].reasons if name in suggested else (),
            "still_missing": suggested[name].missing if name in suggested else missing,
        }
        for name, missing in told.pop("missing").items()
    }
    if columns is not None:
        tables = {topic: table.model_dump(exclude_defaults=True) for topic, table in columns.columns.items()}
        told["columns"] = {"columns": tables, "reasons": list(columns.reasons), "doubts": list(columns.doubts)}
    return plain_json("info", told | {"unused": list(unused)})


def show_facts(
    name: str,
    facts: SessionFacts,
    found: Sequence[Suggestion] = (),
    unused: Sequence[str] = (),
    columns: Columns | None = None,
) -> None:
    """What a recording can calibrate and with which topics, what each method lacks, then what there is."""
    say(f"{name}, {facts.duration_s:.1f} s")
    _show_columns(columns)
    _show_methods(facts, found)
    proposed = {str(name) for each in found for source in each.topics.values() for _, name in source}
    if left := [name for name in unused if name not in proposed]:
        _say_wrapped(f"not used: {', '.join(left)}")
    for note in facts.notes:
        _say_wrapped(f"note: {note}")
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("topic", no_wrap=True)
    table.add_column("type", overflow="ellipsis")
    for column in ("messages", "Hz", "gap, s", "dupli-\ncates", "out of\norder"):
        table.add_column(column, justify="right", no_wrap=True)
    for t in facts.topics:
        gap = ""
        if t.largest_gap_s is not None and t.rate_hz is not None:
            gap = f"{t.largest_gap_s:.2g}" + (
                f" at {t.largest_gap_at_s:.0f}" if t.largest_gap_s * t.rate_hz > 2 else ""
            )
        rate = "" if t.rate_hz is None else f"{t.rate_hz:.4g}"
        kind = printable(t.type.rsplit("/", 1)[-1])
        name = escape(printable(t.name))
        table.add_row(name, escape(kind), str(t.count), rate, gap, str(t.duplicates), str(t.out_of_order))
    console.print(table)
    if facts.attachments:
        say(f"attachments: {', '.join(facts.attachments)}")


def _say_wrapped(text: str) -> None:
    """In lines that fit, those after the first indented; words are left whole."""
    lines = textwrap.wrap(text, _WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    for line in [text[: len(text) - len(text.lstrip())] + lines[0].lstrip(), *lines[1:]] if lines else []:
        say(line)


def _show_columns(columns: Columns | None) -> None:
    """The proposed section `columns`, with reasons and doubts."""
    if columns is None:
        return
    if columns.columns:
        console.print("[yellow]tables, proposed (use `calibrate --auto-columns` or paste into the config):[/]")
        for line in columns.yaml.split("\n"):
            say(f"  {line}")
    for sentence in (*columns.reasons, *(f"in doubt: {doubt}" for doubt in columns.doubts)):
        _say_wrapped(f"  {sentence}")


def _show_methods(facts: SessionFacts, found: Sequence[Suggestion]) -> None:
    """Methods that are served, those that could be with other topics, and what the others lack."""
    for method, missing in facts.missing.items():
        if not missing:
            console.print(f"[green]{method}: yes[/]")
            for key in facts.proposed.get(method, ()):
                _say_wrapped(f"  proposed for the config: {key}")
    for suggestion in found:
        if not suggestion.missing:
            name = f"--method {suggestion.method} " if suggestion.has_to_be_asked_for else ""
            how = f"use `calibrate {name}--auto-topics` or paste them into the config"
            console.print(f"[yellow]{suggestion.method}: yes, with these topics ({how}):[/]")
            for reason in suggestion.reasons:
                _say_wrapped(f"  {reason}")
            for line in suggestion.yaml.split("\n"):
                say(f"  {line}")
        elif not suggestion.topics:
            _say_wrapped(f"{suggestion.method}: {'; '.join(suggestion.reasons)}")
    whole = {suggestion.method for suggestion in found if not suggestion.missing}
    for method, missing in facts.missing.items():
        if missing and method not in whole:
            _say_wrapped(f"{method}: missing {_TYPE.sub('', '; '.join(missing))}")


def show_plan(plan: Plan) -> None:
    """Predicted sigmas of a motion and of the better one, what falls short, and what to change."""
    from alidade.pipelines.display.units import human_unit, rounded
    from alidade.pipelines.reports.budget import limits

    limited = {limit.name: limit for limit in limits(plan.best.budget, plan.best.quantities)}
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("parameter", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for column in ("required", "predicted", *(["with changes"] if plan.steps else [])):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("limited by")
    now, best, verdicts = plan.now.sigmas, plan.best.sigmas, plan.now.verdicts
    for q in filter(lambda q: q.judged, plan.now.quantities):
        unit, factor = human_unit(q)
        cells = [rounded(factor * sigma) for sigma in (q.require, now[q.name], best[q.name])]
        verdict = verdicts[q.name]
        most = limited[q.name].parts[0] if q.name in limited else ("", 0.0)
        limit = f"{most[0]}, {100.0 * most[1]:.0f} %" if most[0] else ""
        table.add_row(q.name, unit, *cells[: 3 if plan.steps else 2], f"[{COLOURS[verdict]}]{verdict}[/]", limit)
    console.print(table)
    _say_directions(plan.now.directions)
    if not plan.now.missing:
        say(f"This motion, {plan.now.duration:.0f} s of it, determines everything as accurately as required.")
        return
    say("Better:" if plan.steps else "None of the changes tried determines what is missing.")
    for step in plan.steps:
        say(f"  {step.change} ({step.gain:.1f} nats of what is missing)")
    if plan.best.missing:
        say(f"Still short: {', '.join(f'{name} by {ratio:.2g}' for name, ratio in plan.best.missing.items())}.")
    else:
        say(f"With that, {plan.best.duration:.0f} s determine everything as accurately as required.")


def show_noise(study: NoiseStudy) -> None:
    """A table a sensor, what to know beside it, and the section to paste."""
    from alidade.pipelines.reports.noise import remarks, rows, section, title

    for sensor in study.sensors:
        say(title(sensor))
        table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
        table.add_column("noise", no_wrap=True)
        table.add_column("unit", no_wrap=True)
        for axis in sensor.axes:
            table.add_column(axis, justify="right", no_wrap=True)
        for row in rows(sensor):
            table.add_row(row.name, row.unit, *map(escape, row.cells))
            table.add_row("", row.si_unit, *map(escape, row.si_cells), style="dim")
        console.print(table)
        for remark in remarks(sensor):
            say(f"  {remark}")
        say("")
    for note in study.notes:
        say(f"note: {note}")
    for line in section(study)[1].splitlines():
        say(line)


def _cell(parameter: ParameterResult, factor: float, error_sigmas: float | None, alone: bool) -> str:
    from alidade.pipelines.display.units import rounded, signed, to_digits_of

    value = to_digits_of(parameter.value * factor, parameter.sigma * factor)
    if parameter.sigma == 0.0:
        return f"{value} fixed"
    # Several solvers fit a terminal's 80 columns only with the error below the value.
    error = "" if error_sigmas is None else f"{' ' if alone else chr(10)}({signed(error_sigmas)})"
    return f"{value} ±{rounded(parameter.sigma * factor)}{error}"


def _verdict(calibration: Calibration, name: bool) -> None:
    published = calibration.estimate.solver == "published"
    solver = f"{calibration.estimate.solver}: " if name else ""
    headline, status = calibration.headline, calibration.status
    if published and calibration.directions:
        # The published solvers know their own model only, so they give no advice.
        short = [p.name for p in calibration.parameters.values() if p.observability in ("weak", "unobservable")]
        headline = f"By its own sigmas less accurate than required: {', '.join(short)}."
    console.print(f"{solver}[bold {COLOURS[status]}]{status}.[/] {escape(headline)}", soft_wrap=True)
    _say_directions(() if published else calibration.directions)
    for note in calibration.notes:
        say(f"  note: {note}")


def _say_directions(directions: Sequence[Finding]) -> None:
    """A line a direction: verdict, parameters, advice."""
    from alidade.pipelines.reports.sentences import label

    for direction in directions:
        e = direction.evidence
        say(f"  {direction.severity.name.lower()}: {label(e['weights'])}: {e['advice']}")
