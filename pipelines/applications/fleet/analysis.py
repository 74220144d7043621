"""Joint analysis of the calibrations of a fleet: each parameter across units and dates, and who needs attention.

A recording counts when it is calibrated or weak, a parameter when the recording rather than the prior determined it:
the others' sigmas mean nothing here. Values scatter by what units differ (population), by what recordings of one unit
differ (repeatability: of a number of the recording, as a turn-on bias, by nature) and by their own sigmas.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.histories import History
from alidade.pipelines.applications.fleet.statistics import Component, Spread, Trend
from alidade.pipelines.applications.fleet.store import Cell, RecordingResult, Row, UnitResult
from alidade.pipelines.applications.sharing import DAY_S
from alidade.pipelines.diagnostics.device_changes import Change
from alidade.pipelines.display.units import shown_unit, to_digits_of
from alidade.pipelines.reports.joint_report import what

_COUNTED = {"calibrated", "weak"}
_DETERMINED = {"observable", "weak"}


@dataclass(frozen=True, eq=False)
class Population:
    """One parameter across a fleet; arrays (n,) over the recordings that determine it.

    Attributes:
        method: of the recordings.
        name: the parameter's.
        unit: SI.
        require: accuracy wanted; None: none is.
        of_device: whether it is the device's; else each recording has its own.
        recordings: their names; `units` are what they show.
        dates: Unix s.
        values: SI; `sigmas` their own.
        spread: None from fewer than five.
        z: distance from the centre in standard deviations, NaN without a spread.
        outlying: farther than chance would have it anywhere in the fleet.
        drift: per day, of the whole fleet; `drifts` when it is more than chance.
        changed: of units that changed in it, those after the change.
        population: standard deviation from unit to unit; None from fewer than five units.
        repeatability: from recording to recording of one unit; None where no unit has several.
    """

    method: str
    name: str
    unit: str
    require: float | None
    of_device: bool
    recordings: tuple[str, ...]
    units: tuple[str, ...]
    dates: Array
    values: Array
    sigmas: Array
    spread: Spread | None
    z: Array
    outlying: Mask
    drift: Trend | None
    drifts: bool
    changed: Mask
    population: Component | None
    repeatability: Component | None

    @property
    def control(self) -> tuple[float, float] | None:
        """Lower and upper control limit: centre -+ 3 standard deviations, at the median sigma; None without spread."""
        if self.spread is None:
            return None
        reach = 3.0 * float(np.hypot(self.spread.tau, np.median(self.sigmas)))
        return self.spread.centre - reach, self.spread.centre + reach

    @property
    def beyond(self) -> int:
        """Number of recordings more than three standard deviations off the centre, each by its own sigma."""
        return int((np.abs(self.z) > 3.0).sum())


def counting(result: RecordingResult | UnitResult) -> list[str]:
    """Return the names of the parameters that a recording determines, by which it is compared with others."""
    if result["status"] not in _COUNTED:
        return []
    return [name for name, p in result["parameters"].items() if p["verdict"] in _DETERMINED]


def populations(results: Mapping[str, UnitResult], histories: Sequence[History] = ()) -> list[Population]:
    """Return a Population for each parameter of the fleet, in the recordings' order; `histories` mark changed units."""
    members: dict[tuple[str, str], list[str]] = {}
    for recording, result in results.items():
        for name in counting(result):
            members.setdefault((result["method"], name), []).append(recording)
    tests = sum(len(recordings) for recordings in members.values())
    changed = {(h.method, step.name, recording) for h in histories for step in h.found for recording in h.after(step)}
    return [
        _population(results, method, name, recordings, tests, len(members), changed)
        for (method, name), recordings in members.items()
    ]


def table(results: Mapping[str, UnitResult], fleet: Sequence[Population]) -> list[Row]:
    """Return a row for each recording: status, then value, sigma and z of every parameter, SI."""
    z = {(r, p.name): float(p.z[i]) for p in fleet if p.spread for i, r in enumerate(p.recordings)}
    rows: list[Row] = []
    for recording, result in results.items():
        row: dict[str, Cell] = {"recording": recording, "unit": result["unit"], "date": iso(result["date"])}
        cells = cast("Mapping[str, Cell]", result)
        keys = ("method", "status", "exit_code", "reason", "duration_s", "seconds", "sha256")
        row |= {key: cells.get(key) for key in keys}
        for name, parameter in result["parameters"].items():
            row |= {
                name: parameter["value"],
                f"{name}_sigma": parameter["sigma"],
                f"{name}_z": z.get((recording, name)),
            }
        rows.append(row)
    return rows


def iso(date: float | None) -> str | None:
    """Return a time, Unix s, as ISO 8601 in UTC, to the second."""
    if date is None:
        return None
    return datetime.datetime.fromtimestamp(round(date), datetime.UTC).isoformat().replace("+00:00", "Z")


def _population(
    results: Mapping[str, UnitResult],
    method: str,
    name: str,
    recordings: Sequence[str],
    tests: int,
    parameters: int,
    changed: set[tuple[str, str, str]],
) -> Population:
    found = [results[recording]["parameters"][name] for recording in recordings]
    units = tuple(results[recording]["unit"] for recording in recordings)
    dates = np.array([results[recording]["date"] for recording in recordings], dtype=float)
    values = np.array([p["value"] for p in found])
    sigmas = np.array([p["sigma"] for p in found])
    count = len(values)
    spread = statistics.spread(values, sigmas) if count >= statistics.ENOUGH else None
    z = spread.z(values, sigmas) if spread else np.full(count, np.nan)
    outlying = np.abs(z) > statistics.limit(tests, count) if spread else np.zeros(count, dtype=bool)
    after = np.array([(method, name, recording) in changed for recording in recordings], dtype=bool)
    drift = None
    if spread:
        good = ~outlying
        scatter = np.hypot(spread.tau, sigmas)
        drift = statistics.trend(dates[good] / DAY_S, values[good], scatter[good])
    # Steps would count as repeatability: a unit that made one counts as it was before it.
    good = ~outlying & ~after
    groups = np.unique(units, return_inverse=True)[1]
    population, repeatability = statistics.components(values[good], sigmas[good], groups[good])
    return Population(
        method=method,
        name=name,
        unit=found[0]["unit"],
        require=found[0]["require"],
        of_device=name in results[recordings[0]]["device"],
        recordings=tuple(recordings),
        units=units,
        dates=dates,
        values=values,
        sigmas=sigmas,
        spread=spread,
        z=z,
        outlying=outlying,
        drift=drift,
        drifts=drift is not None and abs(drift.z) > statistics.limit(parameters, count),
        changed=after,
        population=population,
        repeatability=repeatability,
    )


Kind = Literal["changed", "outlying", "failed", "inconsistent", "unobservable", "weak"]
# In the order of how much they matter.
_KINDS: tuple[Kind, ...] = ("changed", "outlying", "inconsistent", "failed", "unobservable", "weak")
_MOST_NAMED = 12


@dataclass(frozen=True)
class Finding:
    """Finding about a unit that stands out; `z` is the distance, sigmas, None for a finding without a distance."""

    kind: Kind
    text: str
    z: float | None = None


@dataclass(frozen=True)
class Unit:
    """Unit of the fleet with its findings, the worst first."""

    name: str
    findings: tuple[Finding, ...]


def units_of_interest(
    results: Mapping[str, UnitResult], fleet: Sequence[Population], found: Sequence[History]
) -> list[Unit]:
    """Return the units that need attention: changed units first, then outliers by distance."""
    units: dict[str, list[Finding]] = {}
    populations = {(p.method, p.name): p for p in fleet}
    for history in found:
        units.setdefault(history.unit, []).extend(_changed(history, populations))
    for p in fleet:
        for i in _farthest(p):
            units.setdefault(p.units[i], []).append(_outlying(p, i))
    for recording, result in results.items():
        if result["status"] != "calibrated":
            reason = result["reason"].removeprefix(f"{recording}: ") or result["status"]
            text = f"{Path(recording).name}, exit code {result['exit_code']}: {reason}"
            units.setdefault(result["unit"], []).append(Finding(result["status"], text))
    sorted_ = [Unit(name, tuple(sorted(each, key=_order))) for name, each in units.items() if each]
    return sorted(sorted_, key=lambda unit: _order(unit.findings[0]))


def sentence(units: Sequence[Unit]) -> str:
    """Sentence that names the units that need attention, the first few of many."""
    if not units:
        return "no unit needs attention"
    more = len(units) - _MOST_NAMED
    named = ", ".join(unit.name for unit in units[:_MOST_NAMED])
    need = "unit needs" if len(units) == 1 else "units need"
    return f"{len(units)} {need} attention: {named}{f' and {more} more' if more > 0 else ''}"


def _order(finding: Finding) -> tuple[int, float]:
    return _KINDS.index(finding.kind), -abs(finding.z or 0.0)


def _changed(history: History, fleet: Mapping[tuple[str, str], Population]) -> list[Finding]:
    def between(after: int) -> str:
        return f"between {_day(history.dates[after])} and {_day(history.dates[after + 1])}"

    def step_text(step: Change) -> str:
        p = fleet[history.method, step.name]
        unit, factor = shown_unit(p.unit, p.require)
        size, sigma = (to_digits_of(factor * x, factor * step.sigma) for x in (step.size, step.sigma))
        return f"{what(step)} by {size} ± {sigma} {unit} ".rstrip() + f" {between(step.after)}"

    jointly = [
        Finding("changed", f"all parameters together {between(after)}, none by more than chance for itself")
        for after in history.together
    ]
    return [*(Finding("changed", step_text(step), step.z) for step in history.found), *jointly]


def _farthest(p: Population) -> list[int]:
    """Return the index of the farthest recording of each outlying unit."""
    far: dict[str, int] = {}
    for i in np.flatnonzero(p.outlying).tolist():
        if abs(p.z[i]) > abs(p.z[far.setdefault(p.units[i], i)]):
            far[p.units[i]] = i
    return list(far.values())


def _outlying(p: Population, i: int) -> Finding:
    assert p.spread is not None  # without one nothing is outlying
    unit, factor = shown_unit(p.unit, p.require)
    off, scale = factor * (p.values[i] - p.spread.centre), factor * float(np.hypot(p.spread.tau, p.sigmas[i]))
    text = f"{p.name} is {to_digits_of(off, scale)} {unit} ".rstrip()
    return Finding("outlying", f"{text} off the fleet's centre ({_day(p.dates[i])})", float(p.z[i]))


def _day(date: float) -> str:
    return (iso(date) or "")[:16].replace("T", " ").removesuffix(" 00:00")
