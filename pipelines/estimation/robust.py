"""Statistics and least squares that outliers do not disturb, and intervals in which something disturbed a sensor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from alidade.factors.array import Array, Mask

# Of numeric differentiation, in units of each number.
_STEP = 1e-6
# Numbers that a step moves by less than this part of their sigmas stay where they are.
_SETTLED = 0.05
# Chance that outliers which are independent of each other make an interval in one family of a recording.
_CHANCE = 1e-3
# Shares of outliers: in a disturbance, and at least and at most outside. A field is disturbed along its own direction
# in half of all attitudes, roughly.
_WITHIN, _OUTSIDE = 0.5, (0.01, 0.4)
# The ends of an interval are smooth where the median of its outer quarter is less than this share of that of its inner
# half: of a dipole that passes it is a fifth or less, of a current that is switched 1.
_SMOOTH = 0.5


def robust_sigma(values: Array) -> float:
    """Standard deviation of zero-mean normal numbers, estimated from the median absolute value."""
    return float(np.median(np.abs(values), overwrite_input=True)) / 0.6745 if values.size else 0.0


def fitted(
    near: Callable[[Array], Callable[[Array], Array]], x: Array, prior: Array, sigma: float, most: int
) -> tuple[Array, Array]:
    """Iterate robust least-squares steps until convergence; return x (m,) and its covariance (m, m).

    Args:
        near: what misses (n, d), as a function of x near some x.
        x: where it begins.
        prior: (m,) inverse sigmas of x about zero.
        sigma: the least that what misses is taken to scatter by.
        most: steps.
    """
    for _ in range(most):
        miss = near(x)
        error = miss(x)
        size = np.linalg.norm(error, axis=1)
        scale = max(float(np.median(size)), sigma)
        weight = 1.0 / (scale * np.sqrt(1.0 + (size / (3.0 * scale)) ** 2))[:, None]
        columns = [(weight * (miss(x + d) - error)).ravel() / _STEP for d in _STEP * np.eye(len(x))]
        A = np.vstack([np.stack(columns, axis=1), np.diag(prior)])
        step = np.linalg.lstsq(A, np.concatenate([(weight * error).ravel(), prior * x]))[0]
        x, covariance = x - step, np.linalg.inv(A.T @ A)
        if (np.abs(step) < _SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    return x, covariance


def intervals(rejected: Mask) -> list[tuple[int, int]]:
    """Find disturbed intervals among measurements (n,) in time order: first index and one past the last of each.

    An interval maximises the sum of log likelihood ratios of its measurements, outliers with a share of `_WITHIN`
    against outliers with the recording's share; with n measurements that sum exceeds log(n / p) with a probability of
    at most p in one without a disturbance (Karlin and Altschul, "Methods for assessing the statistical significance of
    molecular sequence features by using general scoring schemes", PNAS 1990).
    """
    if not rejected.any():
        return []
    share = float(np.clip(rejected.mean(), *_OUTSIDE))
    of_outlier, of_other = np.log(_WITHIN / share), np.log((1.0 - _WITHIN) / (1.0 - share))
    scores: Array = of_other + (of_outlier - of_other) * rejected
    found, left, least = [], [(0, len(scores))], np.log(len(scores) / _CHANCE)
    while left:
        low, high = left.pop()
        first, last, total = _best(scores[low:high])
        if total > least:
            found.append((low + first, low + last))
            left += [(low, low + first), (low + last, high)]
    return sorted(found)


def onsets(time: Array, norms: Array, rejected: Mask) -> Mask:
    """Mask (n,) of measurements in a disturbed interval or within half its duration of its smooth ends.

    Outliers are rejected where a disturbance exceeds the gate. That of a dipole falls with the cube of the distance: at
    twice the distance it is an eighth of the gate, half a sigma.

    Args:
        time: (n,) s, increasing.
        norms: (n,) of whitened residuals.
        rejected: (n,).
    """
    out = np.zeros(len(time), dtype=bool)
    for first, last in intervals(rejected):
        quarter = (last - first) // 4
        edge, inner = max(quarter, 1), _SMOOTH * np.median(norms[first + quarter : last - quarter])
        begin, end = time[first], time[last - 1]
        margin = 0.5 * (end - begin)
        smooth = [np.median(norms[some]) < inner for some in (slice(first, first + edge), slice(last - edge, last))]
        if any(smooth):
            out |= (time >= begin - margin * smooth[0]) & (time <= end + margin * smooth[1])
    return out


def _best(scores: Array) -> tuple[int, int, float]:
    """First index, one past the last, and sum of the interval of scores (n,) with the largest sum; zeros if n is 0."""
    if not len(scores):
        return 0, 0, 0.0
    sums = np.append(0.0, np.cumsum(scores))
    lowest = np.minimum.accumulate(sums)
    last = int(np.argmax(sums - lowest))
    return int(np.argmin(sums[: last + 1])), last, float((sums - lowest)[last])
