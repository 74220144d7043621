"""A device over several recordings in words, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle

import numpy as np

from alidade.pipelines.diagnostics.device_changes import Change
from alidade.pipelines.display.figure import COLORS, Figure, Plot, milliseconds
from alidade.pipelines.display.table import Table
from alidade.pipelines.display.units import format_estimate, human_unit, minute, rounded
from alidade.pipelines.estimation.parameters import kind
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import PartResult
from alidade.pipelines.reports.sentences import between

# Beyond so many days a forecast says nothing.
_FAR_DAYS = 36_525.0
_DAY_MS, _STEPS = 8.64e7, 40
_RECORDINGS = ("recording", "start", "length", "by itself")


def forecasts(calibration: Calibration) -> list[tuple[str, str]]:
    """Return for each kind of parameters when it has to be calibrated again, in words."""
    changes = calibration.changes
    if changes is None:
        return []
    forecast = []
    for q in calibration.problem.quantities:
        rate = changes.rates.get(kind(q.name))
        found = calibration.parameters.get(q.name)
        if rate is None or found is None or not q.judged:
            continue
        unit, factor = human_unit(q)
        per_day = f"{rounded(factor * rate.rate)} {unit}".strip()
        at_most = rounded(factor * rate.upper) if math.isfinite(rate.upper) else "unknown"
        likely, soonest = (_days(q.require, found.sigma, each) for each in (rate.rate, rate.upper))
        forecast.append((q.name, f"walks {per_day} in the root of a day (at most {at_most}); {_when(likely, soonest)}"))
    return forecast


def _days(require: float, sigma: float, rate: float) -> float:
    """Return the days until a sigma that grows by a random walk exceeds the required one."""
    return max(require**2 - sigma**2, 0.0) / rate**2 if rate > 0.0 else math.inf


def _when(likely: float, soonest: float) -> str:
    if likely > _FAR_DAYS and soonest > _FAR_DAYS:
        return "within what is required for longer than anybody asks"
    first = "for good" if likely > _FAR_DAYS else f"for {likely:.0f} days"
    surely = "surely" if math.isfinite(soonest) else "perhaps"
    return f"within what is required {first}, {surely} for {min(soonest, _FAR_DAYS):.0f}"


def recording_blocks(calibration: Calibration) -> list[Plot | Table]:
    """Return tables and figures of the recordings of a joint calibration, for the report."""
    parts, known = calibration.recordings, {q.name: q for q in calibration.problem.quantities}
    rows = tuple((p.recording, minute(p.start), f"{p.duration_s:.0f} s", p.status) for p in parts)
    own = []
    for name in dict.fromkeys(n.name for p in parts for n in p.parameters if n.name in known):
        numbers = [next((n for n in p.parameters if n.name == name), None) for p in parts]
        own.append((name, *("" if n is None else format_estimate(known[name], n.value, n.sigma) for n in numbers)))
    heads = ("parameter", *(p.recording for p in parts))
    changes = calibration.changes
    found = [] if changes is None else sorted(changes.found, key=lambda step: step.after)
    steps = tuple(
        (what(s), _between(s.after, parts), format_estimate(known[s.name], s.size, s.sigma), f"{s.z:+.1f}")
        for s in found
    )
    tables = [
        Table("Recordings", "In the order of their dates, each with its verdict by itself.", _RECORDINGS, rows),
        Table("Of the recordings", "What each recording has of its own, from all of them.", heads, tuple(own)),
        Table("Changes", _CHANGES, ("what", "when", "step", "sigmas"), steps),
        Table("Calibration interval", _INTERVAL, ("parameter", "forecast"), tuple(forecasts(calibration))),
    ]
    return [*(table for table in tables if table.rows), *_figures(calibration)]


_CHANGES = "Steps of the device between recordings that are more than chance, which makes any in one history of twenty."
_INTERVAL = (
    "How far the parameters walk, by the likelihood of all recordings, and how long the calibration stays within the "
    "accuracy wanted if they go on so."
)


def _figures(calibration: Calibration) -> list[Plot]:
    """Plot each kind of parameters by each recording alone, with the joint estimate as a band."""
    parts, names = calibration.recordings, [p.name for p in calibration.recordings[-1].alone]
    known = {q.name: q for q in calibration.problem.quantities if q.judged and q.name in names}
    plots = []
    for which in dict.fromkeys(map(kind, known)):
        own = [q for name, q in known.items() if kind(name) == which]
        unit, factor = human_unit(own[0])
        out = Figure(f"{which}, {unit}".removesuffix(", "), "date of the recording", x_scale="datetime")
        for q, color in zip(own, cycle(COLORS), strict=False):
            _add(out, calibration, q, factor, color)
        caption = (
            f"Points: each of the {len(parts)} recordings by itself, less the joint estimate, with two sigmas. Bands: "
            "two sigmas of the joint estimate, after the last recording as the walk lets them grow; dotted: two of the "
            "sigmas wanted. Steps that were found are dashed lines."
        )
        plots.append(Plot(f"{which} over time", caption, out))
    return plots


def _add(out: Figure, calibration: Calibration, q: Quantity, factor: float, color: str) -> None:
    parts, joint = calibration.recordings, calibration.parameters[q.name]
    alone = [(p.start, n) for p in parts for n in p.alone if n.name == q.name]
    dates = milliseconds(start for start, _ in alone)
    values = factor * np.array([n.value - joint.value for _, n in alone])
    spread = 2.0 * factor * np.array([n.sigma for _, n in alone])
    out.segments(dates, values - spread, dates, values + spread, color, q.name)
    out.points(dates, values, q.name, color, 7)
    _band(out, calibration, q, factor, color)
    out.levels([-2.0 * factor * q.require, 2.0 * factor * q.require], color, name=q.name)
    steps = [step for step in (calibration.changes.found if calibration.changes else ()) if step.name == q.name]
    if steps:
        out.moments(milliseconds(parts[step.after + 1].start for step in steps), color, name=q.name)


def _band(out: Figure, calibration: Calibration, q: Quantity, factor: float, color: str) -> None:
    """Draw two sigmas of the joint estimate at each recording, and their growth by the walk after the last one."""
    parts, joint = calibration.recordings, calibration.parameters[q.name]
    own = [next((n for n in p.parameters if n.name == q.name), None) for p in parts]
    values = [0.0 if n is None else n.value - joint.value for n in own]
    sigmas = [joint.sigma if n is None else n.sigma for n in own]
    dates = milliseconds(p.start for p in parts)
    rate = calibration.changes.rates.get(kind(q.name)) if calibration.changes else None
    if rate is not None and rate.rate > 0.0:
        # As long as it stays within what is required, at most as long as the history.
        length = (dates[-1] - dates[0]) / _DAY_MS
        ahead = np.linspace(0.0, min(length, _days(q.require, joint.sigma, rate.rate)), _STEPS)
        dates = np.concatenate([dates, dates[-1] + ahead * _DAY_MS])
        values += [0.0] * _STEPS
        sigmas += np.sqrt(joint.sigma**2 + rate.rate**2 * ahead).tolist()
    middle, reach = factor * np.array(values), 2.0 * factor * np.array(sigmas)
    out.band(dates, middle - reach, middle + reach, color, q.name)


def what(step: Change) -> str:
    """Return words for a change: a mount that moved about an axis, or a parameter that changed."""
    which, _, axis = step.name.rpartition("_")
    return f"{which} about {axis} moved" if which.endswith("mount") and axis in "xyz" else f"{step.name} changed"


def _between(after: int, parts: Sequence[PartResult]) -> str:
    """Return a phrase with the dates, or names, of a recording and the next one."""
    both = parts[after : after + 2]
    return between([part.recording for part in both], [part.start for part in both])
