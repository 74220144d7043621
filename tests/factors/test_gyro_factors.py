"""The gyro chain, (I + S) w + G f + c (T - T0) - band + bias: against integrating again, differences, and gtsam."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gyro import GyroIncrementFactor, carried, corrected, symmetric
from alidade.factors.preintegration import GyroPath, Increments
from alidade.factors.testing import assert_jacobians
from benchmarks.ahrs import ahrs_factors
from tests.support.numerics import assert_rows_are_independent

N = 15
T = np.arange(0.0, 20.0, 0.0025)
RATE = 2.0 * np.sin(2.0 * np.pi * np.array([0.5, 0.8, 0.6]) * T[:, None] + np.array([0.3, 1.9, 4.0]))
FORCE = np.stack([3.0 * np.sin(T), 2.0 * np.cos(1.3 * T), 9.8 + np.sin(2.0 * T)], axis=1)
# K above the first.
WARMTH = 5.0 * (1.0 - np.exp(-T / 8.0)) + 0.3 * np.sin(0.9 * T)
# The sides on which rates are beyond a dead band.
BEYOND = np.sign(RATE) * (np.abs(RATE) > 0.5)
# What moves the gyro's readings, by how many numbers its errors are.
DRIVERS = {
    0: None,
    6: None,
    7: BEYOND,
    9: WARMTH[:, None],
    10: np.column_stack([WARMTH, BEYOND]),
    15: FORCE,
    16: np.column_stack([FORCE, BEYOND]),
    18: np.column_stack([FORCE, WARMTH]),
    19: np.column_stack([FORCE, WARMTH, BEYOND]),
}
BIAS, BIAS_HAT = np.array([0.01, -0.02, 0.015]), np.array([0.005, -0.01, 0.0])
SCALE = np.array([1.0, -0.7, 0.4, -0.5, 0.8, 0.3])
G = np.array([0.2, -0.9, 0.5, 1.0, 0.3, -0.6, 0.1, 0.7, -0.4])
START = np.linspace(0.5, 15.0, N)
WINDOWS = START, START + np.linspace(0.01, 0.9, N)


def _read(scale: Array, g: Array, bias: Array) -> GyroPath:
    """What the gyro measures of RATE."""
    measured = RATE @ (np.eye(3) + symmetric(scale)).T + FORCE @ g.reshape(3, 3).T + bias
    return GyroPath(T, measured, BIAS_HAT, FORCE)


def _error(path: GyroPath, windows: tuple[Array, Array], bias: Array, scale: Array, g: Array) -> float:
    """Largest angle between increments corrected for known errors and the true samples integrated, rad."""
    turns = path.increments(*windows, scale=True)
    n = len(windows[0])
    got, _ = corrected(turns, np.tile(bias - BIAS_HAT, (n, 1)), np.tile([*scale, *g], (n, 1)))
    true = GyroPath(T, RATE).increments(*windows).wxyz
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
    """Each entry of S, G and c, by integrating the changed samples."""
    stop = START + np.linspace(0.001, 1.5, N)
    path = GyroPath(T, RATE, BIAS_HAT, DRIVERS[18])
    turns = path.increments(START, stop, scale=True)
    assert turns.scale_jacobian is not None
    assert turns.driver_jacobian is not None
    h = 1e-5
    for jacobian, vector in [(turns.scale_jacobian, RATE - BIAS_HAT), (turns.driver_jacobian, DRIVERS[18])]:
        for entry in range(3 * vector.shape[1]):
            D = h * np.eye(3 * vector.shape[1])[entry].reshape(3, -1)
            less, more = (
                GyroPath(T, RATE - sign * vector @ D.T, BIAS_HAT).increments(START, stop).wxyz for sign in (-1, 1)
            )
            numeric = so3.log(so3.multiply(so3.inverse(less), more)) / (2.0 * h)
            np.testing.assert_allclose(jacobian[..., entry], numeric, atol=2e-5 * np.abs(numeric).max())


def test_without_drivers_there_is_no_driver_jacobian() -> None:
    path = GyroPath(T, RATE)
    assert path.increments([1.0], [2.0], scale=True).driver_jacobian is None
    assert path.increments([1.0], [2.0]).scale_jacobian is None
    assert path.drivers([1.0]) is None
    with pytest.raises(ValueError, match="drivers for each rate"):
        GyroPath(T, RATE, drivers=FORCE[1:])


def test_drivers_between_stamps() -> None:
    at = np.array([1.0, 1.001, 7.77])
    got = GyroPath(T, RATE, drivers=FORCE).drivers(at)
    assert got is not None
    exact = np.stack([3.0 * np.sin(at), 2.0 * np.cos(1.3 * at), 9.8 + np.sin(2.0 * at)], axis=1)
    np.testing.assert_allclose(got, exact, atol=1e-5)


def _blocks(angle: float, size: float, errors: int, platform: bool = False) -> list[Array]:
    """Random values for the factor's blocks, with `errors` numbers of S and D, of the given size."""
    rng = np.random.default_rng(4)
    attitudes = [so3.exp(angle * rng.normal(size=(N, 3))) for _ in range(2)]
    gyro = [BIAS_HAT + 0.02 * rng.normal(size=(N, 3)), size * rng.normal(size=(N, 19)) * ([1.0] * 6 + [0.03] * 13)]
    base = [size * rng.normal(size=(N, 9))] if platform else []
    return [*attitudes, gyro[0], *([gyro[1][:, :errors]] if errors else []), *base]


@cache
def _increments(errors: int, platform: bool) -> tuple[Increments, GyroPath]:
    """Of the gyro or the platform's, and its path."""
    if platform:
        path = GyroPath(T, 0.3 * np.roll(RATE, 1, axis=1), 0.5 * BIAS_HAT)
    else:
        path = GyroPath(T, RATE, BIAS_HAT, DRIVERS[errors])
    return path.increments(*WINDOWS, scale=errors > 0), path


def _factor(rows: NDArray[np.intp], errors: int, platform: bool = False) -> GyroIncrementFactor:
    (turns, path), (base_turns, base) = _increments(errors, False), _increments(errors, True)
    stop, sigma = WINDOWS[1][rows], np.linspace(0.5, 2.0, N)[rows]
    if platform:
        return GyroIncrementFactor(stop, turns[rows], path, sigma, base_turns[rows], base, share=0.4, errors=errors)
    return GyroIncrementFactor(stop, turns[rows], path, sigma, errors=errors)


CASES = [(errors, platform) for errors in DRIVERS for platform in (False, True) if errors or not platform]


@pytest.mark.parametrize(("errors", "platform"), CASES)
@pytest.mark.parametrize(("angle", "size"), [(0.7, 0.1), (1e-6, 1e-9)], ids=["random", "near zero"])
def test_increment_jacobians(errors: int, platform: bool, angle: float, size: float) -> None:
    assert_jacobians(_factor(np.arange(N), errors, platform), _blocks(angle, size, errors, platform))


@pytest.mark.parametrize(("errors", "platform"), CASES)
def test_increment_rows_are_independent(errors: int, platform: bool) -> None:
    assert_rows_are_independent(lambda rows: _factor(rows, errors, platform), _blocks(0.7, 0.05, errors, platform))


def test_a_platform_of_known_errors() -> None:
    """The residual is zero where both gyros' errors are what they are."""
    base_rate = 0.3 * np.roll(RATE, 1, axis=1)
    scale, g = 1e-2 * SCALE, 1e-4 * G
    gyro = _read(scale, g, BIAS)
    base = GyroPath(T, base_rate @ (np.eye(3) + symmetric(-scale)).T - BIAS)
    windows = START, START + 0.05
    model = GyroIncrementFactor(
        windows[1],
        gyro.increments(*windows, scale=True),
        gyro,
        np.ones(N),
        base.increments(*windows, scale=True),
        base,
        errors=15,
    )
    turned, carrying = (GyroPath(T, rate).increments(*windows).wxyz for rate in (RATE, base_rate))
    i = so3.exp(np.random.default_rng(1).normal(size=(N, 3)))
    j = so3.compose(so3.inverse(carrying), i, turned)
    known = np.tile([*scale, *g], (N, 1)), np.tile([*-BIAS, *-scale], (N, 1))
    np.testing.assert_allclose(model(i, j, np.tile(BIAS, (N, 1)), *known)[0], 0.0, atol=2e-7)
    perfect = np.zeros((N, 9))
    assert np.abs(model(i, j, np.tile(BIAS, (N, 1)), known[0], perfect)[0]).max() > 1e-4


def test_carried_over_short_windows() -> None:
    """As corrected increments, and the rate at the end is the true one."""
    scale, g = 1e-2 * SCALE, 1e-4 * G
    gyro = _read(scale, g, BIAS)
    stop = START + np.linspace(-0.02, 0.03, N)
    got, rate, _ = carried(
        gyro, START, 0.5 * (START + stop), stop, np.tile(BIAS, (N, 1)), np.tile([*scale, *g], (N, 1))
    )
    true = GyroPath(T, RATE).increments(START, stop)
    # A scale of 1e-2 times the rate's second derivative, 50 rad/s^3, times the window's cube over 24.
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(true.wxyz), got)), 0.0, atol=6e-7)
    # The errors are those of the middle of the window: 1e-2 of what the rate changes in half of it.
    np.testing.assert_allclose(rate, true.rate, atol=3e-3)


@pytest.mark.parametrize("errors", [9, 18])
def test_a_gyro_that_warms_up(errors: int) -> None:
    """Corrected for its slope, and for scale and force where those are known too, it tells the true rate."""
    scale, g, slope = 1e-2 * SCALE, 1e-4 * G, np.array([1e-3, -2e-3, 5e-4])
    numbers = np.array([*scale, *g, *slope]) if errors == 18 else np.array([*scale, *slope])
    felt = FORCE @ g.reshape(3, 3).T if errors == 18 else 0.0
    measured = RATE @ (np.eye(3) + symmetric(scale)).T + felt + np.outer(WARMTH, slope) + BIAS
    path = GyroPath(T, measured, BIAS_HAT, DRIVERS[errors])
    stop = START + 0.05
    bias, known = np.tile(BIAS, (N, 1)), np.tile(numbers, (N, 1))
    true = GyroPath(T, RATE).increments(START, stop).wxyz
    ways = (
        corrected(path.increments(START, stop, scale=True), bias - BIAS_HAT, known)[0],
        carried(path, START, START + 0.025, stop, bias, known)[0],
    )
    for got, limit in zip(ways, (3e-7, 4e-6), strict=True):
        np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(true), got)), 0.0, atol=limit)
    without = np.tile([*numbers[:-3], 0.0, 0.0, 0.0], (N, 1))
    cold, _ = corrected(path.increments(START, stop, scale=True), bias - BIAS_HAT, without)
    assert np.abs(so3.log(so3.multiply(so3.inverse(true), cold))).max() > 1e-4


@pytest.mark.parametrize("errors", [7, 10, 16, 19])
def test_gyro_that_subtracts_its_dead_band(errors: int) -> None:
    """Readings, larger in size by what it subtracts, are the true rate."""
    scale, band = 1e-2 * SCALE, 5e-3
    others = np.zeros(errors - 7)
    path = GyroPath(T, RATE @ (np.eye(3) + symmetric(scale)).T + BIAS - band * BEYOND, BIAS_HAT, DRIVERS[errors])
    stop, bias = START + 0.05, np.tile(BIAS, (N, 1))
    true = GyroPath(T, RATE).increments(START, stop).wxyz
    turns = path.increments(START, stop, scale=True)
    for subtracted, low, high in ((band, 0.0, 5e-7), (0.0, 1e-4, 1e-3)):
        got, _ = corrected(turns, bias - BIAS_HAT, np.tile([*scale, *others, subtracted], (N, 1)))
        off = np.abs(so3.log(so3.multiply(so3.inverse(true), got))).max()
        assert low <= off < high


def test_errors_as_variables_need_derivatives_by_them() -> None:
    path = GyroPath(T, RATE)
    turns = path.increments([1.0], [2.0])
    with pytest.raises(ValueError, match="scale=True"):
        corrected(turns, np.zeros((1, 3)), np.zeros((1, 6)))
    with pytest.raises(ValueError, match="drivers"):
        corrected(path.increments([1.0], [2.0], scale=True), np.zeros((1, 3)), np.zeros((1, 15)))


def test_equals_the_native_factor_where_the_gyro_is_perfect() -> None:
    path = GyroPath(T, RATE, BIAS_HAT, FORCE)
    turns = path.increments(START, START + 0.1, scale=True)
    i, j, bias, _ = _blocks(0.4, 0.0, 15)
    keys_i, keys_j, keys_bias = (list(range(k, k + N)) for k in (0, N, 2 * N))
    values = gtsam.Values()
    for k in range(N):
        values.insert(keys_i[k], so3.to_gtsam(i[k]))
        values.insert(keys_j[k], so3.to_gtsam(j[k]))
        values.insert(keys_bias[k], bias[k])
    errors = 100
    values.insert(errors, np.zeros(15))
    sigma = np.linspace(0.5, 2.0, N)
    keys = keys_i, keys_j, keys_bias
    ours = GyroIncrementFactor(START + 0.1, turns, path, sigma, errors=15).on(*keys, errors)
    perfect = GyroIncrementFactor(START + 0.1, path.increments(START, START + 0.1), path, sigma).on(*keys)
    graph = gtsam.NonlinearFactorGraph()
    for factor in ahrs_factors(keys_i, keys_j, keys_bias, turns, BIAS_HAT, sigma**2):
        graph.add(factor)
    assert ours.factor.error(values) == pytest.approx(graph.error(values), rel=1e-9)
    assert perfect.factor.error(values) == pytest.approx(graph.error(values), rel=1e-9)
    ordering = gtsam.Ordering()
    for key in range(3 * N):
        ordering.push_back(key)
    expected = graph.linearize(values).hessian(ordering)[0]
    for each in (ours, perfect):
        _, A = each.rows(values)
        kept = np.concatenate([np.arange(3) + 3 * each.keys.index(key) for key in range(3 * N)])
        np.testing.assert_allclose((A.T @ A)[np.ix_(kept, kept)], expected, atol=1e-7 * np.abs(expected).max())
