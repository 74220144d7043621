"""Properties of the attitude factors: Jacobians, batches, the native fast path."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.attitude import VisionAttitudeFactor
from alidade.factors.gyro import GyroIncrementFactor, symmetric
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from benchmarks.ahrs import ahrs_factors
from tests.support.numerics import assert_rows_are_independent

RNG = np.random.default_rng(1)
N = 12


T = np.arange(0.0, 6.0, 0.005)
FORCE = np.stack([np.sin(T), np.cos(T), 9.8 + np.sin(2.0 * T)], axis=1)
WARMTH = 4.0 * np.sin(0.7 * T)[:, None]
# What moves the helmet gyro's readings, by how many numbers its errors are.
DRIVERS = {6: None, 9: WARMTH, 15: FORCE, 18: np.column_stack([FORCE, WARMTH])}


def _path(seed: int, amplitude: float, drivers: Array | None = None) -> GyroPath:
    rng = np.random.default_rng(seed)
    t = T
    phase = rng.uniform(0, 6, size=3)
    rate = amplitude * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None] + phase)
    return GyroPath(t, rate, rng.normal(scale=0.01, size=3), drivers)


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


def _errors(size: float, errors: int) -> list[Array]:
    """Blocks of the pictures' errors and of both gyros'."""
    rng = np.random.default_rng(8)
    picture = np.tile([0.012, 3e-4, size, 1e-3], (N, 1))
    gyro = size * rng.normal(size=(N, 18)) * ([1.0] * 6 + [0.03] * 12)
    return [picture, gyro[:, :errors], size * rng.normal(size=(N, 9))]


def _vision_of_all(rows: np.ndarray, errors: int, moving: bool) -> tuple[VisionAttitudeFactor, list[Array]]:
    """Some pictures of a factor with all variables, at random values."""
    rng = np.random.default_rng(9)
    picture, gyro, platform = _errors(0.05, errors)
    rotations = [so3.exp(rng.normal(size=(n, 3))) for n in (N, 1, 1)]
    bias = HELMET.bias_hat + rng.normal(scale=0.02, size=(N, 3))
    blocks = [rotations[0], bias, *(np.tile(q, (N, 1)) for q in rotations[1:]), picture, gyro]
    measured = so3.exp(rng.normal(size=(N, 3)))
    model = VisionAttitudeFactor(
        TIMES[rows],
        measured[rows],
        (rng.normal(size=(N, 3, 3)) + 3 * np.eye(3))[rows],
        _path(1, 1.5, DRIVERS[errors]),
        PLATFORM if moving else None,
        errors=errors,
        platform_errors=moving,
        anchor=TIMES[rows] + np.linspace(-0.05, 0.05, N)[rows],
        expected=TIMES[rows] + np.linspace(0.02, -0.01, N)[rows],
        elapsed=TIMES[rows],
        first=np.tile(so3.exp(np.array([0.1, 0.2, -0.3])), (N, 1))[rows],
    )
    return model, [*blocks, *([platform] if moving else [])]


@pytest.mark.parametrize("moving", [True, False], ids=["moving platform", "platform at rest"])
@pytest.mark.parametrize("errors", DRIVERS)
def test_vision_jacobians_with_all_variables(errors: int, moving: bool) -> None:
    model, blocks = _vision_of_all(np.arange(N), errors, moving)
    steps = [1e-5, 1e-4, 1e-5, 1e-5, 1e-6, 1e-4, 1e-4]
    assert_jacobians(model, blocks, steps[: len(blocks)])
    everything = model(*blocks)
    for i in range(N):
        one = _vision_of_all(np.array([i]), errors, moving)[0](*(b[i : i + 1] for b in blocks))
        np.testing.assert_allclose(one[0][0], everything[0][i], rtol=1e-9, atol=1e-9)
        for a, b in zip(one[1](), everything[1](), strict=True):
            np.testing.assert_allclose(a[0], b[i], rtol=1e-9, atol=1e-7)


def test_vision_of_known_errors_is_zero() -> None:
    """Times, angles and rates off by what the variables say."""
    scale, skew, offset, moment = 0.01, 2e-4, 0.01, 1e-4
    at = TIMES + offset - skew * (TIMES - TIMES[0])
    S_numbers = np.array([0.01, -0.005, 0.008, 0.002, -0.003, 0.004])
    S = symmetric(S_numbers)
    base_bias = np.array([1e-3, -2e-3, 5e-4])
    t = HELMET.t
    w, base = (0.3 * np.sin(np.array(f) * t[:, None] + f[0]) for f in ([1.1, 0.7, 1.9], [0.3, 0.5, 0.4]))
    bRv0, cRb, vRh = so3.exp(np.random.default_rng(3).normal(size=(3, 3)))
    inertial, platform = (GyroPath(t, rate).attitude for rate in (w, base))

    def bRv(times: Array) -> Array:
        return so3.compose(so3.inverse(platform(times)), bRv0, inertial(times))

    ahead, behind = (so3.local(bRv(at), bRv(at + step)) for step in (2e-3, -2e-3))
    acceleration = (ahead + behind) / 2e-3**2
    cRh = so3.compose(cRb, bRv(at), so3.exp(moment * acceleration), np.tile(vRh, (N, 1)))
    turned = so3.log(so3.multiply(so3.inverse(cRh[:1]), cRh)) * (1.0 + scale)
    measured = so3.multiply(cRh[:1], so3.exp(turned))
    model = VisionAttitudeFactor(
        TIMES,
        measured,
        np.tile(np.eye(3), (N, 1, 1)),
        GyroPath(t, w + w @ S),
        GyroPath(t, base - base @ S + base_bias),
        errors=6,
        platform_errors=True,
        anchor=TIMES - 0.02,
        elapsed=TIMES - TIMES[0],
        first=np.tile(cRh[:1], (N, 1)),
    )
    errors = [np.array([offset, skew, scale, moment]), S_numbers, np.concatenate([base_bias, -S_numbers])]
    blocks = [bRv(TIMES - 0.02), np.zeros((N, 3)), *(np.tile(each, (N, 1)) for each in (cRb, vRh, *errors))]
    np.testing.assert_allclose(model(*blocks)[0], 0.0, atol=3e-6)
    for k in (4, 5, 6):
        without = [0.0 * b if i == k else b for i, b in enumerate(blocks)]
        assert np.abs(model(*without)[0]).max() > 5e-5


def test_vision_rows_are_independent() -> None:
    blocks = _vision_blocks(1.0, 0.01)
    assert_rows_are_independent(lambda rows: _vision(rows, blocks, 0.3, PLATFORM), blocks)


def test_vision_is_zero_at_the_truth_and_follows_the_offset() -> None:
    blocks = _vision_blocks(1.0, 0.02)
    model = _vision(np.arange(N), blocks, 0.0, PLATFORM)
    np.testing.assert_allclose(model(*blocks)[0], 0.0, atol=1e-9)
    late = [*blocks[:4], blocks[4] + 0.01]
    assert np.abs(model(*late)[0]).max() > 1e-3


def _relative(rows: np.ndarray, noise: float) -> tuple[GyroIncrementFactor, list[Array]]:
    start, stop = TIMES, TIMES + np.linspace(0.01, 0.9, N)
    rng = np.random.default_rng(7)
    helmet = HELMET.increments(start[rows], stop[rows])
    platform = PLATFORM.increments(start, stop)
    bRv_i = so3.exp(rng.normal(size=(N, 3)))
    bias = HELMET.bias_hat + rng.normal(scale=0.02, size=(N, 3))
    everything = HELMET.increments(start, stop)
    correction = np.einsum("nij,nj->ni", everything.bias_jacobian, bias - HELMET.bias_hat)
    bRv_j = so3.compose(so3.inverse(platform.wxyz), bRv_i, everything.wxyz, so3.exp(correction))
    bRv_j = so3.multiply(bRv_j, so3.exp(rng.normal(scale=max(noise, 1e-15), size=(N, 3))))
    sigma = np.linspace(0.5, 2.0, N)
    model = GyroIncrementFactor(stop[rows], helmet, HELMET, sigma[rows], platform[rows], PLATFORM)
    return model, [bRv_i, bRv_j, bias]


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
    assert model.platform_turns is not None
    iRb_j = so3.multiply(iRb_i, model.platform_turns.wxyz)
    keys = list(range(N))
    native = ahrs_factors(
        keys, [N + k for k in keys], [2 * N + k for k in keys], model.turns, HELMET.bias_hat, model.sigma**2
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


def test_scale_of_angles_is_smooth_through_half_a_turn() -> None:
    """Beyond 150 deg it fades out, so that attitudes on either side of half a turn are seen alike."""
    angles = np.deg2rad([100.0, 149.0, 179.9, 180.1])
    attitudes = so3.exp(np.outer(angles, [0.0, 0.6, 0.8]))
    model = VisionAttitudeFactor(
        np.zeros(4), attitudes, np.tile(np.eye(3), (4, 1, 1)), HELMET, None, elapsed=np.zeros(4), first=so3.identity(4)
    )
    one = so3.identity(4)
    at_rest = np.tile(HELMET.bias_hat, (4, 1))
    seen = model(attitudes, at_rest, one, one, np.tile([0.0, 0.0, 0.01, 0.0], (4, 1)))[0]
    np.testing.assert_allclose(-seen @ [0.0, 0.6, 0.8], [0.01 * angles[0], 0.01 * angles[1], 0.0, 0.0], atol=1e-6)
