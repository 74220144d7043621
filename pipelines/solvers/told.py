"""What a linearised graph says of its reported numbers, priors of the device set apart, as rows of unit variance."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import gtsam
import numpy as np

from alidade.pipelines.belief import Belief, root_of_information
from alidade.pipelines.estimation.believing import about_alone
from alidade.pipelines.estimation.problem import Array, Problem, Told
from alidade.pipelines.solvers.marginals import coordinate_inverse, marginal, reported
from alidade.pipelines.solvers.system import Linear

# Combinations whose sigma would be so many times their prior's are not told at all.
_UNKNOWN = 1e6


def told(problem: Problem, linear: Linear, current_keys: Mapping[int, int], device: Collection[str]) -> Told:
    """States are eliminated; what is left are rows about the parameters.

    Args:
        problem: the graph's.
        linear: the graph about some values.
        current_keys: parameter key -> variable that holds its value, for parameters that move along.
        device: names of the numbers whose priors are set apart.

    Raises:
        IndeterminateError: a state is not determined.
    """
    values, keys = linear.values, [current_keys.get(p.key, p.key) for p in problem.parameters]
    rest, priors, alone = gtsam.GaussianFactorGraph(), [], [np.empty(0, dtype=bool)]
    for i, family in enumerate(linear.families):
        factor = linear.graph.at(i)
        if family == "prior" and set(keys).issuperset(factor.keys()):
            priors.append(factor)
            alone.append(about_alone(factor, problem.parameters, values, device))
        else:
            rest.push_back(factor)
    rest = marginal(rest, linear.system.ordering, keys)

    quantities = problem.quantities
    free = np.flatnonzero([q.prior_sigma != 0.0 for q in quantities])
    scales = np.array([quantities[i].prior_scale for i in free])
    sizes = [p.coordinates(values, key)[1].shape[1] for p, key in zip(problem.parameters, keys, strict=True)]
    inverse = coordinate_inverse(problem.parameters, values, keys)[:, free]
    columns = dict(zip(keys, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]), strict=True))
    A, b = _rows((rest.at(i) for i in range(rest.size())), columns, sum(sizes))
    prior_A, prior_b = _rows(priors, columns, sum(sizes))
    of_device = np.concatenate(alone)
    R, d = fewest(np.vstack([A, prior_A[~of_device]]) @ inverse, np.concatenate([b, prior_b[~of_device]]), scales)
    return Told(
        names=tuple(quantities[i].name for i in free),
        at=reported(problem, values, current_keys)[free],
        R=R,
        d=d,
        prior_R=prior_A[of_device] @ inverse,
        prior_d=prior_b[of_device],
        scales=scales,
    )


def told_of(belief: Belief, scales: Sequence[float]) -> Told:
    """A belief, none of whose numbers is exactly known, as rows of unit variance; `scales` (n,) of the usual priors."""
    n, sigmas = len(belief.names), belief.sigmas
    R = root_of_information(belief.covariance / np.outer(sigmas, sigmas), sigmas)
    return Told(belief.names, belief.mean, R, np.zeros(n), np.empty((0, n)), np.empty(0), np.array(scales, dtype=float))


def fewest(R: Array, d: Array, scales: Array) -> tuple[Array, Array]:
    """As few rows that say the same, what nothing is told of left out."""
    if not len(R):
        return R, d
    u, s, vt = np.linalg.svd(R * scales, full_matrices=False)
    kept = s > 1.0 / _UNKNOWN
    return (s[kept, None] * vt[kept]) / scales, u.T[kept] @ d


def _rows(factors: Iterable[gtsam.GaussianFactor], columns: Mapping[int, Array], width: int) -> tuple[Array, Array]:
    """The rows of linear factors, (m, width) and (m,), variables in their columns."""
    rows, rights = [np.empty((0, width))], [np.empty(0)]
    for factor in factors:
        A, b = factor.jacobian()
        whole = np.zeros((len(b), width))
        whole[:, np.concatenate([columns[key] for key in factor.keys()])] = A
        rows.append(whole)
        rights.append(b)
    return np.vstack(rows), np.concatenate(rights)
