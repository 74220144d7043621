"""The cube from the command line: every kind of bad recording is one clear line, exit code 2, and nothing written."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from alidade.factors import so3
from alidade.pipelines.methods import method, simulate
from alidade.pipelines.methods.cube.recording import CubeData, Sightings
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.vision.camera import Camera
from tests.support.command import Command

SCENARIO = CubeScenario(poses=8, static_s=1.5, turn_rad_s=1.5, camera=CubeCamera(rate_hz=5.0))
CONFIG = cube_config(SCENARIO)


@pytest.fixture(scope="module")
def data() -> CubeData:
    return simulate_cube(SCENARIO, 1).data


def _refused(alidade: Command, folder: Path, message: str) -> None:
    """calibrate says one line and leaves nothing behind."""
    code, out, err = alidade("calibrate", folder / "s.mcap", "--out", folder / "out")
    assert code == 2, out + err
    assert out == ""
    assert re.search(message, err), err
    assert err.count("\n") == 1
    assert err.startswith("alidade: ")
    assert sorted(p.name for p in folder.iterdir()) == ["s.mcap"]


def _tags(change: Callable[[dict[int, Any]], object]) -> str:
    """The config with its tags changed."""
    yaml = YAML(typ="safe", pure=True)
    config = yaml.load(CONFIG)
    change(config["cube"]["tags"])
    return json.dumps(config)  # JSON is YAML, but for keys that are words


def _numbers(text: str) -> str:
    return re.sub(r'"(\d+)":', r"\1:", text)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tags: tags[18].pop("size"), r"cube\.tags\.18\.size: is missing"),
        (lambda tags: tags[18].update(size=-0.12), r"cube\.tags\.18\.size: must be greater than 0"),
        (lambda tags: tags[18].update(rotation=[1, 1, 0, 0]), r"cube\.tags\.18\.rotation"),
    ],
    ids=["size missing", "size negative", "rotation no quaternion"],
)
def test_bad_tags(alidade: Command, tmp_path: Path, data: CubeData, change: Any, message: str) -> None:
    method("cube").write_data(tmp_path / "s.mcap", data, None, _numbers(_tags(change)))
    _refused(alidade, tmp_path, message)


def test_two_tags_with_one_id_in_the_config(alidade: Command, tmp_path: Path, data: CubeData) -> None:
    method("cube").write_data(tmp_path / "s.mcap", data, None, CONFIG.replace("    17:\n", "    16:\n"))
    _refused(alidade, tmp_path, "16")


def test_two_tags_with_one_id_in_the_pictures(alidade: Command, tmp_path: Path, data: CubeData) -> None:
    seen = data.sightings
    assert seen is not None
    frame, ids, corners = (np.concatenate([a, a]) for a in (seen.frame, seen.ids, seen.corners))
    method("cube").write_data(
        tmp_path / "s.mcap", replace(data, sightings=Sightings(seen.t, frame, ids, corners, None)), None, CONFIG
    )
    _refused(alidade, tmp_path, r"/tag_detections: tag 16 is seen twice .* every tag in sight needs its own id")


def test_camera_info_zero(alidade: Command, tmp_path: Path, data: CubeData) -> None:
    assert data.camera is not None
    blind = Camera(1280, 960, data.camera.K)
    object.__setattr__(blind, "K", np.zeros((3, 3)))
    method("cube").write_data(tmp_path / "s.mcap", replace(data, camera=blind), None, CONFIG)
    _refused(alidade, tmp_path, "camera_info")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {"mag": d.mag * 1e6}, r"/mag: field has a norm of .* implausible in T; is it in uT\?"),
        (lambda d: {"mag": d.mag * 1e4}, r"/mag: field .* is it in gauss\?"),
        (lambda d: {"accel": d.accel / 9.8}, r"/imu: acceleration .* implausible in m/s\^2; is it in g\?"),
        (lambda d: {"gyro": d.gyro + np.random.default_rng(1).normal(size=d.gyro.shape)}, "no static pose"),
    ],
    ids=["uT", "gauss", "g", "never at rest"],
)
def test_bad_sensors(alidade: Command, tmp_path: Path, data: CubeData, change: Any, message: str) -> None:
    method("cube").write_data(tmp_path / "s.mcap", replace(data, **change(data)), None, CONFIG)
    _refused(alidade, tmp_path, message)


def test_a_cube_that_is_not_rigid_names_the_tag(alidade: Command, tmp_path: Path, data: CubeData) -> None:
    def turn(tags: dict[int, Any]) -> None:
        turned = so3.multiply(tags[18]["rotation"], so3.exp([0.0, 0.0, 0.5 * np.pi]))
        tags[18]["rotation"] = turned.tolist()

    method("cube").write_data(tmp_path / "s.mcap", data, None, _numbers(_tags(turn)))
    _refused(alidade, tmp_path, "cube not rigid: tag 18 disagrees")


def test_blurred_pictures_only(alidade: Command, tmp_path: Path) -> None:
    (tmp_path / "blurred.yaml").write_text(
        "{poses: 1, static_s: 1.5, camera: {pictures: {rate_hz: 1.0, blur_px: 25.0}}}"
    )
    simulate("cube", str(tmp_path / "blurred.yaml"), 1, tmp_path / "s.mcap", images=True)
    (tmp_path / "blurred.yaml").unlink()
    _refused(alidade, tmp_path, "no tag is seen sharply in any of the .* are they blurred")


@pytest.mark.slow
def test_three_poses_are_unobservable_and_say_what_is_missing(alidade: Command, tmp_path: Path) -> None:
    scenario = SCENARIO.model_copy(update={"poses": 3})
    data, truth = simulate_cube(scenario, 2)
    method("cube").write_data(tmp_path / "s.mcap", data, truth, cube_config(scenario))
    code, out, err = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out", "--all")
    assert (code, err) == (3, "")
    for words in ("accel_k", "dd static poses in other attitudes", "gyro_k", "urn the cube"):
        assert words in out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["status"] == "unobservable"
    assert len(result["tables"]["static_poses"]) == 3


def test_from_recording_to_other_programs(alidade: Command, tmp_path: Path, data: CubeData) -> None:
    """calibrate, export in every format, validate."""
    method("cube").write_data(tmp_path / "s.mcap", data, None, CONFIG)
    code, _, err = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out")
    assert (code in (0, 3), err) == (True, "")
    saved = tmp_path / "out" / "calibration.yaml"
    for form, word in (
        ("px4", "CAL_ACC0_XOFF"),
        ("ardupilot", "INS_ACCOFFS_X"),
        ("ros2", "ros__parameters"),
        ("kalibr", "gyroscope_noise_density"),
    ):
        code, out, _ = alidade("export", saved, "--format", form)
        assert code == 0
        assert word in out
    told = json.loads(alidade("export", saved, "--format", "kalibr", "--json")[1])
    assert (told["schema"], told["format"], told["text"]) == ("alidade.export/1", "kalibr", out)
    noise = YAML(typ="safe", pure=True).load(out)
    assert noise["gyroscope_noise_density"] == pytest.approx(SCENARIO.noise.gyro_density, rel=0.25)
    assert noise["accelerometer_noise_density"] == pytest.approx(SCENARIO.noise.accel_density, rel=0.25)
    assert (noise["rostopic"], noise["update_rate"]) == ("/imu", 100)
    code, out, _ = alidade("export", saved, "--format", "json")
    assert code == 2
    common = ("validate", tmp_path / "s.mcap", "--calibration", saved, "--out", tmp_path / "val")
    code, out, _ = alidade(*common, "--json")
    assert code == 0
    told = json.loads(out)
    assert (told["schema"], told["method"]) == ("alidade.validation/1", "cube")
    force = next(v for v in told["validations"] if "specific force" in v["name"])
    assert force["rms"]["after"] < force["rms"]["before"] < force["peak"]["before"]


def test_a_methods_own_commands_are_the_command_lines(alidade: Command, tmp_path: Path) -> None:
    """They are listed, run, and refuse what they cannot use in one line."""
    _, out, _ = alidade("--help")
    assert "cube-layout" in out
    code, _, _ = alidade("cube-print", "--edge", "0.16", "--out", tmp_path / "cube.pdf")
    assert code == 0
    assert (tmp_path / "cube.pdf").read_bytes().startswith(b"%PDF")
    code, _, err = alidade("cube-layout", tmp_path / "none.mcap", "--out", tmp_path / "l.yaml")
    assert code == 2
    assert "none.mcap" in err
    assert not (tmp_path / "l.yaml").exists()
