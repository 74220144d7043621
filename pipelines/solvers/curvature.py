"""What a linearised graph leaves out of the covariance where parameters may still move far.

A sensor at rest tells a sum of bias and mounting angle times rate to the last digit, and neither of both. The linear
system knows the sum along the tangent at the estimate alone: at the true values, a tenth of a radian off, it differs by
what is of second order, which is thousands of its sigmas. So the directions that are known have, beside the variance
that the linear system gives them, that of how far they follow the ones that are not: of the way from the tangent back
to the floor of the error, at values drawn from their covariance.

Variables that measurements are linear in may be reported as numbers that are not: an offset c of raw readings is known
to the last digit where b = -K c, with a K that is not, is reported. Of that the same draws tell, by the way from the
numbers' own tangent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from pipelines.graph.problem import Array, Problem
from pipelines.solvers.marginals import IndeterminateError, prior_units, reduced

if TYPE_CHECKING:
    from pipelines.solvers.system import System

# Directions of which sigma is within this share of the prior, and of the widest, follow the others.
_WEAK, _LESS = 0.1, 0.5
# Where no sigma of what is calibrated is beyond this share nothing is drawn.
_SURE = 0.01
_DRAWS = 16
# The first few suffice to see that none makes up this much of a squared sigma in all.
_TRIED, _SLIGHT = 3, 0.1
# Information in units of the priors' with which there is no prior.
_ANYWHERE = 0.5


def second_order(
    problem: Problem,
    system: System,
    values: gtsam.Values,
    covariance: Array,
    current_keys: Mapping[int, int],
) -> Array | None:
    """Covariance (n, n) of the reported numbers that the linear system does not know of.

    None where nothing may move far, or where what moves has neither prior nor measurements, and may be anywhere.

    Args:
        problem: the graph's.
        system: of the same.
        values: its solution.
        covariance: (n, n) of the reported numbers as the linearised graph has it.
        current_keys: parameter key -> variable that holds its value.
    """
    calibrated = [q.prior_sigma != 0.0 and not q.assumed for q in problem.quantities]
    scales = np.array([q.scale for q in problem.quantities])
    scaled = (covariance / np.outer(scales, scales))[np.ix_(calibrated, calibrated)]
    if not len(scaled) or np.linalg.eigvalsh(scaled)[-1] < _SURE**2:
        return None
    keys = [current_keys.get(p.key, p.key) for p in problem.parameters]
    free, scale, unit = prior_units(problem.parameters, values, keys)
    # Far from the solution the loss would reject what is good.
    system, ordering = system.without_rejected(values), system.ordering
    try:
        linear = system.linearized(values)
        information, slope = reduced(linear.graph, ordering, keys)
        eigenvalues, vectors = np.linalg.eigh(unit.T @ information @ unit)
        if eigenvalues[0] < _ANYWHERE:
            return None
        told = eigenvalues >= max(_WEAK**-2.0, _LESS**-2.0 * eigenvalues[0])
        steps: list[Array] = []
        known = unit @ vectors[:, told]
        generator = np.random.default_rng(0)
        # Values of hours are large: no more of them at once than are looked at.
        draws = (linear.drawn(keys, count, generator) for count in (_TRIED, _DRAWS - _TRIED))
        for each in chain.from_iterable(draws):
            move = values.localCoordinates(each)
            # As far as the linear system goes back itself, its covariance has it already.
            tangent = slope - information @ np.concatenate([move.at(key) for key in keys])
            back = _back(*reduced(system.linearize(each), ordering, keys), known)
            bent = _numbers_bent(problem, values, each, move, keys)[free] / scale
            steps.append(back - _back(information, tangent, known) + vectors[:, told].T @ bent)
            if len(steps) == _TRIED and (eigenvalues[told] * np.square(steps)).sum(axis=1).max() < _SLIGHT:
                return None
    except (RuntimeError, IndeterminateError, np.linalg.LinAlgError):
        return None
    moves = np.array(steps) @ vectors[:, told].T * scale
    found = np.zeros_like(covariance)
    found[np.ix_(free, free)] = moves.T @ moves / _DRAWS
    return found


def _back(information: Array, slope: Array, known: Array) -> Array:
    """The step (k,) to the floor along some directions, by columns, of parameters with these normal equations."""
    return np.asarray(np.linalg.solve(known.T @ information @ known, known.T @ slope))


def _numbers_bent(
    problem: Problem, values: gtsam.Values, moved: gtsam.Values, move: gtsam.VectorValues, keys: Sequence[int]
) -> Array:
    """How far the reported numbers (n,) of values moved are from what their Jacobian foresees."""
    found = []
    for p, key in zip(problem.parameters, keys, strict=True):
        numbers, J = p.coordinates(values, key)
        found.append(p.coordinates(moved, key)[0] - numbers - J @ move.at(key))
    return np.concatenate(found)
