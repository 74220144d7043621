"""Static intervals of a device: from its samples alone for whoever asks for their noise, or with the noise stated.

Without a statement (`stretches_at_rest`) samples are cut into blocks of half a second. A block is at rest when every
sensor shows in it

- a scatter below twice that of the quietest blocks,
- a mean that differs from the neighbours' by little more than chance (a motion goes on; noise averages out), and
- samples that differ from one to the next nearly as much as from the mean, von Neumann's ratio, Ann. Math. Stat. 1941
  (a motion is smooth from sample to sample; noise is not, even behind a low-pass filter).

Intervals of two seconds and more count; the block next to a motion does not, for its mean differs. A steady turn looks
like rest to a gyro: the interval with the smallest mean rate is at rest, others are if they have the same rate.

With one (`find_static_intervals`) rests are where the scatter over half a second is that of a rest, after Tedaldi,
Pretto, Menegatti, "A robust and easy to implement method for IMU calibration without external equipments", ICRA 2014,
which tests the accelerometer; a turn about the vertical shows in the gyro alone. The threshold between rest and motion
is Otsu's, in the logarithm of the scatter ("A threshold selection method from gray-level histograms", IEEE Trans. SMC
1979): a hand that holds a device still makes ten times the noise of the sensors, one that turns it a hundred times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array, Index, Mask
from alidade.pipelines.errors import InputError

# A block, s, has at least so many samples.
_BLOCK, _LEAST = 0.5, 32
# Scatter: the quietest share of blocks, and how many times theirs a block at rest may have.
_QUIETEST, _LOUDER = 0.05, 2.0
# Difference of neighbouring means: in units of what chance does; at least and at most in units of the scatter, of
# which a ramp has 3.5.
_DIFFERENT, _DIFFERENT_LIMITS = 4.5, (1.0, 2.5)
# Mean squared step over twice the variance: 1 in white noise, 0.1 behind a filter of a tenth of half the rate.
_SMOOTH = 0.02
# An interval at rest, s.
_SHORTEST_REST = 2.0
# Rates of rests agree to within the first, and are below the second: no bias is so large, rad/s.
_SAME_RATE, _LARGEST_BIAS = 0.01, 0.2


def stretches_at_rest(t: Array, sensors: Sequence[Array], gyro: Array | None = None) -> Array:
    """Find static intervals: start and end (P, 2), s, each at a sample; P = 0 where there is none.

    Args:
        t: (N,) s, increasing; a pause of the recorder ends an interval.
        sensors: (N, k) each, of one device.
        gyro: that of the sensors which measures a steady turn, (N, 3) rad/s, if there is one.
    """
    interval = float(np.median(np.diff(t)))
    size = max(_LEAST, round(_BLOCK / interval))
    count = len(t) // size
    if count < 3:
        return np.empty((0, 2))
    quiet = np.all([_quiet(values[: count * size].reshape(count, size, -1)) for values in sensors], axis=0)
    edges = t[: count * size].reshape(count, size)
    quiet &= edges[:, -1] - edges[:, 0] < 1.5 * size * interval
    runs = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(int))).reshape(-1, 2)
    stop = np.where(runs[:, 1] == count, len(t), runs[:, 1] * size) - 1
    spans = np.stack([runs[:, 0] * size, stop], axis=1)
    spans = spans[t[spans[:, 1]] - t[spans[:, 0]] >= _SHORTEST_REST]
    if gyro is not None and len(spans):
        spans = spans[_not_turning(gyro, spans)]
    return t[spans]


def _quiet(blocks: Array) -> Mask:
    """Mask of blocks (count, size, k) during which one sensor is at rest."""
    blocks = blocks - blocks[0, 0]  # readings that never change are exactly zero then
    means = blocks.mean(axis=1)
    variance = ((blocks - means[:, None]) ** 2).mean(axis=(1, 2))
    steps = (np.diff(blocks, axis=1) ** 2).mean(axis=(1, 2))
    moved = np.sqrt((np.diff(means, axis=0) ** 2).mean(axis=1))
    scatter = np.sqrt(variance)
    # Readings that repeat for seconds are those of a coarse sensor, whose step is the least that can be seen.
    change = np.abs(np.diff(blocks, axis=1))
    step = float(change.min(where=change > 0.0, initial=np.inf))
    floor = max(float(np.quantile(scatter, _QUIETEST)), step if np.isfinite(step) else 0.0)
    ratio = np.clip(np.divide(steps, 2.0 * variance, out=np.ones(len(steps)), where=variance > 0.0), 1e-3, 1.0)
    # Samples that are correlated like a first-order filter's count for fewer.
    chance = np.sqrt(2.0 * (2.0 - ratio) / ratio / blocks.shape[1])
    allowed = np.clip(_DIFFERENT * chance, *_DIFFERENT_LIMITS) * np.maximum(scatter, 0.5 * floor)
    still = np.maximum(np.append(moved, 0.0), np.append(0.0, moved)) <= allowed
    return np.asarray((scatter <= _LOUDER * floor) & still & (ratio >= _SMOOTH))


def _not_turning(gyro: Array, spans: Index) -> Mask:
    """Mask of spans with a mean rate that is one constant bias, without a steady rotation."""
    means = np.array([gyro[start : stop + 1].mean(axis=0) for start, stop in spans])
    rate = np.linalg.norm(means, axis=1)
    same = np.linalg.norm(means - means[np.argmin(rate)], axis=1) < _SAME_RATE
    return np.asarray(same & (rate < _LARGEST_BIAS))


# -- with the noise that is stated, and a hand that holds the device

# The test looks at this much time about each sample, s.
_SPAN = 0.25
# Shorter intervals, s, are turning points of a motion; so are those below the second in which readings scatter by more
# than the third times what they differ by from one to the next, over sqrt(2): 1 for white noise, 2 in a hand at rest,
# beyond 5 where it turns back.
_SHORTEST, _BRIEF, _WHITE = 0.25, 1.0, 2.0
# Scatter over the noise floor that is rest whatever else the recording shows.
_STILL = 6.0
# Share of the variance of the logarithms that two classes explain: 3/4 in a uniform distribution, 0.85 and more in
# recordings with rests, 0.55 to 0.67 in motion without.
_SEPARATED = 0.75
# A motion starts slower than the test can see: this share of an interval, between these limits, s, is cut off at both
# ends.
_SLOW_SHARE, _SLOW = 0.2, (0.125, 0.45)
# ... and more where the sum of what the readings differ by from the quietest half of the interval, from there on, comes
# out beyond the first many of its sigmas: back to where it was last within the second.
_MOVED, _UNMOVED = 5.0, 1.0
# Samples whose means show whether noise is white, and how many such means it takes.
_TOGETHER, _FEWEST_BLOCKS, _TINY = 8, 4, np.finfo(float).tiny
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


@dataclass(frozen=True, eq=False)
class Stream:
    """Readings of one sensor at common stamps.

    Attributes:
        values: (N, 3).
        sigma: stated noise of one sample, per axis.
        tremor: largest scatter over half a second that is a hand holding still, in the unit of the values.
    """

    values: Array
    sigma: float
    tremor: float


# Scatter over half a second of a hand that holds a device, rad/s and m/s^2: 95 % of the MPU-6050 recording of
# tomisuarez2/ImuCalibration lie below .04 and .13.
GYRO_TREMOR, ACCEL_TREMOR = 0.05, 0.2


def find_static_intervals(
    t: Array, accel: Stream, gyro: Stream | None = None, *others: Stream, dropped: dict[str, int] | None = None
) -> Array:
    """Find static intervals: start and end, (P, 2) s, each at a sample's stamp.

    Without a gyro a steady turn about what a sensor feels passes for a rest.

    Args:
        t: (N,) s.
        accel: m/s^2.
        gyro: rad/s.
        others: more sensors that have to be quiet.
        dropped: reason -> number of quiet intervals left out, filled in.

    Raises:
        InputError: there is none.
    """
    streams = [accel, *others] if gyro is None else [gyro, accel, *others]
    runs, scatter, floor = _quiet_runs(t, streams)
    if not len(runs):
        raise InputError(
            f"no static pose: in the quietest {_SPAN:g} s the readings scatter by "
            f"{', '.join(f'{least:.2g}' for least in scatter.min(axis=1))}, noise stated is "
            f"{', '.join(f'{each.sigma:.2g}' for each in streams)} ({'' if gyro is None else 'gyro, rad/s; '}"
            "accelerometer, m/s^2); let the device stand still for a few seconds in each pose, or state its noise in "
            "the config"
        )
    if gyro is None:
        return np.asarray(t[runs])
    rates, forces = (np.array([each.values[a : b + 1].mean(axis=0) for a, b in runs]) for each in (gyro, accel))
    still = _turns_not(rates, forces, runs[:, 1] - runs[:, 0] + 1, floor[0])
    if not still.any():
        raise InputError(
            f"no static pose: the device is quiet in {len(runs)} intervals, but the gyro's mean rates in them lie up "
            f"to {np.ptp(rates, axis=0).max():.2g} rad/s apart: either it turns steadily in them, or gravity shifts "
            "its gyro by far more than a usual one's (g-sensitivity)"
        )
    if dropped is not None and not still.all():
        dropped["quiet interval with another mean rate than the static ones"] = int((~still).sum())
    return np.asarray(t[runs[still]])


def _quiet_runs(t: Array, streams: Sequence[Stream]) -> tuple[Index, Array, Array]:
    """First and last sample of each quiet run (P, 2); scatter (N,) and noise floor of each stream.

    Raises InputError when the record is shorter than what is looked at.
    """
    interval = float(np.median(np.diff(t)))
    half = max(2, round(0.5 * _SPAN / interval))
    if len(t) < 2 * half + 1:
        raise InputError(f"the device's record is {t[-1] - t[0]:.3g} s long, shorter than one static pose")
    scatter = np.stack([_scatter(each.values, half) for each in streams])
    stated = np.array([each.sigma for each in streams])
    low, high = _FLOOR_LIMITS
    floor = np.clip(np.quantile(scatter, _FLOOR_SHARE, axis=1), low * stated, high * stated)
    split = [min(_split(own), each.tremor) for own, each in zip(scatter, streams, strict=True)]
    still = np.all(scatter < np.maximum(_STILL * floor, split)[:, None], axis=0)
    dense = np.diff(t) < _GAP_SAMPLES * interval
    still &= np.append(dense, True) & np.append(True, dense)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    runs = [_unmoved(first, last - 1, streams, floor, interval) for first, last in edges.tolist()]
    kept = [(first, last) for first, last in runs if _is_rest(streams[0].values[first : last + 1], interval)]
    return np.array(kept, dtype=np.intp).reshape(-1, 2), scatter, floor


def _is_rest(values: Array, interval: float) -> bool:
    """Whether a quiet run of vectors (n, 3) is a rest: long enough, or short and white."""
    length = (len(values) - 1) * interval
    if length < _SHORTEST or length > _BRIEF:
        return length > _BRIEF
    step = np.sqrt(0.5 * (np.diff(values, axis=0) ** 2).mean())
    return bool(np.sqrt(values.var(axis=0).mean()) <= _WHITE * step)


def _split(scatter: Array) -> float:
    """Otsu's threshold between two classes of scatter, on the logarithm; 0 where the classes are not separate."""
    x = np.log(np.sort(scatter[np.isfinite(scatter) & (scatter > 0.0)]))
    lower = np.arange(1, len(x))
    if not len(lower):
        return 0.0
    sums = np.cumsum(x)
    apart = sums[:-1] / lower - (sums[-1] - sums[:-1]) / (len(x) - lower)
    between = lower * (len(x) - lower) / len(x) ** 2 * apart**2
    best = int(np.argmax(between))
    return float(np.exp(x[best])) if between[best] > _SEPARATED * x.var() else 0.0


def _unmoved(first: int, last: int, streams: Sequence[Stream], floor: Array, interval: float) -> tuple[int, int]:
    """Trim slow motion at both ends of a quiet run; return its first and last sample."""
    low, high = _SLOW
    slow = round(min(max(_SLOW_SHARE * (last - first) * interval, low), high) / interval)
    first, last = first + slow, last - slow
    quarter = (last - first) // 4
    if quarter <= 0:
        return first, last
    sensors = [(each.values, noise) for each, noise in zip(streams, floor, strict=True)]
    stirring = np.sum([(_scatter(values[first : last + 1], quarter) / noise) ** 2 for values, noise in sensors], axis=0)
    centre = first + quarter + int(np.argmin(stirring[quarter:-quarter]))
    middle = slice(centre - quarter, centre + quarter + 1)
    before, after = [], []
    for values, noise in sensors:
        still = values[middle]
        mean, sigma = still.mean(axis=0), _colour(still) * np.maximum(still.std(axis=0), noise)
        before.append((values[first : middle.start] - mean)[::-1] / sigma)
        after.append((values[middle.stop : last + 1] - mean) / sigma)
    count = middle.stop - middle.start
    return middle.start - _still_for(np.hstack(before), count), middle.stop - 1 + _still_for(np.hstack(after), count)


def _colour(values: Array) -> float:
    """Ratio of the scatter of sums of samples (n, d) to that of white noise; above 1 for a filtered sensor."""
    blocks = len(values) // _TOGETHER
    if blocks < _FEWEST_BLOCKS:
        return 1.0
    means = values[: blocks * _TOGETHER].reshape(blocks, _TOGETHER, -1).mean(axis=1)
    more = _TOGETHER * means.var(axis=0) / np.maximum(values.var(axis=0), _TINY)
    return float(np.sqrt(max(more.mean(), 1.0)))


def _still_for(off: Array, count: int) -> int:
    """Number of leading samples, given as deviations (n, d) in sigmas from a mean of `count` others, without drift."""
    n = np.arange(1, len(off) + 1)
    drift = np.abs(np.cumsum(off, axis=0)).max(axis=1, initial=0.0) / np.sqrt(n * (1.0 + n / count))
    moved = np.flatnonzero(drift > _MOVED)
    if not len(moved):
        return len(off)
    return int(np.max(np.flatnonzero(drift[: moved[0]] < _UNMOVED) + 1, initial=0))


def _scatter(values: Array, half: int) -> Array:
    """Running standard deviation (N,) over 2 half + 1 samples, rms over the axes."""
    n = 2 * half + 1
    centred = values - values.mean(axis=0)
    sums = [np.cumsum(np.pad(power, ((1, 0), (0, 0))), axis=0) for power in (centred, centred**2)]
    mean, square = ((s[n:] - s[:-n]) / n for s in sums)
    out = np.full(len(values), np.inf)
    out[half:-half] = np.sqrt(np.maximum(square - mean**2, 0.0).mean(axis=1))
    # The recording's ends are as quiet as the first and last whole span.
    out[:half], out[-half:] = out[half], out[-half - 1]
    return out


def _turns_not(means: Array, forces: Array, lengths: Index, sigma: float) -> Mask:
    """Mask of runs whose mean rate (n, 3) agrees with one gyro bias and g-sensitivity, so without rotation.

    Bias b and g-sensitivity G of means = b + G forces by least squares with Cauchy's weights, from the median on: a
    turn adds far more than gravity does.
    """
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
