"""A step of a sensor's offset is found in graphs with and without states, as large as it is, and none where none is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import alidade
from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.change_test import LEVEL, offset_finding
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import OffsetStep, Quantity
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve, solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.offset_step import largest_offset_step
from datasets.broad import read_trial, to_session

TURN = np.array([0.6, -0.64, 0.48])
SCENARIO: dict[str, Any] = {
    "duration_s": 40.0,
    "vision_rate_hz": 20.0,
    "gyro_rate_hz": 100.0,
    "latitude_deg": None,
    "sensors": {},
}
NAMES = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")


def found_in(session: alidade.Session) -> OffsetStep:
    """Most significant step, from the solution of a session's graph."""
    compiled = Compiled.of(session.problem())
    step = largest_offset_step(compiled, solve(compiled).posterior.at)
    assert step is not None
    return step


def turned(
    seed: int, size: float = 0.0, at: float = 0.5, correlation_time: float = 0.0
) -> tuple[alidade.Session, Array]:
    """A magnetometer whose offset steps by a share of the field; errors of 1 % may be correlated. Step of raw, T."""
    simulated = alidade.simulate("tumble", {}, seed)
    data, field = simulated.data, float(np.linalg.norm(simulated.data.mag, axis=1).mean())
    mag, t = data.mag.copy(), data.mag_t
    mag[t > t[0] + at * (t[-1] - t[0])] += size * field * TURN
    if correlation_time:
        rng, error = np.random.default_rng([seed, 9]), np.zeros(3)
        for k, kept in enumerate(np.exp(-np.diff(t, prepend=t[0] - 1e6) / correlation_time)):
            error = kept * error + np.sqrt(1.0 - kept**2) * rng.standard_normal(3)
            mag[k] += 0.01 * field * error
    return alidade.open(replace(simulated, data=replace(data, mag=mag))), size * field * TURN


@pytest.mark.parametrize("correlation_time", [0.0, 1.0])
def test_where_no_offset_steps_none_is_significant(correlation_time: float) -> None:
    levels = [found_in(turned(seed, correlation_time=correlation_time)[0]).level for seed in range(12)]
    assert min(levels) > LEVEL
    # P-values over many moments are conservative, and not always 1.
    assert np.mean(np.array(levels) < 0.05) <= 0.25


@pytest.mark.parametrize("at", [0.3, 0.5, 0.7])
def test_a_step_of_hard_iron_is_found_with_its_time_and_size(at: float) -> None:
    session, raw = turned(3, 0.05, at, 0.3)
    step, data = found_in(session), session.data
    assert step.level < LEVEL
    span = data.mag_t[-1] - data.mag_t[0]
    assert step.time_s == pytest.approx(data.mag_t[0] + at * span, abs=0.03 * span)
    values = session.calibrate(report=False).values
    K = np.array([[values[f"mag_k{min(i, j)}{max(i, j)}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
    steps, sigmas = (np.array([step.steps[f"mag_b{i}"][k] for i in (1, 2, 3)]) for k in (0, 1))
    assert (np.abs(steps + K @ raw) < 4.0 * sigmas + 0.1 * np.abs(K @ raw)).all()


def test_hard_iron_that_moves_is_a_change_and_not_noise() -> None:
    for size in (0.05, 0.3):
        result = turned(5, size, 0.5, 0.3)[0].calibrate(report=False)
        assert result.status == "inconsistent"
        (change,) = (each for each in result.findings if each.kind == "change")
        assert {name[:5] for name in change.evidence["steps"]} <= {"mag_b", "mag_k", "mag_s"}
    assert "change" not in {each.kind for each in turned(5, 0.0, 0.5, 0.3)[0].calibrate(report=False).findings}


def test_rests_before_a_step_are_no_outliers() -> None:
    """Of a third of the rests, which the robust loss rejects: the others fit."""
    scenario: dict[str, object] = {"attitudes": 40, "rest_s": 2.0, "magnetometer": None, "accelerometer": {}}
    simulated = alidade.simulate("tumble", scenario, 1)
    data = simulated.data
    accel = data.accel.copy()
    accel[data.accel_t > np.quantile(data.accel_t, 0.3)] += 0.3 * TURN
    stepped = alidade.open(replace(simulated, data=replace(data, accel=accel))).calibrate(report=False)
    assert stepped.status == "inconsistent"
    assert "change" in {each.kind for each in stepped.findings}
    assert alidade.open(simulated).calibrate(report=False).status == "calibrated"


def test_outliers_are_no_step() -> None:
    """A twentieth of the readings, all of them late, are 30 radii away."""
    simulated = alidade.simulate("tumble", {}, 2)
    mag, rng = simulated.data.mag.copy(), np.random.default_rng(2)
    late = np.flatnonzero(np.arange(len(mag)) > 0.6 * len(mag))
    mag[rng.choice(late, len(mag) // 20, replace=False)] += 30.0 * np.abs(mag).max() * TURN
    assert found_in(alidade.open(replace(simulated, data=replace(simulated.data, mag=mag)))).level > LEVEL


def test_a_rest_that_repeats_one_error_is_no_step() -> None:
    """Readings of the first attitude for as long again as the device turned, and 1 % off."""
    simulated = alidade.simulate("tumble", {}, 4)
    data, rng = simulated.data, np.random.default_rng(4)
    noise = 1e-4 * float(np.linalg.norm(data.mag[0])) * rng.standard_normal(data.mag.shape)
    mag = np.concatenate([1.01 * data.mag[:1] + noise, data.mag])
    t = np.concatenate([data.mag_t, 2.0 * data.mag_t[-1] - data.mag_t[-2] - data.mag_t[0] + data.mag_t])
    assert found_in(alidade.open(replace(simulated, data=replace(data, mag=mag, mag_t=t)))).level > LEVEL


def test_a_wrong_offset_that_the_config_fixes_is_no_step() -> None:
    simulated = alidade.simulate("tumble", {"magnetometer": {"hard_iron": 1e-6}}, 1)
    fixed = {"priors": dict.fromkeys(("mag_b1", "mag_b2", "mag_b3"), 0.0)}
    result = alidade.open(simulated, config=alidade.Config.model_validate(fixed)).calibrate(report=False)
    assert result.status == "inconsistent"
    assert "change" not in {each.kind for each in result.findings}


def stepped(data: HeadData, time: float, step: Array) -> HeadData:
    """The gyro reads a step more from a time on."""
    return replace(data, head_gyro=data.head_gyro + np.where(data.head_t[:, None] > time, step, 0.0))


def found_at(seed: int, time: float, deg: tuple[float, float, float]) -> OffsetStep:
    """The most significant step of a simulated recording with one, deg/s."""
    session = alidade.open(alidade.simulate("head", SCENARIO, seed))
    data = stepped(session.data, time, np.deg2rad(deg))
    step = solve_batch(replace(session, data=data).problem(), steps=True).offset_step
    assert step is not None
    return step


def test_a_step_of_the_gyro_bias_is_found_with_its_size() -> None:
    """The squared errors over the sigmas are at most as chi-square has them: a step raises the noise levels."""
    total, true = 0.0, np.deg2rad([0.6, 0.0, -0.4])
    seeds = range(6)
    for seed in seeds:
        step = found_at(seed, 18.0, (0.6, 0.0, -0.4))
        assert step.level < 1e-6
        assert abs(step.time_s - 18.0) <= 1.1
        total += sum(
            ((step.steps[name][0] - t) / step.steps[name][1]) ** 2 for name, t in zip(NAMES, true, strict=True)
        )
    dof = 3 * len(seeds)
    assert total < quantile(0.995, dof)


def test_a_step_is_named_where_it_raises_the_noise_beyond_what_is_stated() -> None:
    session = alidade.open(alidade.simulate("head", SCENARIO, 0))
    found = replace(session, data=stepped(session.data, 18.0, np.deg2rad([0.6, 0.0, -0.4]))).calibrate(report=False)
    assert found.status == "inconsistent"
    assert "Change at 18 s: gyro_bias_x by 0.6" in found.headline


def test_no_gyro_bias_steps_where_nothing_steps() -> None:
    """Of ten p-values for a step anywhere, at most one is below a twentieth: with two of them, p = .09."""
    levels = [found_at(seed, 18.0, (0.0, 0.0, 0.0)).level for seed in range(10)]
    assert min(levels) > 1e-3
    assert sum(level < 0.05 for level in levels) <= 1


def test_a_step_is_material_beyond_half_of_what_is_required() -> None:
    quantities = [Quantity(name, "rad/s", 0.05, 0.05, 2e-3) for name in NAMES]

    def severity(size: float, level: float = 1e-9) -> Severity | None:
        step = OffsetStep(3.0, 6.0, level, {"gyro_bias_x": (size, 1e-4), "gyro_bias_y": (0.0, 1e-4)})
        finding = offset_finding(step, quantities)
        return None if finding is None else finding.severity

    assert severity(2e-3) == Severity.WEAK
    assert severity(1e-3) == Severity.NOTE
    assert severity(2e-3, level=2.0 * LEVEL) is None
    assert severity(1e-4) is None


def test_a_bias_that_steps_half_way_in_a_real_recording(shared_data: Path) -> None:
    """1 deg/s on BROAD 21: the mean bias was 5.7 of its sigmas off, and `calibrated`."""
    trial = read_trial(shared_data / "broad" / "21_undisturbed_fast_combined.mat")
    method = methods.method("head")
    data = method.faults.segment(to_session(trial, 0, 0.0), 30.0, 90.0)
    session = Session.of(method, Simulated(data, {}, ""))
    healthy = replace(session, data=data).calibrate(report=False)
    found = replace(session, data=stepped(data, 60.0, np.deg2rad([0.0, 1.0, 0.0]))).calibrate(report=False)
    assert healthy.status == "calibrated"
    assert found.status == "weak"
    (change,) = (each.evidence for each in found.findings if each.kind == "change")
    size, sigma = change["steps"]["gyro_bias_y"]
    assert abs(size - np.deg2rad(1.0)) < 3.0 * sigma
    mean = healthy.parameters["gyro_bias_y"].value + np.deg2rad(0.5)
    assert abs(found.parameters["gyro_bias_y"].value - mean) < found.parameters["gyro_bias_y"].sigma
