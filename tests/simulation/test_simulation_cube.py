"""The cube's simulator against closed forms and its own truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.earth import earth_rate, gravity, magnetic_field
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import simulate
from alidade.pipelines.methods.cube.recording import CubeConfig, read_cube
from alidade.pipelines.methods.cube.simulation import (
    CubeCamera,
    CubeNoise,
    CubeScenario,
    Errors,
    FieldErrors,
    ReferenceAttitude,
    Resting,
    cube_config,
    simulate_cube,
)
from alidade.pipelines.methods.cube.static_poses import static_intervals, static_poses
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.scenario import YEAR, load_scenario

QUIET = CubeNoise(gyro_density=1e-12, gyro_bias_walk=0.0, accel_density=1e-12, mag_density=1e-18, corner_px=1e-6)
EXACT = CubeScenario(
    poses=5,
    static_s=2.0,
    noise=QUIET,
    errors=Errors(camera_mount=0.0, tag_mount=0.0),
    field=FieldErrors(direction=0.0, strength=0.0),
    reference=ReferenceAttitude(level_noise_deg=1e-9, heading_noise_deg=1e-9, heading_error_deg=0.0),
    camera=CubeCamera(rate_hz=5.0, occluded=0.0),
)


def _gain(truth: dict[str, float], name: str) -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[truth[f"{name}_k{i}{j}"] for j in "123"] for i in "123"])
    return K, np.array([truth[f"{name}_b{i}"] for i in "123"])


def test_at_rest_every_sensor_says_what_the_attitude_seen_by_the_camera_predicts() -> None:
    data, truth = simulate_cube(EXACT, 1)
    config = load_config(cube_config(EXACT.model_copy(update={"noise": CubeNoise()})).encode())
    poses = static_poses(data, config)
    assert len(poses) == EXACT.poses
    assert data.reference_wxyz is not None
    BRC = config.section(CubeConfig).camera_rotation
    assert BRC is not None
    nRC = so3.multiply(data.reference_wxyz[0], BRC)
    field = np.array([truth[f"field_{axis}"] for axis in "enu"])
    latitude = float(np.deg2rad(EXACT.place.latitude_deg))
    vectors = {
        "accel": np.array([0, 0, gravity(latitude, EXACT.place.height)]),
        "gyro": earth_rate(latitude),
        "mag": field,
    }
    means = {"accel": poses.accel, "gyro": poses.gyro, "mag": poses.mag}
    for k, seen in enumerate(poses.tags):
        assert seen is not None
        bRn = so3.inverse(so3.multiply(nRC, seen.pose.cRb))
        for name, vector in vectors.items():
            K, b = _gain(truth, name)
            mean = means[name]
            assert mean is not None
            scale = np.linalg.norm(vector)
            np.testing.assert_allclose((K @ mean[k] + b) / scale, so3.rotate(bRn, vector) / scale, atol=2e-5)


def test_the_gyro_leads_from_pose_to_pose() -> None:
    data, truth = simulate_cube(EXACT, 2)
    config = load_config(cube_config(EXACT.model_copy(update={"noise": CubeNoise()})).encode())
    poses = static_poses(data, config)
    K, b = _gain(truth, "gyro")
    first, last = poses.tags[0], poses.tags[-1]
    assert first is not None
    assert last is not None
    start, stop = np.searchsorted(data.imu_t, [poses.span[0, 0], poses.span[-1, 0]])
    dt = float(np.median(np.diff(data.imu_t)))
    attitude = so3.multiply(_nRC(data.reference_wxyz[0], config), first.pose.cRb)
    # Mean rates over intervals centred on the stamps: half an interval at both ends.
    weights = np.full(stop - start + 1, dt)
    weights[[0, -1]] *= 0.5
    for rate, weight in zip(data.gyro[start : stop + 1], weights, strict=True):
        attitude = so3.multiply(attitude, so3.exp((K @ rate + b) * weight))
    turned = earth_rate(float(np.deg2rad(EXACT.place.latitude_deg))) * (poses.span[-1, 0] - poses.span[0, 0])
    attitude = so3.multiply(so3.exp(-turned), attitude)
    expected = so3.multiply(_nRC(data.reference_wxyz[0], config), last.pose.cRb)
    assert np.linalg.norm(so3.log(so3.multiply(so3.inverse(attitude), expected))) < 2e-4


def _nRC(nRB: np.ndarray, config: object) -> np.ndarray:
    return so3.multiply(nRB, config.section(CubeConfig).camera_rotation)  # type: ignore[attr-defined]


def test_noise_is_as_stated() -> None:
    scenario = CubeScenario(poses=1, static_s=60.0)
    data, _ = simulate_cube(scenario, 3)
    noise = scenario.noise
    assert data.gyro.std(axis=0) == pytest.approx(noise.gyro_density * 10.0, rel=0.05)
    assert data.accel.std(axis=0) == pytest.approx(noise.accel_density * 10.0, rel=0.05)
    assert data.mag is not None
    assert data.mag.std(axis=0) == pytest.approx(noise.mag_density * np.sqrt(50.0), rel=0.05)


def test_field_and_heading_are_drawn_as_their_priors_have_them() -> None:
    """Sigmas over seeds: 500 nT each way across the model's field and along it, 10 mrad of heading."""
    truths = [simulate_cube(CubeScenario(poses=1, static_s=0.5), seed).truth for seed in range(60)]
    field = np.array([[truth[f"field_{axis}"] for axis in "enu"] for truth in truths])
    place = CubeScenario().place
    latitude, longitude = np.deg2rad([place.latitude_deg, place.longitude_deg])
    model = magnetic_field(latitude, longitude, place.height, YEAR)
    along = (field - model) @ model / np.linalg.norm(model)
    # A sigma of n draws is known to 1 / sqrt(2 n) of itself.
    assert np.sqrt(np.mean(along**2)) == pytest.approx(5e-7, rel=3.0 / np.sqrt(2 * 60))
    across = np.sqrt((((field - model) ** 2).sum(axis=1) - along**2).mean() / 2.0)
    assert across == pytest.approx(5e-7, rel=3.0 / np.sqrt(2 * 120))
    heading = np.array([truth["reference_heading"] for truth in truths])
    assert np.sqrt(np.mean(heading**2)) == pytest.approx(1e-2, rel=3.0 / np.sqrt(2 * 60))


def test_same_seed_same_session_and_another_one_differs() -> None:
    scenario = CubeScenario(poses=2, camera=CubeCamera(rate_hz=2.0))
    (a, truth_a), (b, truth_b), (c, _) = (simulate_cube(scenario, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.gyro, b.gyro)
    assert truth_a == truth_b
    assert not np.array_equal(a.gyro, c.gyro[: len(a.gyro)])


def test_given_attitudes_come_after_the_random_ones() -> None:
    """A side up, one to the north, the top leaned to the east; what the sensors say at rest follows."""
    given = [Resting(up="-x", north="+z"), Resting(up="+y", north="-x", lean_deg=30.0)]
    scenario = EXACT.model_copy(update={"poses": 1, "attitudes": given, "errors": Errors(gain=0.0, accel_bias=0.0)})
    east, north, up = np.eye(3)
    np.testing.assert_allclose(so3.rotate(given[0].nRb, [[-1, 0, 0], [0, 0, 1]]), [up, north], atol=1e-12)
    lean = np.deg2rad(30.0)
    leaned = [np.cos(lean) * up + np.sin(lean) * east, north]
    np.testing.assert_allclose(so3.rotate(given[1].nRb, [[0, 1, 0], [-1, 0, 0]]), leaned, atol=1e-12)
    assert str(given[1]) == "+y (tag 18) up, -x to the north, leaned by 30 deg to the east"
    data, _ = simulate_cube(scenario, 4)
    poses = static_poses(data, load_config(cube_config(scenario.model_copy(update={"noise": CubeNoise()})).encode()))
    g = float(gravity(np.deg2rad(scenario.place.latitude_deg), scenario.place.height))
    np.testing.assert_allclose(poses.accel[1] / g, [-1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(poses.accel[2] / g, so3.rotate(so3.inverse(given[1].nRb), up), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{attitudes: [{up: +x, north: -x}]}", r"attitudes\.0: .*sides across each other are needed"),
        ("{attitudes: [{up: +w, north: -x}]}", r"attitudes\.0\.up"),
        ("{poses: 0}", "poses or attitudes are needed"),
        ("{camera_rate_hz: 5.0}", "unknown key camera_rate_hz"),
        ("{camera: {rate_hz: 5.0, ocluded: 0.1}}", r"unknown key camera\.ocluded; the nearest known key is occluded"),
        ("{reference: false}", r"reference: must be a section of keys, not False"),
    ],
)
def test_attitudes_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_scenario(CubeScenario, tmp_path / "s.yaml")


@pytest.mark.parametrize(
    "name", ["nominal", "no_camera", "three_poses", "one_axis", "wrong_heading", "disturbed", "pictures"]
)
def test_scenarios_are_valid(name: str) -> None:
    load_scenario(CubeScenario, f"cube_{name}")


def test_pictures_show_the_tags_where_the_detections_have_them(tmp_path: Path) -> None:
    scenario = tmp_path / "short.yaml"
    scenario.write_text(
        "{poses: 1, static_s: 2.0, camera: {occluded: 0.0, pictures: {rate_hz: 1.0}}, errors: {tag_mount: 0.002}}"
    )
    simulate("cube", str(scenario), 5, tmp_path / "p.mcap", images=True)
    simulate("cube", str(scenario), 5, tmp_path / "d.mcap", images=False)
    seen = []
    for file in ("p.mcap", "d.mcap"):
        recording = open_recording(tmp_path / file)
        config = load_config(recording.attachment("alidade.yaml"))
        data = read_cube(recording, config)
        assert len(static_intervals(data, config)) == 1
        poses = static_poses(data, config)
        assert poses.tags[0] is not None
        seen.append(poses.tags[0])
    pictured, detected = seen
    both = sorted(set(pictured.ids.tolist()) & set(detected.ids.tolist()))
    assert both
    for tag in both:
        a, b = (s.corners[list(s.ids).index(tag)] for s in seen)
        np.testing.assert_allclose(a, b, atol=0.2)
