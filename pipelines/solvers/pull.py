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

from pipelines.graph.problem import Array, Factor, Problem
from pipelines.solvers.gauss_newton import MOST_ITERATIONS, Solution, minimize
from pipelines.solvers.marginals import joint_covariance
from pipelines.solvers.spurious import information_of_noise
from pipelines.solvers.system import Linear, System

# Combinations nearer than this to their priors' means, in sigmas of these, stay where they are.
_NEAR = 0.05
# They are held by so many priors' sigmas to one, and a force is a prior with this part of a sigma's weight, far away.
_TIGHT, _FAINT = 30.0, 0.03
# Where that raises chi-square by more than this for each of them, it was not noise that told them.
_DEAR = 9.0


def without_pull(
    problem: Problem,
    solution: Solution,
    about: Linear,
    current_keys: Mapping[int, int],
    most: int = MOST_ITERATIONS,
) -> Solution:
    """The solution, with what noise alone tells of its parameters held where their priors have it.

    Args:
        problem: the graph's.
        solution: of the same.
        about: it, linearised.
        current_keys: parameter key -> variable that holds its value.
        most: iterations.

    Raises:
        IndeterminateError: states other than the parameters are not determined.
    """
    system, values = solution.system, solution.values
    covariance = joint_covariance(problem, about.graph, system.ordering, values, current_keys)
    noise = information_of_noise(problem, about, covariance, current_keys)
    if not solution.converged or noise is None:
        return solution
    combined = _Combined(problem, current_keys, noise.directions)
    if not (np.abs(combined.at(values)) > _NEAR).any():
        return solution
    # What is rejected stays so, lest what is held have measurements rejected that speak against it.
    hold = combined.prior(np.zeros(len(noise.directions)), _TIGHT)
    held = minimize(_with(system.without_rejected(values), hold), values, most=most)
    costs = 2.0 * (system.error(held.values) - system.error(values))
    if not held.converged or costs > _DEAR * len(noise.directions):
        return solution
    mean = combined.at(held.values) * (1.0 - (_TIGHT / _FAINT) ** 2)
    iterations = solution.iterations + held.iterations
    return replace(held, system=_with(system, combined.prior(mean, _FAINT)), iterations=iterations)


def _with(system: System, factor: Factor) -> System:
    """The system with one more factor, at its end."""
    factors = [*system.factors, factor]
    ends = [*system.boundaries[:-1], *(end._replace(factors=len(factors)) for end in system.boundaries[-1:])]
    return System.of(factors, system.shared, system.loss, ends)


@dataclass(frozen=True)
class _Combined:
    """Combinations of the reported numbers that are free, off their priors' means, in prior scales.

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
        return Factor("prior", gtsam.CustomFactor(noise, keys, evaluate))
