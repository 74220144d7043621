"""What the axes of an indexer did: turns, moves and dwells, found in the encoder stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.indexer.recording import IndexerData

Array = NDArray[np.float64]
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
    """A stretch in which the same axes moved the same way, without gaps in either stream.

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
        """+1 forward, -1 back, 0 at rest."""
        return int(np.sign(self.turned))

    @property
    def whole_turns(self) -> int:
        """Number of whole turns, counting a tenth of a degree short of one as whole."""
        return int((abs(self.turned) + np.deg2rad(0.1)) // (2.0 * np.pi))


@dataclass(frozen=True)
class AxisMotion:
    """The encoder stream made continuous, the runs in it, and the gaps between them.

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
    """Runs of a recording; wrapped angles are unwrapped, runs end at gaps of either stream.

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
    """Cut one piece where the state of the axes changes; states too short to be meant join the one before.

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
    """Noise from encoder sample to encoder sample while the axes rest, rad; 0 if they never do."""
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
        any(run.axis != "none" and (run.stop in (start,) or run.start in (stop,)) for run in motion.runs)
        for start, stop in motion.gaps
    )
