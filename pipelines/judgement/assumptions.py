"""Assumptions that do not hold: systematic effects that the recording finds far beyond what their priors allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipelines.graph.assumptions import pull
from pipelines.graph.problem import Estimate, Quantity

# A pull beyond this is no chance ...
_FAR = 4.0
# ... and assumptions correlated beyond this are one: which of them it is the recording does not determine.
_ALIKE = 0.9


@dataclass(frozen=True)
class Strained:
    """An assumption that does not hold.

    Attributes:
        quantity: the one with the largest pull of its group.
        value, sigma: its estimate, SI.
        pull: how far the recording takes it from its prior, in sigmas of what it could.
        others: assumptions that it cannot be told from.
    """

    quantity: Quantity
    value: float
    sigma: float
    pull: float
    others: tuple[str, ...]


def strained(estimate: Estimate, quantities: Sequence[Quantity]) -> tuple[Strained, ...]:
    """The assumptions that do not hold, the worst first, one for each group that belongs together.

    Args:
        estimate: converged.
        quantities: of the estimate, in its order.
    """
    sigmas = estimate.sigmas
    pulls = {
        i: size
        for i, q in enumerate(quantities)
        if q.assumed and (size := pull(q, float(estimate.values[i]), float(sigmas[i]))) is not None
    }
    assumed = [i for i, q in enumerate(quantities) if q.assumed and sigmas[i] > 0.0]
    left = sorted((i for i, p in pulls.items() if abs(p) > _FAR), key=lambda i: -abs(pulls[i]))
    found = []
    while left:
        worst = left[0]
        alike = {
            j for j in assumed if abs(estimate.covariance[worst, j]) > _ALIKE * sigmas[worst] * sigmas[j] and j != worst
        }
        others = tuple(quantities[j].name for j in sorted(alike))
        value, sigma = float(estimate.values[worst]), float(sigmas[worst])
        found.append(Strained(quantities[worst], value, sigma, pulls[worst], others))
        left = [i for i in left[1:] if i not in alike]
    return tuple(found)
