"""Assumptions about sensors: which prior is in force, what is said of them, and what a recording tells of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import DEAD_BAND, ParameterSpec, prior_z_score, quantities
from alidade.pipelines.estimation.problem import Estimate, Quantity
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.model import problem
from alidade.pipelines.methods.head.parameters import PARAMETERS, VISION_MAP
from alidade.pipelines.methods.head.recording import read_head
from alidade.pipelines.methods.head.report import findings
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.scenario import Simulated, load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.command import Command
from tests.support.judged import judge

SCALE = ParameterSpec("gyro_scale", "", 1e-2, "Scale, {axis}.", "gyro.scale", "xy")


@pytest.mark.parametrize(
    ("config", "prior", "usual"),
    [
        ("{}", 1e-2, 1e-2),
        ("sensors: {gyro: {skew: 1.0e-3}}", 1e-2, 1e-2),
        ("sensors: {gyro: {scale: 3.0e-4}}", 3e-4, 3e-4),
        ("sensors: {gyro: {scale: 0}}", 0.0, 1e-2),
        ("sensors: {gyro: {scale: null}}", 1e-1, 1e-1),
        ("sensors: ideal", 0.0, 1e-2),
        ("{sensors: {gyro: {scale: 3.0e-4}}, priors: {gyro_scale_x: 2.0e-2}}", 2e-2, 3e-4),
        ("{sensors: {gyro: {scale: 3.0e-4}}, priors: {gyro_scale_x: 0}}", 0.0, 3e-4),
        ("{sensors: {gyro: {scale: 3.0e-4}}, priors: {gyro_scale_x: null}}", 3e-3, 3e-4),
        ("{sensors: ideal, priors: {gyro_scale_x: 1.0e-3}}", 1e-3, 1e-2),
        ("priors: {gyro_scale_x: null}", 1e-1, 1e-2),
    ],
)
def test_priors_beat_sheets_beat_the_usual_grade(config: str, prior: float, usual: float) -> None:
    x, y = quantities(SCALE, load_config(config.encode()))
    assert x.prior_sigma == pytest.approx(prior)
    assert x.prior_scale == pytest.approx(usual)
    assert x.group == "assumption"
    assert not x.judged
    # A figure of the data sheet that a prior of its own overrules is none to state.
    assert x.sheet == ("" if "priors" in config else "gyro.scale")
    sheets = load_config(config.encode()).model_copy(update={"priors": {}})
    assert y == replace(quantities(SCALE, sheets)[1], prior_scale=y.prior_scale)


def test_an_accuracy_wanted_brings_a_verdict() -> None:
    config = load_config(b"require: {gyro_scale_x: 1.0e-3}")
    x, y = quantities(SCALE, config)
    assessment = judge((x, y), np.diag([4e-6, 1e-4]), None, None)
    assert assessment.verdicts == {"gyro_scale_x": "weak"}
    assert [tuple(d.evidence["weights"]) for d in assessment.directions] == [("gyro_scale_x",)]
    assert judge((replace(x, require=math.inf), y), np.diag([4e-6, 1e-4]), None, None).status == "calibrated"


def test_prior_z_score() -> None:
    q = Quantity("gyro_scale_x", "", 1e-2, 1e-2, math.inf, group="assumption")
    assert prior_z_score(q, 6e-3, 8e-3) == pytest.approx(1.0)
    assert prior_z_score(q, -2e-2, 1e-6) == pytest.approx(-2.0, rel=1e-6)
    assert prior_z_score(q, 1e-4, 0.985e-2) is None
    assert prior_z_score(replace(q, prior_sigma=0.0), 0.0, 0.0) is None


def test_unknown_figures_are_named() -> None:
    with pytest.raises(InputError, match=r"unknown key sensors\.gyro\.scal\b.*scale"):
        load_config(b"sensors: {gyro: {scal: 1.0e-3}}")
    with pytest.raises(InputError, match=r"sensors: .*ideal"):
        load_config(b"sensors: perfect")


def test_the_old_option_says_what_to_write_instead() -> None:
    data, _ = _recording()
    with pytest.raises(InputError, match=r"noise\.gyro_scale.*sensors: \{gyro: \{scale: 0\.005, skew: 0\.005\}\}"):
        problem(data, load_config(b"noise: {gyro_scale: 5.0e-3}"))


# One of everything, beyond or within its prior.
EFFECTS = {
    "gyro_scale_x": 2e-2,
    "gyro_scale_z": -1e-2,
    "gyro_skew_xy": 8e-3,
    "gyro_g_xz": 2e-4,
    "platform_bias_y": 1e-4,
    "platform_scale_z": -2e-2,
    "clock_skew": 2e-4,
    "vision_scale": 4e-3,
}


@cache
def _recording() -> Simulated:
    return simulate_head(_scenario(), 1)


def _scenario() -> HeadScenario:
    settings = load_scenario(HeadScenario, "head_mounts").model_dump()
    return HeadScenario.model_validate(settings | {"gyro_rate_hz": 100, "vision_rate_hz": 20, "effects": EFFECTS})


@cache
def _estimate(sensors: str = "") -> Estimate:
    data, _ = _recording()
    return solve_batch(problem(data, load_config((head_config(_scenario()) + sensors).encode())))


def test_effects_that_a_recording_determines_are_found() -> None:
    _, truth = _recording()
    estimate = _estimate()
    assert set(estimate.names) == {
        name for spec in PARAMETERS if spec not in (GYRO_SLOPE, DEAD_BAND, VISION_MAP) for name in spec.names
    }
    error = (estimate.values - [truth[name] for name in estimate.names]) / estimate.sigmas
    assert np.abs(error).max() < 4.0
    found = dict(zip(estimate.names, zip(estimate.values, estimate.sigmas, strict=True), strict=True))
    for name in ("gyro_scale_x", "gyro_scale_z", "gyro_skew_xy", "platform_scale_z", "clock_skew"):
        value, sigma = found[name]
        assert abs(value) > 3.0 * sigma


def test_ideal_sensors_leave_what_is_calibrated_alone_and_go_wrong() -> None:
    _, truth = _recording()
    # With the noise stated: what the graph lacks would be taken for noise.
    estimate = _estimate("\nsensors: ideal\nnoise_known: 0\n")
    assert len(estimate.names) == 10
    error = (estimate.values - [truth[name] for name in estimate.names]) / estimate.sigmas
    assert np.abs(error).max() > 5.0


def test_without_acceleration_g_sensitivity_is_fixed_with_a_finding(tmp_path: Path) -> None:
    data, _ = _recording()
    config = load_config(head_config(_scenario()).encode())
    method("head").write_data(tmp_path / "s.mcap", replace(data, head_force=None))
    read = read_head(open_recording(tmp_path / "s.mcap"), config)
    assert read.head_force is None
    assert not any(q.name.startswith("gyro_g") for q in problem(read, config).quantities)
    (row,) = findings(read, config, _estimate())["fixed_assumptions"]
    assert row["parameters"] == "gyro_g_xx to gyro_g_zz"
    assert row["why"] == "/head/imu has no acceleration"
    assert findings(data, config, _estimate()) == {}


def test_result_and_report_tell_assumptions_apart(alidade: Command, tmp_path: Path) -> None:
    brief = HeadScenario(duration_s=4.0, vision_rate_hz=10.0, gyro_rate_hz=50.0)
    method("head").write(tmp_path / "s.mcap", simulate_head(brief, 1))
    alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out")
    parameters = {p["name"]: p for p in json.loads((tmp_path / "out" / "result.json").read_text())["parameters"]}
    scale, mount = parameters["gyro_scale_x"], parameters["helmet_mount_x"]
    assert scale["group"] == "assumption"
    assert scale["prior_sigma"] == 1e-2
    assert scale["require"] is None
    assert scale["observability"] is None
    spread = math.sqrt(scale["prior_sigma"] ** 2 - scale["sigma"] ** 2)
    assert scale["pull"] == pytest.approx(scale["value"] / spread)
    assert not {"group", "pull"} & mount.keys()
    page = (tmp_path / "out" / "report.html").read_text()
    tables = (page.split(f'id="{name}"')[1].split("</table>")[0] for name in ("parameters", "assumptions"))
    calibrated, assumed = tables
    assert "gyro_scale_x" not in calibrated
    assert "gyro_scale_x" in assumed


def test_a_data_sheet_that_a_method_has_no_use_for_is_refused() -> None:
    """It would be ignored in silence; `ideal` and figures of 0 say nothing and are taken everywhere."""
    simulated = alidade.simulate("cube", {"poses": 6}, seed=1)
    stated = alidade.Config.model_validate({"sensors": {"clock": {"skew": 1e-4}}})
    with pytest.raises(alidade.InputError, match=r"cube has no use for it; it uses sensors\.tags, sensors\.gyro, "):
        alidade.open(simulated, config=stated).problem()
    for nothing in ("ideal", {"clock": {"skew": 0.0}}):
        alidade.open(simulated, config=alidade.Config.model_validate({"sensors": nothing})).problem()
    stated = alidade.Config.model_validate({"sensors": {"camera": {"focal": 1e-3, "scale": 1e-3}}})
    with pytest.raises(alidade.InputError, match=r"sensors\.camera\.scale: .* uses sensors\.camera\.focal, "):
        alidade.open(simulated, config=stated).problem()


# Which figures are used does not depend on how much is recorded.
BRIEF: dict[str, dict[str, float]] = {
    "los": {"duration_s": 5.0, "image_rate_hz": 10.0, "gyro_rate_hz": 100.0},
    "indexer": {"gyro_rate_hz": 20.0, "encoder_rate_hz": 20.0},
    "head": {"duration_s": 5.0, "vision_rate_hz": 10.0, "gyro_rate_hz": 100.0},
    "cube": {"poses": 6, "imu_rate_hz": 50.0},
    "tumble": {"attitudes": 12},
}


@pytest.mark.parametrize("name", BRIEF)
def test_a_method_says_which_figures_it_uses(name: str) -> None:
    method = methods.method(name)
    taken = {f"{sensor}.{figure}" for sensor, figures in method.data_sheets.items() for figure in figures}
    used = set()
    for scenario in (None, f"{name}_warming", *(("tumble_phone",) if name == "tumble" else ())):
        settings = method.settings(scenario).model_copy(update=BRIEF[name])
        problem = Session.of(method, method.simulate(settings, 0)).problem()
        used |= {q.sheet for q in problem.quantities if q.group == "assumption" and q.sheet}
    assert used
    assert used <= taken
