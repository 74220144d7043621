"""What noise alone tells of parameters is held where their priors have it.

The solution is found anew with the combinations of numbers that `spurious` names held tightly. There measurements still
pull at them; a force that balances the pull takes the place of the hold. So the solution is the minimum of a system
that says nothing more of the combinations than it did, and all that is made of a solution can be made of this one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Array, Factor, Problem
from alidade.pipelines.solvers.gauss_newton import MOST_ITERATIONS, Solution, minimize
from alidade.pipelines.solvers.marginals import HELD, joint_covariance
from alidade.pipelines.solvers.spurious import Spurious, information_of_noise
from alidade.pipelines.solvers.system import System

# Combinations nearer than this to their priors' means, in sigmas of these, stay where they are. Where some are held, it
# may show of others that they have been pulled, or that all is told: so often there are more. One that is less than
# this off others is theirs.
_NEAR, _MOST, _SAME = 0.05, 3, 0.1
# They are held by so many priors' sigmas to one, and a force is a prior with this part of a sigma's weight, far away.
_TIGHT, _FAINT = 30.0, 0.03
# Where that raises chi-square by more than this a squared sigma of their priors, it was not noise that told them.
_DEAR = 3.0


def without_pull(
    problem: Problem,
    solution: Solution,
    noise: Spurious | None,
    current_keys: Mapping[int, int],
    most: int = MOST_ITERATIONS,
) -> Solution:
    """The solution, with what noise alone tells of its parameters held where their priors have it.

    Args:
        problem: the graph's.
        solution: of the same, converged.
        noise: what of its information is noise.
        current_keys: parameter key -> variable that holds its value.
        most: iterations.

    Raises:
        IndeterminateError: states other than the parameters are not determined.
    """
    found, rows = solution, np.zeros((0, np.count_nonzero([q.prior_sigma != 0.0 for q in problem.quantities])))
    for _ in range(_MOST):
        if noise is None:
            return solution
        rows = _orthonormal(np.concatenate([rows, noise.directions]))
        # The keys of now: later other variables hold a bias that walks.
        combined = _Combined(problem, dict(current_keys), rows)
        held = None
        if (np.abs(combined.at(found.values)) > _NEAR).any():
            held = _held(solution.system, found.values, combined, most)
        if held is None:
            return found
        found = replace(held, iterations=found.iterations + held.iterations)
        about = found.system.linearized(found.values)
        covariance = joint_covariance(problem, about, current_keys)
        noise = information_of_noise(problem, about, covariance, current_keys)
    return solution if noise is None else found


def _held(system: System, values: gtsam.Values, combined: _Combined, most: int) -> Solution | None:
    """The solution with combinations held, found from some values, with the force that does it; None: there is none."""
    # What is rejected stays so, lest what is held have measurements rejected that speak against it.
    hold = combined.prior(np.zeros(len(combined.rows)), _TIGHT)
    held = minimize(_with(system.without_rejected(values), hold), values, most=most)
    costs, off = 2.0 * (system.error(held.values) - system.error(values)), combined.at(values)
    if not held.converged or costs > _DEAR * float(off @ off):
        return None
    mean = combined.at(held.values) * (1.0 - (_TIGHT / _FAINT) ** 2)
    return replace(held, system=_with(system, combined.prior(mean, _FAINT)))


def _orthonormal(rows: Array) -> Array:
    """Orthonormal rows that span the same, but for what is nearly in the others already."""
    _, sizes, axes = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(axes[sizes > _SAME])


def _with(system: System, factor: Factor) -> System:
    """The system with one more factor, at its end."""
    factors = [*system.factors, factor]
    ends = [*system.boundaries[:-1], *(end._replace(factors=len(factors)) for end in system.boundaries[-1:])]
    return System.of(factors, system.shared, system.loss, ends)


@dataclass(frozen=True)
class _Combined:
    """Combinations of the reported numbers that are free: how far they are off their priors' means, in prior scales.

    Attributes:
        problem: the graph's.
        current_keys: parameter key -> variable that holds its value.
        rows: (k, m) of the numbers.
    """

    problem: Problem
    current_keys: Mapping[int, int]
    rows: Array

    def at(self, values: gtsam.Values, jacobians: list[Array] | None = None) -> Array:
        """(k,) and, if asked, the derivatives by the variables."""
        found, start = np.zeros(len(self.rows)), 0
        for i, p in enumerate(self.problem.parameters):
            free = np.flatnonzero([q.prior_sigma != 0.0 for q in p.quantities])
            numbers, J = p.coordinates(values, self.current_keys.get(p.key, p.key))
            scales = np.array([q.prior_scale for q in p.quantities])[free]
            means = np.array([q.prior_mean for q in p.quantities])[free]
            own = self.rows[:, start : start + len(free)] / scales
            start += len(free)
            found += own @ (numbers[free] - means)
            if jacobians is not None:
                jacobians[i] = np.asfortranarray(own @ J[free])
        return found

    def prior(self, mean: Array, weight: float) -> Factor:
        """A prior on them about a mean (k,), its sigma in prior scales the reciprocal of the weight."""

        def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            return self.at(values, jacobians) - mean

        keys = [self.current_keys.get(p.key, p.key) for p in self.problem.parameters]
        noise = gtsam.noiseModel.Isotropic.Sigma(len(self.rows), 1.0 / weight)
        return Factor(HELD, gtsam.CustomFactor(noise, keys, evaluate))
