"""A camera described otherwise than tags were detected: refused, with the description by which all tags fit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.recording import CubeData
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.cube.static_poses import static_poses
from alidade.pipelines.vision.camera import Camera
from tests.support.command import Command

ORDERS = [[(first + step * k) % 4 for k in range(4)] for first, step in product(range(4), (1, -1))]


@cache
def _simulated() -> tuple[CubeData, dict[str, float], str]:
    scenario = CubeScenario(poses=12, static_s=2.0, turn_rad_s=1.6, camera=CubeCamera(rate_hz=5.0))
    return *simulate_cube(scenario, 4), cube_config(scenario)


def _refused(**changes: Any) -> str:
    data, _, given = _simulated()
    config = load_config(given.encode())
    with pytest.raises(InputError) as refused:
        static_poses(replace(data, **changes), config)
    return str(refused.value)


def _with_corners(corners: np.ndarray) -> dict[str, Any]:
    sightings = _simulated()[0].sightings
    assert sightings is not None
    return {"sightings": replace(sightings, corners=corners)}


def _corners() -> np.ndarray:
    sightings = _simulated()[0].sightings
    assert sightings is not None
    return sightings.corners


def _camera() -> Camera:
    camera = _simulated()[0].camera
    assert camera is not None
    return camera


def test_what_is_right_is_no_fault() -> None:
    data, _, given = _simulated()
    config = load_config(given.encode())
    assert sum(seen is not None for seen in static_poses(replace(data), config).tags) > 5


@pytest.mark.parametrize(
    "order", [ORDERS[4], ORDERS[7], *(pytest.param(ORDERS[i], marks=pytest.mark.slow) for i in (1, 2, 3, 5, 6))]
)
def test_the_order_of_corners_is_told(order: list[int]) -> None:
    said = _refused(**_with_corners(_corners()[:, order]))
    names = ("bottom left", "bottom right", "top right", "top left")
    assert f"the corners of all tags come as {', '.join(names[k] for k in order)} (" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    "scale", [1.5, pytest.param(2.0, marks=pytest.mark.slow), pytest.param(0.5, marks=pytest.mark.slow)]
)
def test_camera_info_of_another_size_of_picture_is_told(scale: float) -> None:
    camera = _camera()
    other = replace(
        camera,
        K=np.diag([scale, scale, 1.0]) @ camera.K,
        width=round(scale * camera.width),
        height=round(scale * camera.height),
    )
    said = _refused(camera=other)
    assert f"{camera.width}x{camera.height} fits, K times {1.0 / scale:.3g} (" in said


def test_corners_of_rectified_pictures_are_told() -> None:
    camera = _camera()
    size = camera.width, camera.height
    P = cv2.getOptimalNewCameraMatrix(camera.K, camera.coefficients, size, 0.0)[0]
    corners = cv2.undistortPoints(_corners().reshape(-1, 1, 2), camera.K, camera.coefficients, P=P).reshape(-1, 4, 2)
    assert "D = 0 with K = P fits" in _refused(camera=replace(camera, rectified=P), **_with_corners(corners))


def test_a_tag_that_came_loose_is_no_fault_of_the_camera() -> None:
    sightings = _simulated()[0].sightings
    assert sightings is not None
    moved = sightings.corners + 40.0 * (sightings.ids == sightings.ids.min())[:, None, None]
    assert "cube not rigid" in _refused(**_with_corners(moved))


def test_the_command_says_it_in_one_line(tmp_path: Path, alidade: Command) -> None:
    data, truth, config = _simulated()
    method("cube").write_data(
        tmp_path / "s.mcap", replace(data, **_with_corners(_corners()[:, [2, 3, 0, 1]])), truth, config
    )
    run = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out")
    assert run.code == 2
    assert "the corners of all tags come as top right, top left, bottom left, bottom right" in run.err
    assert len(run.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
