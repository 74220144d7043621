"""Static intervals of a device from its samples alone, without knowing their noise.

The samples are cut into blocks of half a second. A block is at rest when every sensor shows in it

- a scatter below twice that of the quietest blocks,
- a mean that differs from the neighbours' by little more than chance (a motion goes on; noise averages out), and
- samples that differ from one to the next nearly as much as from the mean, von Neumann's ratio, Ann. Math. Stat. 1941
  (a motion is smooth from sample to sample; noise is not, even behind a low-pass filter).

Intervals of two seconds and more count; the block next to a motion does not, for its mean differs. A steady turn looks
like rest to a gyro: the interval with the smallest mean rate is at rest, others are if they have the same rate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.factors.array import Array, Index, Mask

# A block, s, has at least so many samples.
_BLOCK, _LEAST = 0.5, 32
# Scatter: the quietest share of blocks, and how many times theirs a block at rest may have.
_QUIETEST, _LOUDER = 0.05, 2.0
# Difference of neighbouring means: in units of what chance does; at least and at most in units of the scatter, of
# which a ramp has 3.5.
_MOVED, _MOVED_LIMITS = 4.5, (1.0, 2.5)
# Mean squared step over twice the variance: 1 in white noise, 0.1 behind a filter of a tenth of half the rate.
_SMOOTH = 0.02
# An interval at rest, s.
_SHORTEST = 2.0
# Rates of rests agree to within the first, and are below the second: no bias is so large, rad/s.
_STEADY, _LARGEST_BIAS = 0.01, 0.2


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
    spans = spans[t[spans[:, 1]] - t[spans[:, 0]] >= _SHORTEST]
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
    allowed = np.clip(_MOVED * chance, *_MOVED_LIMITS) * np.maximum(scatter, 0.5 * floor)
    still = np.maximum(np.append(moved, 0.0), np.append(0.0, moved)) <= allowed
    return np.asarray((scatter <= _LOUDER * floor) & still & (ratio >= _SMOOTH))


def _not_turning(gyro: Array, spans: Index) -> Mask:
    """Mask of spans with a mean rate that is one constant bias, without a steady rotation."""
    means = np.array([gyro[start : stop + 1].mean(axis=0) for start, stop in spans])
    rate = np.linalg.norm(means, axis=1)
    same = np.linalg.norm(means - means[np.argmin(rate)], axis=1) < _STEADY
    return np.asarray(same & (rate < _LARGEST_BIAS))
