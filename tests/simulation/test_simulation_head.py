"""The head simulator, checked by integration and composition of its own outputs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.earth import earth_rate
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import read_head
from alidade.pipelines.methods.head.simulation import HeadNoise, HeadScenario, head_config, simulate_head
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.scenario import load_scenario

SCENARIOS = ["head_nominal", "head_mounts", "head_outages", "head_turntable"]
QUIET = {
    "noise": HeadNoise(gyro_density=0, gyro_bias_walk=0, platform_gyro_density=0, vision_attitude=0),
    "gyro_turn_on_bias_deg_s": 0.0,
    "outlier_fraction": 0.0,
}


def quiet(name: str, **changes: object) -> HeadScenario:
    scenario = load_scenario(HeadScenario, name)
    return HeadScenario.model_validate(scenario.model_dump() | QUIET | changes)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(so3.log(so3.multiply(so3.inverse(a), b)), axis=-1)


def integrate(gyro: np.ndarray, rate_hz: float) -> np.ndarray:
    """Attitude at the end of each sample's interval in the frame at the start of the first."""
    path, whole = so3.exp(gyro / rate_hz), 1
    # Each the product of the last `whole` steps, of twice as many every time.
    while whole < len(path):
        path[whole:] = so3.multiply(path[:-whole], path[whole:])
        whole *= 2
    return path


@pytest.mark.parametrize("latitude", [None, 40.0])
@pytest.mark.parametrize("name", ["head_nominal", "head_turntable"])
def test_integrated_gyros_give_the_true_attitude(name: str, latitude: float | None) -> None:
    # With both gyros sampled at the same instants their increments can be composed without interpolation.
    rate = load_scenario(HeadScenario, name).gyro_rate_hz
    scenario = quiet(name, latitude_deg=latitude, platform_gyro_rate_hz=rate, platform_gyro_phase=0.0)
    data, _ = simulate_head(scenario, seed=1)
    spin = np.zeros(3) if latitude is None else earth_rate(np.deg2rad(latitude))
    at_rest = np.broadcast_to(spin, data.head_gyro.shape)
    w_ib = at_rest if data.platform_gyro is None else data.platform_gyro
    start = scenario.head.attitude(np.array([-0.5 / rate]))
    bRv = so3.compose(so3.inverse(integrate(w_ib, rate)), start, integrate(data.head_gyro, rate))
    truth = scenario.head.attitude(data.head_t + 0.5 / rate)
    assert angle_between(bRv, truth).max() < 1e-6


def test_platform_gyro_alone_gives_the_platform_attitude() -> None:
    scenario = quiet("head_nominal", latitude_deg=None)
    data, _ = simulate_head(scenario, seed=1)
    assert scenario.platform is not None
    assert data.platform_t is not None
    assert data.platform_gyro is not None
    edges = data.platform_t + 0.5 / scenario.platform_gyro_rate_hz
    start = scenario.platform.attitude(edges[:1] - 1.0 / scenario.platform_gyro_rate_hz)
    path = so3.multiply(start, integrate(data.platform_gyro, scenario.platform_gyro_rate_hz))
    assert angle_between(path, scenario.platform.attitude(edges)).max() < 1e-6


def test_platform_at_rest_turns_with_the_earth() -> None:
    scenario = quiet("head_nominal", head={}, platform=None, latitude_deg=40.0)
    data, _ = simulate_head(scenario, seed=1)
    np.testing.assert_allclose(data.head_gyro.mean(axis=0), earth_rate(np.deg2rad(40.0)), atol=1e-9)


@pytest.mark.parametrize("name", SCENARIOS)
def test_gyro_rate_obeys_the_published_relation(name: str) -> None:
    """w_bv = w_iv - vRb w_ib, with Euler rates by numerical differentiation."""
    scenario = quiet(name, latitude_deg=None)
    data, _ = simulate_head(scenario, seed=1)
    t, h = data.head_t[4000:8000:50], 1e-4

    def body_rate(attitude: np.ndarray, later: np.ndarray) -> np.ndarray:
        return so3.log(so3.multiply(so3.inverse(attitude), later)) / (2 * h)

    head, platform = scenario.head, scenario.platform
    w_bv = body_rate(head.attitude(t - h), head.attitude(t + h))
    w_ib = np.zeros_like(w_bv) if platform is None else body_rate(platform.attitude(t - h), platform.attitude(t + h))
    expected = w_bv + so3.rotate(so3.inverse(head.attitude(t)), w_ib)
    np.testing.assert_allclose(data.head_gyro[4000:8000:50], expected, atol=5e-4)


def test_euler_motion_is_the_published_order() -> None:
    swing = [{"rate_deg_s": 1.0}]
    scenario = HeadScenario.model_validate({"head": {"yaw": swing, "pitch": swing, "roll": swing}})
    c, s = np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0))
    rx = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    ry = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    rz = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    bRv = so3.matrix(scenario.head.attitude(np.array([30.0])))[0]
    np.testing.assert_allclose(bRv.T, rx @ ry @ rz, atol=1e-12)


def test_picture_stamped_t_shows_the_head_at_t_plus_offset() -> None:
    scenario = quiet("head_mounts")
    data, truth = simulate_head(scenario, seed=1)

    def mount(name: str) -> np.ndarray:
        return so3.exp(np.array([truth[f"{name}_{axis}"] for axis in "xyz"]))

    bRv = scenario.head.attitude(data.vision_t + truth["time_offset"])
    expected = so3.compose(mount("camera_mount"), bRv, mount("helmet_mount"))
    assert truth["time_offset"] == 0.012
    assert angle_between(data.vision_wxyz, expected).max() < 1e-12
    # Not the head at the stamp: 12 ms at these rates is a fraction of a degree.
    at_stamp = so3.compose(mount("camera_mount"), scenario.head.attitude(data.vision_t), mount("helmet_mount"))
    assert angle_between(data.vision_wxyz, at_stamp).max() > 1e-3


def test_outages_are_empty_and_outliers_as_many_and_as_large_as_asked() -> None:
    scenario = load_scenario(HeadScenario, "head_outages")
    data, _ = simulate_head(scenario, seed=3)
    for start, end in scenario.vision_outages_s:
        assert not ((data.vision_t >= start) & (data.vision_t < end)).any()
    assert len(data.vision_t) == round(scenario.vision_rate_hz * (scenario.duration_s - 20.0))
    error = np.rad2deg(angle_between(data.vision_wxyz, scenario.head.attitude(data.vision_t)))
    outliers = error > 10.0
    assert 0.03 < outliers.mean() < 0.07
    assert np.abs(error[outliers] - scenario.outlier_deg).max() < 3.0


def test_noise_has_the_size_asked_for() -> None:
    scenario = load_scenario(HeadScenario, "head_nominal")
    data, truth = simulate_head(scenario, seed=5)
    clean, _ = simulate_head(quiet("head_nominal"), seed=5)
    noise = data.head_gyro - clean.head_gyro
    bias = np.array([truth[f"gyro_bias_{axis}"] for axis in "xyz"])
    density = noise.std(axis=0) / np.sqrt(scenario.gyro_rate_hz)
    np.testing.assert_allclose(density, scenario.noise.gyro_density, rtol=0.03)
    np.testing.assert_allclose(noise.mean(axis=0), bias, atol=4 * 1e-4 / np.sqrt(60.0))
    delta = so3.log(so3.multiply(so3.inverse(clean.vision_wxyz), data.vision_wxyz))
    np.testing.assert_allclose(delta.std(axis=0), scenario.noise.vision_attitude, rtol=0.08)
    assert data.vision_cov is not None
    np.testing.assert_allclose(data.vision_cov, np.broadcast_to(8.7e-3**2 * np.eye(3), (len(delta), 3, 3)))


def test_bias_walk_grows_with_the_square_root_of_time() -> None:
    noise = HeadNoise(gyro_density=0, gyro_bias_walk=1e-3, platform_gyro_density=0, vision_attitude=0)
    scenario = quiet("head_turntable", noise=noise, duration_s=16.0, gyro_rate_hz=100.0)
    clean, _ = simulate_head(quiet("head_turntable", duration_s=16.0, gyro_rate_hz=100.0), seed=0)
    ends = [simulate_head(scenario, seed).data.head_gyro[-1] - clean.head_gyro[-1] for seed in range(100)]
    assert np.std(ends) == pytest.approx(1e-3 * np.sqrt(16.0), rel=0.15)


def test_same_seed_same_session_other_seed_another() -> None:
    scenario = load_scenario(HeadScenario, "head_mounts")
    (a, truth_a), (b, truth_b), (c, truth_c) = (simulate_head(scenario, seed) for seed in (7, 7, 8))
    for field in dataclasses.fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))
    assert truth_a == truth_b
    assert truth_a["gyro_bias_x"] != truth_c["gyro_bias_x"]
    assert not np.array_equal(a.vision_wxyz, c.vision_wxyz)


@pytest.mark.parametrize("name", SCENARIOS)
def test_written_and_read_back_is_the_same_session(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(HeadScenario, name)
    data, truth = simulate_head(scenario, seed=2)
    path = tmp_path / "s.mcap"
    method("head").write_data(path, data, truth, head_config(scenario))
    recording = open_recording(path)
    config = load_config(recording.attachment("alidade.yaml"))
    back = read_head(recording, config)
    for field in dataclasses.fields(data):
        original, read = getattr(data, field.name), getattr(back, field.name)
        if "density" in field.name and original is not None:
            assert read == pytest.approx(original, rel=1e-6)  # through a sample's covariance
        else:
            np.testing.assert_array_equal(read, original, err_msg=field.name)
    assert config.method == "head"
    assert config.noise.gyro_density == scenario.noise.gyro_density
    assert config.priors == scenario.priors


def test_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("noise: {gyro_densty: 1.0e-4}\n")
    with pytest.raises(InputError, match=r"mine\.yaml: unknown key noise\.gyro_densty.*gyro_density"):
        load_scenario(HeadScenario, path)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("duration_s: -1\n", "duration_s"),
        ("duration_s: [1\n", "YAML"),
        ("- 1\n- 2\n", "the whole"),
        ("vision_outages_s: [[20, 10]]\n", "start before end"),
    ],
)
def test_bad_scenario_is_one_clear_line(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        load_scenario(HeadScenario, path)
    assert "\n" not in str(caught.value)


def test_unknown_scenario_names_the_nearest_shipped_ones() -> None:
    with pytest.raises(InputError, match="the nearest are head_nominal, "):
        load_scenario(HeadScenario, "head_nominl")
