"""Joint analysis of the calibrations of a fleet: each parameter across units and dates, and what stands out.

A recording counts when it is calibrated or weak, a parameter when the recording rather than the prior determined it:
the others' sigmas mean nothing here. Values scatter by what units differ (population), by what recordings of one unit
differ (repeatability: of a number of the recording, as a turn-on bias, by nature) and by their own sigmas.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.histories import History
from alidade.pipelines.applications.fleet.statistics import Component, Spread, Trend
from alidade.pipelines.applications.fleet.store import RecordingResult, UnitResult
from alidade.pipelines.applications.fleet.tables import Cell, Row
from alidade.pipelines.applications.sharing import DAY_S

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
    outlying: NDArray[np.bool_]
    drift: Trend | None
    drifts: bool
    changed: NDArray[np.bool_]
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
