"""Cube sessions: written and read back, what is missing, what is wrong."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.recording import CubeConfig, CubeData, Sightings, local_field, read_cube
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.cube.static_poses import static_intervals, static_poses
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config
from alidade.pipelines.vision.camera import Camera

SCENARIO = CubeScenario(poses=4, static_s=2.0, camera=CubeCamera(rate_hz=5.0))


@pytest.fixture(scope="module")
def session() -> CubeData:
    return simulate_cube(SCENARIO, 1).data


def _config(text: str = "") -> Config:
    return load_config((cube_config(SCENARIO) + text).encode())


def _read_back(path: Path, data: CubeData, config: Config | None = None) -> CubeData:
    method("cube").write_data(path, data, {"accel_k11": 1.0}, cube_config(SCENARIO))
    recording = open_recording(path)
    return read_cube(recording, config or load_config(recording.attachment("alidade.yaml")))


def _assert_same(a: Any, b: Any, where: str) -> None:
    if where == "camera.rectified":  # P of CameraInfo, which a file has and a simulator need not
        return
    if isinstance(a, Sightings | Camera):
        for field in fields(a):
            _assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=where)
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-12), where
    else:
        assert a == b, where


def test_written_and_read_back_is_the_same(tmp_path: Path, session: CubeData) -> None:
    back = _read_back(tmp_path / "s.mcap", session)
    for field in fields(session):
        _assert_same(getattr(session, field.name), getattr(back, field.name), field.name)


@pytest.mark.parametrize(
    "absent",
    [
        {"mag_t": None, "mag": None, "mag_density": None},
        {"reference_t": None, "reference_wxyz": None, "reference_cov": None},
        {"camera": None, "sightings": None},
        {"latitude": None, "longitude": None, "height": 0.0},
    ],
    ids=["magnetometer", "reference", "camera", "position"],
)
def test_what_is_missing_is_none(tmp_path: Path, session: CubeData, absent: dict[str, Any]) -> None:
    back = _read_back(tmp_path / "s.mcap", replace(session, **absent))
    for name, value in absent.items():
        assert getattr(back, name) == value


def test_the_config_may_say_where_it_was(tmp_path: Path, session: CubeData) -> None:
    """Without a longitude the magnetometer is left out, loudly."""
    nowhere = replace(session, latitude=None, longitude=None)
    for text, premises in (("latitude_deg: 47.0", 1), ("latitude_deg: 47.0\nlongitude_deg: 8.5", 0)):
        config = _config(f"\n{text}\n")
        back = _read_back(tmp_path / "s.mcap", nowhere, config)
        told = method("cube").problem(back, config)
        assert len(told.premises) == premises
        assert ("mag_k11" in [q.name for q in told.quantities]) == (premises == 0)
        assert all("give latitude_deg and longitude_deg" in sentence for sentence in told.premises)


def test_rests_lie_within_the_true_ones(session: CubeData) -> None:
    found = static_intervals(session, _config())
    assert len(found) == SCENARIO.poses
    assert np.all(np.diff(found[:, 0]) > SCENARIO.static_s)
    lengths = found[:, 1] - found[:, 0]
    assert np.all((lengths > 0.5 * SCENARIO.static_s) & (lengths < SCENARIO.static_s))


def test_a_steady_turn_is_no_rest() -> None:
    """Constant rate about the vertical: as quiet as a rest, in gyro and accelerometer."""
    data, _ = simulate_cube(CubeScenario(poses=2, static_s=5.0, camera=None), 2)
    turning = (data.imu_t > 1.0) & (data.imu_t < 3.5)
    data = replace(data, gyro=data.gyro + 0.3 * turning[:, None])
    found = static_intervals(data, load_config(b""))
    middle = found.mean(axis=1)
    assert not ((middle > 1.0) & (middle < 3.5)).any()
    assert static_poses(data, load_config(b"")).dropped == {
        "quiet interval with another mean rate than the static ones": 1
    }


def test_a_gyro_that_gravity_shifts_is_at_rest_in_all_poses(session: CubeData) -> None:
    """By six times what usual gyros have, 0.02 rad/s and more from face to face.

    It feels the accelerometer's noise too, which moves an end by a sample.
    """
    sensitivity = 1.2e-3 * np.random.default_rng(3).choice([-1.0, 1.0], (3, 3))
    shifted = replace(session, gyro=session.gyro + session.accel @ sensitivity.T)
    unshifted = static_intervals(session, _config())
    np.testing.assert_allclose(static_intervals(shifted, _config()), unshifted, rtol=0.0, atol=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {"mag": d.mag * 1e6}, r"/mag: field has a norm of .* implausible in T; is it in uT\?"),
        (lambda d: {"mag": d.mag * 1e4}, r"is it in gauss\?"),
        (lambda d: {"mag": d.mag * 1e9}, r"is it in nT\?"),
        (lambda d: {"accel": d.accel / 9.8}, r"/imu: acceleration .* implausible in m/s\^2; is it in g\?"),
        (lambda d: {"gyro": np.rad2deg(d.gyro)}, "is the gyro in deg/s.* conversion .* cube: {raw: {gyro: "),
        (lambda d: {"reference_wxyz": d.reference_wxyz * 1.1}, "unit quaternion"),
        (lambda d: {"reference_t": d.reference_t + 1e4}, "no time"),
        (lambda _: {"latitude": float(np.deg2rad(95.0))}, "NavSatFix is in degrees"),
    ],
)
def test_bad_sensors_are_named(tmp_path: Path, session: CubeData, change: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        _read_back(tmp_path / "s.mcap", replace(session, **change(session)))


def test_counts_are_named_where_the_method_is_asked_for_by_option(tmp_path: Path, session: CubeData) -> None:
    counts = replace(session, accel=1671.0 * session.accel, camera=None, sightings=None)
    method("cube").write_data(tmp_path / "s.mcap", counts, {"accel_k11": 1.0}, cube_config(SCENARIO))
    with pytest.raises(InputError, match="is it in raw counts"):
        Session.read(open_recording(tmp_path / "s.mcap"), "cube", Config())


def test_camera_info_zero(tmp_path: Path, session: CubeData) -> None:
    assert session.camera is not None
    blind = Camera(1280, 960, session.camera.K)
    object.__setattr__(blind, "K", np.zeros((3, 3)))
    with pytest.raises(InputError, match="camera_info zero"):
        _read_back(tmp_path / "s.mcap", replace(session, camera=blind))


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        ("16: {rotation: [1, 0, 0, 0]}", r"cube.tags.16.size: is missing"),
        ("16: {size: -0.1}", r"cube.tags.16.size: must be greater than 0"),
        ("16: {size: 0.1}, 16: {size: 0.2}", "16"),
    ],
)
def test_bad_tags_in_the_config(tag: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_config(f"cube: {{tags: {{{tag}}}}}".encode())


def test_two_tags_with_one_id(tmp_path: Path, session: CubeData) -> None:
    seen = session.sightings
    assert seen is not None
    frame, ids, corners = (np.concatenate([a, a]) for a in (seen.frame, seen.ids, seen.corners))
    twice = Sightings(seen.t, frame, ids, corners, None)
    with pytest.raises(InputError, match="is seen twice in"):
        _read_back(tmp_path / "s.mcap", replace(session, sightings=twice))


def test_tags_of_another_cube(tmp_path: Path, session: CubeData) -> None:
    seen = session.sightings
    assert seen is not None
    with pytest.raises(InputError, match=r"no tag of the cube .* the config names \[16, 17"):
        _read_back(tmp_path / "s.mcap", replace(session, sightings=replace(seen, ids=seen.ids + 100)))


def test_tags_not_given(tmp_path: Path, session: CubeData) -> None:
    with pytest.raises(InputError, match="tags on the cube are not given"):
        _read_back(tmp_path / "s.mcap", session, load_config(b"method: cube"))


def test_no_static_pose(session: CubeData) -> None:
    shaking = replace(session, gyro=session.gyro + np.random.default_rng(1).normal(size=session.gyro.shape))
    with pytest.raises(InputError, match="no static pose: in the quietest"):
        static_intervals(shaking, _config())


def test_a_tag_that_is_not_where_the_config_says_is_named() -> None:
    scenario = CubeScenario(poses=12, static_s=2.0, camera=CubeCamera(rate_hz=5.0), magnetometer=None)
    session, config = simulate_cube(scenario, 3).data, load_config(cube_config(scenario).encode())
    tags = dict(config.section(CubeConfig).tags)
    turned = so3.multiply(tags[18].rotation, so3.exp([0.0, 0.0, np.pi / 2]))
    tags[18] = tags[18].model_copy(update={"rotation": tuple(turned)})
    cube = config.section(CubeConfig).model_copy(update={"tags": tags})
    with pytest.raises(InputError, match="cube not rigid: tag 18 disagrees"):
        static_poses(session, config.model_copy(update={"cube": cube}))


def test_date_outside_the_field_model(session: CubeData) -> None:
    with pytest.raises(InputError, match=r"World Magnetic Model holds from .* the config has `date`"):
        local_field(session, load_config(b"date: 2009-05-01"))


def test_blurred_pictures_only(tmp_path: Path, session: CubeData) -> None:
    from alidade.pipelines.simulation.rendering import encode

    t = static_intervals(session, _config()).mean(axis=1)
    nothing = Sightings(t, *(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 4, 2)), None)
    grey = encode(np.full((960, 1280), 90, dtype=np.uint8), "jpeg")
    method("cube").write_data(
        tmp_path / "s.mcap", replace(session, sightings=nothing), None, cube_config(SCENARIO), [grey] * len(t)
    )
    with pytest.raises(InputError, match="no tag is seen sharply in any of the 4 pictures"):
        read_cube(open_recording(tmp_path / "s.mcap"), _config())
