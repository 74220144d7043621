"""Measurements with errors by where they are made: analytic Jacobians, and what the block means."""

from __future__ import annotations

import numpy as np

from alidade.factors import so3
from alidade.factors.attitude import VisionAttitudeFactor
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from alidade.pipelines.estimation.error_map import ErrorMapFactor

N, K = 8, 3


def _vision(measured: np.ndarray) -> VisionAttitudeFactor:
    t = np.arange(0.0, 6.0, 0.005)
    rate = np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None])
    root = np.random.default_rng(5).normal(size=(N, 3, 3)) + 3.0 * np.eye(3)
    return VisionAttitudeFactor(np.linspace(0.5, 5.0, N), measured, root, GyroPath(t, rate, np.zeros(3)), None)


def _blocks(rng: np.random.Generator) -> list[np.ndarray]:
    rotations = [so3.exp(0.5 * rng.normal(size=(n, 3))) for n in (N, 1, 1)]
    state, camera, helmet = (np.broadcast_to(each, (N, 4)) for each in rotations)
    bias, offset = (np.broadcast_to(0.01 * rng.normal(size=(1, d)), (N, d)) for d in (3, 1))
    return [state, bias, camera, helmet, offset]


def test_jacobians_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    blocks = _blocks(rng)
    model = ErrorMapFactor(_vision(so3.exp(0.5 * rng.normal(size=(N, 3)))), rng.normal(size=(N, K)), 3)
    assert_jacobians(model, [*blocks, np.broadcast_to(1e-3 * rng.normal(size=(1, 3 * K)), (N, 3 * K))])


def test_map_takes_off_the_errors_of_the_measurements_to_first_order() -> None:
    rng = np.random.default_rng(2)
    blocks, functions = _blocks(rng), rng.normal(size=(N, K))
    exact = VisionAttitudeFactor(
        **{**vars(_vision(so3.identity(N))), "sqrt_information": np.tile(np.eye(3), (N, 1, 1))}
    )
    true = so3.inverse(so3.exp(exact(*blocks)[0]))
    c = 1e-3 * rng.normal(size=(K, 3))
    seen = _vision(so3.multiply(true, so3.exp(functions @ c)))
    with_map = ErrorMapFactor(seen, functions, 3)(*blocks, np.broadcast_to(c.reshape(1, -1), (N, 3 * K)))[0]
    assert np.abs(seen(*blocks)[0]).max() > 1e-3
    assert np.abs(with_map).max() < 1e-5
