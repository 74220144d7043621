"""Whether a linearised system stands for the real one as far as the parameters may still move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.solvers.gauss_newton import Solution
from alidade.pipelines.solvers.marginals import IndeterminateError, coordinate_inverse

# So many points about the estimate are tried, in pairs.
_PAIRS = 4
# By this part the error there, or a variance, may differ from what the linear system foresees: sigmas are then wrong by
# half as much.
BENT = 0.15


def is_linear(problem: Problem, solution: Solution, keys: Sequence[int], kept: Sequence[int]) -> bool:
    """Whether the error is what its linearisation foresees at parameters drawn from their covariance.

    What is kept follows the parameters by the linearisation, as it will once the past is folded; all other states are
    where they are likeliest then. (Where these too follow by the linearisation they may leave the error's floor, as
    along a camera's roll, though the floor itself is as foreseen.)
    Where it is not, the past must not be folded into a Gaussian: motion to come may move the parameters so far.

    Args:
        problem: the graph's.
        solution: its minimum, of a system in one piece.
        keys: variables that hold the parameters.
        kept: those that the Gaussian is to be of.
    """
    values, system = solution.values, solution.system
    linear, error = system.linearized(values), system.error(values)
    dims = values.dims()
    ends = np.cumsum([dims[key] for key in keys])
    still = {key: np.zeros(dims[key]) for key in kept}
    generator = np.random.default_rng(0)
    try:
        information = linear.information(keys)
        free = np.flatnonzero([q.prior_sigma != 0.0 for q in problem.quantities])
        scale = np.array([q.scale for q in problem.quantities])[free]
        unit = coordinate_inverse(problem.parameters, values, keys)[:, free] * scale
        eigenvalues, vectors = np.linalg.eigh(unit.T @ information @ unit)
        root = unit @ vectors / np.sqrt(np.maximum(eigenvalues, 1e-12))
        for drawn in generator.standard_normal((_PAIRS, len(free))):
            for z in (drawn, -drawn):
                moves = dict(zip(keys, np.split(root @ z, ends[:-1]), strict=True))
                there = values.retract(linear.holding(moves).step()[0])
                rise = 0.5 * float(z @ z)
                off = system.error(there) - error - rise
                if off > BENT * rise:
                    there = there.retract(system.linearized(there).holding(still).step()[0])
                    off = system.error(there) - error - rise
                if not abs(off) < BENT * rise:
                    return False
    except (RuntimeError, IndeterminateError, np.linalg.LinAlgError):
        return False
    return True
