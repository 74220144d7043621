"""Sequential history of the batch estimate: what was determined until each of some moments, by one elimination.

The system is linearised at the final estimate. States are eliminated as soon as no later factor holds them; what stays,
the parameters and the states at the moment, is solved there, and carried on to the next moment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Array, Course, Problem
from alidade.pipelines.solvers.assembly import StepBoundary
from alidade.pipelines.solvers.marginals import coordinate_inverse, ordering_of, reported, reported_covariance

# The recording is looked back upon at so many moments.
_MOMENTS = 50


def sequential_history(
    problem: Problem,
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    boundaries: Sequence[StepBoundary],
    start: float,
) -> Course | None:
    """What was known at some of the boundaries, the last among them, all linearised at the values.

    Args:
        problem: the graph's.
        linear: its factors linearised at the values, in their order.
        ordering: of the whole; states are eliminated in this order.
        values: the final estimate.
        boundaries: ends of steps, in time order, all of them or those of the moments at least.
        start: end of the first of all steps, s.

    Returns None when states are not determined until a later step, or there is but one moment.
    """
    place = {ordering.at(i): i for i in range(ordering.size())}
    keys = [linear.at(i).keys() for i in range(linear.size())]
    last = {key: i for i, own in enumerate(keys) for key in own}
    carried, begin = gtsam.GaussianFactorGraph(), 0
    rows: list[tuple[float, Array, Array]] = []
    blocks: dict[int, Array] = {}
    held_at_first: list[int] | None = None
    steady = np.ones(len(problem.quantities), dtype=bool)
    moments = [boundaries[i] for i in moments_of(boundaries, start)]
    if len(moments) < 2:
        return None
    for boundary in moments:
        held = [boundary.current_keys.get(p.key, p.key) for p in problem.parameters]
        held_at_first = held_at_first or held
        steady &= np.repeat(np.equal(held, held_at_first), [len(p.quantities) for p in problem.parameters])
        # What comes after the last one belongs to it.
        end = linear.size() if boundary is moments[-1] else boundary.factors
        for i in range(begin, end):
            carried.push_back(linear.at(i))
        begin = end
        try:
            past = sorted({k for k in _keys(carried) if last[k] < begin} - set(held), key=place.__getitem__)
            carried = _without(carried, past)
            now = _without(carried, sorted(set(_keys(carried)) - set(held), key=place.__getitem__))
        except RuntimeError:
            return None
        numbers, covariance = _solved(problem, now, values, boundary.current_keys, held, blocks)
        rows.append((boundary.time, numbers, covariance))
    time, numbers, covariances = (np.array(column) for column in zip(*rows, strict=True))
    return Course(time, numbers, covariances, steady)


def moments_of(boundaries: Sequence[StepBoundary], start: float) -> list[int]:
    """Which boundaries are looked back upon: spread over the time since the start, the last one among them."""
    times = np.array([boundary.time for boundary in boundaries])
    wanted = np.linspace(start, times[-1], _MOMENTS + 1)[1:]
    chosen: list[int] = np.unique(np.searchsorted(times, wanted).clip(max=len(boundaries) - 1)).tolist()
    return chosen


def _keys(graph: gtsam.GaussianFactorGraph) -> list[int]:
    return list(graph.keyVector())


def _without(graph: gtsam.GaussianFactorGraph, keys: Sequence[int]) -> gtsam.GaussianFactorGraph:
    """What a graph says of its other variables. Raises RuntimeError when one of the keys is not determined."""
    return graph.eliminatePartialMultifrontal(ordering_of(keys), gtsam.EliminateQR)[1] if keys else graph


def _solved(
    problem: Problem,
    graph: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    current_keys: Mapping[int, int],
    held: Sequence[int],
    blocks: dict[int, Array],
) -> tuple[Array, Array]:
    """Reported numbers and their covariance from a graph of nothing but the parameters; for `blocks` see marginals."""
    information, slope = graph.hessian(ordering_of(held))
    covariance = reported_covariance(problem.parameters, information, values, held, blocks=blocks)
    inverse = coordinate_inverse(problem.parameters, values, held, blocks)
    extra = np.array([0.0 if q.prior_sigma == 0.0 else q.extra_sigma**2 for q in problem.quantities])
    move = (covariance - np.diag(extra)) @ inverse.T @ slope
    return reported(problem, values, current_keys) + move, covariance
