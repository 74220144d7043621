"""Predicted sigmas of planned motions, and better motions."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import alidade
from alidade.pipelines.applications.planning import Prediction, predict, requirements
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.guidance import next_poses
from alidade.pipelines.methods.cube.simulation import CubeScenario, Resting, Side
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.plan_report import plan_json, plan_report
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.browser import fits
from tests.support.pages import Page

LOS = LosScenario(duration_s=8, image_rate_hz=5, gyro_rate_hz=50, gimbal_rate_hz=50, sensors=Sensors())
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.3)],
    pitch=[Swing(amplitude_deg=15, frequency_hz=0.4)],
    roll=[Swing(amplitude_deg=10, frequency_hz=0.5)],
)
HEAD = HeadScenario(
    duration_s=15,
    vision_rate_hz=10,
    gyro_rate_hz=100,
    platform_gyro_rate_hz=100,
    head=SWAY,
    platform=SWAY,
    sensors=Sensors(),
)


def errors_in_sigmas(scenario: LosScenario | HeadScenario, prediction: Prediction, runs: int) -> np.ndarray:
    """(runs, n) errors of simulated recordings over the predicted sigmas, and checks the sigmas they report."""
    out = []
    for seed in range(1, runs + 1):
        data: Any
        if isinstance(scenario, LosScenario):
            chosen, text = method("los"), los_config(scenario)
            data, truth = simulate_los(scenario, seed)
        else:
            chosen, text = method("head"), head_config(scenario)
            data, truth = simulate_head(scenario, seed)
        estimate = solve_batch(chosen.problem(data, load_config(text.encode())))
        predicted = np.array(list(prediction.sigmas.values()))
        np.testing.assert_allclose(estimate.sigmas, predicted, rtol=0.2)
        out.append((estimate.values - [truth[name] for name in estimate.names]) / predicted)
    return np.array(out)


@pytest.mark.parametrize("scenario", [LOS, pytest.param(HEAD, marks=pytest.mark.slow)], ids=["los", "head"])
def test_plan_against_outcome(scenario: LosScenario | HeadScenario) -> None:
    """Sigmas reported by simulated runs agree within 20 %, and their errors scatter by them."""
    name = "los" if isinstance(scenario, LosScenario) else "head"
    prediction = predict(name, scenario.model_dump(), None, {})
    scatter = np.sqrt((errors_in_sigmas(scenario, prediction, 5) ** 2).mean())
    # 5 runs of 35 numbers, correlated.
    assert scatter == pytest.approx(1.0, abs=0.2)


def scenario_file(folder: Path, text: str) -> str:
    path = folder / "scenario.yaml"
    path.write_text(text)
    return str(path)


def test_what_is_weak_gets_advice_and_a_motion_that_mends_it(tmp_path: Path) -> None:
    """Without sway in azimuth delta_px cannot be told from delta_gx and delta_gy."""
    weak = scenario_file(
        tmp_path,
        "{duration_s: 8, image_rate_hz: 5, gyro_rate_hz: 50, gimbal_rate_hz: 50, azimuth_deg: 20, elevation_deg: 0,"
        " carrier: {roll: [{amplitude_deg: 6, frequency_hz: 0.21}], pitch: [{amplitude_deg: 5, frequency_hz: 0.17}]}}",
    )
    plan = alidade.plan("los", weak, require={"delta_px": 5e-4}, most_steps=1)
    told = json.loads(plan_json(plan))
    status = plan.now.status
    assert (told["schema"], told["status"], len(told["changes"])) == ("alidade.plan/1", status, len(plan.steps))
    assert told["missing"].keys() == plan.now.missing.keys()
    assert status in ("weak", "unobservable")
    assert any("azimuth" in direction.evidence["advice"] for direction in plan.now.directions)
    assert plan.steps
    page = render_html(plan_report(plan))
    fits(page, tmp_path)
    assert "Does the planned motion determine what is wanted? no" in Page(page).text
    assert 'title="Boresight in elevation' in page
    assert plan.best.sigmas["delta_px"] < 0.1 * plan.now.sigmas["delta_px"]
    better = tmp_path / "better.yaml"
    better.write_text(plan.scenario_text)
    again = predict("los", load_scenario(LosScenario, better).model_dump(), None, {})
    assert again.sigmas == pytest.approx(plan.best.sigmas)


def test_a_motion_that_tells_everything_is_left_as_it_is(tmp_path: Path) -> None:
    motion = "duration_s: 12, image_rate_hz: 5, gyro_rate_hz: 50, gimbal_rate_hz: 50"
    plan = alidade.plan("los", scenario_file(tmp_path, f"{{{motion}, sensors: ideal}}"))
    assert plan.now.status == "calibrated"
    assert plan.steps == ()
    assert plan.best is plan.now


def test_plan_without_scenario_predicts_mounts_and_names_what_a_scenario_fixes() -> None:
    """The nominal scenario of head fixes the mounts, and the plan once determined everything."""
    assert set(alidade.plan("head", most_steps=0).now.verdicts.values()) == {"observable"}
    fixed = alidade.plan("head", "head_nominal", most_steps=0)
    assert fixed.now.verdicts["helmet_mount_x"] == "fixed"
    assert "determines all free parameters as accurately as required; fixed are helmet_mount_x, " in str(
        plan_report(fixed).summary
    )


@pytest.mark.slow
def test_what_no_motion_can_tell_gets_no_change(tmp_path: Path) -> None:
    """delta_pz and delta_gz asked for apart: only their difference is ever known."""
    asked = tmp_path / "config.yaml"
    asked.write_text("priors: {delta_pz: 0.1, delta_gz: 0.1}\n")
    good = scenario_file(tmp_path, "{duration_s: 6, image_rate_hz: 5, gyro_rate_hz: 50, gimbal_rate_hz: 50}")
    plan = alidade.plan("los", good, config=asked, most_steps=1)
    assert plan.now.status == "unobservable"
    for name in ("delta_pz", "delta_gz"):
        assert plan.best.missing[name] == pytest.approx(plan.now.missing[name], rel=0.01)


@pytest.mark.slow
def test_the_next_best_poses_of_a_cube_are_named_and_mend_the_plan(tmp_path: Path) -> None:
    """Three poses tell little; the scenario written holds the poses named, and simulates to what was foreseen."""
    few = scenario_file(
        tmp_path, "{poses: 3, static_s: 1.5, turn_rad_s: 1.5, camera: {rate_hz: 2}, magnetometer: null}"
    )
    plan = alidade.plan("cube", few, most_steps=1)
    assert plan.now.status == "unobservable"
    (step,) = plan.steps
    assert re.match(r"(one|6) more poses?: [+-][xyz] \(tag (1[6-9]|2[01])\) up, [+-][xyz] to the north", step.change)
    assert step.gain > 5.0
    (tmp_path / "better.yaml").write_text(plan.scenario_text)
    better = load_scenario(CubeScenario, tmp_path / "better.yaml")
    assert [str(each) for each in better.attitudes] == step.change.split(": ")[1].split("; then ")
    again = predict("cube", better.model_dump(), None, {})
    assert again.sigmas == pytest.approx(plan.best.sigmas)


def test_the_next_pose_fills_the_gap() -> None:
    """All sides have been up but one, and level turns about all axes made: that side comes next."""
    sides: list[tuple[Side, Side]] = [
        ("+x", "+y"),
        ("-x", "+z"),
        ("+y", "+z"),
        ("-y", "+x"),
        ("+z", "+x"),
        ("+z", "-y"),
    ]
    others = 3 * [Resting(up=up, north=north) for up, north in sides]
    scenario = CubeScenario(poses=0, attitudes=others, magnetometer=None)
    single, series = next_poses(scenario, 0, 2)
    assert {"-z"} <= {pose.up for pose in single}
    assert series[0] in single
    assert len(series) == 2


def test_requirements_are_read_and_checked() -> None:
    assert requirements(["delta_px=1e-4", "gyro_bias_x=2"]) == {"delta_px": 1e-4, "gyro_bias_x": 2.0}
    for wrong in ("delta_px", "delta_px=", "=1", "delta_px=-1", "delta_px=nan", "delta_px=inf"):
        with pytest.raises(InputError, match="NAME=SIGMA"):
            requirements([wrong])
    with pytest.raises(InputError, match="nearest known key is delta_px"):
        alidade.plan("los", require={"deltapx": 1.0})
    with pytest.raises(InputError, match="no method 'gimbal'"):
        alidade.plan("gimbal")


@pytest.mark.slow
def test_a_drawn_motion_is_promised_no_more_than_other_draws_keep() -> None:
    """Random attitudes of one draw determine the accelerometer half as well again as those of another."""
    scenario = CubeScenario(poses=8, static_s=1.5, camera=None, reference=None, imu_rate_hz=50.0)
    gains = [f"{sensor}_k{i}{j}" for sensor in ("accel", "gyro") for i in "123" for j in "123"]
    promised = predict("cube", scenario.model_dump(), None, {}).sigmas
    single = [predict("cube", scenario.model_dump(), None, {}, (seed,)).sigmas for seed in (0, 11, 12, 13)]

    def ratios(others: list[dict[str, float]], said: dict[str, float]) -> list[float]:
        return [other[name] / said[name] for other in others for name in gains if said[name] > 0.0]

    assert max(ratios(single[1:], promised)) < 1.3
    assert max(ratios(single[1:], single[0])) > 1.3
