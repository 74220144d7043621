"""Inputs taken for exact, against solving again with the input changed; and the measurements that matter most."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.fault_models import ExactInput
from alidade.pipelines.estimation.problem import Estimate, Factor, Step
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.simulation import CubeScenario
from alidade.pipelines.methods.indexer.guidance import FAULTS
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import result
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.pages import Page

SCENARIOS: dict[str, dict[str, Any]] = {
    "indexer": {"gyro_rate_hz": 100.0, "encoder_rate_hz": 50.0},
    "cube": {"poses": 12, "static_s": 2.0, "turn_rad_s": 1.6, "camera": {"rate_hz": 5.0}},
    "head": {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 10.0},
}
# Of its usual size, so that what is of second order does not matter.
SHARE = 0.01


@cache
def session(name: str) -> Session:
    """With noise as stated: levels found anew would move the parameters too."""
    chosen = method(name)
    made = Session.of(chosen, chosen.simulate(chosen.scenario.model_validate(SCENARIOS[name]), 2))
    return replace(made, config=made.config.model_copy(update={"noise_known": 0.0}))


@cache
def calibration(name: str) -> Calibration:
    return session(name).calibrate()


def solved(of: Session) -> Estimate:
    return solve_batch(of.problem(), budget=True)


def in_sigmas(moved: Array, estimate: Estimate, names: list[str]) -> Array:
    return np.asarray(moved / [estimate.sigmas[estimate.names.index(name)] for name in names])


def moves(of: Session, name: str) -> tuple[Array, Array]:
    """What an input off by a little moves, as foretold and when solved again, in sigmas of the usual size."""
    exact = next(e for e in of.method.faults.exact if e.name == name)
    changed = exact.changed(of.data, of.config, SHARE * exact.step)
    assert changed is not None
    before = solve_batch(of.problem(), budget=True, changed=[(name, of.method.problem(*changed))])
    # Fresh data: nothing that was found before serves.
    after = solve_batch(of.method.problem(replace(changed[0]), changed[1]))
    assert before.moved is not None
    names = list(before.moved[name])
    again = dict(zip(before.names, after.values - before.values, strict=True))
    foretold = np.array([before.moved[name][n] for n in names])
    found = np.array([again[n] for n in names])
    return in_sigmas(foretold, before, names) / SHARE, in_sigmas(found, before, names) / SHARE


@pytest.mark.parametrize(
    ("name", "exact"),
    [
        ("indexer", "latitude_deg"),
        *(pytest.param("cube", name, marks=pytest.mark.slow) for name in ("latitude_deg", "tag_size")),
    ],
)
def test_an_input_that_is_off_moves_what_is_foretold(name: str, exact: str) -> None:
    foretold, found = moves(session(name), exact)
    assert np.abs(found).max() > 0.05
    np.testing.assert_allclose(foretold, found, atol=0.01 * np.abs(found).max())


def test_rejected_measurements_stay_rejected() -> None:
    """What lies beyond the gate has no part in what an input moves."""
    of = session("cube")
    data = of.data
    mag = data.mag.copy()
    mag[len(mag) // 3 : len(mag) // 3 + 60] += 2e-5
    broken = replace(of, data=replace(data, mag=mag))
    assert solved(broken).rejected["magnetometer"] > 0
    foretold, found = moves(broken, "tag_size")
    np.testing.assert_allclose(foretold, found, atol=0.01 * np.abs(found).max())


def test_a_graph_on_other_variables_tells_nothing() -> None:
    of = session("head")
    fewer = replace(of.data, vision_t=of.data.vision_t[:-40], vision_wxyz=of.data.vision_wxyz[:-40])
    other = of.method.problem(fewer, of.config)
    assert solve_batch(of.problem(), budget=True, changed=[("fewer", other)]).moved == {}


def test_an_input_that_cannot_be_changed_is_left_out() -> None:
    of = session("indexer")

    def unusable(data: Any, config: Config, change: float) -> tuple[Any, Config]:
        return replace(data, gyro=-change * data.gyro), config

    faults = replace(FAULTS, exact=(ExactInput("direction", "1", 1.0, unusable), *FAULTS.exact))
    sensitivity = replace(of, method=replace(of.method, faults=faults)).calibrate().sensitivity
    assert sensitivity is not None
    assert list(sensitivity) == ["latitude_deg"]


def test_the_result_has_changes_by_unit() -> None:
    made = calibration("cube")
    sensitivity = result(made).sensitivity
    assert sensitivity is not None
    assert set(sensitivity) == {"latitude_deg", "tag_size"}
    latitude = sensitivity["latitude_deg"]
    assert (latitude.unit, latitude.step) == ("deg", 0.1)
    assert "gyro_g_xx" not in latitude.parameters
    # Gravity grows with the latitude, by 5.3e-3 sin^2 of it in all.
    slope = 5.3e-3 * np.sin(np.deg2rad(2.0 * CubeScenario().place.latitude_deg)) * np.deg2rad(1.0)
    assert latitude.parameters["accel_k11"] == pytest.approx(slope, rel=0.1)


@pytest.mark.usefixtures("few_solutions")
def test_without_such_inputs_or_by_another_solver_there_is_none() -> None:
    assert result(calibration("head")).sensitivity == {}
    brief = alidade.open(alidade.simulate("head", {"duration_s": 2.0, "vision_rate_hz": 5.0, "sensors": "ideal"}))
    other = result(brief.calibrate("incremental", check=False))
    assert other.sensitivity is None
    assert other.measurements is None
    of = session("cube")
    blind = replace(of, data=replace(of.data, camera=None, sightings=None, reference_t=None, reference_wxyz=None))
    found = result(blind.calibrate()).sensitivity
    assert found is not None
    assert list(found) == ["latitude_deg"]


def planted() -> Session:
    """Head with one attitude in the middle off by what the gate lets pass, the others far better than stated."""
    of = session("head")
    assert of.config.noise.vision_attitude is not None
    sigma = 4.0 * of.config.noise.vision_attitude
    noise = of.config.noise.model_copy(update={"vision_attitude": sigma})
    row = len(of.data.vision_t) // 2
    wxyz = of.data.vision_wxyz.copy()
    wxyz[row] = so3.multiply(wxyz[row], so3.exp([3.5 * sigma, 0.0, 0.0]))
    return replace(of, data=replace(of.data, vision_wxyz=wxyz), config=of.config.model_copy(update={"noise": noise}))


def test_a_planted_error_within_the_gate_stands_on_top() -> None:
    made = planted().calibrate()
    assert sum(made.estimate.rejected.values()) == 0
    measurements = result(made).measurements
    assert measurements is not None
    assert len(measurements) == 20
    sizes = [abs(m.pull) for m in measurements]
    assert sizes == sorted(sizes, reverse=True)
    time = session("head").data.vision_t
    assert (measurements[0].family, measurements[0].time_s) == ("vision", time[len(time) // 2])
    assert all(made.problem.quantities[made.estimate.names.index(m.parameter)].assumed is False for m in measurements)


def without(factor: Factor, time: float) -> Factor:
    """Without the measurement of that time."""
    if factor.measurement is None or time not in factor.measurement.model.time:
        return factor
    return Factor.of(factor.family, factor.measurement.only(factor.measurement.model.time != time))


def test_without_a_measurement_the_parameter_is_back_by_its_pull() -> None:
    problem = planted().problem()
    before = solve_batch(problem, budget=True)
    assert before.strongest is not None
    pull = before.strongest[0]

    def steps(chunk: int) -> Iterator[Step]:
        for step in problem.steps(chunk):
            yield replace(step, factors=[without(f, pull.time) for f in step.factors])

    after = solve_batch(replace(problem, steps=steps))
    i = before.names.index(pull.parameter)
    assert (before.values[i] - after.values[i]) / before.sigmas[i] == pytest.approx(pull.sigmas, rel=0.1)


def test_the_report_tells_both() -> None:
    page = Page(report_html(calibration("cube")))
    assert "Sensitivity to fixed inputs" in page.text
    assert "latitude_deg 0.1 deg nothing noticeably" in page.text  # the field's strength is measured
    assert re.search(r"tag_size 0\.2 % [a-z]+_k\d\d [+-]\d\.\d σ", page.text)
    assert "Most influential measurements 20 rows" in page.text
    assert "Sensitivity to fixed inputs" not in Page(report_html(calibration("head"))).text
