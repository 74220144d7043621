"""Static intervals, when a device stood still: a variance test on its gyro and accelerometer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError

Array = NDArray[np.float64]

# The test looks at this much time about each sample, s; half of it keeps a pose's ends clear of the motion.
_SPAN = 0.5
# Shorter intervals, s, are turning points of a motion.
_SHORTEST = 0.5
# The scatter over the span is below the first many times the noise somewhere in an interval, and below the second all
# through it: a hand's tremor does not end a rest.
_QUIET, _STILL = 3.0, 6.0
# A motion starts slower than the test can see: this much, s, is cut off at both ends.
_MARGIN = 0.25
# ... and more where the sum of what the readings differ by from the quietest half of the interval, from there on, comes
# out beyond the first many of its sigmas: back to where it was last within the second.
_MOVED, _UNMOVED = 5.0, 1.0
# What stays below that is slow all the same: this share of a long interval, up to s, is cut off at least.
_SLOW_SHARE, _SLOW = 0.1, 0.4
# Samples whose means show whether noise is white, and how many such means it takes.
_TOGETHER, _FEWEST_BLOCKS, _TINY = 8, 4, np.finfo(float).tiny
# Brief rests, of a second and less, are looked for with this share of span, margin and shortest; there readings scatter
# by less than so many times what they differ by from one to the next, over sqrt(2): 1 for white noise, beyond 5 where
# a hand turns back.
_BRIEF, _WHITE = 0.5, 2.0
# Of a triad, nine numbers at rest, fewer static poses than this are too few for brief ones to be left out.
_FEWEST_POSES = 9
# The noise is what the quietest twentieth of the recording shows, between these multiples of the stated one.
_FLOOR_SHARE, _FLOOR_LIMITS = 0.05, (0.2, 10.0)
# A steady turn is as quiet; its mean rate departs from that of the static intervals by more than this, rad/s, when what
# gravity does to the gyro is taken off, whose g-sensitivity, if it is out of order, has this sigma, rad/s per m/s^2.
_STEADY, _SHIFT = 0.01, 2e-3
# How well rates at rest repeat, rad/s.
_REPEATED = 3e-3
_REWEIGHTINGS = 20
# A pause between samples is a gap when longer than this many intervals.
_GAP_SAMPLES = 5.0


def find_static_intervals(t: Array, gyro: Array, accel: Array, gyro_sigma: float, accel_sigma: float) -> Array:
    """Beginnings and ends, (P, 2) s, of the static intervals, each at a sample's stamp.

    After Tedaldi, Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without external
    equipments", ICRA 2014, which tests the accelerometer; a turn about the vertical shows in the gyro alone.

    Args:
        t: (N,) s.
        gyro: (N, 3) rad/s.
        accel: (N, 3) m/s^2.
        gyro_sigma, accel_sigma: stated noise of one sample, per axis.

    Raises:
        InputError: there is none.
    """
    (runs, scatter, floor), share = _runs_or_brief_ones(t, [(gyro, gyro_sigma), (accel, accel_sigma)], _FEWEST_POSES)
    interval = float(np.median(np.diff(t)))
    ends = [_unmoved(run, [(gyro, float(floor[0])), (accel, float(floor[1]))], interval) for run in runs]
    runs = np.array([run for run in ends if t[run[1]] - t[run[0]] >= share * _SHORTEST], dtype=np.intp).reshape(-1, 2)
    means, forces = (
        np.array([values[a : b + 1].mean(axis=0) for a, b in runs]).reshape(-1, 3) for values in (gyro, accel)
    )
    still = _turns_not(means, forces, runs[:, 1] - runs[:, 0] + 1, floor[0])
    if len(runs) and not still.any():
        raise InputError(
            f"no static pose: the device is quiet in {len(runs)} intervals, but the gyro's mean rates in them lie up "
            f"to {np.ptp(means, axis=0).max():.2g} rad/s apart: either it turns steadily in them, or gravity shifts "
            "its gyro by far more than a usual one's (g-sensitivity)"
        )
    if not len(runs):
        least = scatter.min(axis=1)
        raise InputError(
            f"no static pose: in the quietest {_SPAN:g} s the gyro scatters by {least[0]:.2g} rad/s and the "
            f"accelerometer by {least[1]:.2g} m/s^2, noise stated is {gyro_sigma:.2g} and {accel_sigma:.2g}; let the "
            "cube stand still for a few seconds in each pose, or state the device's noise in the config"
        )
    return t[runs[still]]


def quiet_intervals(t: Array, streams: Sequence[tuple[Array, float]], fewest: int) -> Array:
    """Beginnings and ends, (P, 2) s, of intervals in which vectors (N, 3) are quiet, each with its noise; maybe none.

    For a device without a gyro: a steady turn about what a sensor feels does not show in it. Where that finds fewer
    than `fewest`, brief ones count in which the first vectors scatter by white noise: at turning points they do not.
    """
    return np.asarray(t[_runs_or_brief_ones(t, streams, fewest)[0][0]])


def _runs_or_brief_ones(
    t: Array, streams: Sequence[tuple[Array, float]], fewest: int
) -> tuple[tuple[NDArray[np.intp], Array, Array], float]:
    """Quiet runs as `_quiet_runs` has them and their share of what is usual: brief ones where others are too few."""
    usual = _quiet_runs(t, streams)
    if len(usual[0]) >= fewest:
        return usual, 1.0
    brief = _quiet_runs(t, streams, _BRIEF)
    if len(brief[0]) >= fewest and _is_white(streams[0][0], brief[0]):
        return brief, _BRIEF
    return usual, 1.0


def _is_white(values: Array, runs: NDArray[np.intp]) -> bool:
    """Whether vectors (N, 3) scatter in runs (P, 2) about as much as they differ from one sample to the next."""
    within = [values[first : last + 1] for first, last in runs]
    scatter = np.median([np.sqrt(each.var(axis=0).mean()) for each in within])
    steps = np.median([np.sqrt(0.5 * (np.diff(each, axis=0) ** 2).mean()) for each in within])
    return bool(scatter < _WHITE * steps)


def _quiet_runs(
    t: Array, streams: Sequence[tuple[Array, float]], share: float = 1.0
) -> tuple[NDArray[np.intp], Array, Array]:
    """First and last sample of each quiet run (P, 2), and for each stream its scatter (N,) and the floor of that.

    `share` is what the test looks at, cuts off and takes for shortest, over what is usual.

    Raises InputError when the record is shorter than what is looked at.
    """
    interval = float(np.median(np.diff(t)))
    half = max(2, round(0.5 * share * _SPAN / interval))
    if len(t) < 2 * half + 1:
        raise InputError(f"the device's record is {t[-1] - t[0]:.3g} s long, shorter than one static pose")
    scatter = np.stack([_scatter(values, half) for values, _ in streams])
    stated = np.array([sigma for _, sigma in streams])
    low, high = _FLOOR_LIMITS
    floor = np.clip(np.quantile(scatter, _FLOOR_SHARE, axis=1), low * stated, high * stated)
    quiet, still = (np.all(scatter < limit * floor[:, None], axis=0) for limit in (_QUIET, _STILL))
    dense = np.diff(t) < _GAP_SAMPLES * interval
    still &= np.append(dense, True) & np.append(True, dense)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    counted = np.append(0, np.cumsum(quiet & still))
    edges = edges[counted[edges[:, 1]] > counted[edges[:, 0]]]
    margin = round(share * _MARGIN / interval)
    runs = edges + np.array([margin, -1 - margin])
    runs = runs[runs[:, 1] > runs[:, 0]]
    return runs[t[runs[:, 1]] - t[runs[:, 0]] >= share * _SHORTEST], scatter, floor


def _unmoved(run: NDArray[np.intp], streams: Sequence[tuple[Array, float]], interval: float) -> tuple[int, int]:
    """First and last sample of a quiet run of vectors, each with its noise, but for ends in which motion is slow."""
    first, last = run.tolist()
    quarter = (last - first) // 4
    if quarter == 0:
        return first, last
    stirring = np.sum([(_scatter(values[first : last + 1], quarter) / noise) ** 2 for values, noise in streams], axis=0)
    centre = first + quarter + int(np.argmin(stirring[quarter:-quarter]))
    middle = slice(centre - quarter, centre + quarter + 1)
    before, after = [], []
    for values, noise in streams:
        still = values[middle]
        mean, sigma = still.mean(axis=0), _colour(still) * np.maximum(still.std(axis=0), noise)
        before.append((values[first : middle.start] - mean)[::-1] / sigma)
        after.append((values[middle.stop : last + 1] - mean) / sigma)
    count = middle.stop - middle.start
    rest = (last - first) * interval + 2.0 * _MARGIN
    slow = round((max(min(_SLOW_SHARE * rest, _SLOW), _MARGIN) - _MARGIN) / interval)
    return (
        max(middle.start - _still_for(np.hstack(before), count), first + slow),
        min(middle.stop - 1 + _still_for(np.hstack(after), count), last - slow),
    )


def _colour(values: Array) -> float:
    """By what sums of some samples (n, d) scatter more than those of white noise: a filtered sensor's are alike."""
    blocks = len(values) // _TOGETHER
    if blocks < _FEWEST_BLOCKS:
        return 1.0
    means = values[: blocks * _TOGETHER].reshape(blocks, _TOGETHER, -1).mean(axis=1)
    more = _TOGETHER * means.var(axis=0) / np.maximum(values.var(axis=0), _TINY)
    return float(np.sqrt(max(more.mean(), 1.0)))


def _still_for(off: Array, count: int) -> int:
    """Number of leading samples (n, d), in units of their noise about a mean of `count` others, at that mean."""
    n = np.arange(1, len(off) + 1)
    drift = np.abs(np.cumsum(off, axis=0)).max(axis=1, initial=0.0) / np.sqrt(n * (1.0 + n / count))
    moved = np.flatnonzero(drift > _MOVED)
    if not len(moved):
        return len(off)
    return int(np.max(np.flatnonzero(drift[: moved[0]] < _UNMOVED) + 1, initial=0))


def _scatter(values: Array, half: int) -> Array:
    """Standard deviation (N,) over 2 half + 1 samples about each, root mean square over the axes; inf at the ends."""
    n = 2 * half + 1
    centred = values - values.mean(axis=0)
    sums = [np.cumsum(np.pad(power, ((1, 0), (0, 0))), axis=0) for power in (centred, centred**2)]
    mean, square = ((s[n:] - s[:-n]) / n for s in sums)
    out = np.full(len(values), np.inf)
    out[half:-half] = np.sqrt(np.maximum(square - mean**2, 0.0).mean(axis=1))
    # The recording's ends are as quiet as the first and last whole span.
    out[:half], out[-half:] = out[half], out[-half - 1]
    return out


def _turns_not(means: Array, forces: Array, lengths: NDArray[np.intp], sigma: float) -> NDArray[np.bool_]:
    """Which runs, of so many samples, have the mean rate (n, 3) that gyro bias and g-sensitivity give in most of them.

    Bias b and g-sensitivity G of means = b + G forces by least squares with Cauchy's weights, from the median on: a
    turn adds far more than gravity does.
    """
    if not len(means):
        return np.zeros(0, dtype=bool)
    middle = np.quantile(means, 0.5, axis=0, weights=lengths, method="inverted_cdf")
    allowed = _STEADY + 5.0 * sigma / np.sqrt(lengths)
    design = np.column_stack([np.ones(len(means)), forces])
    prior = np.diag([0.0, *3 * [(_REPEATED / _SHIFT) ** 2]])
    off = means - middle
    for _ in range(_REWEIGHTINGS):
        weights = lengths / lengths.max() / (1.0 + (off**2).sum(axis=1) / _REPEATED**2)
        normal = design.T @ (weights[:, None] * design) + prior
        off = means - design @ np.linalg.solve(normal, design.T @ (weights[:, None] * means))
    return np.asarray(np.abs(off).max(axis=1) < allowed)
