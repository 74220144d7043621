"""Influence and uncertainty budget against the dense system, against solving again, and against simulated noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from alidade.pipelines.estimation.problem import Array, Factor, Parameter, Problem, Quantity
from alidade.pipelines.solvers.assembly import Assembly
from alidade.pipelines.solvers.influence import FactorRows, Influence, influence, uncertainty_budget
from alidade.pipelines.solvers.marginals import IndeterminateError, joint_information, ordering_of, reported_covariance
from alidade.pipelines.solvers.system import System
from alidade.pipelines.solvers.weighing import optimize
from tests.support.short_problems import head_problem, los_problem

A, B, S = gtsam.symbol("a", 0), gtsam.symbol("b", 0), gtsam.symbol("s", 0)


@dataclass
class Solved:
    problem: Problem
    system: System
    values: gtsam.Values
    current_keys: dict[int, int]
    linear: gtsam.GaussianFactorGraph
    found: Influence


def solved(problem: Problem) -> Solved:
    whole = Assembly.of(problem.steps(20))
    solution = optimize(whole.factors, whole.initial, whole.shared(problem), problem.loss)
    linear = solution.system.linearized(solution.values)
    found = influence(problem, linear, whole.current_keys)
    return Solved(problem, solution.system, solution.values, whole.current_keys, linear.graph, found)


@pytest.fixture(scope="module", params=[los_problem, head_problem])
def case(request: pytest.FixtureRequest) -> Solved:
    make: Callable[[], Problem] = request.param
    return solved(make())


def rows_of(found: Influence) -> list[Array]:
    """Of every factor, in time order."""
    return [row for part in found.ask(_derivatives) for row in part]


def _derivatives(rows: FactorRows) -> list[Array]:
    return [row for *_, row in rows]


def test_squares_sum_to_the_covariance(case: Solved) -> None:
    found = case.found
    total = sum(rows @ rows.T for rows in rows_of(found))
    scale = np.sqrt(np.outer(np.diag(found.covariance), np.diag(found.covariance)))
    np.testing.assert_allclose(total / scale, found.covariance / scale, atol=1e-9)
    keys = [case.current_keys.get(p.key, p.key) for p in case.problem.parameters]
    information = joint_information(case.linear, case.system.ordering, keys)
    whole = reported_covariance(case.problem.parameters, information, case.values, keys)
    quantities = case.problem.quantities
    free = [i for i, q in enumerate(quantities) if q.prior_sigma != 0.0]
    assert found.names == tuple(quantities[i].name for i in free)
    extra = np.array([quantities[i].extra_sigma for i in free])
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(whole[np.ix_(free, free)]) - extra**2, rtol=1e-5)


def test_rows_are_those_of_the_dense_system(case: Solved) -> None:
    """Brute force on the whole dense matrix."""
    dense, _ = case.linear.jacobian(case.system.ordering)
    q, r = np.linalg.qr(dense)
    inverse = np.linalg.solve(r, q.T)
    ordering = case.system.ordering
    keys = [ordering.at(i) for i in range(ordering.size())]
    start, place = 0, {}
    for key in keys:
        size = case.values.dims()[key]
        place[key] = slice(start, start + size)
        start += size
    expected = []
    for p in case.problem.parameters:
        key = case.current_keys.get(p.key, p.key)
        free = [q.prior_sigma != 0.0 for q in p.quantities]
        expected.append((p.coordinates(case.values, key)[1] @ inverse[place[key]])[free])
    streamed = np.concatenate(rows_of(case.found), axis=1)
    sigmas = np.sqrt(np.diag(case.found.covariance))[:, None]
    np.testing.assert_allclose(streamed / sigmas, np.concatenate(expected) / sigmas, atol=1e-6)


def test_budget_sums_to_one_and_names_its_sources(case: Solved) -> None:
    budget = uncertainty_budget(case.problem, case.found, {})
    families = {f.family for f in case.system.factors}
    for name, shares in budget.items():
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-9)
        assert list(shares.values()) == sorted(shares.values(), reverse=True)
        for source in shares:
            assert source in families | {"not modelled"} or source.startswith("prior of "), (name, source)


def _quantity(name: str, sigma: float, extra: float = 0.0) -> Quantity:
    return Quantity(name, "m", sigma, 1.0, 1.0, extra_sigma=extra)


def _line(noise: Array | None = None) -> tuple[Problem, list[Factor], gtsam.Values]:
    """y = a + b t at t = 0 ... 4 through a state s = a that is known to 0.3; sigmas 0.1 and 0.2 by turns."""
    parameters = (
        Parameter(A, (_quantity("a", 2.0, extra=0.05),)),
        Parameter(B, (_quantity("b", 0.5),)),
    )
    noise = np.zeros(5) if noise is None else noise
    factors = [
        Factor("prior", gtsam.PriorFactorVector(A, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 2.0))),
        Factor("prior", gtsam.PriorFactorVector(B, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.5))),
        Factor("tie", gtsam.BetweenFactorVector(A, S, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, 0.3))),
    ]
    for i in range(5):
        sigma = (0.1, 0.2)[i % 2]
        linear = gtsam.JacobianFactor(
            S, np.eye(1), B, i * np.eye(1), np.array([noise[i]]), gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        )
        factors.append(Factor(("fine", "coarse")[i % 2], gtsam.LinearContainerFactor(linear)))
    values = gtsam.Values()
    for key in (A, B, S):
        values.insert(key, np.zeros(1))
    return Problem("line", parameters, lambda _: iter(())), factors, values


def _of_line(noise: Array | None = None) -> tuple[Problem, gtsam.GaussianFactorGraph, Influence]:
    problem, factors, values = _line(noise)
    linear = System.of(factors, [A, B], None).linearized(values)
    return problem, linear.graph, influence(problem, linear, {})


def test_a_measurement_moves_the_parameters_as_foretold() -> None:
    _, linear, found = _of_line()
    rows = rows_of(found)
    for i in range(5):
        noise = np.zeros(5)
        noise[i] = 0.37
        _, moved, _ = _of_line(noise)
        change = moved.optimize()
        whitened = 0.37 / (0.1, 0.2)[i % 2]
        expected = rows[3 + i][:, 0] * whitened
        assert [change.at(A)[0], change.at(B)[0]] == pytest.approx(expected, rel=1e-9)
    assert linear.size() == len(rows)


def test_budget_is_what_each_source_alone_does() -> None:
    """Each source switched on alone: the variance of the estimate over many draws of it."""
    problem, linear, found = _of_line()
    budget = uncertainty_budget(problem, found, {})
    dense, _ = linear.jacobian(ordering_of([A, B, S]))
    rng = np.random.default_rng(0)
    total = found.covariance[0, 0] + 0.05**2
    sources = {"prior of a": [0], "prior of b": [1], "tie": [2], "fine": [3, 5, 7], "coarse": [4, 6]}
    for source, rows in sources.items():
        noise = np.zeros((8, 20_000))
        noise[rows] = rng.normal(size=(len(rows), 20_000))
        alone = np.linalg.lstsq(dense, noise, rcond=None)[0][0].var()
        assert budget["a"][source] == pytest.approx(alone / total, rel=0.05), source
    assert budget["a"]["not modelled"] == pytest.approx(0.05**2 / total)
    assert sum(budget["a"].values()) == pytest.approx(1.0, abs=1e-9)


def test_an_undetermined_state_is_named() -> None:
    _, factors, values = _line()
    free, other = gtsam.symbol("f", 0), gtsam.symbol("f", 1)
    for key in (free, other):
        values.insert(key, np.zeros(1))
    between = gtsam.BetweenFactorVector(free, other, np.zeros(1), gtsam.noiseModel.Unit.Create(1))
    linear = System.of([*factors, Factor("tie", between)], [A, B], None).linearized(values)
    with pytest.raises(IndeterminateError, match=r"f\d"):
        _ = linear.triangular
