"""Mounting rotations as static transforms, with covariances."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import method
from alidade.pipelines.methods.formula import apply
from alidade.pipelines.reports.calibration import SavedCalibration, calibration_yaml, load_calibration, saved
from alidade.pipelines.reports.export_formats import export, roll_pitch_yaw
from alidade.pipelines.reports.result import Calibration
from tests.support.short_problems import COARSE

FRAMES = {
    "indexer": {"mRt": ("imu", "platform")},
    "head": {"vRh": ("helmet_imu", "markers"), "cRb": ("camera", "platform")},
}
SCENARIOS = {"indexer": COARSE, "head": {"duration_s": 10.0, "gyro_rate_hz": 50.0, "vision_rate_hz": 5.0}}


@pytest.fixture(scope="module", params=sorted(FRAMES))
def calibration(request: pytest.FixtureRequest) -> Calibration:
    chosen = method(request.param)
    scenario = chosen.scenario.model_validate(SCENARIOS[request.param])
    return Session.of(chosen, chosen.simulate(scenario, 1)).calibrate(report=False)


@pytest.fixture(scope="module")
def read_back(calibration: Calibration, tmp_path_factory: pytest.TempPathFactory) -> SavedCalibration:
    path: Path = tmp_path_factory.mktemp("saved") / "calibration.yaml"
    path.write_text(calibration_yaml(calibration))
    return load_calibration(path)


def test_frames_and_rotations_are_those_of_the_formulas(calibration: Calibration, read_back: SavedCalibration) -> None:
    frames = {name: (each.parent, each.child) for name, each in read_back.transforms.items()}
    assert frames == FRAMES[calibration.method.name]
    applied = calibration.apply()
    for name, each in read_back.transforms.items():
        np.testing.assert_allclose(each.wxyz, applied[name], atol=1e-11)


def test_the_covariance_is_that_of_rotations_about_the_parents_axes(calibration: Calibration) -> None:
    """Against draws of the parameters, a hundred times closer than they are known, put through the formulas."""
    rng = np.random.default_rng(0)
    estimate = calibration.estimate
    scale = 1e-2
    draws = rng.multivariate_normal(np.zeros(len(estimate.names)), calibration.covariance, 2000) * scale
    for name, each in saved(calibration).transforms.items():
        formulas = [f for f in calibration.formulas if f.name == name]
        turns = []
        for draw in draws:
            values = dict(zip(estimate.names, (estimate.values + draw).tolist(), strict=True))
            turned = apply(formulas, values, {})[name]
            turns.append(so3.log(so3.multiply(turned, so3.inverse(np.array(each.wxyz)))))
        found = np.cov(np.array(turns).T) / scale**2
        stated = np.reshape(each.covariance, (3, 3))
        sigmas = np.maximum(np.sqrt(np.diag(stated)), 1e-9)  # a mount may be fixed
        np.testing.assert_allclose(found / np.outer(sigmas, sigmas), stated / np.outer(sigmas, sigmas), atol=0.08)


def test_tf_and_urdf_say_the_same(read_back: SavedCalibration) -> None:
    published = re.findall(
        r"--qw (\S+) --qx (\S+) --qy (\S+) --qz (\S+) --frame-id (\w+) --child-frame-id (\w+)",
        export(read_back, "tf"),
    )
    robot = ElementTree.fromstring(f"<robot>{export(read_back, 'urdf')}</robot>")
    joints = robot.findall("joint")
    assert len(published) == len(joints) == len(read_back.transforms)
    for found, joint, each in zip(published, joints, read_back.transforms.values(), strict=True):
        parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
        assert parent is not None
        assert child is not None
        assert origin is not None
        assert found[4:] == (each.parent, each.child) == (parent.get("link"), child.get("link"))
        roll, pitch, yaw = map(float, str(origin.get("rpy")).split())
        axes = np.eye(3)
        by_angles = so3.compose(so3.exp(yaw * axes[2]), so3.exp(pitch * axes[1]), so3.exp(roll * axes[0]))
        for wxyz in (np.array(found[:4], dtype=float), by_angles):
            np.testing.assert_allclose(so3.matrix(wxyz), so3.matrix(np.array(each.wxyz)), atol=1e-10)


def test_a_cubes_mounts_are_those_of_its_config_corrected() -> None:
    cube = method("cube")
    simulated = cube.simulate(
        cube.scenario.model_validate({"poses": 4, "static_s": 1.0, "imu_rate_hz": 50.0, "camera": {"rate_hz": 2.0}}), 0
    )
    calibration = Session.of(cube, simulated).calibrate(report=False)
    transforms = saved(calibration).transforms
    assert (transforms["BRC"].parent, transforms["BRC"].child) == ("reference", "camera")
    given = np.array(cube.report.fixed_rotations(calibration.config)["camera_rotation"])
    mount = np.array([calibration.applied_values[f"camera_mount_{axis}"] for axis in "xyz"])
    expected = so3.matrix(so3.compose(given, so3.exp(mount)))
    np.testing.assert_allclose(so3.matrix(np.array(transforms["BRC"].wxyz)), expected, atol=1e-10)
    assert {f"bodyRtag_{tag}" for tag in range(16, 22)} < set(transforms)


def test_angles_at_a_right_angle_of_pitch(read_back: SavedCalibration) -> None:
    each = next(iter(read_back.transforms.values()))
    axes = np.eye(3)
    for wxyz in (so3.exp(0.5 * np.pi * axes[1]), so3.compose(so3.exp(-0.5 * np.pi * axes[1]), so3.exp(0.3 * axes[0]))):
        w, x, y, z = wxyz.tolist()
        roll, pitch, yaw = roll_pitch_yaw(each.model_copy(update={"wxyz": (w, x, y, z)}))
        again = so3.compose(so3.exp(yaw * axes[2]), so3.exp(pitch * axes[1]), so3.exp(roll * axes[0]))
        np.testing.assert_allclose(so3.matrix(again), so3.matrix(wxyz), atol=1e-9)
