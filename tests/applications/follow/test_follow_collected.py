"""What the person recording is told has been collected, and what is still wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from alidade.pipelines.applications.follow.follow import Screen
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.observability import weak_directions
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.guidance import next_pose
from alidade.pipelines.methods.cube.simulation import CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, simulate_indexer
from alidade.pipelines.methods.los.simulation import LosScenario, simulate_los
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.simulation.sensors import EulerMotion, Swing


def _wanted(found: object) -> dict[str, str]:
    return {c.what: c.wanted for c in found}  # type: ignore[attr-defined]


def test_los_names_the_axis_that_did_not_sway() -> None:
    roll, pitch = [Swing(amplitude_deg=6, frequency_hz=0.31)], [Swing(amplitude_deg=5, frequency_hz=0.27)]
    scenario = LosScenario(
        duration_s=12.0,
        carrier=EulerMotion(roll=roll, pitch=pitch, yaw=[]),
        elevation_deg=0.0,
        gyro_rate_hz=50.0,
        gimbal_rate_hz=50.0,
        image_rate_hz=10.0,
    )
    data, _ = simulate_los(scenario, 0)
    wanted = _wanted(method("los").guidance.checklist(data, Config()))
    assert wanted["sway about z"] == "sway the carrier about its z by 2 deg and more"
    assert not wanted["sway about x"]
    assert not wanted["sway about y"]


def test_head_names_what_did_not_move() -> None:
    scenario = load_scenario(HeadScenario, "head_nominal").model_copy(update={"duration_s": 10.0})
    data, _ = simulate_head(scenario, 0)
    assert data.platform_gyro is not None
    still = replace(data, platform_gyro=np.zeros_like(data.platform_gyro))
    moved, wanted = (
        _wanted(method("head").guidance.checklist(data, Config())),
        _wanted(method("head").guidance.checklist(still, Config())),
    )
    assert not moved["head about x"]
    assert not moved["platform about x"]
    assert wanted["platform about x"] == "turn the platform about its x by 5 deg and more"


def test_indexer_counts_turns_by_position() -> None:
    data, _ = simulate_indexer(IndexerScenario(), 0)
    assert set(_wanted(method("indexer").guidance.checklist(data, Config())).values()) == {""}
    half = data.encoder_t < 0.4 * data.encoder_t[-1]
    early = replace(
        data,
        encoder_t=data.encoder_t[half],
        outer=data.outer[half],
        inner=data.inner[half],
    )
    wanted = _wanted(method("indexer").guidance.checklist(early, Config()))
    assert not wanted["outer axis, inner one at 0 deg"]
    assert wanted["inner axis, outer one at 180 deg"] == "three whole turns forward and back"


@pytest.fixture(scope="module")
def cube() -> tuple[ChecklistItem, ...]:
    scenario = CubeScenario()
    data, _ = simulate_cube(scenario, 0)
    config = load_config(cube_config(scenario).encode())
    few = data.imu_t < 45.0
    first = replace(data, imu_t=data.imu_t[few], gyro=data.gyro[few], accel=data.accel[few])
    return tuple(method("cube").guidance.checklist(first, config))


def test_cube_counts_poses_and_faces(cube: tuple[ChecklistItem, ...]) -> None:
    found = {c.what: c for c in cube}
    count = dict(item.split(" ") for item in found["faces up"].have.split(", "))
    assert set(count) == {"+x", "-x", "+y", "-y", "+z", "-z"}
    poses = int(found["poses"].have.split(" ")[0])
    assert poses == sum(map(int, count.values()))
    assert bool(found["poses"].wanted) == (poses < 4)
    assert found["next"].wanted.startswith("rest the cube with ")


def test_the_next_best_pose_shows_the_axis_that_was_not_up() -> None:
    y, z = np.eye(3)[1:]
    assert next_pose(np.array([y, -y, z, -z, y, z]), None).words in (
        "rest the cube with +x up",
        "rest the cube with -x up",
    )
    assert next_pose(np.array([[1.0, 0.0, 0.0], -z, -y, z]), None).words in (
        "rest the cube with -x up",
        "rest the cube with +y up",
    )


def _sway(_: Mapping[str, float]) -> Motion:
    return Motion("sway it more")


def _view(sigma: float) -> View:
    quantities = (Quantity("delta_px", "rad", 0.1, 0.1, 1e-3),)
    covariance = np.eye(1) * sigma**2
    findings = weak_directions(quantities, covariance, _sway, np.zeros(1))
    wanted = ChecklistItem("sway", "1.0 deg", "turn it")
    return View(3.0, 0, quantities, np.array([0.02]), covariance, (wanted,), None, findings, _sway)


def test_the_status_is_initialising_until_there_is_an_estimate() -> None:
    some = _view(1e-4)
    assert replace(some, values=None, covariance=None, findings=()).summary["status"] == "initialising"
    assert some.summary["status"] == "calibrated"


@pytest.mark.parametrize("terminal", [True, False])
def test_the_screen_says_what_is_missing_and_when_it_is_enough(terminal: bool) -> None:
    console = Console(force_terminal=terminal, width=110, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with Screen(console) as screen:
        screen.show(_view(1e-2))
        early = console.export_text()
        screen.show(_view(1e-4))
    late = console.export_text()
    assert "not yet as accurate as required: delta_px" in early
    assert "sway it more" in early
    assert "the accuracy wanted is reached" in late
    assert "sway it more" not in late.split("the accuracy wanted is reached")[1]
