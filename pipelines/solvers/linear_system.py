"""Graphs of factors, linear systems of these, and the order in which they are eliminated."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.marginals import ordering_of


def graph_of(factors: Sequence[Factor]) -> gtsam.NonlinearFactorGraph:
    """The gtsam graph of the factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for f in factors:
        graph.add(f.factor)
    return graph


def linear_graph_of(factors: Sequence[Factor], values: gtsam.Values) -> gtsam.GaussianFactorGraph:
    """The linear system of the factors about the values, in their order."""
    graph = gtsam.GaussianFactorGraph()
    for f in factors:
        graph.push_back(f.linearized(values))
    return graph


def elimination_ordering(graph: gtsam.NonlinearFactorGraph, shared: Sequence[int]) -> gtsam.Ordering:
    """Nested dissection of the chain with the shared variables last, which suits chains with a few common variables."""
    # METIS wants variables that share a factor with another, or it brings the process down.
    joined = gtsam.NonlinearFactorGraph()
    alone = dict.fromkeys(shared)
    for i in range(graph.size()):
        keys = graph.at(i).keys()
        if len(keys) > 1:
            joined.push_back(graph.at(i))
        else:
            alone.update(dict.fromkeys(keys))
    last = set(shared)
    metis = gtsam.Ordering.MetisNonlinearFactorGraph(joined) if joined.size() else gtsam.Ordering()
    chain = [metis.at(i) for i in range(metis.size()) if metis.at(i) not in last]
    return ordering_of([*(alone.keys() - last - set(chain)), *chain, *shared])


def damped(
    linear: gtsam.GaussianFactorGraph, weight: float, keys: Collection[int] | None = None
) -> gtsam.GaussianFactorGraph:
    """The system with each unknown, or some, held where it is by `weight` times its own information."""
    gradient = linear.gradientAtZero()
    diagonal = {key: np.zeros(len(gradient.at(key))) for key in linear.keyVector()}
    for i in range(linear.size()):
        factor = linear.at(i)
        squares = (factor.jacobian()[0] ** 2).sum(axis=0)
        for key in factor.keys():
            size = len(diagonal[key])
            diagonal[key] += squares[:size]
            squares = squares[size:]
    out = gtsam.GaussianFactorGraph()
    out.push_back(linear)
    for key in diagonal if keys is None else keys:
        scale = np.sqrt(weight * np.maximum(diagonal[key], 1e-6))
        noise = gtsam.noiseModel.Unit.Create(len(scale))
        out.add(gtsam.JacobianFactor(key, np.diag(scale), np.zeros(len(scale)), noise))
    return out
