"""A factor that numbers have in common with the strength of what a sensor measures, and the shape that is left.

A magnetometer's K and b, and the field, fit as well when all are multiplied by one factor, which only the prior of the
field's strength determines. K and b in units of that strength, their shape, are what a recording determines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.problem import Array, CommonFactor, Quantity


@dataclass(frozen=True, eq=False)
class Scaling:
    """A common factor in the linear approximation.

    Attributes:
        factor: as the quantities have it.
        sigma: of the strength, relative.
        moves: (n,) what one sigma of the strength moves each number by.
        shape: (n, n) covariance of the numbers given the strength: with `moves` squared it is that of the numbers.
    """

    factor: CommonFactor
    sigma: float
    moves: Array
    shape: Array


def scalings(quantities: Sequence[Quantity], covariance: Array, values: Array) -> list[Scaling]:
    """The common factors of quantities with this covariance (n, n) and these values (n,), SI."""
    found = []
    for factor in dict.fromkeys(q.factor for q in quantities if q.factor is not None):
        of = np.array([q.factor == factor and q.assumed for q in quantities])
        strength = np.where(of, values, 0.0)
        gain = strength / max(float(strength @ strength), np.finfo(float).tiny)
        sigma = float(np.sqrt(max(float(gain @ covariance @ gain), 0.0)))
        moves = covariance @ gain / sigma if sigma > 0.0 else np.zeros(len(values))
        found.append(Scaling(factor, sigma, moves, covariance - np.outer(moves, moves)))
    return found
