"""Turns, moves and dwells of an indexer's axes from its encoders, and groups of windows with their mean rates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate
from alidade.factors.indexer import AxisPath, PlatformRates, gyro_edges, gyro_means
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.indexer.recording import IndexerConfig, IndexerData
from alidade.pipelines.settings import Config

Axis = Literal["outer", "inner", "both", "none"]

# An axis moves when it is faster than this share of the top speed, over this time, s.
_MOVING = 0.02
_SPEED_SPAN = 0.2
# States shorter than this, s, are the ramps of the others.
_SHORTEST = 0.4
# Less turning than this in all, rad, calibrates nothing.
_LEAST_TURNED = 0.5
# How far a motion reaches into the rest about it, in samples: the angle at its edge is made of two on either side.
_REST_SAMPLES = 3
# A pause between samples is a gap when longer than both of these: s, sample intervals.
_GAP = 0.1
_GAP_SAMPLES = 2.5


@dataclass(frozen=True)
class Run:
    """A segment with a constant state of motion of both axes, without gaps in either stream.

    Attributes:
        axis: which one moved.
        start, stop: s.
        turned: rad, net angle of the axis that moved, positive forward; of both together the sum of the two; 0 at rest.
        other: rad, mean angle of the axis at rest, in [0, 2 pi); 0 when both moved or none.
    """

    axis: Axis
    start: float
    stop: float
    turned: float
    other: float

    @property
    def direction(self) -> int:
        """Direction of the run: +1 forward, -1 back, 0 at rest."""
        return int(np.sign(self.turned))

    @property
    def whole_turns(self) -> int:
        """Number of whole turns, counting a tenth of a degree short of one as whole."""
        return int((abs(self.turned) + np.deg2rad(0.1)) // (2.0 * np.pi))


@dataclass(frozen=True)
class AxisMotion:
    """The continuous encoder stream, its runs, and the gaps between these.

    Attributes:
        t: (M,) s.
        angles: (M, 2) outer and inner, rad, unwrapped.
        runs: in time order.
        gaps: [(start, stop)] s, pauses in the gyro or encoder stream inside the time both cover.
    """

    t: Array
    angles: Array
    runs: tuple[Run, ...]
    gaps: tuple[tuple[float, float], ...]


def axis_motion(data: IndexerData) -> AxisMotion:
    """Find the runs of a recording, from unwrapped angles; runs end at gaps of either stream.

    Raises:
        InputError: the axes hardly turn.
    """
    angles = np.unwrap(np.column_stack([data.outer, data.inner]), axis=0)
    t = data.encoder_t
    gaps = _gaps(data)
    borders = [max(t[0], data.gyro_t[0]), *(edge for gap in gaps for edge in gap), min(t[-1], data.gyro_t[-1])]
    pieces = [
        np.flatnonzero((t >= start) & (t <= stop)) for start, stop in zip(borders[::2], borders[1::2], strict=True)
    ]
    pieces = [piece for piece in pieces if len(piece) > 2]
    turned = sum((np.ptp(angles[piece], axis=0) for piece in pieces), start=np.zeros(2))
    if turned.max() < _LEAST_TURNED:
        raise InputError(
            f"indexer: no rotation found, the outer axis moves by {np.rad2deg(turned[0]):.3g} deg and the inner by "
            f"{np.rad2deg(turned[1]):.3g} deg; turn each axis through whole turns, forward and back, in two positions"
        )
    speeds = [_speeds(t[piece], angles[piece]) for piece in pieces]
    moving = _MOVING * float(np.percentile(np.abs(np.concatenate(speeds)).max(axis=1), 99.0))
    runs = [
        run
        for piece, speed in zip(pieces, speeds, strict=True)
        for run in _runs(t[piece], angles[piece], np.sign(speed) * (np.abs(speed) > moving))
    ]
    return AxisMotion(t, angles, tuple(runs), gaps)


def _gaps(data: IndexerData) -> tuple[tuple[float, float], ...]:
    found: list[tuple[float, float]] = []
    for t in (data.gyro_t, data.encoder_t):
        step = np.diff(t)
        wide = np.flatnonzero(step > max(_GAP, _GAP_SAMPLES * float(np.median(step))))
        found += [(float(t[i]), float(t[i + 1])) for i in wide]
    merged: list[tuple[float, float]] = []
    first = max(data.gyro_t[0], data.encoder_t[0])
    last = min(data.gyro_t[-1], data.encoder_t[-1])
    for start, stop in sorted(found):
        if stop <= first or start >= last:
            continue
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return tuple(merged)


def _speeds(t: Array, angles: Array) -> Array:
    """Rates of both axes (M, 2), rad/s, over a short span around each sample."""
    span = max(1, round(0.5 * _SPEED_SPAN / float(np.median(np.diff(t)))))
    before = np.maximum(np.arange(len(t)) - span, 0)
    after = np.minimum(np.arange(len(t)) + span, len(t) - 1)
    return np.asarray((angles[after] - angles[before]) / (t[after] - t[before])[:, None])


def _runs(t: Array, angles: Array, moving: Array) -> list[Run]:
    """Cut a piece into runs where the axes' motion changes; too short states join the previous run.

    `moving` (M, 2) is 1 for an axis that moves forward, -1 back, 0 at rest.
    """
    state = (moving @ [1, 3]).astype(int)
    changes = np.flatnonzero(np.diff(state)) + 1
    begins = [0]
    kept = [int(state[0])]
    for begin, end in zip(changes, np.append(changes, len(t))[1:], strict=True):
        if t[end - 1] - t[begin] < _SHORTEST or state[begin] == kept[-1]:
            continue
        begins.append(int(begin))
        kept.append(int(state[begin]))
    first_of = list(begins)
    # A motion begins and ends inside the rest about it, where the angle between samples is known exactly.
    for i in range(1, len(begins)):
        if (kept[i - 1] == 0) != (kept[i] == 0):
            begins[i] += _REST_SAMPLES if kept[i] == 0 else -_REST_SAMPLES
    ends = [*begins[1:], len(t) - 1]
    states = moving[first_of]
    return [_run(t, angles, s, a, b) for s, a, b in zip(states, begins, ends, strict=True) if b > a]


def _run(t: Array, angles: Array, moving: Array, begin: int, end: int) -> Run:
    turned = angles[end] - angles[begin]
    mean = angles[begin : end + 1].mean(axis=0) % (2.0 * np.pi)
    names: tuple[Axis, ...] = ("none", "outer", "inner", "both")
    axis = names[int(np.abs(moving) @ [1, 2])]
    net = {"none": 0.0, "outer": turned[0], "inner": turned[1], "both": turned.sum()}[axis]
    other = {"outer": mean[1], "inner": mean[0]}.get(axis, 0.0)
    return Run(axis, float(t[begin]), float(t[end]), float(net), float(other))


def encoder_scatter(motion: AxisMotion) -> float:
    """Noise of one encoder sample, from second differences at rest, rad; 0 if the axes never rest."""
    spread = []
    for run in motion.runs:
        if run.axis == "none":
            rows = slice(*np.searchsorted(motion.t, [run.start, run.stop]))
            second = np.diff(motion.angles[rows], n=2, axis=0)[3:-3]
            if len(second):
                spread.append(np.sqrt((second**2).mean() / 6.0))
    return float(np.median(spread)) if spread else 0.0


def cut_turns(motion: AxisMotion) -> int:
    """Number of gaps during which an axis turned."""
    return sum(
        any(run.axis != "none" and (run.stop == start or run.start == stop) for run in motion.runs)
        for start, stop in motion.gaps
    )


# Windows end where the driven axes have turned by this much, rad: short enough to see the earth's rate come and go.
_WINDOW_ANGLE = np.pi / 4
# Less than this over, rad, does not make a window of its own.
_CRUMB = 2e-3
# Encoder samples that a dwell leaves to the motion after it.
_DWELL_MARGIN = 5.0
# Groups and windows of fewer gyro samples than this are the crumbs of rounding.
_FEWEST_SAMPLES = 4
# The other axis stands at the same angle when it differs by less than half of this, deg.
_SAME_ANGLE_DEG = 5.0

# Whole turns, less than these, and rests.
KINDS = ("turn", "move", "dwell")


@dataclass(frozen=True)
class Group:
    """Consecutive windows of one run with their measurements.

    Attributes:
        kind: "turn" for a whole turn, "move" for less, "dwell".
        run: the run it is part of.
        gyro: (n, 3) mean rates in m, rad/s.
        rates: the platform's mean rates.
        celsius: (n,) mean temperatures, degrees Celsius; None where nobody measures them.
    """

    kind: str
    run: Run
    gyro: Array
    rates: PlatformRates
    celsius: Array | None = None

    @property
    def duration(self) -> float:
        """Time from start to end of a group, s."""
        return float(self.rates.edges[-1] - self.rates.edges[0])

    @property
    def mean_gyro(self) -> Array:
        """Mean gyro rate (3,) over the group, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ self.gyro / self.duration)

    def temperature_rise(self, reference: float | None) -> Array | None:
        """Mean temperatures (n,) above a reference, K; None where not measured."""
        return None if self.celsius is None or reference is None else self.celsius - reference

    @property
    def mean_platform(self) -> Array:
        """Mean rate (3,) of the platform over the group, for perpendicular axes, in t, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ (self.rates.fixed + self.rates.cosine) / self.duration)

    @property
    def position(self) -> tuple[str, int] | None:
        """Rotating axis and angle of the other one, in steps; None unless exactly one axis turns."""
        if self.run.axis not in ("outer", "inner"):
            return None
        steps = round(360.0 / _SAME_ANGLE_DEG)
        return self.run.axis, round(np.rad2deg(self.run.other) / _SAME_ANGLE_DEG) % steps


def groups_of(data: IndexerData, config: Config, motion: AxisMotion, split: bool = True) -> tuple[Group, ...]:
    """Groups of windows of a recording in time order, without common encoder samples."""
    nRbase = np.array(config.section(IndexerConfig).base_attitude)
    latitude = data.latitude_deg
    earth = np.zeros(3) if latitude is None else earth_rate(np.deg2rad(latitude))
    path = AxisPath(motion.t, motion.angles[:, 0], motion.angles[:, 1], so3.rotate(so3.inverse(nRbase), earth))
    edges = gyro_edges(data.gyro_t)
    middles = 0.5 * (edges[1:] + edges[:-1])
    celsius = temperature.above(data.temperature, 0.0, data.gyro_t)
    groups: list[Group] = []
    free_from = before = -np.inf
    for run in motion.runs:
        if run.start > before:  # behind a gap, all samples are new
            free_from = -np.inf
        before = run.stop
        for kind, borders in _borders(motion, run):
            # The sample edges nearest to the borders, within what the run and the group before leave.
            first = np.searchsorted(edges, max(run.start, free_from))
            last = np.searchsorted(edges, run.stop, side="right") - 1
            if last - first < _FEWEST_SAMPLES:
                continue
            nearest = np.searchsorted(middles, borders if split else borders[[0, -1]])
            cuts = np.unique(np.clip(nearest, first, last))
            cuts = cuts[np.concatenate([[True], np.diff(cuts) >= _FEWEST_SAMPLES])]
            if len(cuts) < 2:
                continue
            mean = None if celsius is None else gyro_means(edges, celsius[:, None], cuts)[:, 0]
            groups.append(Group(kind, run, gyro_means(edges, data.gyro, cuts), path.rates(edges[cuts]), mean))
            # The angle at the last edge is made of the two encoder samples on either side of it, and so is that at
            # the first edge of the next group.
            after = np.searchsorted(motion.t, edges[cuts[-1]], side="right") + 3
            free_from = motion.t[min(after, len(motion.t) - 1)]
    return tuple(groups)


def _borders(motion: AxisMotion, run: Run) -> Iterator[tuple[str, Array]]:
    """Yield kind and window edges, s, of each group of a run."""
    if run.axis == "none":
        # Ends early enough for the motion that follows to start where it does.
        yield "dwell", np.array([run.start, run.stop - _DWELL_MARGIN * float(np.median(np.diff(motion.t)))])
        return
    first, last = np.searchsorted(motion.t, [run.start, run.stop])
    rows = slice(first, last + 1)
    t, angles = motion.t[rows], motion.angles[rows]
    driven = {"outer": [0], "inner": [1]}.get(run.axis, [0, 1])
    path = np.maximum.accumulate(np.abs(angles[:, driven] - angles[0, driven]).sum(axis=1))
    # The ends are the run's, at rest; a crossing searched for in a resting encoder would pick its noise.
    levels = np.arange(_WINDOW_ANGLE, path[-1] - _CRUMB, _WINDOW_ANGLE)
    borders = np.concatenate([[run.start], np.interp(levels, path, t), [run.stop]])
    per_turn = round(2.0 * np.pi / _WINDOW_ANGLE)
    for first in range(0, len(borders) - 1, per_turn):
        turned = path[-1] - first * _WINDOW_ANGLE
        yield "turn" if turned > 2.0 * np.pi - _CRUMB else "move", borders[first : first + per_turn + 1]
