"""Goodness of fit: chi-square with its interval, whiteness of innovations, difference between two solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from alidade.factors.chi_square import quantile
from alidade.pipelines.estimation.problem import Estimate, Quantity, Residuals

# Either tail outside the 99.9 % interval.
_TAIL = 5e-4
# Lags of the autocorrelation, and the fewest innovations that have one.
_LAGS, _MIN_INNOVATIONS = 5, 20


@dataclass(frozen=True)
class Fit:
    """A sum of squared whitened residuals, its degrees of freedom and its 99.9 % interval.

    With less than one degree of freedom there is no interval: low and high are NaN.
    """

    value: float
    dof: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, dof: float) -> Fit:
        """Build a chi-square value with its interval."""
        if dof < 1.0:
            return cls(value, dof, np.nan, np.nan)
        return cls(value, dof, quantile(_TAIL, dof), quantile(1.0 - _TAIL, dof))

    @property
    def noise_factor(self) -> float:
        """Factor on the noise used that makes chi-square equal to its expectation."""
        return float(np.sqrt(self.value / max(self.dof, 1.0)))

    @property
    def z(self) -> float:
        """Deviation of chi-square from its expectation, in standard deviations."""
        return float((self.value - self.dof) / np.sqrt(2.0 * max(self.dof, 1.0)))


@dataclass(frozen=True)
class InnovationTest:
    """Whiteness and normalised innovation squared (NIS) of the innovations of a family.

    Attributes:
        autocorrelation: at the lags 1, 2, ... measurements; 0 expected.
        bound: 99.9 % of white innovations have an autocorrelation within plus and minus this.
        nis: mean of the squared norms; `rows` expected.
        low, high: 99.9 % interval of that mean.
        rows: numbers in a measurement.
    """

    autocorrelation: tuple[float, ...]
    bound: float
    nis: float
    low: float
    high: float
    rows: int

    @classmethod
    def of(cls, residuals: Residuals) -> InnovationTest | None:
        """Test the innovations of inlier measurements; None if there are too few."""
        used = residuals.whitened[residuals.used]
        n, rows = used.shape
        if n < _MIN_INNOVATIONS:
            return None
        square = float((used**2).sum())
        lags = tuple(float((used[lag:] * used[:-lag]).sum()) / square for lag in range(1, _LAGS + 1))
        fit = Fit.of(square, float(n * rows))
        bound = NormalDist().inv_cdf(1.0 - _TAIL) / float(np.sqrt(n * rows))
        return cls(lags, bound, square / n, fit.low / n, fit.high / n, rows)


@dataclass(frozen=True)
class SolverDifference:
    """Largest difference of an estimate from a reference solution, in sigmas.

    Attributes:
        parameter: that differs most, in units of its own sigma.
        z: estimate less reference, over that sigma.
        sigma_ratio: the smallest of the estimate's sigmas over the reference's.
    """

    parameter: str
    z: float
    sigma_ratio: float


def solver_difference(
    estimate: Estimate, reference: Estimate, quantities: Sequence[Quantity]
) -> SolverDifference | None:
    """Compare the required numbers with those of a reference solution; None if unconverged or without free ones."""
    known = (estimate.sigmas > 0.0) & (reference.sigmas > 0.0)
    free = np.flatnonzero(known & np.isin(estimate.names, [q.name for q in quantities if q.required]))
    if not len(free) or not reference.converged:
        return None
    z = (estimate.values - reference.values)[free] / estimate.sigmas[free]
    worst = int(np.argmax(np.abs(z)))
    ratio = float((estimate.sigmas[free] / reference.sigmas[free]).min())
    return SolverDifference(estimate.names[free[worst]], float(z[worst]), ratio)
