"""Gauss-Markov processes: Jacobians, variances of what their transitions allow, and vision that errs by one."""

from __future__ import annotations

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.attitude import VisionAttitudeFactor
from alidade.factors.gauss_markov import GaussMarkovFactor, remaining
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians

N = 6


def test_jacobians_of_transitions_agree_with_differences() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, N, 3))
    interval = np.geomspace(0.01, 3.0, N)
    assert_jacobians(GaussMarkovFactor(np.cumsum(interval), 0.01, 0.3, interval), [before, after])
    assert_jacobians(GaussMarkovFactor(np.zeros(N), 0.01, 0.3), [before])


def test_transitions_keep_the_process_stationary_and_its_autocorrelation_exponential() -> None:
    """The covariance that the factors of a whole process leave, as their information inverted."""
    time, sigma, tau = np.array([0.0, 0.1, 0.15, 0.4, 1.0]), 0.02, 0.5
    n = len(time)
    A = np.zeros((n, n))
    A[0, 0] = GaussMarkovFactor(time[:1], sigma, tau)(np.ones((1, 3)))[0][0, 0]
    (by_before, by_after) = GaussMarkovFactor(time[1:], sigma, tau, np.diff(time))(*np.zeros((2, n - 1, 3)))[1]()
    for k in range(1, n):
        A[k, k - 1], A[k, k] = by_before[k - 1, 0, 0], by_after[k - 1, 0, 0]
    covariance = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(covariance, sigma**2 * np.exp(-np.abs(time[:, None] - time) / tau), rtol=1e-9)


def test_transitions_over_any_interval_are_finite_in_both_directions() -> None:
    """The process backward in time is divided by what is left of it."""
    left = remaining(np.array([0.0, 100.0]), 1.0)
    assert left[1] == pytest.approx(1e-2)
    assert 0.0 < 1.0 - left[0] < 1e-8
    assert np.isfinite(GaussMarkovFactor(np.zeros(1), 0.01, 1.0, np.zeros(1))(*np.ones((2, 1, 3)))[0]).all()


def _vision(measured: np.ndarray, root: np.ndarray) -> VisionAttitudeFactor:
    t = np.arange(0.0, 6.0, 0.005)
    rate = np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None])
    gyro = GyroPath(t, rate, np.zeros(3))
    return VisionAttitudeFactor(np.linspace(0.5, 5.0, N), measured, root, gyro, None, correlated=True)


def test_jacobians_of_vision_with_a_lasting_error_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    state, camera, helmet, measured = so3.exp(0.5 * rng.normal(size=(4, N, 3)))
    root = rng.normal(size=(N, 3, 3)) + 3.0 * np.eye(3)
    blocks = [
        state,
        0.01 * rng.normal(size=(N, 3)),
        camera,
        helmet,
        np.full((N, 1), 0.01),
        0.2 * rng.normal(size=(N, 3)),
    ]
    assert_jacobians(_vision(measured, root), blocks)


def test_a_lasting_error_turns_the_marker_frame() -> None:
    rng = np.random.default_rng(2)
    state, camera, helmet = so3.exp(0.5 * rng.normal(size=(3, N, 3)))
    u, root = 0.2 * rng.normal(size=(N, 3)), np.tile(np.eye(3), (N, 1, 1))
    measured = so3.compose(camera, state, helmet, so3.exp(u))
    blocks = [state, np.zeros((N, 3)), camera, helmet, np.zeros((N, 1))]
    assert np.abs(_vision(measured, root)(*blocks, np.zeros((N, 3)))[0]).max() > 0.1
    np.testing.assert_allclose(_vision(measured, root)(*blocks, u)[0], 0.0, atol=1e-12)
