"""The published regressions of the cube, on data where the answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.earth import EARTH_RATE, gravity
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.model import problem
from alidade.pipelines.methods.cube.published import nominal_vectors, published_estimate, regression
from alidade.pipelines.methods.cube.recording import CubeData, local_field
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, Errors, cube_config, simulate_cube

RNG = np.random.default_rng(1)
K = np.eye(3) + 0.05 * RNG.normal(size=(3, 3))
B = RNG.normal(size=3)


def _vectors(n: int) -> np.ndarray:
    return 9.8 * so3.rotate(so3.normalize(RNG.normal(size=(n, 4))), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("poses", [4, 18])
def test_exact_data_give_exact_gains(poses: int) -> None:
    raw = _vectors(poses)
    found = regression(raw, raw @ K.T + B)
    np.testing.assert_allclose(found.K, K, atol=1e-9)
    np.testing.assert_allclose(found.b, B, atol=1e-8)


def test_counts_with_a_large_offset_keep_their_digits() -> None:
    raw = 32768.0 + 415.0 * _vectors(12)
    found = regression(raw, raw @ (K / 415.0).T + B)
    np.testing.assert_allclose(found.K * 415.0, K, rtol=1e-8, atol=1e-9)


def test_covariance_is_that_of_repeated_noise() -> None:
    """Noise in the nominal, exact raw: then linear regression's covariance is right."""
    raw = _vectors(18)
    sigma = np.array([0.01, 0.02, 0.03])
    runs = [regression(raw, raw @ K.T + B + sigma * RNG.normal(size=raw.shape)) for _ in range(400)]
    estimates = np.array([[*r.K.ravel(), *r.b] for r in runs])
    stated = np.mean([np.diag(r.covariance) for r in runs], axis=0)
    np.testing.assert_allclose(estimates.var(axis=0), stated, rtol=0.25)
    np.testing.assert_allclose(
        np.sqrt(np.diag(np.mean([r.residual_covariance for r in runs], axis=0))), sigma, rtol=0.05
    )


def test_three_poses_or_all_alike_are_refused() -> None:
    with pytest.raises(InputError, match="at least 4 static poses, there are 3"):
        regression(_vectors(3), _vectors(3))
    with pytest.raises(InputError, match="all static poses are alike"):
        regression(np.tile([1.0, 2.0, 3.0], (6, 1)) + np.linspace(0, 1, 6)[:, None], _vectors(6))


def test_nominal_vectors_are_those_of_the_local_level_frame() -> None:
    """North-East-Down inside, the same vectors in the body as from East-North-Up."""
    data, config = (
        CubeData(0, np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3)), latitude=0.7, longitude=2.0, height=50.0),
        load_config(b"date: 2026-11-20"),
    )
    data = replace(data, mag=np.zeros((1, 3)))
    nRb = so3.normalize(RNG.normal(size=(5, 4)))
    bRn = so3.inverse(nRb)
    nominal = nominal_vectors(data, config, nRb)
    np.testing.assert_allclose(nominal["accel"], so3.rotate(bRn, [0, 0, float(gravity(0.7, 50.0))]), atol=1e-12)
    np.testing.assert_allclose(nominal["mag"], so3.rotate(bRn, local_field(data, config)), atol=1e-18)
    np.testing.assert_allclose(nominal["gyro"], so3.rotate(bRn, [0, 0, -EARTH_RATE]), atol=1e-18)


def test_static_gyro_regression_returns_no_gain() -> None:
    """The defect that the graph is there for: earth rate alone, under MEMS noise."""
    scenario = CubeScenario(poses=18, errors=Errors(gain=0.0), camera=CubeCamera(rate_hz=5.0))
    found = simulate_cube(scenario, 2)
    data, config = found.data, load_config(found.config.encode())
    estimate = published_estimate(data, config, problem(data, config))
    values = dict(zip(estimate.names, estimate.values, strict=True))
    assert abs(values["accel_k11"] - 1.0) < 0.01
    assert abs(values["mag_k22"] - 1.0) < 0.01
    assert max(abs(values[f"gyro_k{i}{i}"]) for i in "123") < 0.6
    assert "static poses" in estimate.message


def test_needs_camera_and_reference() -> None:
    scenario = CubeScenario(poses=4, camera=None)
    data, _ = simulate_cube(scenario, 2)
    config = load_config(cube_config(scenario).encode())
    with pytest.raises(InputError, match="needs a camera and a reference"):
        published_estimate(data, config, problem(data, config))
