"""A standard deviation that is not known beforehand, as the likelihood has it: zero, or how large."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Of a chi-square with one degree of freedom, the 95 % quantile: what the bound costs in twice the log likelihood.
_BOUND = 3.84
# Where it is looked for, in typical ones.
_LEAST, _MOST, _PLACES = 1e-3, 1e6, 400


def likeliest(doubled: Callable[[float], float], typical: float) -> tuple[float, float]:
    """The standard deviation of the largest likelihood, and the one that it does not exceed (95 %; may be infinite).

    Args:
        doubled: minus twice the log likelihood of a standard deviation >= 0, of one minimum.
        typical: > 0, one that is neither far too large nor far too small.
    """
    grid = typical * np.geomspace(_LEAST, _MOST, _PLACES)
    costs = np.array([doubled(each) for each in grid])
    best, nothing = int(costs.argmin()), doubled(0.0)
    if nothing <= costs[best]:
        found, cost = 0.0, nothing
    else:
        found, cost = _lowest(doubled, float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)]))
    beyond = np.flatnonzero((costs > cost + _BOUND) & (grid > found))
    return found, float(grid[beyond[0]]) if len(beyond) else float("inf")


def _lowest(cost: Callable[[float], float], low: float, high: float) -> tuple[float, float]:
    """Where a function of one minimum between two numbers has it, by thirds."""
    for _ in range(60):
        third = (high - low) / 3.0
        if cost(low + third) < cost(high - third):
            high -= third
        else:
            low += third
    return 0.5 * (low + high), cost(0.5 * (low + high))
