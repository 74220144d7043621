"""Whether an earlier calibration holds on a recording: verdict, what changed, errors found and expected."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from alidade import calibrate, simulate, validate
from alidade import open as opened
from alidade.factors import so3
from alidade.pipelines.applications.sharing import device_prior, walks
from alidade.pipelines.applications.validate import Validated
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.device_changes import LEVEL, CalibrationCheck, check_calibration
from alidade.pipelines.estimation.problem import Quantity, SqrtInformation
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.methods import method
from alidade.pipelines.reports.calibration import load_known
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.browser import fits
from tests.support.command import Command
from tests.support.short_problems import COARSE

MOVED_ARCSEC = 0.5
# As many samples as it takes; those of the usual rates take four times as long.


def written(path: Path, simulated: Simulated) -> Path:
    method("indexer").write_data(path, simulated.data, simulated.truth, simulated.config)
    return path


def short_head(**more: float) -> dict[str, Any]:
    """The scenario of head that determines mounts, with samples as few as it takes."""
    rates = {"gyro_rate_hz": 100.0, "platform_gyro_rate_hz": 50.0, "vision_rate_hz": 10.0}
    return method("head").settings("head_mounts").model_dump() | rates | more


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("first")
    calibrate(simulate("indexer", COARSE, seed=1)).write(folder)
    return folder


def simulated(arcsec: float) -> Simulated:
    return simulate("indexer", {**COARSE, "mounting_deg": [0.5, -0.3 + arcsec / 3600.0, 0.4]}, seed=2)


@pytest.mark.parametrize("file", ["calibration.yaml", pytest.param("result.json", marks=pytest.mark.slow)])
def test_it_holds_with_another_bias(calibrated: Path, file: str, tmp_path: Path, alidade: Command) -> None:
    """The bias is the recording's own: that it is another one is no change of the device."""
    recording = written(tmp_path / "june.mcap", simulated(0.0))
    done = alidade("validate", recording, "--calibration", calibrated / file, "--json")
    found = json.loads(done.out)
    assert (done.code, found["verdict"]) == (0, "holds")
    assert [p["name"] for p in found["parameters"]] == ["theta_x", "theta_y", "theta_z"]
    (error,) = found["validations"]
    assert error["rms"]["expected"] < 1.1 * error["rms"]["device"] < 1.5 * error["rms"]["expected"]


def test_it_does_not_hold_after_a_knock(calibrated: Path, tmp_path: Path, alidade: Command) -> None:
    recording = written(tmp_path / "june.mcap", simulated(MOVED_ARCSEC))
    done = alidade("validate", recording, "--calibration", calibrated / "calibration.yaml")
    assert done.code == 4
    assert "The calibration does not hold: theta_y changed by 0." in done.out
    assert "That is less than what is required of them." in done.out
    assert "It may be used: the change is within the required accuracy." in done.out
    page = (tmp_path / "june-validation" / "validation.html").read_text()
    fits(page, tmp_path)
    assert "The calibration does not hold" in page


def one(value: float, sigma: float, shift: float, rng: np.random.Generator) -> CalibrationCheck:
    """A number known to sigma, and a recording that says as much of it, shifted."""
    quantity = Quantity("mount", "rad", 0.1, 0.1, 1e-2)
    own = Quantity("bias", "rad/s", 0.1, 0.1, 1e-2)
    known = GaussianPrior(
        ("mount",), np.array([value + sigma * rng.standard_normal()]), np.array([[sigma**2]]), "march"
    )
    R = np.array([[1.0 / sigma, 0.3 / sigma], [0.0, 1.0 / sigma]])
    truth = np.array([value + shift, 0.02])
    prior = np.array([[10.0, 0.0]])
    sqrt_info = SqrtInformation(
        ("mount", "bias"), truth, R, rng.standard_normal(2), prior, -prior @ truth, np.array([0.1, 0.1])
    )
    return check_calibration(known, sqrt_info, (quantity, own), {})


def test_verdicts_are_as_sure_as_stated() -> None:
    """False alarms at the level; a shift of three of its own sigmas is noticed in as many cases as chance allows."""
    rng = np.random.default_rng(0)
    still = [one(0.01, 1e-3, 0.0, rng) for _ in range(200)]
    step = still[0].steps[0]
    assert step.sigma == pytest.approx(2.0**0.5 * 1e-3, rel=0.1)
    alarms = sum(each.verdict == "changed" for each in still)
    assert abs(alarms - 200 * LEVEL) < 3.0 * (200 * LEVEL) ** 0.5
    noticed = [one(0.01, 1e-3, 3.0 * step.sigma, rng).verdict == "changed" for _ in range(100)]
    assert np.mean(noticed) > 0.75
    surely = [one(0.01, 1e-3, 4.5 * step.sigma, rng).verdict == "changed" for _ in range(100)]
    assert np.mean(surely) > 0.97


def test_numbers_judged_up_to_a_factor_are_tested() -> None:
    """As a magnetometer's with `require: {mag_shape: ...}`: none has a verdict of its own, all may change."""
    known = GaussianPrior(("b",), np.zeros(1), np.array([[1e-6]]), "march")
    quantity = Quantity("b", "T", 0.1, 0.1, 1e-2, relative=True)
    shifted = SqrtInformation(
        ("b",), np.array([0.01]), np.eye(1) * 1e3, np.zeros(1), np.eye(1) * 10.0, np.array([-0.1]), np.ones(1)
    )
    assert check_calibration(known, shifted, (quantity,), {}).verdict == "changed"


def test_a_parameter_that_goes_with_a_changed_one_is_counted_as_not_tested() -> None:
    """The recording determines c, and the sum of a and b, which changed; no accuracy is required of b."""
    names = ("b", "a", "c")
    known = GaussianPrior(names, np.zeros(3), 1e-8 * np.eye(3), "march")
    quantities = [Quantity(name, "rad", 0.1, 0.1, np.inf if name == "b" else 1e-2) for name in names]
    R = 1e4 * np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    values, prior = np.array([5e-3, 5e-3, 0.0]), 10.0 * np.eye(3)
    sqrt_info = SqrtInformation(names, values, R, np.zeros(2), prior, -prior @ values, np.full(3, 0.1))
    saved: Any = SimpleNamespace(status="calibrated")
    held = check_calibration(known, sqrt_info, quantities, {})
    validated = Validated(saved, "june.mcap", (), same_recording=False, held=held)
    assert validated.sentence.startswith("The calibration holds: 1 of 2 parameters unchanged, to ")
    assert validated.notes[-1] == "the recording does not determine whether a changed, apart from what did"


def test_it_does_not_hold_for_a_recording_in_which_it_slips(tmp_path: Path, alidade: Command) -> None:
    """By three degrees at two thirds of it."""
    scenario = short_head(duration_s=30.0)
    opened(simulate("head", scenario, seed=1)).calibrate("batch", report=False).write(tmp_path)
    later = simulate("head", scenario, seed=2)
    wxyz = later.data.vision_wxyz.copy()
    wxyz[later.data.vision_t > 20.0] = so3.multiply(
        wxyz[later.data.vision_t > 20.0], so3.exp(np.deg2rad([3.0, 0.0, 0.0]))
    )
    recording = tmp_path / "later.mcap"
    method("head").write(recording, replace(later, data=replace(later.data, vision_wxyz=wxyz)))
    done = alidade("validate", recording, "--calibration", tmp_path / "calibration.yaml", "--out", tmp_path / "v")
    assert done.code == 4
    assert re.search(r"does not hold: Change at (19|20) s: helmet_mount_x by ", done.out)


@pytest.mark.slow
def test_why_a_recording_says_nothing_is_said(tmp_path: Path) -> None:
    """Encoders that slip half way leave no solution of the whole recording."""
    scenario = {"duration_s": 20.0, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 10.0}
    opened(simulate("los", scenario, seed=1)).calibrate("batch", report=False).write(tmp_path)
    later = simulate("los", scenario, seed=2)
    slipped = np.where((later.data.gimbal_t > 10.0)[:, None], np.deg2rad([8.0, -7.0]), 0.0)
    data = replace(later.data, gimbal=later.data.gimbal + slipped)
    method("los").write(tmp_path / "later.mcap", replace(later, data=data))
    found = validate(tmp_path / "later.mcap", tmp_path / "calibration.yaml")
    assert found.verdict == "unknown"
    assert any(re.match(r"later.mcap by itself: Change at (9|10|11) s: ", note) for note in found.notes)


def test_errors_of_vision_by_attitude_are_no_change(tmp_path: Path) -> None:
    """A change has the sigmas of the recording's own calibration, which these errors widen."""
    scenario = short_head(duration_s=20.0, vision_map=5e-3)
    opened(simulate("head", scenario, seed=2)).calibrate("batch", report=False).write(tmp_path)
    method("head").write(tmp_path / "later.mcap", simulate("head", scenario, seed=3))
    known, later = tmp_path / "calibration.yaml", tmp_path / "later.mcap"
    found = [validate(later, known, config=config) for config in (None, {"sensors": {"camera": {"map": 0.0}}})]
    sigmas = [np.array([step.sigma for step in each.held.steps]) for each in found if each.held]
    assert found[0].verdict == "holds"
    assert (sigmas[0] > 1.02 * sigmas[1]).all()


def test_a_gyro_whose_scale_changed_is_no_mount_that_moved(tmp_path: Path) -> None:
    """By 3 %: both camera mounts were 4 and 7 sigmas off, and the scale was not mentioned."""
    scenario = short_head(duration_s=30.0)
    opened(simulate("head", scenario, seed=1)).calibrate("batch", report=False).write(tmp_path)
    later = simulate("head", scenario, seed=2)
    scaled = replace(later.data, head_gyro=later.data.head_gyro * [1.03, 1.0, 1.0])
    method("head").write(tmp_path / "later.mcap", replace(later, data=scaled))
    found = validate(tmp_path / "later.mcap", tmp_path / "calibration.yaml")
    assert found.verdict == "holds"
    assert any(note.startswith("gyro_scale_x changed by 2.9") for note in found.notes)


def test_a_recording_among_those_of_the_calibration_says_nothing_of_it(tmp_path: Path, alidade: Command) -> None:
    """Jointly with another, or behind the calibration that was a prior: it would count twice."""
    seeds = (1, 2, 3)
    first, second, third = (written(tmp_path / f"{k}.mcap", simulate("indexer", COARSE, seed=k)) for k in seeds)
    assert alidade("calibrate", first, second, "--out", tmp_path / "joint").code == 0
    prior = tmp_path / "joint" / "recordings" / "1" / "calibration.yaml"
    assert alidade("calibrate", second, "--prior", prior, "--out", tmp_path / "chain").code == 0
    for known in (tmp_path / "joint" / "calibration.yaml", tmp_path / "chain" / "result.json"):
        assert json.loads(alidade("validate", first, "--calibration", known, "--json").out)["verdict"] == "same"
        again = alidade("calibrate", first, "--prior", known, "--out", tmp_path / "twice")
        assert (again.code, "would count twice" in again.err) == (2, True)
    assert alidade("calibrate", third, "--prior", tmp_path / "joint" / "result.json", "--out", tmp_path / "c").code == 0


def test_a_recording_that_says_nothing_gives_no_verdict() -> None:
    quantity = Quantity("mount", "rad", 0.1, 0.1, 1e-2)
    known = GaussianPrior(("mount",), np.zeros(1), np.array([[1e-6]]), "march")
    nothing = SqrtInformation(
        ("mount",), np.zeros(1), np.empty((0, 1)), np.empty(0), np.eye(1) * 10.0, np.zeros(1), np.ones(1)
    )
    assert check_calibration(known, nothing, (quantity,), {}).verdict == "unknown"


@pytest.mark.slow
def test_head_mounts_that_turned_are_noticed(tmp_path: Path) -> None:
    """A helmet mount that turned by 0.3 deg, with everything else of the head's estimated too."""
    scenario = short_head(platform_gyro_rate_hz=100.0, duration_s=30.0)
    mount = scenario["helmet_mount_deg"]
    first = simulate("head", scenario, seed=1)
    opened(first).calibrate(report=False).write(tmp_path)
    turned = {**scenario, "helmet_mount_deg": (mount[0], mount[1] + 0.3, mount[2])}
    verdicts = []
    for shape in (scenario, turned):
        session = opened(simulate("head", shape, seed=2))
        problem = session.problem()
        device = walks(session.method, session.config, [q.name for q in problem.quantities])
        gaussian_prior = device_prior(
            load_known(tmp_path / "result.json"), session.method, session.config, "another", 0
        )
        estimate = solve_batch(problem, device=device)
        assert estimate.sqrt_info is not None
        verdicts.append(check_calibration(gaussian_prior, estimate.sqrt_info, problem.quantities, {}))
    assert [each.verdict for each in verdicts] == ["holds", "changed"]
    assert any(s.name == "helmet_mount_y" and abs(np.rad2deg(s.size) - 0.3) < 0.12 for s in verdicts[1].changes.found)


def test_an_own_config_that_shares_the_bias_asks_for_it(calibrated: Path) -> None:
    shared = load_config(b"share: {'gyro_bias_*': device}")
    session = opened(simulated(0.0), config=shared, prior=calibrated / "result.json")
    priors = {q.name: q.prior_sigma for q in session.problem().quantities}
    assert priors["gyro_bias_x"] is not None
    assert priors["gyro_bias_x"] < 1e-6
