"""What the calibrations of a fleet say together: each parameter across units and dates, and what stands out.

A recording counts when it is calibrated or weak, a parameter when the recording rather than the prior determined it:
the others' sigmas mean nothing here.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines import methods
from pipelines.fleet import statistics
from pipelines.fleet.statistics import Array, Spread, Trend
from pipelines.fleet.store import Result
from pipelines.fleet.tables import Cell, Row
from pipelines.sharing import of_recording

DAY = 86400.0
_COUNTED = {"calibrated", "weak"}
_DETERMINED = {"observable", "weak"}


@dataclass(frozen=True)
class Change:
    """A parameter of one unit at two dates: `before` and `after` are places in its population.

    Attributes:
        difference: after minus before, SI; `sigma` by the two recordings' own sigmas.
        z: the difference in sigmas.
        changed: more than the sigmas allow and, where sessions differ by nature, more than those of other units.
    """

    unit: str
    before: int
    after: int
    difference: float
    sigma: float
    z: float
    changed: bool


@dataclass(frozen=True, eq=False)
class Population:
    """One parameter across a fleet; arrays (n,) over the recordings that determine it.

    Attributes:
        method: of the recordings.
        name: the parameter's.
        unit: SI.
        require: accuracy wanted; None: none is.
        recordings: their names; `units` are what they show.
        dates: Unix s.
        values: SI; `sigmas` their own.
        spread: None from fewer than five.
        z: distance from the centre in standard deviations, NaN without a spread.
        outlying: farther than chance would have it anywhere in the fleet.
        drift: per day, of the whole fleet; `drifts` when it is more than chance.
        changes: of units that were measured several times.
        repeatability: how much sessions of one unit differ beyond their sigmas, standard deviation; None where the
            sigmas explain the differences of most units.
    """

    method: str
    name: str
    unit: str
    require: float | None
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
    changes: tuple[Change, ...]
    repeatability: float | None

    @property
    def control(self) -> tuple[float, float] | None:
        """Lower and upper control limit, three standard deviations about the centre, for the typical sigma."""
        if self.spread is None:
            return None
        reach = 3.0 * float(np.hypot(self.spread.tau, np.median(self.sigmas)))
        return self.spread.centre - reach, self.spread.centre + reach

    @property
    def beyond(self) -> int:
        """Recordings more than three standard deviations off, each with its own sigma."""
        return int((np.abs(self.z) > 3.0).sum())


def populations(results: Mapping[str, Result]) -> list[Population]:
    """Every parameter of the fleet, in the order of the recordings' own lists."""
    members: dict[tuple[str, str], list[str]] = {}
    for recording, result in results.items():
        for name in _counting(result):
            members.setdefault((result["method"], name), []).append(recording)
    sizes = [len(recordings) for recordings in members.values()]
    pairs = [len(_pairs(results, recordings)) for recordings in members.values()]
    return [
        _population(results, method, name, recordings, sum(sizes), sum(pairs), len(sizes))
        for (method, name), recordings in members.items()
    ]


def table(results: Mapping[str, Result], fleet: Sequence[Population]) -> list[Row]:
    """A row a recording: what became of it, then value, sigma and z of every parameter, SI."""
    z = {(r, p.name): float(p.z[i]) for p in fleet if p.spread for i, r in enumerate(p.recordings)}
    rows: list[Row] = []
    for recording, result in results.items():
        row: dict[str, Cell] = {"recording": recording, "unit": result["unit"], "date": iso(result["date"])}
        row |= {key: result.get(key) for key in ("method", "status", "exit_code", "reason", "duration_s", "seconds")}
        row["sha256"] = result.get("sha256")
        for name, parameter in result["parameters"].items():
            row |= {
                name: parameter["value"],
                f"{name}_sigma": parameter["sigma"],
                f"{name}_z": z.get((recording, name)),
            }
        rows.append(row)
    return rows


def change_table(fleet: Sequence[Population]) -> list[Row]:
    """A row a change of a unit that was measured several times, SI."""
    return [
        {
            "unit": c.unit,
            "method": p.method,
            "parameter": p.name,
            "before": p.recordings[c.before],
            "after": p.recordings[c.after],
            "difference": c.difference,
            "sigma": c.sigma,
            "z": c.z,
            "changed": int(c.changed),
        }
        for p, c in every_change(fleet)
    ]


def every_change(fleet: Sequence[Population]) -> Iterator[tuple[Population, Change]]:
    """All changes with their populations."""
    return ((p, c) for p in fleet for c in p.changes)


def iso(date: float | None) -> str | None:
    """Unix s as ISO 8601, UTC, to the second."""
    if date is None:
        return None
    return datetime.datetime.fromtimestamp(round(date), datetime.UTC).isoformat().replace("+00:00", "Z")


def _counting(result: Result) -> list[str]:
    """The parameters of a recording that count."""
    if result["status"] not in _COUNTED:
        return []
    return [name for name, p in result["parameters"].items() if p["verdict"] in _DETERMINED]


def _pairs(results: Mapping[str, Result], recordings: Sequence[str]) -> list[tuple[str, int, int]]:
    """(unit, before, after) of what is to be compared, as places in the list."""
    places: dict[str, list[int]] = {}
    for i, recording in enumerate(recordings):
        places.setdefault(results[recording]["unit"], []).append(i)
    return [
        (unit, group[a], group[b])
        for unit, group in places.items()
        for a, b in statistics.changes([results[recordings[i]]["date"] for i in group])
    ]


def _population(
    results: Mapping[str, Result],
    method: str,
    name: str,
    recordings: Sequence[str],
    tests: int,
    comparisons: int,
    parameters: int,
) -> Population:
    found = [results[recording]["parameters"][name] for recording in recordings]
    dates = np.array([results[recording]["date"] for recording in recordings], dtype=float)
    values = np.array([p["value"] for p in found])
    sigmas = np.array([p["sigma"] for p in found])
    count = len(values)
    spread = statistics.spread(values, sigmas) if count >= statistics.ENOUGH else None
    z = spread.z(values, sigmas) if spread else np.full(count, np.nan)
    outlying = np.abs(z) > statistics.limit(tests, count) if spread else np.zeros(count, dtype=bool)
    drift = None
    if spread:
        good = ~outlying
        scatter = np.hypot(spread.tau, sigmas)
        drift = statistics.trend(dates[good] / DAY, values[good], scatter[good])
    own = of_recording(methods.method(method), name)
    changes, repeatability = _changes(_pairs(results, recordings), values, sigmas, comparisons, own)
    return Population(
        method=method,
        name=name,
        unit=found[0]["unit"],
        require=found[0]["require"],
        recordings=tuple(recordings),
        units=tuple(results[recording]["unit"] for recording in recordings),
        dates=dates,
        values=values,
        sigmas=sigmas,
        spread=spread,
        z=z,
        outlying=outlying,
        drift=drift,
        drifts=drift is not None and abs(drift.z) > statistics.limit(parameters, count),
        changes=changes,
        repeatability=repeatability,
    )


def _changes(
    pairs: Sequence[tuple[str, int, int]], values: Array, sigmas: Array, comparisons: int, own: bool
) -> tuple[tuple[Change, ...], float | None]:
    """The changes, and how much sessions of one unit differ by nature if they do; `own` numbers of a recording may."""
    if not pairs:
        return (), None
    before = np.array([pair[1] for pair in pairs])
    after = np.array([pair[2] for pair in pairs])
    difference, sigma = values[after] - values[before], np.hypot(sigmas[after], sigmas[before])
    z = difference / sigma
    changed = np.abs(z) > statistics.limit(comparisons)
    repeatability = None
    if statistics.varies(z):
        usual = statistics.spread(difference, sigma, centre=0.0)
        repeatability = usual.tau / 2.0**0.5
        changed &= np.abs(usual.z(difference, sigma)) > statistics.limit(comparisons, len(pairs))
    if own:
        changed[:] = False
    rows = zip(pairs, difference, sigma, z, changed, strict=True)
    return tuple(
        Change(unit, a, b, float(d), float(s), float(q), bool(flag)) for (unit, a, b), d, s, q, flag in rows
    ), repeatability
