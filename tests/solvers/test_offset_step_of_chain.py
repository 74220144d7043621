"""A gyro bias that steps: found at its moment, as large as it is, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import alidade
from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.change_test import offset_finding
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import OffsetStep, Quantity
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch
from datasets.broad import read_trial, to_session

SCENARIO: dict[str, Any] = {
    "duration_s": 40.0,
    "vision_rate_hz": 20.0,
    "gyro_rate_hz": 100.0,
    "latitude_deg": None,
    "sensors": {},
}
NAMES = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")


def stepped(data: HeadData, time: float, step: Array) -> HeadData:
    """The gyro reads a step more from a time on."""
    return replace(data, head_gyro=data.head_gyro + np.where(data.head_t[:, None] > time, step, 0.0))


def found(seed: int, time: float, deg: tuple[float, float, float]) -> OffsetStep:
    """The most significant step of a simulated recording with one, deg/s."""
    session = alidade.open(alidade.simulate("head", SCENARIO, seed))
    data = stepped(session.data, time, np.deg2rad(deg))
    step = solve_batch(replace(session, data=data).problem(), steps=True).offset_step
    assert step is not None
    return step


def test_a_step_is_found_with_its_size() -> None:
    """The squared errors over the sigmas are at most as chi-square has them: a step raises the noise levels."""
    total, true = 0.0, np.deg2rad([0.6, 0.0, -0.4])
    seeds = range(6)
    for seed in seeds:
        step = found(seed, 18.0, (0.6, 0.0, -0.4))
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
    assert "Change at 18 s: gyro_bias_x by 0.5" in found.headline


def test_nothing_is_found_where_nothing_steps() -> None:
    """Of ten p-values for a step anywhere, at most one is below a twentieth: with two of them, p = .09."""
    levels = [found(seed, 18.0, (0.0, 0.0, 0.0)).level for seed in range(10)]
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
    assert severity(2e-3, level=1e-4) is None
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
