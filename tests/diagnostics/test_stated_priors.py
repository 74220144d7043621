"""What the config fixes or states tightly, and the recording contradicts, is found and named; what is right is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.stated_priors import contradictions, freed_config
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import Quantity, SqrtInformation
from alidade.pipelines.methods import method
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.sentences import sentence
from alidade.pipelines.settings import Config

_PLATFORM = {
    axis: [{"amplitude_deg": size, "frequency_hz": f}]
    for axis, size, f in (("yaw", 10, 0.11), ("pitch", 6, 0.17), ("roll", 8, 0.23))
}
HEAD = {"duration_s": 30, "gyro_rate_hz": 50, "vision_rate_hz": 6, "platform": _PLATFORM, "sensors": "ideal"}
LOS = {"duration_s": 30, "gyro_rate_hz": 100, "gimbal_rate_hz": 100, "image_rate_hz": 15}


def calibrated(name: str, scenario: dict[str, Any], config: dict[str, Any], solver: str = "batch") -> Calibration:
    of = method(name)
    simulated = of.simulate(of.scenario.model_validate(scenario), 1)
    stated = Config.model_validate(config)
    return Session.of(of, simulated, stated).calibrate(solver, check=True, report=False)


def contradicted(calibration: Calibration) -> dict[str, float]:
    """Parameter -> what it is if free, of the findings that make the result inconsistent."""
    found = [each for each in calibration.findings if each.kind == "contradiction"]
    return {f.evidence["parameter"]: f.evidence["value"] for f in found if f.severity == Severity.INCONSISTENT}


@pytest.mark.parametrize("solver", ["batch", pytest.param("incremental", marks=pytest.mark.slow)])
def test_a_camera_mount_fixed_to_0_that_is_3_deg(solver: str) -> None:
    """Levels of noise take it up: the gyro's is 42 times its statement."""
    scenario = HEAD | {"camera_mount_deg": [3, 0, 0]}
    found = calibrated("head", scenario, {"priors": {f"camera_mount_{axis}": 0.0 for axis in "xyz"}}, solver)
    assert found.status == "inconsistent"
    assert contradicted(found) == {"camera_mount_x": pytest.approx(np.deg2rad(3.0), abs=np.deg2rad(0.4))}
    assert "camera_mount_x is fixed at 0.00 deg by the config, and the recording contradicts it" in found.headline


def test_a_prior_ten_times_too_tight_that_a_bias_contradicts() -> None:
    scenario = HEAD | {"gyro_turn_on_bias_deg_s": 3.0}
    found = calibrated("head", scenario, {"priors": {f"gyro_bias_{axis}": 5e-3 for axis in "xyz"}})
    assert found.status == "inconsistent"
    assert "gyro_bias_y contradicts its prior" in found.headline


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ideal_sensors_that_are_not(seed: int) -> None:
    """With usual sensors the mounting angles are 15 and 44 sigmas off."""
    of = method("los")
    simulated = of.simulate(of.scenario.model_validate(LOS | {"sensors": {}}), seed)
    found = Session.of(of, simulated, Config.model_validate({"sensors": "ideal"})).calibrate(report=False)
    assert found.status == "inconsistent"
    assert "gyro_scale_x" in contradicted(found)


@pytest.mark.parametrize(
    ("name", "scenario"), [pytest.param("head", HEAD, marks=pytest.mark.slow), ("los", LOS | {"sensors": "ideal"})]
)
def test_ideal_sensors_are_not_contradicted(name: str, scenario: dict[str, Any]) -> None:
    found = calibrated(name, scenario, {"sensors": "ideal"})
    assert found.status == "calibrated"
    assert not [each for each in found.findings if each.kind in ("contradiction", "prior_conflict")]


def test_the_score_of_a_fixed_number_is_what_it_is_alone_freed() -> None:
    """Two numbers free, two fixed: b explains all of the misfit, c shares its direction in part."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(200, 4))
    A[:, 3] = 0.6 * A[:, 2] + 0.8 * A[:, 3]
    truth = np.array([0.0, 0.0, 0.5, 0.0])
    names = ("a", "d", "b", "c")
    y = A @ truth + rng.normal(size=200)
    fixed_at = np.append(np.linalg.lstsq(A[:, :2], y)[0], [0.0, 0.0])
    sqrt_info = SqrtInformation(names, fixed_at, A, y - A @ fixed_at, np.empty((0, 4)), np.empty(0), np.ones(4))
    freed = [Quantity(name, "", None, 1.0, 0.1) for name in names]
    (found,) = contradictions(sqrt_info, freed, freed[:2], 1.0)
    alone, *_ = np.linalg.lstsq(A[:, :3], y)
    covariance = np.linalg.inv(A[:, :3].T @ A[:, :3])
    evidence = found.evidence
    assert (evidence["parameter"], found.severity) == ("b", Severity.INCONSISTENT)
    assert evidence["value"] == pytest.approx(alone[2])
    assert evidence["sigma"] == pytest.approx(covariance[2, 2] ** 0.5)
    assert evidence["z"] == pytest.approx(alone[2] / covariance[2, 2] ** 0.5)
    assert evidence["effect"]["a"] == pytest.approx(alone[0] - fixed_at[0])
    text = sentence(found, {q.name: q for q in freed[:2]})
    assert text.startswith("b is fixed at 0.0 % by the config, and the recording contradicts it")


def test_what_is_fixed_is_freed_and_what_is_tight_with_it() -> None:
    config = Config.model_validate(
        {"priors": {"a": 0.0, "b": 0.1, "c": 2.0}, "sensors": {"gyro": {"scale": 0.0, "skew": 1e-3}}}
    )
    quantities = [Quantity(name, "", config.prior(name, 1.0), 1.0, 1.0) for name in "abc"]
    freed = freed_config(config, quantities)
    assert freed is not None
    assert freed.priors == {"a": None, "b": None, "c": 2.0}
    assert (freed.sensors.gyro.scale, freed.sensors.gyro.skew) == (None, 1e-3)
    assert "scale" in freed.sensors.gyro.model_fields_set
    assert freed_config(Config.model_validate({"priors": {"b": 0.1}}), quantities) is None
