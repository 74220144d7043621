"""Quantiles of the chi-square distribution, for gates and for bounds on the sum of squared residuals."""

from __future__ import annotations

from statistics import NormalDist


def quantile(probability: float, dof: float) -> float:
    """x with P(chi-square of dof degrees of freedom <= x) = probability.

    To 1 % for dof >= 100; upper quantiles to 5 % for dof >= 2. Wilson,
    Hilferty, "The distribution of chi-square", PNAS 1931: the cube root of x / dof is nearly normal.
    """
    if dof <= 0.0:
        return 0.0
    spread = 2.0 / (9.0 * dof)
    root = 1.0 - spread + NormalDist().inv_cdf(probability) * spread**0.5
    return float(dof * max(root, 0.0) ** 3)


def gate(rows: int) -> float:
    """Norm of `rows` whitened residuals that one good measurement in 10,000 exceeds."""
    return quantile(1.0 - 1e-4, rows) ** 0.5
