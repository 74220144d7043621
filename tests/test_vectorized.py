"""The bridge to gtsam: layout, robust loss, compression."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np
import pytest

from factors.vectorized import Array, Ensemble, TruncatedLoss, VectorizedFactor, square_root


@dataclass(frozen=True)
class _Line:
    """y = A_i x + b_i, two rows a measurement; linear, so gtsam's answer must be numpy's."""

    time: Array
    A: Array
    y: Array
    rows: int = 2
    stacked: ClassVar = ("time", "A", "y")

    def __call__(self, x: Array, b: Array) -> tuple[Array, Callable[[], tuple[Array, ...]]]:
        residual = np.einsum("nij,nj->ni", self.A, x) + b - self.y
        return residual, lambda: (self.A, np.broadcast_to(np.eye(2), (len(self.A), 2, 2)))


def _line(n: int, seed: int = 0) -> _Line:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, 2, 3))
    y = A @ np.array([1.0, -2.0, 0.5]) + rng.normal(scale=0.1, size=(n, 2))
    return _Line(np.arange(float(n)), A, y)


def _values(*vectors: Array) -> gtsam.Values:
    values = gtsam.Values()
    for key, v in enumerate(vectors):
        values.insert(key, v)
    return values


def _normal_equations(factor: VectorizedFactor, values: gtsam.Values) -> tuple[Array, Array]:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor.factor)
    return graph.linearize(values).hessian()


def test_shared_columns_stack_to_least_squares() -> None:
    model = _line(50)
    factor = VectorizedFactor(model, [0, 1], [3, 2])
    H, g = _normal_equations(factor, _values(np.zeros(3), np.zeros(2)))
    full = np.concatenate([model.A.reshape(-1, 3), np.tile(np.eye(2), (50, 1))], axis=1)
    np.testing.assert_allclose(H, full.T @ full, rtol=1e-12)
    np.testing.assert_allclose(g.ravel(), full.T @ model.y.ravel(), rtol=1e-12)


def test_own_and_shared_variables_are_laid_out_row_by_row() -> None:
    model = _line(4)
    factor = VectorizedFactor(model, [[0, 1, 0, 2], 3], [3, 2])
    assert factor.keys == [0, 1, 2, 3]
    x = np.random.default_rng(1).normal(size=(3, 3))
    H, _ = _normal_equations(factor, _values(*x, np.zeros(2)))
    full = np.zeros((8, 11))
    for i, slot in enumerate([0, 1, 0, 2]):
        full[2 * i : 2 * i + 2, 3 * slot : 3 * slot + 3] = model.A[i]
        full[2 * i : 2 * i + 2, 9:] = np.eye(2)
    np.testing.assert_allclose(H, full.T @ full, rtol=1e-12, atol=1e-12)


def test_compressed_factor_is_the_same_factor() -> None:
    model = _line(1000)
    plain, small = (VectorizedFactor(model, [0, 1], [3, 2], compress=c) for c in (False, True))
    assert small.factor.dim() == 6
    for values in (_values(np.zeros(3), np.zeros(2)), _values(np.array([1.0, -2, 0.5]), np.array([0.1, 0.2]))):
        assert small.factor.error(values) == pytest.approx(plain.factor.error(values), rel=1e-12)
        (Ha, ga), (Hb, gb) = (_normal_equations(f, values) for f in (plain, small))
        np.testing.assert_allclose(Hb, Ha, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(gb, ga, rtol=1e-9, atol=1e-9)


def test_compression_of_singular_systems_keeps_the_null_space() -> None:
    J = np.random.default_rng(2).normal(size=(30, 4))
    J[:, 3] = J[:, 0] * 1e3 - J[:, 1]
    e = np.random.default_rng(3).normal(size=30)
    R, d, rest = square_root(J.T @ J, J.T @ e, float(e @ e))
    x = np.array([0.3, -0.2, 1.0, 2.0])
    exact = float(((J @ x + e) ** 2).sum())
    assert float(((R @ x + d) ** 2).sum()) + rest**2 == pytest.approx(exact, rel=1e-9)
    assert np.linalg.norm(R @ np.array([1e3, -1.0, 0.0, -1.0])) < 1e-4 * np.linalg.norm(R)


@pytest.mark.parametrize("compress", [False, True])
def test_rows_are_the_plain_linearisation(compress: bool) -> None:
    model = _line(6)
    values = _values(np.array([0.2, 0.1, -0.3]), np.ones(2))
    loss = TruncatedLoss(gate=0.1)
    error, A = VectorizedFactor(model, [0, 1], [3, 2], loss=loss, compress=compress).rows(values)
    np.testing.assert_allclose(A, np.concatenate([model.A.reshape(-1, 3), np.tile(np.eye(2), (6, 1))], axis=1))
    np.testing.assert_allclose(error, A @ np.array([0.2, 0.1, -0.3, 1, 1]) - model.y.ravel())


def test_compressed_factors_need_shared_columns() -> None:
    with pytest.raises(ValueError, match="shared by all"):
        VectorizedFactor(_line(2), [[0, 1], 2], [3, 2], compress=True)


def test_outliers_lose_their_pull_and_no_more() -> None:
    model = _line(200)
    bad = model.y.copy()
    bad[::5] += 50.0
    outlying = _Line(model.time, model.A, bad)
    factor = VectorizedFactor(outlying, [0, 1], [3, 2], loss=TruncatedLoss(gate=1.0))
    truth = _values(np.array([1.0, -2.0, 0.5]), np.zeros(2))
    assert factor.used(truth).tolist() == [i % 5 != 0 for i in range(200)]
    inliers = np.flatnonzero(np.arange(200) % 5)
    clean = VectorizedFactor(_Line(model.time[inliers], model.A[inliers], bad[inliers]), [0, 1], [3, 2])
    for got, expected in zip(_normal_equations(factor, truth), _normal_equations(clean, truth), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert factor.factor.error(truth) == pytest.approx(clean.factor.error(truth) + 40 * 0.5)


@pytest.mark.parametrize("mu", [0.0, 1e-4, 0.1, 1.0, 30.0, np.inf])
def test_loss_weight_is_the_slope_of_its_cost(mu: float) -> None:
    loss = TruncatedLoss(gate=3.0, mu=mu)
    square = np.linspace(0.01, 200.0, 4001) + 1e-4
    square = square[np.abs(square - 9.0) > 0.1] if np.isinf(mu) else square
    h = 1e-7 * square
    slope = (loss.cost(square + h) - loss.cost(square - h)) / (2 * h)
    np.testing.assert_allclose(loss.weight(square), slope, atol=1e-4)
    assert (np.diff(loss.cost(square)) >= -1e-12).all()


def test_an_ensemble_evaluates_what_its_factors_would() -> None:
    columns: list[tuple[list[int | list[int]], int]] = [([[0, 1], 5], 2), ([[1, 2, 1], 5], 3), ([3, 5], 4), ([3, 6], 4)]
    factors = [VectorizedFactor(_line(n, seed), c, [3, 2]) for seed, (c, n) in enumerate(columns)]
    rng = np.random.default_rng(1)
    graph, values, others = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Values()
    for factor in factors:
        graph.add(factor.factor)
    for key in graph.keyVector():
        values.insert(key, rng.normal(size=3 if key < 5 else 2))
        others.insert(key, rng.normal(size=3 if key < 5 else 2))
    error, jacobian = graph.error(values), graph.linearize(values).augmentedJacobian()
    ensemble = Ensemble(factors)
    for _ in range(2):
        with ensemble.at(others):
            assert graph.error(others) != pytest.approx(error)
        with ensemble.at(values):
            assert graph.error(values) == pytest.approx(error, rel=1e-14)
            np.testing.assert_allclose(graph.linearize(values).augmentedJacobian(), jacobian, rtol=1e-14)
    assert graph.error(others) != pytest.approx(error)


def test_models_that_differ_in_more_than_measurements_are_evaluated_apart() -> None:
    @dataclass(frozen=True)
    class Offset(_Line):
        offset: float = 0.0

        def __call__(self, x: Array, b: Array) -> tuple[Array, Callable[[], tuple[Array, ...]]]:
            residual, jacobians = super().__call__(x, b)
            return residual + self.offset, jacobians

    line = _line(2)
    factors = [VectorizedFactor(Offset(line.time, line.A, line.y, offset=o), [0, 1], [3, 2]) for o in (0.0, 1.0)]
    values = _values(np.zeros(3), np.zeros(2))
    with Ensemble(factors).at(values):
        np.testing.assert_allclose(factors[1].residuals(values), factors[0].residuals(values) + 1.0)
