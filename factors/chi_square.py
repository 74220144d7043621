"""Quantiles of the chi-square distribution: gates, bounds on sums of squared residuals, intervals of variances."""

from __future__ import annotations

import math
from functools import lru_cache


@lru_cache(maxsize=4096)
def quantile(probability: float, dof: float) -> float:
    """x with P(chi-square of dof degrees of freedom <= x) = probability; 0 without degrees of freedom."""
    # Importing it takes longer than most commands that need no quantile.
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * dof, probability)) if dof > 0.0 else 0.0


def interval(probability: float, dof: float) -> tuple[float, float]:
    """A true variance lies between these multiples of its estimate with this probability; infinite where unbounded.

    The estimate has dof (equivalent) degrees of freedom.
    """
    tail = 0.5 * (1.0 - probability)
    low, high = dof / quantile(1.0 - tail, dof), quantile(tail, dof)
    return low, dof / high if high > 0.0 else math.inf


def gate(rows: int) -> float:
    """Norm of `rows` whitened residuals that one good measurement in 10,000 exceeds."""
    return quantile(1.0 - 1e-4, rows) ** 0.5


def student(z: float, dof: float) -> float:
    """The number that Student's t exceeds as often as a standard normal number exceeds z > 0."""
    from scipy.special import ndtr, stdtrit

    return abs(float(stdtrit(dof, ndtr(-z))))
