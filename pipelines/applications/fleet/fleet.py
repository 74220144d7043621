"""Calibration of many recordings, each of which is finished once and kept, and its files.

    fleet(["recordings/*.mcap"], out, jobs=2).summary

Each worker reads its own recording and sends back a small mapping; nothing else of a recording reaches this process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alidade.pipelines import errors, methods
from alidade.pipelines.applications.fleet import require_extra
from alidade.pipelines.applications.fleet.analysis import (
    Population,
    counting,
    populations,
    sentence,
    table,
    units_of_interest,
)
from alidade.pipelines.applications.fleet.engine import Killed, source_version, work_off
from alidade.pipelines.applications.fleet.histories import History, change_table, histories, packed
from alidade.pipelines.applications.fleet.recordings import Recording, find, from_metadata, from_name, local
from alidade.pipelines.applications.fleet.store import (
    RecordingResult,
    Store,
    UnitResult,
    csv_text,
    failure,
    quarantined,
    run_isolated,
    settings_key,
    write_parquet,
)
from alidade.pipelines.applications.sharing import walks
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import as_date, load_yaml, plain_json, write_whole
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.recording.container import combined_sha256, file_sha256
from alidade.pipelines.reports.calibration import load_known

if TYPE_CHECKING:
    from alidade.pipelines.estimation.problem import Quantity, SqrtInformation
    from alidade.pipelines.reports.result import Calibration


# In the path of earlier calibrations.
_UNIT = "{unit}"


@dataclass(frozen=True)
class Settings:
    """Settings with which every recording of a fleet is calibrated.

    Attributes:
        method: overrides the recordings' own; None: what fits.
        config: text of a YAML file that overrides the recordings' own config key by key.
        solver: batch, incremental or published.
        window: s, of the incremental solver; None keeps the whole history.
        prior: path or fsspec's address of the earlier calibration that each begins from, `{unit}` in place of the unit;
            None: of none.
    """

    method: str | None = None
    config: str | None = None
    solver: str = "batch"
    window: float | None = 1.0
    prior: str | None = None

    @classmethod
    def of(
        cls, method: str | None, config: Path | None, solver: str, window: float | None, prior: str | None = None
    ) -> Settings:
        """Make settings with the text of a config file. Raises InputError for an unknown method or unusable file."""
        require_extra()
        if method is not None:
            methods.method(method)  # there is one of that name
        if prior is not None:
            prior = prior if "://" in prior else str(Path(prior).absolute())
            if _UNIT not in prior:
                with _earlier(prior):
                    pass  # it can be used
        if config is None:
            return cls(method, None, solver, window, prior)
        load_config(None, config)
        return cls(method, config.read_text(encoding="utf-8"), solver, window, prior)


@dataclass(frozen=True)
class Outcome:
    """The results of a fleet's run.

    Attributes:
        results: by recording, in their order; of those that are finished.
        recordings: how many there are.
        kept: how many had been finished by an earlier run.
        interrupted: Ctrl-C came before the end.
    """

    results: Mapping[str, UnitResult]
    recordings: int
    kept: int
    interrupted: bool

    @property
    def verdicts(self) -> str:
        """How many recordings ended with each status."""
        statuses = [result["status"] for result in self.results.values()]
        return ", ".join(f"{statuses.count(status)} {status}" for status in sorted(set(statuses)))

    @property
    def summary(self) -> list[str]:
        """Summary in a few lines: how many recordings, with what verdicts, and what was quarantined."""
        done = f"{len(self.results)} of {self.recordings} recordings, {self.kept} from an earlier run"
        lines = [f"{done}: {self.verdicts}"]
        aside = [name for name, result in self.results.items() if result["exit_code"] == errors.EXIT_KILLED]
        lines += [f"quarantined, it kills workers: {name}" for name in aside]
        return [*lines, "interrupted; the same command continues"] if self.interrupted else lines


@dataclass(frozen=True, repr=False)
class FleetResult:
    """Results of a calibrated fleet, and the files they are written to.

    Attributes:
        outcome: the results by recording.
        populations: of each parameter over the units.
        histories: of each unit over its recordings.
        written: the files.
    """

    outcome: Outcome
    populations: Sequence[Population]
    histories: Sequence[History]
    written: tuple[Path, ...]

    @property
    def summary(self) -> list[str]:
        """Sentences that sum up the fleet: number of recordings by verdict, and the units that need attention."""
        units = units_of_interest(self.outcome.results, self.populations, self.histories)
        return [*self.outcome.summary, sentence(units)]

    def __repr__(self) -> str:
        return f"<FleetResult: {self.outcome.summary[0]}>"


def fleet(
    recordings: Sequence[str | Path],
    out: str | Path,
    *,
    method: str | None = None,
    config: str | Path | None = None,
    solver: str = "batch",
    window: float | None = 1.0,
    names: str | None = None,
    prior: str | None = None,
    scheduler: str | None = None,
    jobs: int | None = None,
) -> FleetResult:
    """Calibrate recordings of many units (paths or patterns); writes fleet.html and tables to `out` and resumes there.

    Raises:
        InputError: a pattern matches nothing, or a setting cannot be used.
    """
    settings, out = Settings.of(method, None if config is None else Path(config), solver, window, prior), Path(out)
    outcome = calibrate_fleet(find([str(each) for each in recordings]), settings, out, scheduler, jobs, names)
    several = histories(outcome.results, {name: counting(result) for name, result in outcome.results.items()})
    found = populations(outcome.results, several)
    return FleetResult(outcome, found, several, write_fleet(out, outcome, found, several))


def calibrate_fleet(
    recordings: Mapping[str, Recording],
    settings: Settings,
    out: Path,
    scheduler: str | None = None,
    jobs: int | None = None,
    names: str | None = None,
) -> Outcome:
    """Calibrate every recording that has not been finished before with these settings and this version.

    Args:
        recordings: by name.
        settings: for all of them.
        out: folder; results are kept there as they come.
        scheduler: address; None works on this machine.
        jobs: how many local workers.
        names: pattern of the file names, see recordings.from_name.

    Raises:
        InputError: out cannot be written to, no cluster can be had, or a name does not fit.
    """
    named = {name: from_name(name, names) for name in recordings}
    for fields in named.values():
        if "date" in fields:
            as_date(fields["date"])
    store = Store(out, settings_key(source_version(), asdict(settings)), RecordingResult)
    unchanged = {name for name in recordings if _unchanged(recordings[name], settings, store.results.get(name))}
    tasks = {
        name: (recording, settings, named[name].get("unit"), _inputs(store.results.get(name)))
        for name, recording in recordings.items()
        if name not in unchanged
    }
    fresh: dict[str, RecordingResult] = {}  # that are not to be kept

    def take(name: str, result: Any) -> None:
        if isinstance(result, Killed):
            fresh[name] = quarantined()
        elif result is None:
            unchanged.add(name)
        elif "sha256" in result:
            store.add(name, result)
        else:
            fresh[name] = result

    with store:
        interrupted = work_off(calibrate_recording, tasks, take, "calibrating", scheduler, jobs)
    known = {**{name: store.results[name] for name in recordings if name in store.results}, **fresh}
    results = {name: _placed(name, known[name], named[name]) for name in recordings if name in known}
    return Outcome(results, len(recordings), len(unchanged), interrupted)


def calibrate_recording(
    recording: Recording, settings: Settings, unit: str | None = None, known: tuple[str, str | None] | None = None
) -> RecordingResult | None:
    """Calibrate one recording on the worker; None if the known result was made from the same files.

    A result without `sha256` is of a file that could not be read at all; the next run tries again.

    Args:
        recording: where it is.
        settings: how.
        unit: as the file's name has it.
        known: SHA-256 of the recording and of the earlier calibration that the result known was made of.
    """
    try:
        with local(recording.file, recording.is_bag) as path:
            stated = from_metadata(path)
            if "date" in stated:
                as_date(stated["date"])  # refused where it is none
            with _prior(settings, unit or stated.get("unit") or Path(recording.file.path).stem) as prior:
                result: Any = {"sha256": _sha256(path), "prior_sha256": prior and _sha256(prior), **stated}
                if _inputs(result) == known:
                    return None
                found: RecordingResult = run_isolated(_summary, partial(_calibration, path, settings, prior))
                return {**result, "tag": recording.tag, **found}
    except (OSError, InputError) as error:
        return failure(errors.EXIT_BAD_INPUT, str(error))


def _inputs(result: RecordingResult | None) -> tuple[str, str | None] | None:
    """Return the SHA-256 of the recording and of the prior that a result was made from; None without a result."""
    return (result["sha256"], result["prior_sha256"]) if result else None


def _unchanged(recording: Recording, settings: Settings, kept: RecordingResult | None) -> bool:
    """Whether the tag in the listing shows that a kept result is up to date, so that no file is to be fetched."""
    return bool(kept and recording.tag and kept.get("tag") == recording.tag and settings.prior is None)


def _prior(settings: Settings, unit: str) -> AbstractContextManager[Path | None]:
    """Context manager of the local file of the earlier calibration that a unit begins from; None without one."""
    return nullcontext() if settings.prior is None else _earlier(settings.prior.replace(_UNIT, unit))


@contextmanager
def _earlier(address: str) -> Iterator[Path]:
    import fsspec

    with local(fsspec.open(address)) as path:
        load_known(path)
        yield path


def _calibration(path: Path, settings: Settings, prior: Path | None) -> Calibration:
    from alidade.pipelines.applications.session import open_session

    config = None if settings.config is None else load_yaml(settings.config, "config")
    session = open_session(path, settings.method, config, prior=prior)
    return session.calibrate(settings.solver, settings.window, report=False)


def _summary(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration that a fleet compares and keeps, SI."""
    names = [q.name for q in calibration.problem.quantities]
    return {
        "start_ns": calibration.facts.epoch_ns,
        "duration_s": calibration.facts.duration_s,
        "method": calibration.problem.method,
        "device": walks(calibration.method, calibration.config, names),
        "told": packed(_sqrt_information(calibration)),
        "parameters": {
            p.name: {
                "value": p.value,
                "sigma": p.sigma,
                "unit": p.unit,
                "require": p.require,
                "verdict": p.observability or _up_to_factor(calibration.quantities[p.name], p.sigma),
                "inflation": p.inflation,
            }
            for p in calibration.parameters.values()
        },
    }


def _up_to_factor(quantity: Quantity, sigma: float) -> str | None:
    """Verdict on a parameter that is required up to a factor in common with others; None if it is not required."""
    return "observable" if quantity.required and quantity.determined(sigma) else None


def _sqrt_information(calibration: Calibration) -> SqrtInformation:
    """Return a calibration's square-root information on its parameters; if the solver has none, from the covariance."""
    from alidade.pipelines.solvers.posterior import sqrt_information_of

    estimate = calibration.estimate
    if estimate.sqrt_info is not None:
        return estimate.sqrt_info
    scales = {q.name: q.prior_scale for q in calibration.problem.quantities}
    known = [name for name, sigma in zip(estimate.names, estimate.sigmas, strict=True) if sigma > 0.0]
    gaussian_prior = GaussianPrior(estimate.names, estimate.values, estimate.covariance).of(known)
    return sqrt_information_of(gaussian_prior, [scales[name] for name in gaussian_prior.names])


def _placed(name: str, result: RecordingResult, named: Mapping[str, str]) -> UnitResult:
    """Return a result with unit and date: by the file's name, else the metadata, else file name and start."""
    unit = named.get("unit") or result.get("unit") or Path(name).stem
    text = named.get("date") or result.get("date")
    date = as_date(text).timestamp() if text else result.get("start_ns", 0) * 1e-9 or None
    return {**result, "unit": unit, "date": date}


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files in a folder, hexadecimal."""
    return combined_sha256(map(file_sha256, sorted(path.iterdir()))) if path.is_dir() else file_sha256(path)


def write_fleet(out: Path, outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> tuple[Path, ...]:
    """Write a fleet's report and tables (CSV, Parquet), all of them or none; returns their paths."""
    from alidade.pipelines.applications.fleet.pages import fleet_report
    from alidade.pipelines.reports.html import render_html

    rows = table(outcome.results, fleet)
    return write_whole(
        out,
        {
            "fleet.csv": csv_text(rows),
            "fleet.parquet": partial(write_parquet, rows=rows),
            "changes.csv": csv_text(change_table(found)),
            "fleet.html": render_html(fleet_report(outcome, fleet, found)),
        },
    )


def fleet_json(found: FleetResult) -> str:
    """JSON of `fleet`: rows of fleet.csv and changes.csv, components of every parameter, who needs attention."""
    outcome, fleet, histories = found.outcome, found.populations, found.histories
    return plain_json(
        "fleet",
        {
            "recordings": table(outcome.results, fleet),
            "changes": change_table(histories),
            "attention": units_of_interest(outcome.results, fleet, histories),
            "parameters": [
                {"name": p.name, "method": p.method, "of_device": p.of_device}
                | {"population": p.population, "repeatability": p.repeatability}
                for p in fleet
            ],
            "wanted": outcome.recordings,
            "interrupted": outcome.interrupted,
        },
    )
