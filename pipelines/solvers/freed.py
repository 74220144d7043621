"""Graphs linearised about a known solution, some numbers freed or moved: only the states are solved again."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from alidade.factors.array import Mask
from alidade.pipelines.estimation.problem import Estimate, Problem, SqrtInformation
from alidade.pipelines.solvers.chain import IndeterminateStateError
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.linear_chain import LinearChain
from alidade.pipelines.solvers.linearization import Group, Linearization
from alidade.pipelines.solvers.marginal_likelihood import at_widening, estimate_levels, unwidened, widened
from alidade.pipelines.solvers.noise_estimation import apply_levels
from alidade.pipelines.solvers.posterior import moved_to, sqrt_information

# Steps to the states that are optimal for the parameters as estimated; first values are near them.
_STEPS = 3


def freed_information(freed: Problem, estimate: Estimate) -> SqrtInformation | None:
    """Square-root information of a graph about the solution of another one that had some numbers fixed.

    Arguments as of `at_solution`; None where the graph does not determine its states.
    """
    try:
        return sqrt_information(*at_solution(freed, estimate), ())
    except (IndeterminateStateError, np.linalg.LinAlgError):
        return None


def at_solution(freed: Problem, estimate: Estimate) -> tuple[Compiled, Linearization, Values]:
    """Compile a graph and linearise it at the solution of another one that had some numbers fixed.

    Noise levels and rejected measurements are the solution's. Levels that a misfit has raised hide its cause: where
    they maximise the likelihood they are found anew.

    Args:
        freed: the graph in which they are free.
        estimate: the solution; a number that it has not is at its prior mean.

    Raises:
        IndeterminateStateError, LinAlgError: the graph does not determine its states.
    """
    compiled, engine, values, used = _linearised(freed, estimate)
    if freed.marginal_likelihood and compiled.engine.is_chain:
        found = estimate_levels(LinearChain.of(compiled.engine, values), estimate.levels, unwidened(used))
        engine = apply_levels(compiled.engine, found).counting(used)
    return compiled, engine, values


def information_at(problem: Problem, estimate: Estimate, device: Collection[str]) -> SqrtInformation:
    """Square-root information of a graph about other values of its numbers than those of its solution.

    Args:
        problem: the graph that was solved.
        estimate: its solution, with the values about which the information is to be linear.
        device: names of the numbers whose priors are set apart.

    Raises:
        IndeterminateStateError: a state is not determined.
    """
    compiled, engine, values, used = _linearised(problem, estimate)
    if problem.marginal_likelihood and engine.is_chain:
        chain = LinearChain.of(compiled.engine, values)
        engine = at_widening(compiled.engine, estimate.levels, widened(chain, estimate.levels, unwidened(used)))
    return sqrt_information(compiled, engine, values, device)


def _linearised(problem: Problem, estimate: Estimate) -> tuple[Compiled, Linearization, Values, list[Mask]]:
    """Compile a graph; return it with an estimate's noise levels and inliers, its states optimal for the values."""
    compiled = Compiled.of(problem.at_levels(estimate.levels))
    used, values = _used(compiled.engine.groups, estimate), compiled.initial
    numbers = {q.name: q.prior_mean for q in compiled.problem.quantities}
    numbers |= zip(estimate.names, estimate.values.tolist(), strict=True)
    engine = apply_levels(compiled.engine, estimate.levels).counting(used)
    for _ in range(_STEPS):
        values = moved_to(compiled, engine, values, numbers)
    return compiled, engine, values, used


def _used(groups: Sequence[Group], estimate: Estimate) -> list[Mask]:
    """Inlier mask (n,) of each group in an estimate; all True where the family's measurements differ."""
    used = [np.ones(len(group.model.time), dtype=bool) for group in groups]
    for family, known in estimate.residuals.items():
        own = [i for i, group in enumerate(groups) if group.family == family and group.is_measurement]
        if not own or sum(len(used[i]) for i in own) != len(known.used):
            continue
        order = np.argsort(np.concatenate([groups[i].factors for i in own]), kind="stable")
        flat = np.empty(len(order), dtype=bool)
        flat[order] = known.used
        ends = np.cumsum([len(used[i]) for i in own])[:-1]
        for i, each in zip(own, np.split(flat, ends), strict=True):
            used[i] = each
    return used
