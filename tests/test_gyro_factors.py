"""The gyro chain, measured = (I + S) w + G f + bias: against integrating again, numerically, and against gtsam."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import so3
from factors.attitude import ahrs_factors
from factors.gyro import GyroIncrementFactor, correction, rate_error, symmetric
from factors.model import Array, Block, Model, Residuals
from factors.preintegration import GyroPath, Increments
from factors.testing import assert_jacobians
from factors.vectorized import Ensemble
from tests.numerics import assert_rows_are_independent

N = 15
T = np.arange(0.0, 20.0, 0.0025)
RATE = 2.0 * np.sin(2.0 * np.pi * np.array([0.5, 0.8, 0.6]) * T[:, None] + np.array([0.3, 1.9, 4.0]))
FORCE = np.stack([3.0 * np.sin(T), 2.0 * np.cos(1.3 * T), 9.8 + np.sin(2.0 * T)], axis=1)
BIAS, BIAS_HAT = np.array([0.01, -0.02, 0.015]), np.array([0.005, -0.01, 0.0])
SCALE = np.array([1.0, -0.7, 0.4, -0.5, 0.8, 0.3])
G = np.array([0.2, -0.9, 0.5, 1.0, 0.3, -0.6, 0.1, 0.7, -0.4])


def _read(scale: Array, g: Array, bias: Array) -> GyroPath:
    """What the gyro measures of RATE."""
    measured = RATE @ (np.eye(3) + symmetric(scale)).T + FORCE @ g.reshape(3, 3).T + bias
    return GyroPath(T, measured, BIAS_HAT, FORCE)


def _error(path: GyroPath, windows: tuple[Array, Array], bias: Array, scale: Array, g: Array) -> float:
    """Largest angle between increments corrected for known errors and the true samples integrated, rad."""
    turns = path.increments(*windows, scale=True)
    n = len(windows[0])
    phi, _ = correction(turns, np.tile(bias - BIAS_HAT, (n, 1)), np.tile(scale, (n, 1)), np.tile(g, (n, 1)))
    true = GyroPath(T, RATE).increments(*windows).wxyz
    got = so3.multiply(turns.wxyz, so3.exp(phi))
    return float(np.abs(so3.log(so3.multiply(so3.inverse(true), got))).max())


def test_increments_turned_for_known_errors_are_those_of_the_true_rate() -> None:
    """The figures that the module's docstring gives."""
    for window, small, large in [(1 / 60, 6e-9, 7e-8), (0.1, 9e-7, 1.4e-5), (0.2, 7e-6, 1e-4)]:
        start = np.arange(1.0, 15.0, window)
        windows = start, start + window
        assert _error(_read(1e-2 * SCALE, 1e-4 * G, BIAS), windows, BIAS, 1e-2 * SCALE, 1e-4 * G) < small
        assert _error(_read(5e-2 * SCALE, 5e-4 * G, BIAS), windows, BIAS, 5e-2 * SCALE, 5e-4 * G) < large


def test_what_is_left_over_is_of_second_order() -> None:
    start = np.arange(1.0, 15.0, 0.3)
    windows = start, start + 0.3
    large, small = (
        _error(_read(s * SCALE, s / 30 * G, s * BIAS + BIAS_HAT), windows, s * BIAS + BIAS_HAT, s * SCALE, s / 30 * G)
        for s in (2e-2, 5e-3)
    )
    assert large / small == pytest.approx(16.0, rel=0.1)


def test_windows_between_stamps_and_backwards() -> None:
    """Partial sample intervals count too, whatever the window."""
    start = np.array([1.0012, 2.0001, 3.1, 5.0009, 6.0])
    windows = start, start + np.array([0.0301, 0.0007, 0.0, -0.0452, 1e-9])
    assert _error(_read(1e-3 * SCALE, 1e-5 * G, BIAS), windows, BIAS, 1e-3 * SCALE, 1e-5 * G) < 3e-8


def test_jacobians_of_increments_against_differences() -> None:
    """Each entry of S and G, by integrating the changed samples."""
    start = np.linspace(0.5, 15.0, N)
    stop = start + np.linspace(0.001, 1.5, N)
    path = GyroPath(T, RATE, BIAS_HAT, FORCE)
    turns = path.increments(start, stop, scale=True)
    assert turns.scale_jacobian is not None
    assert turns.g_jacobian is not None
    h = 1e-5
    for jacobian, vector in [(turns.scale_jacobian, RATE - BIAS_HAT), (turns.g_jacobian, FORCE)]:
        for entry in range(9):
            D = h * np.eye(9)[entry].reshape(3, 3)
            less, more = (
                GyroPath(T, RATE - sign * vector @ D.T, BIAS_HAT).increments(start, stop).wxyz for sign in (-1, 1)
            )
            numeric = so3.log(so3.multiply(so3.inverse(less), more)) / (2.0 * h)
            np.testing.assert_allclose(jacobian[..., entry], numeric, atol=2e-5 * np.abs(numeric).max())


def test_without_specific_force_there_is_no_g_jacobian() -> None:
    path = GyroPath(T, RATE)
    assert path.increments([1.0], [2.0], scale=True).g_jacobian is None
    assert path.increments([1.0], [2.0]).scale_jacobian is None
    assert path.specific_force([1.0]) is None
    with pytest.raises(ValueError, match="a specific force for each rate"):
        GyroPath(T, RATE, specific_force=FORCE[1:])


def test_specific_force_between_stamps() -> None:
    at = np.array([1.0, 1.001, 7.77])
    got = GyroPath(T, RATE, specific_force=FORCE).specific_force(at)
    assert got is not None
    exact = np.stack([3.0 * np.sin(at), 2.0 * np.cos(1.3 * at), 9.8 + np.sin(2.0 * at)], axis=1)
    np.testing.assert_allclose(got, exact, atol=1e-5)


def _blocks(angle: float, size: float, g: bool) -> list[Array]:
    """Random values for the factor's blocks, scale and g-sensitivity of the given size."""
    rng = np.random.default_rng(4)
    attitudes = [so3.exp(angle * rng.normal(size=(N, 3))) for _ in range(2)]
    errors = [BIAS_HAT + 0.02 * rng.normal(size=(N, 3)), size * rng.normal(size=(N, 6))]
    return [*attitudes, *errors, *([0.03 * size * rng.normal(size=(N, 9))] if g else [])]


def _turns(g: bool) -> Increments:
    path = GyroPath(T, RATE, BIAS_HAT, FORCE if g else None)
    start = np.linspace(0.5, 15.0, N)
    return path.increments(start, start + np.linspace(0.01, 0.9, N), scale=True)


def _factor(rows: NDArray[np.intp], g: bool) -> GyroIncrementFactor:
    return GyroIncrementFactor(T[rows], _turns(g)[rows], GyroPath(T, RATE, BIAS_HAT), np.linspace(0.5, 2.0, N)[rows])


@pytest.mark.parametrize("g", [True, False], ids=["with g", "without g"])
@pytest.mark.parametrize(("angle", "size"), [(0.7, 0.1), (1e-6, 1e-9)], ids=["random", "near zero"])
def test_increment_jacobians(g: bool, angle: float, size: float) -> None:
    assert_jacobians(_factor(np.arange(N), g), _blocks(angle, size, g))


@pytest.mark.parametrize("g", [True, False], ids=["with g", "without g"])
def test_increment_rows_are_independent(g: bool) -> None:
    assert_rows_are_independent(lambda rows: _factor(rows, g), _blocks(0.7, 0.05, g))


@dataclass(frozen=True)
class _RateError(Model):
    time: Array
    read: Array
    force: Array | None
    rows: int = 3

    @property
    def blocks(self) -> tuple[Block, ...]:
        return (3, 6) if self.force is None else (3, 6, 9)

    def __call__(self, bias: Array, scale: Array, g: Array | None = None) -> Residuals:
        return rate_error(bias, scale, g, self.read, self.force)


@pytest.mark.parametrize("g", [True, False], ids=["with g", "without g"])
def test_rate_error_and_its_jacobians(g: bool) -> None:
    """The rate read by a gyro of known errors, less what it reads too much, is the rate."""
    rng = np.random.default_rng(2)
    w, f = rng.normal(size=(N, 3)), 9.8 * rng.normal(size=(N, 3))
    _, _, bias, scale, *by_g = _blocks(0.0, 0.05, g)
    read = w + np.einsum("nij,nj->ni", symmetric(scale), w) + bias
    if g:
        read += np.einsum("nij,nj->ni", by_g[0].reshape(N, 3, 3), f)
    blocks = [bias, scale, *by_g]

    model = _RateError(np.arange(float(N)), read, f if g else None)
    np.testing.assert_allclose(read - model(*blocks)[0], w, atol=1e-12)
    assert_jacobians(model, blocks)


def test_equals_the_native_factor_where_the_gyro_is_perfect() -> None:
    start = np.linspace(0.5, 15.0, N)
    path = GyroPath(T, RATE, BIAS_HAT, FORCE)
    turns = path.increments(start, start + 0.1, scale=True)
    i, j, bias, *_ = _blocks(0.4, 0.0, True)
    keys_i, keys_j, keys_bias = (list(range(k, k + N)) for k in (0, N, 2 * N))
    values = gtsam.Values()
    for k in range(N):
        values.insert(keys_i[k], so3.to_gtsam(i[k]))
        values.insert(keys_j[k], so3.to_gtsam(j[k]))
        values.insert(keys_bias[k], bias[k])
    scale, g = 100, 101
    values.insert(scale, np.zeros(6))
    values.insert(g, np.zeros(9))
    sigma = np.linspace(0.5, 2.0, N)
    ours = GyroIncrementFactor(start + 0.1, turns, path, sigma).on(keys_i, keys_j, keys_bias, scale, g)
    graph = gtsam.NonlinearFactorGraph()
    for factor in ahrs_factors(keys_i, keys_j, keys_bias, turns, BIAS_HAT, sigma**2):
        graph.add(factor)
    assert ours.factor.error(values) == pytest.approx(graph.error(values), rel=1e-9)
    ordering = gtsam.Ordering()
    for key in range(3 * N):
        ordering.push_back(key)
    expected = graph.linearize(values).hessian(ordering)[0]
    _, A = ours.rows(values)
    kept = np.concatenate([np.arange(3) + 3 * ours.keys.index(key) for key in range(3 * N)])
    np.testing.assert_allclose((A.T @ A)[np.ix_(kept, kept)], expected, atol=1e-7 * np.abs(expected).max())


def test_several_factors_are_evaluated_as_one() -> None:
    """As the solvers do it; each then answers as it does alone."""
    blocks = _blocks(0.5, 0.02, True)
    values = gtsam.Values()
    for k in range(N):
        values.insert(k, so3.to_gtsam(blocks[0][k]))
        values.insert(N + k, so3.to_gtsam(blocks[1][k]))
    for key, block in [(100, blocks[2]), (101, blocks[3]), (102, blocks[4])]:
        values.insert(key, block[0])
    whole = _factor(np.arange(N), True)
    factors = [
        GyroIncrementFactor(whole.time[part], whole.turns[part], whole.gyro, whole.sigma[part]).on(
            part, [N + k for k in part], 100, 101, 102
        )
        for part in (range(4), range(4, 11), range(11, N))
    ]
    alone = [factor.rows(values) for factor in factors]
    with Ensemble(factors).at(values):
        for factor, (residuals, jacobian) in zip(factors, alone, strict=True):
            together = factor.rows(values)
            np.testing.assert_allclose(together[0], residuals, atol=1e-12)
            np.testing.assert_allclose(together[1], jacobian, atol=1e-12)
