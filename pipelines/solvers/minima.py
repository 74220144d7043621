"""Other minima of a graph's cost: where a method says they may be, they are looked at.

Of two minima whose measurements are explained alike only their priors tell which is meant. The likelihood ratio of two
points that are not nested has no distribution of its own; CLOSE is where one number off by its prior would be excluded
at one percent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Minimum, Problem
from alidade.pipelines.solvers.marginals import reported

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from alidade.pipelines.solvers.gauss_newton import Solution
    from alidade.pipelines.solvers.system import System

# By so much less than this, in chi-square, another minimum is told: the 99 % quantile for one degree of freedom.
CLOSE = 6.635
# Values so much above are not followed: descent to a minimum nearby takes off far less.
_FOLLOWED = 3.0 * CLOSE
# Values are others if a number differs by this part of its prior scale.
_DIFFERENT = 0.1


def likeliest(
    problem: Problem,
    solution: Solution,
    minimize: Callable[[System, gtsam.Values], Solution],
    current_keys: Mapping[int, int],
) -> tuple[Solution, Minimum | None]:
    """The solution or, if another minimum is deeper, that one; and the second best if it is close.

    Args:
        problem: the graph's; see its `elsewhere`.
        solution: of the same.
        minimize: finds the minimum of a system from some values.
        current_keys: parameter key -> variable that holds its value.
    """
    if problem.elsewhere is None or not solution.converged:
        return solution, None
    system, found = solution.system, [(solution.system.error(solution.values), solution)]
    for values in problem.elsewhere(solution.values):
        if 2.0 * (system.error(values) - found[0][0]) < _FOLLOWED:
            other = minimize(system, values)
            if other.converged:
                found.append((system.error(other.values), other))
    (least, best), *others = sorted(found, key=lambda each: each[0])
    here = reported(problem, best.values, current_keys)
    scales = np.array([q.scale for q in problem.quantities])
    for error, other in others:
        there = reported(problem, other.values, current_keys)
        if (np.abs(there - here) > _DIFFERENT * scales).any():
            above = 2.0 * (error - least)
            return best, Minimum(there, above) if above < CLOSE else None
    return best, None
