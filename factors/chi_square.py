"""Quantiles of the chi-square distribution: gates, bounds on sums of squared residuals, intervals of variances."""

from __future__ import annotations

import math
from functools import lru_cache


@lru_cache(maxsize=4096)
def quantile(probability: float, dof: float) -> float:
    """Quantile of the chi-square distribution with dof degrees of freedom; 0 for dof = 0."""
    # Importing it takes longer than most commands that need no quantile.
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * dof, probability)) if dof > 0.0 else 0.0


def interval(probability: float, dof: float) -> tuple[float, float]:
    """Confidence interval of a variance, as multiples of its estimate; infinite where unbounded.

    The estimate has dof (equivalent) degrees of freedom.
    """
    tail = 0.5 * (1.0 - probability)
    low, high = dof / quantile(1.0 - tail, dof), quantile(tail, dof)
    return low, dof / high if high > 0.0 else math.inf


def gate(rows: int) -> float:
    """Norm of `rows` whitened residuals that a good measurement exceeds with probability 1e-4."""
    return quantile(1.0 - 1e-4, rows) ** 0.5


def student(z: float, dof: float) -> float:
    """Quantile of Student's t with the same tail probability as a standard normal number z > 0."""
    from scipy.special import ndtr, stdtrit

    return abs(float(stdtrit(dof, ndtr(-z))))
