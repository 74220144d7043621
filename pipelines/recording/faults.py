"""Faulty samples of a noisy sensor: frozen, saturated, or a spike.

The sensor's own noise identifies them: a valid reading neither repeats exactly while the sensor moves nor lies far from
both its neighbours while these agree. Streams that repeat most of the time (simulated without noise, coarsely quantised
at rest) are not tested for saturation, and are frozen only where a reading ends in a jump beyond the motion beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array, Mask
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.checks import count, too_fast
from alidade.pipelines.recording.plausibility import SI, implausible

# A reading frozen for at least so long, s, and so many samples, that jumps to where the sensor has moved meanwhile.
_FROZEN, _FROZEN_SAMPLES = 0.1, 10
# A jump is more than so many usual steps; a spike more than so many times what its neighbours differ by.
_JUMP, _SPIKE = 10.0, 10.0
# Coarse readings at rest repeat as well, until a motion begins. A jump of theirs is more than so many times the largest
# of so many steps beyond it: so ends no rest of three accelerometers rounded to 4 to 60 mg, and readings held for 10 s
# are found in 96 % of the places where they are without this, those held for 1 s in 77 %.
_MOTION, _MOTION_STEPS = 2.0, 5
# A reading at the end of the range for so many samples is clipped, if the range is more than so many quanta.
_CLIPPED, _QUANTA = 3, 20.0
# The end of a range may wander, as a gyro's from 7.2346 to 7.2653 rad/s: readings this near to the largest, as a share,
# for no longer than so many s (rests and steady turns are longer) are a plateau if they fall by more than a parabola,
# so many times their height within their length before and after, and a quartic through all that misses by so many
# times their height (RMS). So do 90 % of the plateaus of simulated swings, and none of 1,300 of their peaks. Off three
# samples of a noisy peak they may: the longest plateau has so many. Of thousands of noisy peaks some do (an hour at 1
# kHz: 12 of 2,800 samples that near): this share of those is on plateaus where a range ends.
_NEAR_END, _BRIEFLY, _FALL, _MISSED, _PLATEAU, _LEAST_FLAT = 0.02, 1.0, 8.0, 2.0, 6, 0.25
# Ranges begin at 2 g and .8 gauss. Gravity, or the earth's field, that lingers along an axis is at the end of none.
_SMALLEST_RANGE = {"m/s^2": 15.0, "T": 8e-5}
# Readings of two devices in turn: x_k + (-1)^k (a + B x_k), at rest by their biases, in motion by their mounts. So many
# readings in a row are looked at, in so many places; in most of them a + B x is no noise (of twelve numbers chi-square
# is above 64 once in 1e8) and, rms, more than this share of the readings: devices a degree apart. Of the
# sensors of BROAD, 12: at most 13 and .0013; the same with their like in turn, 2 deg apart: above 9,000 and .0127.
_IN_A_ROW, _PLACES, _ALTERNATING, _APART = 512, 64, 64.0, 0.007
# Variance of a reading less the mean of its neighbours, over 2, as a share of what the mean of many in turn has.
_ALTERNATE_SAMPLES, _OF_WHITE = 100, 0.375
# More repeats than this are the nature of the stream.
_MOST_REPEATED = 0.5
# What is dropped, as it is counted.
CLIPPED = "saturated"
_STUCK = "stuck at one value"
# A recording that loses more than this is not worth solving.
_MOST_LOST = 0.2


def drop_faults(
    topic: str, t: Array, values: Array, dropped: dict[str, int], unit: str, may_stand: bool = False
) -> NDArray[np.intp]:
    """Return the rows of values (N, k) at times t (N,), s, that have no fault; count the others in `dropped`.

    Raises:
        InputError: an axis never moves while the others do, none does (unless it `may_stand`), or more than a fifth of
            the samples is lost.
    """
    _check_alive(topic, values, unit, may_stand)
    _check_one_device(topic, values, unit)
    spikes = np.stack([_spikes(column) for column in values.T], axis=1)
    rest = np.where(spikes, np.nan, values)
    smallest = _SMALLEST_RANGE.get(unit, 0.0)
    clipped = np.stack([_clipped(t, column, smallest) for column in rest.T], axis=1)
    frozen = np.stack([_frozen(t, column) for column in rest.T], axis=1)
    return _sound_rows(topic, t, values, {"spike": spikes, CLIPPED: clipped, _STUCK: frozen}, dropped, unit)


def drop_frozen(topic: str, t: Array, values: Array, dropped: dict[str, int], unit: str, axes: str) -> NDArray[np.intp]:
    """Return the rows that are not frozen, of readings whose saturation and outliers the estimate weighs by itself.

    Such a sensor is nowhere at rest: readings frozen for most of the time are faults as well.
    """
    frozen = np.stack([_frozen(t, column, most=1.0) for column in values.T], axis=1)
    return _sound_rows(topic, t, values, {_STUCK: frozen}, dropped, unit, axes)


def _sound_rows(
    topic: str, t: Array, values: Array, reasons: dict[str, Mask], dropped: dict[str, int], unit: str, axes: str = "xyz"
) -> NDArray[np.intp]:
    """Return the rows that no mask (N, k) of a fault marks; count the others by fault, raise InputError if too many."""
    for reason, mask in reasons.items():
        lost = mask.any(axis=1)
        if lost.mean() > _MOST_LOST:
            first = int(np.argmax(lost))
            axis = int(np.argmax(mask[first]))
            raise InputError(
                f"topic {topic}: {100.0 * lost.mean():.0f} % of the samples cannot be used: {reason} "
                f"({values[first, axis]:.6g}{_in_unit(unit, values)} on axis {axes[axis]}, the first at "
                f"{t[first]:.3f} s); check the sensor and its range, and record again"
            )
        count(dropped, f"{topic}: {reason}", int(lost.sum()))
    return np.flatnonzero(~np.any([mask.any(axis=1) for mask in reasons.values()], axis=0))


def _in_unit(unit: str, values: Array) -> str:
    """The unit of readings (N, k) after a blank; empty where they are implausible in it, as counts are."""
    kind = next((kind for kind, si in SI.items() if si == unit), "")
    wrong = too_fast("", np.zeros(len(values)), values) if kind == "gyro" else implausible(kind, values)
    return "" if wrong else f" {unit}"


def _check_alive(topic: str, values: Array, unit: str, may_stand: bool) -> None:
    """Raise InputError for an axis that never changes while the others do, or if no axis ever changes."""
    if len(values) <= _FROZEN_SAMPLES:
        return
    repeated = (np.diff(values, axis=0) == 0.0).mean(axis=0)
    what = "the sensor is dead or its driver does not fill it in: check it and record again"
    if (repeated == 1.0).all() and not may_stand:
        numbers = ", ".join(f"{number:.6g}" for number in values[0] + 0.0)
        raise InputError(
            f"topic {topic}: all axes read the same throughout, ({numbers}){_in_unit(unit, values)}; {what}"
        )
    for axis in np.flatnonzero(repeated == 1.0):
        # Where fewer repeat, noise spans more than two levels of a coarse sensor, and no bias keeps an axis at one.
        if np.delete(repeated, axis).max(initial=0.0) < _MOST_REPEATED:
            raise InputError(
                f"topic {topic}: axis {'xyz'[axis]} reads {values[0, axis] + 0.0:.6g} throughout while the others "
                f"move; {what}"
            )


def _check_one_device(topic: str, values: Array, unit: str) -> None:
    """Raise InputError for readings that alternate between two levels, as those of two devices on one topic do."""
    if len(values) < _ALTERNATE_SAMPLES:
        return
    squares, alternating, size = _alternation(values)
    if np.median(squares) > _ALTERNATING and np.median(alternating.max(axis=1) / size) > _APART:
        apart = 2.0 * np.median(alternating, axis=0)
        axis = int(np.argmax(apart))
        raise InputError(
            f"topic {topic}: axis {'xyz'[axis]} alternates between two levels "
            f"{apart[axis]:.3g}{_in_unit(unit, values)} apart, as readings of two devices do: choose one, by "
            "`frame:` under `topics`, of a table by `where:` under `columns`"
        )


def _alternation(values: Array) -> tuple[Array, Array, Array]:
    """Return how far readings x (N, k) alternate by a + B x from one to the next, in p places of the record.

    Of each place: chi-square (p,), the alternation's rms (p, k), and that of x (p,).

    The rms is of what the first half of a place predicts for the second, as it does not of a vibration at nearly half
    the sampling rate. What alternates with the rate of x alone is the stamps.
    """
    n = min(_IN_A_ROW, len(values) - 2)
    first = np.linspace(0, len(values) - 2 - n, min(_PLACES, (len(values) - 2) // n)).astype(np.intp)
    rows = first[:, None] + np.arange(1, n + 1)
    here, around, change = values[rows], values[rows - 1] + values[rows + 1], values[rows + 1] - values[rows - 1]
    level = 0.25 * (2.0 * here + around)
    columns = np.concatenate([change, np.ones((*rows.shape, 1)), level], axis=2)
    columns /= np.maximum(np.abs(columns).max(axis=1, keepdims=True), 1e-300)
    turned = np.where(rows % 2, 0.25, -0.25)[..., None] * (2.0 * here - around)
    most = _SPIKE * np.median(np.abs(turned), axis=1, keepdims=True)  # spikes and knocks alternate by themselves
    turned = np.clip(turned, -most, most)
    parts = np.swapaxes(np.linalg.qr(columns).Q, 1, 2) @ turned
    own = slice(change.shape[2], None)
    explained = (parts[:, own] ** 2).sum(axis=1)
    left = ((turned**2).sum(axis=1) - (parts**2).sum(axis=1)) / max(n - columns.shape[2], 1)
    squares = (_OF_WHITE * explained / np.maximum(left, 1e-300)).sum(axis=1)
    half = n // 2
    known = (np.linalg.pinv(columns[:, :half]) @ turned[:, :half])[:, own]
    predicted = (turned[:, half:] * (columns[:, half:, own] @ known)).mean(axis=1)
    size = np.sqrt((level**2).mean(axis=1)).max(axis=1)
    return squares, np.sqrt(np.maximum(predicted, 0.0)), np.maximum(size, 1e-300)


def _spikes(x: Array) -> Mask:
    """Mask (N,) of single readings far from both neighbours, which agree with each other."""
    out = np.zeros(len(x), dtype=bool)
    if len(x) < 5:
        return out
    away = np.abs(x[2:-2] - 0.5 * (x[1:-3] + x[3:-1]))
    around = np.abs(x[3:-1] - x[1:-3]) + np.abs(x[1:-3] - x[:-4]) + np.abs(x[4:] - x[3:-1])
    step = np.abs(np.diff(x))
    usual = 1.5 * np.median(step[step > 0.0]) if step.any() else 0.0
    out[2:-2] = away > _SPIKE * (around + usual)
    return out


def _runs(x: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last index of every run of equal readings; NaN equals nothing."""
    change = np.flatnonzero(np.diff(x) != 0.0)
    return np.concatenate([[0], change + 1]), np.concatenate([change, [len(x) - 1]])


def _edge(step: Array, starts: NDArray[np.intp], stops: NDArray[np.intp]) -> Array:
    """Return the larger of the absolute steps into and out of each run of equal readings."""
    return np.fmax(np.concatenate([[0.0], step])[starts], np.concatenate([step, [0.0]])[stops])


def _frozen(t: Array, x: Array, most: float = _MOST_REPEATED) -> Mask:
    """Mask (N,) of long runs of one value that end in a jump; all False where they make up `most` of the stream."""
    starts, stops = _runs(x)
    long = (stops - starts + 1 >= _FROZEN_SAMPLES) & (t[stops] - t[starts] >= _FROZEN)
    step = np.abs(np.diff(x))
    usual = np.nanmedian(step[step > 0.0]) if np.any(step > 0.0) else 0.0
    jumps = long & (_edge(step, starts, stops) > _JUMP * usual)
    if np.mean(step == 0.0) > most:
        for i in np.flatnonzero(jumps):
            into = step[max(starts[i] - 1 - _MOTION_STEPS, 0) : starts[i]][::-1]
            beyond = into, step[stops[i] : stops[i] + 1 + _MOTION_STEPS]
            jumps[i] = any(s[:1].sum() > max(_JUMP * usual, _MOTION * s[1:].max(initial=0.0)) for s in beyond)
    out = np.repeat(jumps, stops - starts + 1)
    out[starts] = False  # the first reading of a run was a good one
    return out if out.mean() < most else np.zeros(len(x), dtype=bool)


def _clipped(t: Array, x: Array, smallest: float) -> Mask:
    """Mask (N,) of samples at the end of the range: runs of one reading, and wandering plateaus above `smallest`."""
    out = _at_end(x)
    return out | ((_on_plateau(t, x, out) | _on_plateau(t, -x, out)) & (np.abs(x) >= smallest))


def _on_plateau(t: Array, x: Array, known: Mask) -> Mask:
    """Mask (N,) of plateaus near the largest reading, with edges sharp for their height, apart from known ones.

    A height is at least the quantum of the readings: the top of coarse ones is flat.
    """
    out, longest, near = np.zeros(len(x), dtype=bool), 0, 0
    step = np.abs(np.diff(x))
    quantum = float(np.min(step[step > 0.0], initial=np.inf))
    above = x - np.nanmedian(x)
    edges = np.diff(np.concatenate([[False], above > (1.0 - _NEAR_END) * np.nanmax(above), [False]]).astype(int))
    for first, stop in np.flatnonzero(edges).reshape(-1, 2).tolist():
        count = stop - first
        if known[first:stop].any() or t[stop - 1] - t[first] > _BRIEFLY:
            continue
        near += count
        if count < _CLIPPED or first < count or stop + count > len(x):
            continue
        low, middle = np.quantile(above[first:stop], [0.25, 0.5])
        level = middle - 3.0 * (middle - low)  # what is on its way there is not on the plateau
        flat = np.flatnonzero(above[first:stop] >= level) + first
        around, height = above[first - count : stop + count], max(float(np.ptp(above[flat])), quantum)
        fall = above[flat].min() - np.fmax(around[0], around[-1])
        if fall > _FALL * height and _off_quartic(around) > _MISSED * height:
            out[flat] = True
            longest = max(longest, len(flat))
    if longest < _PLATEAU or out.sum() < _LEAST_FLAT * near:
        return np.zeros(len(x), dtype=bool)
    # Nothing is read beyond the end of a range, farther than it wanders: else it was a motion that lingered.
    beyond = float(np.nanmax(above) - above[out].max())
    return out & (beyond <= max(float(np.ptp(above[out])), quantum))


def _off_quartic(x: Array) -> float:
    """RMS of what a quartic leaves of readings at even steps; NaN are left out."""
    u, known = np.linspace(-1.0, 1.0, len(x)), np.isfinite(x)
    return float(np.polynomial.Legendre.fit(u[known], x[known], 4, full=True)[1][0].sum() / known.sum()) ** 0.5


def _at_end(x: Array) -> Mask:
    """Mask (N,) of runs of equal readings at the largest or the smallest reading of the stream."""
    starts, stops = _runs(x)
    step = np.abs(np.diff(x))
    if not np.any(step > 0.0):
        return np.zeros(len(x), dtype=bool)
    quantum = float(np.nanmin(step[step > 0.0]))
    low, high = np.nanmin(x), np.nanmax(x)
    at_end = (stops - starts + 1 >= _CLIPPED) & ((x[starts] == low) | (x[starts] == high))
    at_end &= np.abs(x[starts] - 0.5 * (low + high)) > _QUANTA * quantum
    # The rounded top of a smooth motion is entered and left by a quantum or two.
    at_end &= _edge(step, starts, stops) > 3.5 * quantum
    out = np.repeat(at_end, stops - starts + 1)
    inside = np.diff(x)[~out[1:]] == 0.0
    noisy = len(inside) > 0 and inside.mean() < _MOST_REPEATED
    return out if noisy else np.zeros(len(x), dtype=bool)
