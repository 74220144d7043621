"""The chain's system of every method against gtsam's linearisation of the same factors, solved densely."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.chain import ChainSystem
from alidade.pipelines.solvers.layout import Layout, Tangent, Values
from alidade.pipelines.solvers.linearization import Linearization
from tests.support.problems import SCENARIOS, problem


def parts(name: str) -> tuple[gtsam.Values, list[Factor], list[int], Layout, Values]:
    """Initial values, factors and variables that hold the parameters of a problem; its layout and values."""
    made, initial, factors, current = problem(name), gtsam.Values(), list[Factor](), dict[int, int]()
    for step in made.steps(10**9):
        initial.insert(step.initial)
        factors += step.factors
        current.update(step.current_keys)
    assert made.layout is not None
    layout, values = Layout.of(made.layout, initial)
    return initial, factors, [current.get(p.key, p.key) for p in made.parameters], layout, values


@pytest.mark.parametrize("name", SCENARIOS)
def test_step_covariance_and_minimum_are_those_of_gtsams_linearisation(name: str) -> None:
    initial, factors, reported, layout, values = parts(name)
    linearization = Linearization.of(factors, layout).under(None)
    system, cost = linearization.at(values)
    assert isinstance(system, ChainSystem)
    found = system.eliminate()

    graph, error = gtsam.GaussianFactorGraph(), 0.0
    for f in factors:
        native = f.factor if f.bound is None else f.bound.under(None).factor
        graph.add(native.linearize(initial))
        error += 2.0 * native.error(initial)
    others = sorted(set(layout.key.tolist()) - set(reported))
    ordering = gtsam.Ordering()
    for key in [*others, *reported]:
        ordering.push_back(key)
    A, b = graph.jacobian(ordering)
    R = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))
    inverse = np.linalg.inv(R[:-1, :-1])
    sigma, step = np.linalg.norm(inverse, axis=1), inverse @ R[:-1, -1]

    tangent = Tangent(*found.solve())
    moves = [layout.moves(layout.at([key]), tangent)[0] for key in [*others, *reported]]
    assert np.abs((np.concatenate(moves) - step) / sigma).max() < 1e-8
    to_reported = np.vstack([layout.root_columns(key) for key in reported])
    root = np.linalg.inv(found.root[:-1, :-1])
    n = len(to_reported)
    covariance, scale = to_reported @ root @ root.T @ to_reported.T, np.outer(sigma[-n:], sigma[-n:])
    assert np.abs((covariance - inverse[-n:] @ inverse[-n:].T) / scale).max() < 1e-8
    assert found.minimum == pytest.approx(R[-1, -1] ** 2, rel=1e-9)
    assert cost == pytest.approx(error, rel=1e-9)
    assert linearization.cost(values) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("name", SCENARIOS)
def test_gtsam_engine_gives_what_the_chain_gives(name: str) -> None:
    _, factors, _, layout, values = parts(name)
    chain, engine = (Linearization.of(factors, layout, chain=each).under(None) for each in (True, False))
    (system, cost), (other, other_cost) = chain.at(values), engine.at(values)
    assert other_cost == pytest.approx(cost, rel=1e-12)
    assert other.squares == pytest.approx(system.squares, rel=1e-12)
    found, theirs = system.eliminate(), other.eliminate()
    sigma = np.linalg.norm(np.linalg.inv(found.root[:-1, :-1]), axis=1)
    information = found.root.T @ found.root
    scale = np.append(sigma, 1.0 / np.sqrt(information[-1, -1]))
    assert theirs.minimum == pytest.approx(found.minimum, rel=1e-9)
    assert np.abs((theirs.root.T @ theirs.root - information) * np.outer(scale, scale)).max() < 1e-7
    draws = found.sample(50, np.random.default_rng(0))
    for own, other_own, drawn in zip(found.solve(), theirs.solve(), draws, strict=True):
        assert (np.abs(own - other_own) <= 1e-7 * drawn.std(axis=-1)).all()
    if layout.sizes[3] == 0:  # the chain damps deviations of nodes, gtsam the nodes
        assert other.eliminate(0.1).minimum == pytest.approx(system.eliminate(0.1).minimum, rel=1e-9)


@pytest.mark.parametrize("name", ["head with a bias that walks", "cube", "indexer", "tumble", "los"])
def test_graph_works_with_gtsams_own_optimizer_marginals_and_isam2(name: str) -> None:
    made = problem(name)
    graph, initial = made.graph()
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(2)
    found = gtsam.LevenbergMarquardtOptimizer(graph, initial, params).optimize()
    assert graph.error(found) <= graph.error(initial)
    key = made.parameters[0].key
    assert np.linalg.eigvalsh(gtsam.Marginals(graph, found).marginalCovariance(key)).min() > 0.0
    isam = gtsam.ISAM2()
    isam.update(graph, found)
    assert isam.calculateEstimate().size() == initial.size()
