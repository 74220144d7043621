"""The published recursive least squares: what it solves, and how far its model is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.factors.gimbal import GimbalPath
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.methods.los.published import NAMES, published_estimate, rates, recursive_least_squares
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.los.simulation import LosAngles, LosScenario, simulate_los
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import load_scenario
from tests.support.los_rates import LosRateFactor


def _noise_free(elevation: float, size: float = 1.0) -> tuple[LosData, np.ndarray]:
    scenario = load_scenario(LosScenario, "los_noise_free")
    angles = LosAngles(**{name: size * value for name, value in scenario.angles_deg.model_dump().items()})
    changes = {"elevation_deg": elevation, "gyro_rate_hz": 1000.0, "angles_deg": angles}
    data, truth = simulate_los(scenario.model_copy(update=changes), 0)
    return data, np.array([truth[name] for name in NAMES])


def _px_error_deg(X: np.ndarray, truth: np.ndarray) -> float:
    return float(np.rad2deg(abs(X[0] - truth[0])))


def _linear(data: LosData, exact: bool, roll: bool) -> np.ndarray:
    inside = (data.image_t > data.gimbal_t[0]) & (data.image_t < data.gimbal_t[-1])
    gimbal = GimbalPath(data.gimbal_t, data.gimbal)
    model = LosRateFactor.between(
        data.image_t[inside], data.error[inside, :2], data.gyro_t, data.gyro, gimbal, 2e-5, exact, roll
    )
    return np.linalg.lstsq(model.H.reshape(-1, 4), model.measured.ravel())[0]


@pytest.mark.parametrize("elevation", [20.0, *(pytest.param(e, marks=pytest.mark.slow) for e in (0.0, 45.0))])
def test_published_model_is_off_by_a_tenth_of_a_degree_without_any_noise(elevation: float) -> None:
    data, truth = _noise_free(elevation)
    assert 0.08 < _px_error_deg(recursive_least_squares(data).values[-1], truth) < 0.18


def test_with_both_missing_terms_only_second_order_is_left() -> None:
    """Angles ten times smaller: the published error follows them, what the complete model leaves is their square."""
    (large, large_truth), (small, small_truth) = _noise_free(20.0), _noise_free(20.0, 0.1)
    published = [
        _px_error_deg(recursive_least_squares(data, initial_sigma=10.0).values[-1], truth)
        for data, truth in ((large, large_truth), (small, small_truth))
    ]
    complete = [
        _px_error_deg(_linear(data, exact=True, roll=True), truth)
        for data, truth in ((large, large_truth), (small, small_truth))
    ]
    assert published[1] == pytest.approx(0.1 * published[0], rel=0.2)
    assert complete[0] < 0.2 * published[0]
    assert complete[1] < 0.02 * complete[0]


def test_neither_missing_term_alone_is_enough() -> None:
    data, truth = _noise_free(45.0)

    def worst_deg(X: np.ndarray) -> float:
        return float(np.rad2deg(np.abs(X - truth).max()))

    assert worst_deg(recursive_least_squares(data, exact=True).values[-1]) > 0.03
    assert worst_deg(_linear(data, exact=False, roll=True)) > 0.1
    assert worst_deg(_linear(data, exact=True, roll=True)) < 0.01


def test_recursion_is_least_squares() -> None:
    data, _ = simulate_los(LosScenario(duration_s=10.0), 1)
    result = recursive_least_squares(data, los_sigma=2e-5, initial_sigma=0.1)
    t, measured, H = rates(data)
    weight = np.repeat(np.diff(t) / (np.sqrt(2.0) * 2e-5), 2)
    A = np.vstack([weight[:, None] * H.reshape(-1, 4), np.eye(4) / 0.1])
    b = np.concatenate([weight * measured.ravel(), np.zeros(4)])
    np.testing.assert_allclose(result.values[-1], np.linalg.lstsq(A, b)[0], atol=1e-9)
    np.testing.assert_allclose(result.covariance[-1], np.linalg.inv(A.T @ A), rtol=1e-6)


def test_rates_that_follow_the_published_model_give_its_angles() -> None:
    data, _ = simulate_los(LosScenario(duration_s=10.0), 1)
    X = np.array([0.01, -0.02, 0.015, 0.005])
    t, _, H = rates(data)
    inside = np.isin(data.image_t, t)
    error = np.zeros((len(t), 3))
    error[1:, :2] = np.cumsum((H @ X) * np.diff(t)[:, None], axis=0)
    made = replace(data, image_t=data.image_t[inside], error=error)
    result = recursive_least_squares(made, initial_sigma=100.0)
    np.testing.assert_allclose(result.values[-1], X, atol=1e-8)


def test_estimate_stands_beside_the_others() -> None:
    data, _ = simulate_los(LosScenario(duration_s=10.0), 1)
    estimate = published_estimate(data, Config(), problem(data, Config()))
    assert estimate.names == NAMES
    assert estimate.covariance.shape == (4, 4)
    assert estimate.history is not None
    assert estimate.history.values.shape == (len(estimate.history.time), 4)


def test_no_overlap_is_one_clear_line() -> None:
    data, _ = simulate_los(LosScenario(duration_s=2.0), 1)
    with pytest.raises(InputError, match="0 of 100 LOS errors lie within"):
        recursive_least_squares(replace(data, image_t=data.image_t + 100.0))
