"""Intervals in which most measurements of a family are rejected: something disturbed them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Array, Estimate, Residuals

# Chance that outliers which are independent of each other make an interval in one family of a recording.
_CHANCE = 1e-3
# Shares of outliers: in a disturbance, and at least and at most outside. A field is disturbed along its own direction
# in half of all attitudes, roughly.
_WITHIN, _OUTSIDE = 0.5, (0.01, 0.4)


def disturbances(estimate: Estimate) -> Iterator[Finding]:
    """One finding for each interval, in time order."""
    for family, residuals in estimate.residuals.items():
        for since, until, count in _intervals(residuals):
            evidence = {"family": family, "since_s": since, "time_s": until, "rejected": count}
            yield Finding("disturbance", Severity.NOTE, evidence)


def _intervals(residuals: Residuals) -> list[tuple[float, float, int]]:
    """Beginning, end, s, and number of rejected measurements of each interval.

    An interval maximises the sum of log likelihood ratios of its measurements, outliers with a share of `_WITHIN`
    against outliers with the recording's share; with n measurements that sum exceeds log(n / p) with a probability of
    at most p in one without a disturbance (Karlin and Altschul, "Methods for assessing the statistical significance of
    molecular sequence features by using general scoring schemes", PNAS 1990).
    """
    if residuals.used.all():
        return []
    order = np.argsort(residuals.time, kind="stable")
    time, rejected = residuals.time[order], ~residuals.used[order]
    share = float(np.clip(rejected.mean(), *_OUTSIDE))
    of_outlier, of_other = np.log(_WITHIN / share), np.log((1.0 - _WITHIN) / (1.0 - share))
    scores: Array = of_other + (of_outlier - of_other) * rejected
    found, left, least = [], [(0, len(scores))], np.log(len(scores) / _CHANCE)
    while left:
        low, high = left.pop()
        first, last, total = _best(scores[low:high])
        if total > least:
            inside = slice(low + first, low + last)
            found.append((float(time[inside][0]), float(time[inside][-1]), int(rejected[inside].sum())))
            left += [(low, low + first), (low + last, high)]
    return sorted(found)


def _best(scores: Array) -> tuple[int, int, float]:
    """First, one past the last, and sum of the interval of scores (n,) with the largest sum; 0 where n is 0."""
    if not len(scores):
        return 0, 0, 0.0
    sums = np.append(0.0, np.cumsum(scores))
    lowest = np.minimum.accumulate(sums)
    last = int(np.argmax(sums - lowest))
    return int(np.argmin(sums[: last + 1])), last, float((sums - lowest)[last])
