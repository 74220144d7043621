"""Histories of units that were recorded several times, tested for changes as recordings of one device are.

The recordings of a unit are joined as `calibrate` joins them, linear about each one's own estimate. What belongs to a
recording is its own; priors and assumptions count once. Significance is counted over all units of the fleet.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.store import Row, UnitResult
from alidade.pipelines.applications.sharing import DAY_S
from alidade.pipelines.diagnostics.device_changes import Change, Changes, changes
from alidade.pipelines.estimation.problem import SqrtInformation
from alidade.pipelines.solvers.joint import grown, join


@dataclass(frozen=True)
class History:
    """The calibrations of a unit over its recordings.

    Attributes:
        unit: its name.
        method: of its recordings.
        recordings: their names, in the order of their dates; two at least.
        dates: of these, Unix s.
        changes: steps of the device between them.
        found: those that the unit is to be looked after for.
    """

    unit: str
    method: str
    recordings: tuple[str, ...]
    dates: tuple[float, ...]
    changes: Changes
    found: tuple[Change, ...]

    def after(self, step: Change) -> tuple[str, ...]:
        """Return the names of the unit's recordings after a step."""
        return self.recordings[step.after + 1 :]

    @property
    def together(self) -> tuple[int, ...]:
        """Indexes of recordings after which all parameters together changed, if none changed by itself."""
        return tuple(each.after for each in self.changes.jointly)


def packed(sqrt_info: SqrtInformation) -> str:
    """The square-root information of a recording as text, R and d in triangular form."""
    triangle = np.linalg.qr(np.column_stack([sqrt_info.R, sqrt_info.d])).R
    with io.BytesIO() as stream:
        kept = {name: each for name, each in vars(sqrt_info).items() if name != "added"}
        np.savez_compressed(stream, **{**kept, "R": triangle[:, :-1], "d": triangle[:, -1]})
        return base64.b64encode(stream.getvalue()).decode()


def unpacked(text: str) -> SqrtInformation:
    """Return the square-root information in a text that `packed` made."""
    with np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False) as arrays:
        return SqrtInformation(**{**arrays, "names": tuple(arrays["names"].tolist())})


def histories(results: Mapping[str, UnitResult], asked: Mapping[str, Sequence[str]]) -> list[History]:
    """Histories of all units that were recorded several times.

    Args:
        results: of the fleet, by recording.
        asked: recording -> its parameters that count; none: the recording does not.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for recording, result in results.items():
        if asked.get(recording):
            groups.setdefault((result["unit"], result["method"]), []).append(recording)
    several = {group: names for group, names in groups.items() if len(names) > 1}
    level = statistics.FALSE_ALARM / max(len(several), 1)
    return _red([_history(results, unit, method, names, asked, level) for (unit, method), names in several.items()])


def change_table(found: Sequence[History]) -> list[Row]:
    """Return the rows of changes.csv: each step of a device's parameter between two recordings, SI."""
    return [
        {
            "unit": history.unit,
            "method": history.method,
            "parameter": step.name,
            "before": history.recordings[step.after],
            "after": history.recordings[step.after + 1],
            "difference": step.size,
            "sigma": step.sigma,
            "z": step.z,
            "changed": int(step in history.found),
        }
        for history in found
        for step in history.changes.steps
    ]


def _history(
    results: Mapping[str, UnitResult],
    unit: str,
    method: str,
    recordings: Sequence[str],
    asked: Mapping[str, Sequence[str]],
    level: float,
) -> History:
    at = {recording: results[recording]["date"] or 0.0 for recording in recordings}
    order = sorted(recordings, key=lambda recording: at[recording])
    parameters = [results[recording]["parameters"] for recording in order]
    days = [at[recording] / DAY_S for recording in order]
    joined = join([unpacked(results[recording]["told"]) for recording in order], results[order[-1]]["device"], days)
    names = {name for recording in order for name in asked[recording]}
    known = {name: [each[name] for each in parameters if name in each] for name in set().union(*parameters)}
    inflations = {name: grown([p["sigma"] for p in own], [p["inflation"] for p in own]) for name, own in known.items()}
    found = changes(joined, days, inflations, names, level)
    dates = tuple(at[recording] for recording in order)
    return History(unit, method, tuple(order), dates, found, found.found)


def _red(each: Sequence[History]) -> list[History]:
    """Return the histories without steps that most units make as well, of parameters that vary by nature."""
    made: dict[tuple[str, str], list[Change]] = {}
    for history in each:
        for step in history.changes.steps:
            made.setdefault((history.method, step.name), []).append(step)
    usual = {}
    for key, steps in made.items():
        if statistics.varies(np.array([step.z for step in steps])):
            sizes, sigmas = np.array([(step.size, step.sigma) for step in steps]).T
            usual[key] = statistics.spread(sizes, sigmas, centre=0.0)
    tests = sum(map(len, made.values()))

    def beyond(method: str, step: Change) -> bool:
        spread = usual.get((method, step.name))
        if spread is None:
            return True
        z = spread.z(np.array([step.size]), np.array([step.sigma]))
        return bool(abs(z[0]) > statistics.limit(tests, len(made[method, step.name])))

    return [replace(h, found=tuple(step for step in h.found if beyond(h.method, step))) for h in each]
