"""Factors that parameters have in common, and the shape that is left without them.

A magnetometer's K and b, and the strength of the field, fit as well when all are multiplied by one factor, which only
the prior of the strength determines. K and b in units of that strength, their shape, are what a recording determines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.problem import Array, CommonFactor, Quantity


@dataclass(frozen=True, eq=False)
class Scaling:
    """A common factor in the linear approximation.

    A change d of all numbers changes the factor by c = gain d, the projection onto the numbers x in units of the usual
    priors of what is calibrated, and the shape by d - x c.

    Attributes:
        factor: as the quantities have it.
        x: (n,) numbers that have the factor, SI; 0 for the others.
        gain: (n,), as above.
    """

    factor: CommonFactor
    x: Array
    gain: Array

    def sigma(self, covariance: Array) -> float:
        """Relative sigma of the factor, of a covariance (n, n)."""
        return float(np.sqrt(max(self.gain @ covariance @ self.gain, 0.0)))

    def shape(self, covariance: Array) -> Array:
        """Covariance (n, n) of the numbers with the factor known."""
        T = np.eye(len(self.x)) - np.outer(self.x, self.gain)
        return np.asarray(T @ covariance @ T.T)


def scalings(quantities: Sequence[Quantity], values: Array) -> list[Scaling]:
    """The common factors of quantities with these values (n,), SI."""
    found = []
    for factor in dict.fromkeys(q.factor for q in quantities if q.factor is not None):
        x = np.array([v if q.factor == factor else 0.0 for q, v in zip(quantities, values, strict=True)])
        weights = np.array([0.0 if q.assumed else q.prior_scale**-2.0 for q in quantities]) * x
        if weights.any():
            found.append(Scaling(factor, x, weights / (weights @ x)))
    return found
