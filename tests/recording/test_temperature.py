"""Sensors whose biases follow their temperature: messages, slopes, and what becomes of both."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate
from alidade.pipelines.methods import method
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.streams import StreamReader, Temperature
from alidade.pipelines.reports.calibration import load_calibration
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.command import Command

T0 = 1_800_000_000_000_000_000
SENSOR = np.linspace(0.0, 100.0, 1001)
# Enough motion in little time, and slopes about twice what a data sheet says.
SHORT: dict[str, dict[str, Any]] = {
    "head": {
        "duration_s": 30,
        "vision_rate_hz": 15,
        "gyro_rate_hz": 100,
        "platform_gyro_rate_hz": 100,
        "platform": {
            "yaw": [{"amplitude_deg": 25, "frequency_hz": 0.13}],
            "pitch": [{"amplitude_deg": 12, "frequency_hz": 0.17}],
            "roll": [{"amplitude_deg": 15, "frequency_hz": 0.11}],
        },
        "noise": {"vision_attitude": 2e-3},
        "temperature": {"rise_k": 20.0, "time_constant_s": 10.0},
    },
    "los": {
        "duration_s": 30,
        "image_rate_hz": 10,
        "gyro_rate_hz": 100,
        "gimbal_rate_hz": 100,
        "temperature": {"rise_k": 20.0, "time_constant_s": 10.0},
    },
    "indexer": {
        "gyro_rate_hz": 20,
        "encoder_rate_hz": 20,
        "temperature": {"rise_k": 20.0, "time_constant_s": 100.0},
    },
    "cube": {"imu_rate_hz": 50, "camera": None, "temperature": {"rise_k": 20.0, "time_constant_s": 50.0}},
    "tumble": {
        "rest_s": 1.5,
        "accelerometer": {"rate_hz": 50.0},
        "temperature": {"rise_k": 20.0, "time_constant_s": 30.0},
    },
}
SLOPES: dict[str, dict[str, Any]] = {
    "head": {"effects": {"gyro_temperature_x": 2e-4, "gyro_temperature_y": -2.5e-4, "gyro_temperature_z": 1.5e-4}},
    "los": {"effects": {"gyro_temperature_x": 1.5e-4, "gyro_temperature_y": -2e-4, "gyro_temperature_z": 2.5e-4}},
    "indexer": {"effects": {"gyro_temperature_x": 1.5e-4, "gyro_temperature_y": -2e-4, "gyro_temperature_z": 2.5e-4}},
    "cube": {
        "effects": {
            "gyro_temperature_x": 2e-4,
            "gyro_temperature_y": -2e-4,
            "gyro_temperature_z": 2.5e-4,
            "accel_temperature_x": 1.5e-2,
            "accel_temperature_y": -2e-2,
            "accel_temperature_z": 1e-2,
        }
    },
    # Its simulator draws all errors.
    "tumble": {"accelerometer": {"rate_hz": 50.0, "temperature": 2e-2}},
}
# Where the temperature is not told either, noise levels are looked for again and again.
BRIEF: dict[str, dict[str, Any]] = {
    "los": {"duration_s": 20, "image_rate_hz": 5, "gyro_rate_hz": 50, "gimbal_rate_hz": 50}
}
# As sensors of the usual grade, shorter where there are many.
STUDIED: dict[str, dict[str, Any]] = {"los": {"sensors": {}, "duration_s": 15}, "tumble": {}}


def methods(*quick: str) -> pytest.MarkDecorator:
    """Every method, those not named slowly."""
    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in quick)) for name in SHORT]
    )


METHODS = methods(*SHORT)
SLOW_BUT_TUMBLE = methods("tumble")


def simulated(name: str, seed: int = 0, **changes: object) -> Simulated:
    chosen = method(name)
    settings = chosen.settings().model_dump() | SHORT[name] | {"priors": {}} | changes
    return chosen.simulate(chosen.scenario.model_validate(settings), seed)


def session_of(name: str, made: Simulated, **config: object) -> Session:
    found = Session.of(method(name), made)
    return replace(found, config=found.config.model_copy(update=config))


def told(tmp_path: Path, celsius: object, t: object) -> tuple[Temperature, dict[str, int]]:
    """What is read of a topic with such messages by a sensor that measures from 0 to 100 s."""
    t_ns = T0 + np.rint(1e9 * np.asarray(t, dtype=float)).astype(np.int64)
    topics: dict[str, series.Topic] = {
        "/imu": series.ImuSeries(T0 + np.rint(1e9 * SENSOR).astype(np.int64), np.zeros((len(SENSOR), 3))),
        "/temperature": series.TemperatureSeries(t_ns, np.asarray(celsius, dtype=float)),
    }
    write_session(tmp_path / "t.mcap", topics)
    reader = StreamReader(open_recording(tmp_path / "t.mcap"), {})
    return reader.temperature("/temperature", SENSOR), reader.dropped


def test_temperatures_are_read_as_written_and_linear_in_between(tmp_path: Path) -> None:
    t = np.arange(0.5, 100.0, 2.0)
    found, dropped = told(tmp_path, 20.0 + 0.1 * t, t)
    np.testing.assert_allclose(found.t, t, atol=1e-9)
    assert found.first == pytest.approx(20.05)
    np.testing.assert_allclose(found.above(20.0, [0.0, 0.5, 1.7, 98.5, 100.0]), [0.05, 0.05, 0.17, 9.85, 9.85])
    assert dropped == {}


def test_messages_without_a_number_are_left_out_and_counted(tmp_path: Path) -> None:
    t = np.arange(0.0, 101.0, 5.0)
    celsius = np.where(np.arange(len(t)) == 7, np.nan, 25.0)
    found, dropped = told(tmp_path, celsius, t)
    assert len(found.t) == len(t) - 1
    assert dropped == {"/temperature: not a finite number": 1}


@pytest.mark.parametrize(
    ("celsius", "t", "said"),
    [
        ([np.nan, np.nan], [0.0, 50.0], "every one of the 2 messages has a NaN"),
        (np.full(21, 294.15), np.arange(0.0, 101.0, 5.0), r"294.15 at 0.000000 s \(and 20 more\); is it in kelvin\? "),
        (np.full(21, -300.0), np.arange(0.0, 101.0, 5.0), "-300 at .* in degrees Celsius is needed, -100 to 200"),
        (np.full(5, 25.0), np.arange(0.0, 5.0), "no temperature from 4.0 to 100.0 s; .* every 30 s"),
        (np.full(5, 25.0), np.arange(90.0, 95.0), "no temperature from 0.0 to 90.0 s"),
        (np.full(4, 25.0), [0.0, 20.0, 55.0, 80.0], "no temperature from 20.0 to 55.0 s"),
        ([25.0], [-500.0], "no temperature from 0.0 to 100.0 s"),
    ],
)
def test_nonsense_is_refused(celsius: object, t: object, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^topic /temperature: {said}"):
        told(tmp_path, celsius, t)


@SLOW_BUT_TUMBLE
def test_a_slope_that_is_told_is_found_and_one_that_is_not_spoils_the_bias(name: str) -> None:
    made = simulated(name, 1, **SLOPES[name], **BRIEF.get(name, {}))
    problem = session_of(name, made).problem()
    estimate = solve_batch(problem)
    slopes = {each: true for each, true in made.truth.items() if "temperature" in each}
    assert slopes
    for slope, true in slopes.items():
        i = estimate.names.index(slope)
        assert abs(estimate.values[i] - true) < 3.5 * estimate.sigmas[i] < 0.6 * abs(true)
        assert problem.quantities[i].unit == ("rad/s/K" if slope.startswith("gyro") else "m/s^2/K")
        assert problem.quantities[i].group == "assumption"
    assert worst(estimate, made) < 4.0
    blind = solve_batch(session_of(name, replace(made, data=replace(made.data, temperature=None))).problem())
    assert not any("temperature" in each for each in blind.names)
    # The sigmas of head cover a part of it: block-wise covariance finds an error that no noise term has.
    assert worst(blind, made) > (3.0 if name == "head" else 5.0)


def worst(estimate: Estimate, made: Simulated) -> float:
    """The largest error, in sigmas."""
    free = estimate.sigmas > 0.0
    error = estimate.values - np.array([made.truth[each] for each in estimate.names])
    return float(np.abs(error[free] / estimate.sigmas[free]).max())


@METHODS
def test_without_a_temperature_the_graph_is_as_ever(name: str) -> None:
    """And so it is where all slopes are fixed."""
    made = simulated(name, 2)
    problem = session_of(name, made, sensors=load_config(b"sensors: ideal").sensors).problem()
    without = session_of(name, simulated(name, 2, temperature=None)).problem()
    assert not any("temperature" in q.name and q.prior_sigma for q in (*problem.quantities, *without.quantities))
    assert "first_temperature" not in without.constants


def nees(name: str, seeds: range) -> tuple[float, int]:
    """Summed over recordings whose sensors are drawn from their priors, of slopes and of all that is estimated."""
    total, dof = 0.0, 0
    for seed in seeds:
        made = simulated(name, seed, **STUDIED.get(name, {"sensors": {}}))
        estimate = solve_batch(session_of(name, made).problem())
        error = estimate.values - np.array([made.truth[each] for each in estimate.names])
        free = estimate.sigmas > 0.0
        covariance = estimate.covariance[np.ix_(free, free)]
        total += float(error[free] @ np.linalg.solve(covariance, error[free]))
        dof += int(free.sum())
    return total, dof


def assert_consistent(name: str, seeds: range) -> None:
    """Sigmas fit to 5 %: a noise that grows with the rate, which the sensors have not, widens head's by 4 %."""
    total, dof = nees(name, seeds)
    low, high = chi2.ppf([0.005, 0.995], dof) * np.array([0.95, 1.05]) ** 2
    assert low < total < high


@SLOW_BUT_TUMBLE
def test_errors_fit_their_covariance(name: str) -> None:
    assert_consistent(name, range(2))


@pytest.mark.slow
@METHODS
def test_errors_fit_their_covariance_over_many_runs(name: str) -> None:
    assert_consistent(name, range(100, 300))


@SLOW_BUT_TUMBLE
def test_from_the_command_line(name: str, tmp_path: Path, alidade: Command) -> None:
    """Simulated, read from its file, solved, applied."""
    scenario = tmp_path / "warming.yaml"
    scenario.write_text(json.dumps(SHORT[name] | SLOPES[name]))
    assert alidade("simulate", name, "--scenario", scenario, "--out", tmp_path / "s.mcap").code == 0
    topics = open_recording(tmp_path / "s.mcap").topics
    assert topics["/temperature"].type == "sensor_msgs/msg/Temperature"
    run = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out")
    assert run.code == 0, run.out
    saved = load_calibration(tmp_path / "out" / "calibration.yaml")
    assert saved.constants["first_temperature"] == 20.0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["constants"] == saved.constants
    assert "(temperature - first_temperature)" in " ".join(saved.formulas)
    assert "first_temperature = 20" in (tmp_path / "out" / "report.html").read_text()
    run = alidade("validate", tmp_path / "s.mcap", "--calibration", tmp_path / "out" / "calibration.yaml")
    assert run.code == 0, run.err
