"""Quantiles of the chi-square distribution: gates, bounds on sums of squared residuals, intervals of variances."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

# From so many degrees of freedom on the normal approximation is good to 1 % at both ends.
_MANY = 30.0


@lru_cache(maxsize=4096)
def quantile(probability: float, dof: float) -> float:
    """x with P(chi-square of dof degrees of freedom <= x) = probability.

    To 1 %. Many degrees of freedom: Wilson, Hilferty, "The distribution of chi-square", PNAS 1931: the cube root of
    x / dof is nearly normal. Few: the distribution itself, inverted by bisection.
    """
    if dof <= 0.0:
        return 0.0
    spread = 2.0 / (9.0 * dof)
    root = 1.0 - spread + NormalDist().inv_cdf(probability) * spread**0.5
    near = dof * max(root, 0.0) ** 3
    if dof >= _MANY:
        return near
    low, high = 0.0, 2.0 * near + 1.0
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _distribution(middle, dof) < probability else (low, middle)
    return 0.5 * (low + high)


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


def _distribution(x: float, dof: float) -> float:
    """P(chi-square <= x): the series of the incomplete gamma function, Abramowitz, Stegun, 6.5.29."""
    a, y = 0.5 * dof, 0.5 * x
    if y <= 0.0:
        return 0.0
    term = total = 1.0 / a
    n = a
    while term > 1e-12 * total:
        n += 1.0
        term *= y / n
        total += term
    return total * math.exp(a * math.log(y) - y - math.lgamma(a))


def student(z: float, dof: float) -> float:
    """The number that Student's t exceeds as often as a standard normal number exceeds z > 0."""
    from scipy.special import ndtr, stdtrit

    return abs(float(stdtrit(dof, ndtr(-z))))
