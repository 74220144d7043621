"""What a linearised graph leaves out of the covariance where parameters may still move far.

A sensor at rest tells a sum of bias and mounting angle times rate to the last digit, and neither of both. The linear
system knows the sum along the tangent at the estimate alone: at the true values, a tenth of a radian off, it differs by
what is of second order, which is thousands of its sigmas. So the directions that are known have, beside the variance
that the linear system gives them, that of how far they follow the ones that are less known.

How they follow is the slope T of the error's floor, none at the estimate, and elsewhere linear in the way w there. Of
a known direction that follows by w'Hw/2 it is T = Hw, with w in sigmas: its variance tr(HH)/2 is half the mean of TT'
over draws of w, and its mean tr(H)/2 half that of Tw. Slopes tell that from far fewer draws than the ways themselves,
which are products of sigmas. They are those of the reported numbers, so that what bends because numbers are no linear
functions of the variables is among it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from pipelines.graph.problem import Array, Problem
from pipelines.solvers.marginals import (
    IndeterminateError,
    joint_information,
    marginal,
    ordering_of,
    prior_units,
    reported,
)

if TYPE_CHECKING:
    from pipelines.solvers.system import Linear

# A direction with a sigma within this share of the prior follows those of which its sigma is within this share.
_WEAK, _LESS = 0.1, 0.5
# Where no sigma of what is calibrated is beyond this share nothing is drawn.
_SURE = 0.01
_DRAWS = 16
# Looked at after so many draws: where no direction gained this share of its squared sigma, none is said to bend. One
# that gains all of it shows so little in so few draws with a chance of 3 %.
_SLIGHT = {1: 1e-3, 3: 0.1}
# Information in units of the priors' with which there is no prior.
_ANYWHERE = 0.5


def second_order(
    problem: Problem,
    about: Linear,
    covariance: Array,
    current_keys: Mapping[int, int],
) -> Array | None:
    """Covariance (n, n) of the reported numbers that the linear system does not know of.

    None where nothing may move far, or where what moves has neither prior nor measurements, and may be anywhere.

    Args:
        problem: the graph's.
        about: the same, linearised at its solution.
        covariance: (n, n) of the reported numbers as the linearised graph has it.
        current_keys: parameter key -> variable that holds its value.
    """
    calibrated = [q.prior_sigma != 0.0 and not q.assumed for q in problem.quantities]
    scales = np.array([q.scale for q in problem.quantities])
    scaled = (covariance / np.outer(scales, scales))[np.ix_(calibrated, calibrated)]
    if not len(scaled) or np.linalg.eigvalsh(scaled)[-1] < _SURE**2:
        return None
    values, keys = about.values, [current_keys.get(p.key, p.key) for p in problem.parameters]
    free, scale, unit = prior_units(problem.parameters, values, keys)
    # Far from the solution the loss would reject what is good.
    system, ordering = about.system.without_rejected(values), about.system.ordering
    try:
        eigenvalues, vectors = np.linalg.eigh(unit.T @ joint_information(about.graph, ordering, keys) @ unit)
        if eigenvalues[0] < _ANYWHERE:
            return None
        # The best known one first.
        eigenvalues, vectors = eigenvalues[::-1], vectors[:, ::-1]
        numbers, sigmas = reported(problem, values, current_keys), eigenvalues**-0.5
        follows = (sigmas[:, None] < _LESS * sigmas) & (sigmas < _WEAK)[:, None]
        slopes: list[Array] = []
        ways: list[Array] = []
        generator = np.random.default_rng(0)
        # Values of hours are large: no more of them at once than are looked at.
        counts = np.diff([0, *_SLIGHT, _DRAWS]).tolist()
        draws = (about.drawn(keys, count, generator) for count in counts)
        for each in chain.from_iterable(draws):
            unit = prior_units(problem.parameters, each, keys)[2]
            A, _ = marginal(system.linearize(each), ordering, keys).jacobian(ordering_of(keys))
            # One row a direction: it and those less known, the better known ones marginalised out.
            R = np.asarray(np.linalg.qr(A @ unit @ vectors, mode="r"))
            slopes.append(np.where(follows, -R / np.diag(R)[:, None], 0.0) * sigmas)
            moved = (reported(problem, each, current_keys) - numbers)[free] / scale
            ways.append(slopes[-1] @ (vectors.T @ moved / sigmas))
            if len(slopes) in _SLIGHT:
                square = 0.5 * np.square(slopes).sum(axis=2) + 0.25 * np.square(ways)
                if (eigenvalues * square).sum(axis=1).max() < _SLIGHT[len(slopes)]:
                    return None
    except (RuntimeError, IndeterminateError, np.linalg.LinAlgError):
        return None
    bent = 0.5 * np.mean([slope @ slope.T for slope in slopes], axis=0)
    mean = 0.5 * np.mean(ways, axis=0)
    axes = scale[:, None] * vectors
    found = np.zeros_like(covariance)
    found[np.ix_(free, free)] = axes @ (bent + np.outer(mean, mean)) @ axes.T
    return found
