"""Properties of the attitude factors: Jacobians, batches, the native fast path."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors import so3
from factors.attitude import RelativeAttitudeFactor, VisionAttitudeFactor, ahrs_factors
from factors.model import Array
from factors.preintegration import GyroPath
from factors.testing import assert_jacobians
from tests.numerics import assert_rows_are_independent

RNG = np.random.default_rng(1)
N = 12


def _path(seed: int, amplitude: float) -> GyroPath:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 6.0, 0.005)
    phase = rng.uniform(0, 6, size=3)
    rate = amplitude * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None] + phase)
    return GyroPath(t, rate, rng.normal(scale=0.01, size=3))


HELMET, PLATFORM = _path(1, 1.5), _path(2, 0.6)
TIMES = np.linspace(0.5, 5.0, N)


def _rotations(n: int, angle: float) -> Array:
    return so3.exp(RNG.normal(size=(n, 3)) * angle / np.sqrt(3))


def _shared(row: Array) -> Array:
    return np.broadcast_to(row, (N, row.shape[-1]))


def _vision(rows: np.ndarray, blocks: list[Array], noise: float, platform: GyroPath | None) -> VisionAttitudeFactor:
    """A factor whose measurements lie `noise` rad from what the blocks predict."""
    root = np.random.default_rng(5).normal(size=(N, 3, 3)) + 3 * np.eye(3)
    exact = VisionAttitudeFactor(TIMES, so3.identity(N), np.tile(np.eye(3), (N, 1, 1)), HELMET, platform)
    predicted = so3.inverse(so3.exp(exact(*blocks)[0]))  # measured = identity, so the error is Log(predicted^T)
    delta = np.random.default_rng(6).normal(scale=max(noise, 1e-15), size=(N, 3))
    measured = so3.multiply(predicted, so3.exp(delta))
    return VisionAttitudeFactor(TIMES[rows], measured[rows], root[rows], HELMET, platform)


def _vision_blocks(angle: float, dt: float) -> list[Array]:
    return [
        _rotations(N, angle),
        HELMET.bias_hat + RNG.normal(scale=0.02, size=(N, 3)),
        _shared(_rotations(1, angle)[0]),
        _shared(_rotations(1, angle)[0]),
        np.full((N, 1), dt),
    ]


@pytest.mark.parametrize("platform", [PLATFORM, None], ids=["moving platform", "platform at rest"])
@pytest.mark.parametrize("angle", [1.5, 1e-6], ids=["random", "near zero"])
@pytest.mark.parametrize("dt", [0.0, 0.0123, -0.03])
def test_vision_jacobians(angle: float, dt: float, platform: GyroPath | None) -> None:
    blocks = _vision_blocks(angle, dt)
    model = _vision(np.arange(N), blocks, 0.3, platform)
    assert_jacobians(model, blocks, [1e-5, 1e-4, 1e-5, 1e-5, 1e-6])


def test_vision_jacobians_near_half_turn_errors() -> None:
    blocks = _vision_blocks(1.0, 0.01)
    model = _vision(np.arange(N), blocks, 1.5, PLATFORM)
    steps = [1e-6, 1e-4, 1e-6, 1e-6, 1e-7]
    assert_jacobians(model, blocks, steps, rtol=2e-5)


def test_vision_rows_are_independent() -> None:
    blocks = _vision_blocks(1.0, 0.01)
    assert_rows_are_independent(lambda rows: _vision(rows, blocks, 0.3, PLATFORM), blocks)


def test_vision_is_zero_at_the_truth_and_follows_the_offset() -> None:
    blocks = _vision_blocks(1.0, 0.02)
    model = _vision(np.arange(N), blocks, 0.0, PLATFORM)
    np.testing.assert_allclose(model(*blocks)[0], 0.0, atol=1e-9)
    late = [*blocks[:4], blocks[4] + 0.01]
    assert np.abs(model(*late)[0]).max() > 1e-3


def _relative(rows: np.ndarray, noise: float) -> tuple[RelativeAttitudeFactor, list[Array]]:
    start, stop = TIMES, TIMES + np.linspace(0.01, 0.9, N)
    rng = np.random.default_rng(7)
    helmet = HELMET.increments(start[rows], stop[rows])
    platform = PLATFORM.increments(start, stop).wxyz
    bRv_i = so3.exp(rng.normal(size=(N, 3)))
    bias = HELMET.bias_hat + rng.normal(scale=0.02, size=(N, 3))
    everything = HELMET.increments(start, stop)
    correction = np.einsum("nij,nj->ni", everything.bias_jacobian, bias - HELMET.bias_hat)
    bRv_j = so3.compose(so3.inverse(platform), bRv_i, everything.wxyz, so3.exp(correction))
    bRv_j = so3.multiply(bRv_j, so3.exp(rng.normal(scale=max(noise, 1e-15), size=(N, 3))))
    sigma = np.linspace(0.5, 2.0, N)
    return RelativeAttitudeFactor(stop[rows], platform[rows], helmet, HELMET.bias_hat, sigma[rows]), [
        bRv_i,
        bRv_j,
        bias,
    ]


@pytest.mark.parametrize("noise", [0.5, 1e-7])
def test_relative_jacobians(noise: float) -> None:
    model, blocks = _relative(np.arange(N), noise)
    assert_jacobians(model, blocks)


def test_relative_rows_are_independent() -> None:
    _, blocks = _relative(np.arange(N), 0.5)
    assert_rows_are_independent(lambda rows: _relative(rows, 0.5)[0], blocks)


def test_relative_equals_native_path() -> None:
    """bRv variables with the vectorised factor and iRv variables with gtsam's AHRSFactor are the same constraint."""
    model, (bRv_i, bRv_j, bias) = _relative(np.arange(N), 0.3)
    iRb_i = PLATFORM.attitude(TIMES)
    iRb_j = so3.multiply(iRb_i, model.platform)
    keys = list(range(N))
    native = ahrs_factors(
        keys, [N + k for k in keys], [2 * N + k for k in keys], model.helmet, model.bias_hat, model.sigma**2
    )
    values = gtsam.Values()
    ours = gtsam.Values()
    for k in keys:
        values.insert(k, so3.to_gtsam(so3.multiply(iRb_i[k], bRv_i[k])))
        values.insert(N + k, so3.to_gtsam(so3.multiply(iRb_j[k], bRv_j[k])))
        ours.insert(k, so3.to_gtsam(bRv_i[k]))
        ours.insert(N + k, so3.to_gtsam(bRv_j[k]))
        values.insert(2 * N + k, bias[k])
        ours.insert(2 * N + k, bias[k])
    vectorized = model.on(keys, [N + k for k in keys], [2 * N + k for k in keys])
    assert vectorized.factor.error(ours) == pytest.approx(sum(f.error(values) for f in native), rel=1e-9)
    graph = gtsam.NonlinearFactorGraph()
    for f in native:
        graph.add(f)
    ordering = gtsam.Ordering()
    for key in range(3 * N):
        ordering.push_back(key)
    stacked = gtsam.NonlinearFactorGraph()
    stacked.add(vectorized.factor)
    expected = graph.linearize(values).hessian(ordering)[0]
    got = stacked.linearize(ours).hessian(ordering)[0]
    np.testing.assert_allclose(got, expected, atol=1e-7 * np.abs(expected).max())
