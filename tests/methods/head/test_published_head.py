"""The published Euler-angle Kalman filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.head import published
from alidade.pipelines.methods.head.published import HeadFilterResult, euler_kalman_filter
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head
from alidade.pipelines.simulation.scenario import load_scenario


def run(scenario: HeadScenario, data: HeadData) -> HeadFilterResult:
    noise = scenario.noise
    return euler_kalman_filter(data, noise.gyro_density, noise.gyro_bias_walk, noise.vision_attitude)


def error_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.linalg.norm(so3.log(so3.multiply(so3.inverse(a), b)), axis=-1))


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def bias(truth: dict[str, float]) -> np.ndarray:
    return np.array([truth[f"gyro_bias_{axis}"] for axis in "xyz"])


def test_euler_rates_move_the_attitude_at_the_rate_they_were_made_from() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        angles = rng.uniform([-3.0, -1.3, -3.0], [3.0, 1.3, 3.0])
        w_iv, w_ib = rng.standard_normal((2, 3))
        rates, _, _ = published.euler_rates(angles, w_iv, w_ib)
        h = 1e-5
        before, after = (so3.from_angles((angles + step * rates)[::-1]) for step in (-h, h))
        w_bv = so3.log(so3.multiply(so3.inverse(before), after)) / (2 * h)
        expected = w_iv - so3.rotate(so3.inverse(so3.from_angles(angles[::-1])), w_ib)
        np.testing.assert_allclose(w_bv, expected, atol=1e-7)


def test_analytic_derivatives_are_the_numerical_ones() -> None:
    rng = np.random.default_rng(3)
    h = 1e-6
    for _ in range(50):
        angles = rng.uniform([-3.0, -1.3, -3.0], [3.0, 1.3, 3.0])
        w_iv, w_ib = rng.standard_normal((2, 3))
        _, by_angles, by_rate = published.euler_rates(angles, w_iv, w_ib)
        for i, d in enumerate(h * np.eye(3)):
            up, down = (published.euler_rates(angles + s * d, w_iv, w_ib)[0] for s in (1, -1))
            np.testing.assert_allclose(by_angles[:, i], (up - down) / (2 * h), rtol=1e-6, atol=1e-6)
            up, down = (published.euler_rates(angles, w_iv + s * d, w_ib)[0] for s in (1, -1))
            np.testing.assert_allclose(by_rate[:, i], (up - down) / (2 * h), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_published_test_on_the_turntable(seed: int) -> None:
    """Static error within 0.35 deg, bias settled within 2 s, better than vision alone."""
    scenario = load_scenario(HeadScenario, "head_turntable").model_copy(update={"gyro_rate_hz": 200.0})
    data, truth = simulate_head(scenario, seed)
    result = run(scenario, data)
    true = scenario.head.attitude(result.t)
    error, vision = error_deg(result.wxyz, true), error_deg(data.vision_wxyz, true)
    static = ((result.t > 2) & (result.t < 20)) | (result.t > 46)
    assert error[static].max() < 0.35
    assert rms(error[result.t > 2]) < 0.15 * rms(vision)
    bias_error = np.rad2deg(np.abs(result.bias - bias(truth)).max(axis=1))
    # At 2 s vision of 0.5 deg at 50 Hz tells a slope to 0.09 deg/s, 1 sigma; "settled" is three of these.
    assert bias_error[result.t > 2].max() < 0.27
    assert bias_error[result.t > 12].max() < 0.02


def test_platform_motion_is_subtracted() -> None:
    scenario = load_scenario(HeadScenario, "head_nominal")
    data, _ = simulate_head(scenario, seed=1)
    data = shorten(data, 20.0)
    late = data.vision_t > 5.0
    true = scenario.head.attitude(data.vision_t)
    assert rms(error_deg(run(scenario, data).wxyz, true)[late]) < 0.15
    without = run(scenario, replace(data, platform_t=None, platform_gyro=None))
    assert rms(error_deg(without.wxyz, true)[late]) > 0.5


def test_sigma_of_the_bias_is_that_of_its_error() -> None:
    """Over many seeds, at rest, where the filter's model is exact."""
    scenario = HeadScenario.model_validate(
        {
            "duration_s": 3.0,
            "head": {},
            "latitude_deg": None,
            "gyro_turn_on_bias_deg_s": 2.0,
            "gyro_rate_hz": 60.0,
        }
    )
    normalized = []
    for seed in range(40):
        data, truth = simulate_head(scenario, seed)
        result = run(scenario, data)
        normalized.append((result.bias[-1] - bias(truth)) / result.bias_sigma[-1])
    assert 0.8 < np.std(normalized) < 1.2


def test_runs_through_outages_on_the_gyro() -> None:
    scenario = load_scenario(HeadScenario, "head_outages").model_copy(
        update={"outlier_fraction": 0.0, "gyro_rate_hz": 100.0}
    )
    data, _ = simulate_head(scenario, seed=1)
    result = run(scenario, data)
    first_after_gap = np.flatnonzero(np.diff(result.t) > 5.0) + 1
    assert len(first_after_gap) == 2
    error = error_deg(result.wxyz, scenario.head.attitude(result.t))
    assert error[first_after_gap].max() < 1.0
    assert np.rad2deg(np.abs(result.innovation[first_after_gap])).max() < 3.0


@pytest.mark.parametrize("amplitude", [88.0, 90.0, 120.0])
def test_stays_finite_near_and_through_the_vertical(amplitude: float) -> None:
    pitch = {"amplitude_deg": amplitude, "frequency_hz": 0.1, "end_s": 10.0}
    yaw = {"amplitude_deg": 5.0, "frequency_hz": 0.3}
    scenario = HeadScenario.model_validate(
        {"duration_s": 25.0, "gyro_rate_hz": 100.0, "head": {"pitch": [pitch], "yaw": [yaw]}}
    )
    data, _ = simulate_head(scenario, seed=1)
    result = run(scenario, data)
    for values in (result.wxyz, result.bias, result.bias_sigma, result.innovation):
        assert np.isfinite(values).all()
    if amplitude == 88.0:  # not passed over the singularity: the filter comes back
        error = error_deg(result.wxyz, scenario.head.attitude(result.t))
        assert error[result.t > 12.0].max() < 1.0


def test_bias_is_smoothed_only_where_it_varies() -> None:
    rng = np.random.default_rng(4)
    history = np.concatenate([1e-2 * rng.standard_normal((100, 1)), 1e-4 * rng.standard_normal((100, 1))])
    smooth = published._smooth(history, window=25, threshold=2e-3)
    assert smooth[60, 0] == pytest.approx(history[36:61, 0].mean(), abs=1e-15)
    np.testing.assert_array_equal(smooth[130:], history[130:])


def test_no_common_time_is_said() -> None:
    scenario = load_scenario(HeadScenario, "head_turntable")
    data, _ = simulate_head(scenario, seed=1)
    with pytest.raises(InputError, match="do not overlap"):
        run(scenario, replace(data, vision_t=data.vision_t + 100.0))


def shorten(data: HeadData, seconds: float) -> HeadData:
    keep = data.vision_t < seconds
    return replace(
        data,
        vision_t=data.vision_t[keep],
        vision_wxyz=data.vision_wxyz[keep],
        vision_cov=None if data.vision_cov is None else data.vision_cov[keep],
    )
