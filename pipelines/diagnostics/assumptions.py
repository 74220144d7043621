"""What assumptions do to a verdict: those that do not hold, and those that cost the accuracy wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.assumptions import pull
from alidade.pipelines.estimation.problem import Array, Estimate, Quantity

# A pull beyond this is no chance ...
_FAR = 4.0
# ... and assumptions correlated beyond this are one: which of them it is the recording does not determine.
_ALIKE = 0.9
# A data sheet's figure that makes at least this part of a variance is worth stating better, and so many are named.
_COSTLY, _MOST_COSTS = 0.2, 3


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
    numbers = zip(quantities, estimate.values.tolist(), sigmas.tolist(), estimate.inflations.tolist(), strict=True)
    pulls = {
        i: size
        for i, (q, value, sigma, inflation) in enumerate(numbers)
        if q.assumed and (size := pull(q, value, sigma, inflation)) is not None
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


def costs(quantities: Sequence[Quantity], covariance: Array) -> str:
    """A sentence that names the data sheets' figures that cost weak parameters most; empty if there are none.

    What a figure costs is the share of a variance that goes when the numbers it is about are known.

    Args:
        quantities: of the covariance, in its order.
        covariance: (n, n).
    """
    variances = np.diag(covariance)
    weak = [i for i, q in enumerate(quantities) if q.judged and variances[i] > q.require**2]
    figures: dict[str, list[int]] = {}
    for i, q in enumerate(quantities):
        if q.sheet and variances[i] > 0.0:
            figures.setdefault(q.sheet, []).append(i)
    shares = {}
    for figure, rows in figures.items():
        across = covariance[np.ix_(weak, rows)]
        known = across @ np.linalg.pinv(covariance[np.ix_(rows, rows)], hermitian=True) @ across.T
        shares[figure] = max(np.diag(known) / variances[weak], default=0.0)
    named = [f for f in sorted(shares, key=lambda f: -shares[f]) if shares[f] > _COSTLY][:_MOST_COSTS]
    if not named:
        return ""
    because = " and ".join(figure.replace(".", " ").replace("_", " ") for figure in named)
    now = [f"sensors.{f} (now {quantities[figures[f][0]].scale:.2g})" for f in named]
    return f"That is because of {because}: state {', '.join(now)} if the data sheet is better."
