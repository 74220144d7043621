"""Intervals in which most measurements of a family are rejected: something disturbed them."""

from __future__ import annotations

import numpy as np

from alidade.factors.array import Array, Mask

# Chance that outliers which are independent of each other make an interval in one family of a recording.
_CHANCE = 1e-3
# Shares of outliers: in a disturbance, and at least and at most outside. A field is disturbed along its own direction
# in half of all attitudes, roughly.
_WITHIN, _OUTSIDE = 0.5, (0.01, 0.4)
# The ends of an interval are smooth where the median of its outer quarter is less than this share of that of its inner
# half: of a dipole that passes it is a fifth or less, of a current that is switched 1.
_SMOOTH = 0.5


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
        inner = _SMOOTH * np.median(norms[first + quarter : last - quarter])
        margin = 0.5 * (time[last - 1] - time[first])
        begin, end = time[first], time[last - 1]
        smooth = [np.median(norms[some]) < inner for some in _outer(first, last, quarter)]
        if any(smooth):
            out |= (time >= begin - margin * smooth[0]) & (time <= end + margin * smooth[1])
    return out


def _outer(first: int, last: int, quarter: int) -> tuple[slice, slice]:
    return slice(first, first + max(quarter, 1)), slice(last - max(quarter, 1), last)


def _best(scores: Array) -> tuple[int, int, float]:
    """First index, one past the last, and sum of the interval of scores (n,) with the largest sum; zeros if n is 0."""
    if not len(scores):
        return 0, 0, 0.0
    sums = np.append(0.0, np.cumsum(scores))
    lowest = np.minimum.accumulate(sums)
    last = int(np.argmax(sums - lowest))
    return int(np.argmin(sums[: last + 1])), last, float((sums - lowest)[last])
