"""What is said of a second solution that is nearly as likely as the one reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.display.units import human_unit
from alidade.pipelines.estimation.problem import Estimate, Quantity

# So many of the numbers that differ most are named.
_NAMED = 3


def other_solution(estimate: Estimate, quantities: Sequence[Quantity]) -> str:
    """A sentence; empty where there is no such solution. The quantities are the estimate's, in its order."""
    if estimate.second is None:
        return ""
    there, scales = estimate.second.values, np.array([q.scale for q in quantities])
    most = np.argsort(-np.abs(there - estimate.values) / scales)[:_NAMED]
    named = []
    for i in most:
        unit, factor = human_unit(quantities[i])
        named.append(
            f"{quantities[i].name} {factor * there[i]:.3g} for {factor * estimate.values[i]:.3g} {unit}".rstrip()
        )
    return (
        f"Another solution is nearly as likely, its chi-square {estimate.second.chi_square:.1f} higher by the priors: "
        f"{', '.join(named)}. second_best in result.json has it whole."
    )
