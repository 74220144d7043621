"""Posterior of the reported numbers at moments of the recording, and a walking bias over time.

The last few dozen states of the chain are eliminated in time order; `ChainFactorization.prefix_roots` has the
square-root information of (node, shared unknowns) after each of them, all linearised at the final estimate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import History, PosteriorHistory
from alidade.pipelines.solvers.chain import ChainFactorization
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.layout import Layout, Values
from alidade.pipelines.solvers.posterior import Reported
from alidade.pipelines.solvers.weak_directions import Posterior, constrained


def posterior_history(compiled: Compiled, posterior: Posterior) -> PosteriorHistory | None:
    """Filtered values and joint covariance of the reported numbers over time, weak directions at priors.

    The last moment has the posterior's own. None where there is but one, or no chain.
    """
    at, problem, layout = posterior.at, compiled.problem, compiled.layout
    if not isinstance(at.factorization, ChainFactorization):
        return None
    keyframes, roots = at.factorization.prefix_roots()
    if len(keyframes) < 2:
        return None
    nodes = at.engine.piece[keyframes].tolist()
    reported = {node: _reported_at(compiled, at.values, node, posterior.reported) for node in set(nodes)}
    found = [_known(reported[node], root) for node, root in zip(nodes, roots, strict=True)]
    found[-1] = posterior.reported.numbers, posterior.covariance
    numbers, covariances = (np.array(each) for each in zip(*found, strict=True))
    moving = layout.node[layout.at(compiled.keys)] >= 0
    steady = ~np.repeat(moving, [len(p.quantities) for p in problem.parameters])
    return PosteriorHistory(at.engine.time[keyframes], numbers, covariances, steady)


def _reported_at(compiled: Compiled, values: Values, node: int, end: Reported) -> Reported:
    """Reported numbers at a node of a walking bias; `end` is the same at the last node."""
    layout, problem = compiled.layout, compiled.problem
    keys = [_at_node(layout, key, node) for key in compiled.keys]
    jacobian = end.jacobian.copy()
    if layout.sizes[3] and (layout.node[layout.at(keys)] <= 0).all():
        # The first node is among the shared unknowns, and has no numbers beside these.
        jacobian[:, : layout.sizes[3]] = 0.0
    known = layout.to_gtsam(values, keys)
    here = np.concatenate([p.coordinates(known, key)[0] for p, key in zip(problem.parameters, keys, strict=True)])
    return replace(end, numbers=here, jacobian=jacobian)


def _known(reported: Reported, root: Array) -> tuple[Array, Array]:
    """Reported numbers (n,) and their covariance (n, n) from the square-root information until a moment."""
    found = reported.root(root)
    now, directions = constrained(reported, found.R, found.d)
    return now.numbers, reported.covariance(directions.covariance())


def _at_node(layout: Layout, variable: int, node: int) -> int:
    """Key of the same quantity's variable at another node; the key itself for a variable without nodes."""
    (at,) = layout.at([variable])
    if layout.node[at] < 0:
        return variable
    alike = (layout.node == node) & ((layout.part == layout.part[at]) | (node == 0))
    return int(layout.key[np.flatnonzero(alike)[0]])


def smoothed(compiled: Compiled, posterior: Posterior, covariance: Array) -> History | None:
    """Smoothed history of the reported numbers at the nodes of a walking bias; None if no bias walks.

    Args:
        compiled: the problem.
        posterior: of its numbers.
        covariance: (n, n) final one of these, errors without a model included.
    """
    layout, at, factorization = compiled.layout, posterior.at, posterior.at.factorization
    moving = [p for p in compiled.problem.parameters if p.key in compiled.current_keys]
    count = layout.sizes[2]
    if count < 3 or len(moving) != 1 or not isinstance(factorization, ChainFactorization):
        return None
    (parameter,) = moving
    nodes = [_at_node(layout, parameter.key, j) for j in range(count)]
    own, roots = np.arange(len(parameter.quantities)), factorization.shared_roots
    given, moves = factorization.nodes(roots)
    columns = factorization.c + layout.shared[layout.at(nodes[:1])] + own
    squares = given[:, own, own]
    squares[0] = 0.0  # the first node does not deviate from itself
    moved = moves[:, own]
    moved[0] = 0.0
    squares = squares + np.square(moved + roots[columns]).sum(axis=2)
    names = [q.name for q in compiled.problem.quantities]
    numbers = [names.index(q.name) for q in parameter.quantities]
    values = np.tile(posterior.reported.numbers, (count, 1))
    sigmas = np.tile(np.sqrt(np.diag(covariance)), (count, 1))
    values[:, numbers] = [layout.of_key(at.values, key) for key in nodes]
    beside = np.diag(covariance)[numbers] - squares[-1]  # what the last node's has more: errors without a model
    sigmas[:, numbers] = np.sqrt(np.maximum(squares + beside, 0.0))
    return History(at.engine.time[np.searchsorted(at.engine.piece, np.arange(count))], values, sigmas)
