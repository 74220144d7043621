"""The tumble method: magnetometer and accelerometer with nothing beside them, simulated and real."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.factors.ellipsoid import DipFactor, StrengthFactor, sagitta
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from alidade.factors.turned import FieldFactor, UpFactor
from alidade.pipelines.applications.session import Session, resolve_method
from alidade.pipelines.applications.table_discovery import with_columns
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate
from alidade.pipelines.methods import method
from alidade.pipelines.methods.formula import apply
from alidade.pipelines.methods.triads import triad_names, triad_of
from alidade.pipelines.methods.tumble.first_guess import first_guess
from alidade.pipelines.methods.tumble.graph import unturned
from alidade.pipelines.methods.tumble.model import prepare, quantisation, static_rests
from alidade.pipelines.methods.tumble.recording import ACCEL_CURVATURE, TumbleData, read_tumble, tumble_topics
from alidade.pipelines.methods.tumble.report import formulas
from alidade.pipelines.methods.tumble.simulation import (
    TumbledAccelerometer,
    TumbledGyro,
    TumbledMagnetometer,
    TumbleScenario,
)
from alidade.pipelines.methods.tumble.turning import BIAS, SENSITIVITY, Seen, calibrated_force
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.plausibility import dead_band
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.reports.results_table import result_cards
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.simulation.sensors import Warming
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from benchmarks import compass
from tests.support.command import Command

SHARED = Path(__file__).parents[4] / "shared" / "data"
TUMBLE = method("tumble")
N = 7
T0 = 1_700_000_000_000_000_000
# Few attitudes, gone through quickly, at a low rate: what takes long is the number of samples.
BRIEF = TumbleScenario(attitudes=25, magnetometer=TumbledMagnetometer(rate_hz=20.0))
TURNING = TumbleScenario(
    attitudes=25,
    magnetometer=TumbledMagnetometer(rate_hz=20.0),
    accelerometer=TumbledAccelerometer(rate_hz=25.0),
    gyro=TumbledGyro(rate_hz=25.0),
)
AT_50 = {"gyro": {"rate_hz": 50.0}, "accelerometer": {"rate_hz": 50.0}}
RESTING = TumbleScenario(attitudes=25, rest_s=1.5, accelerometer=TumbledAccelerometer(rate_hz=50.0))


def replace_scenario(scenario: TumbleScenario, **changes: Any) -> TumbleScenario:
    """With other values, sensors by their own keys."""
    content = scenario.model_dump()
    for key, value in changes.items():
        content[key] = {**content[key], **value} if isinstance(value, dict) else value
    return TumbleScenario.model_validate(content)


def _shared(name: str) -> Path:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return path


def _simulated(scenario: TumbleScenario, seed: int) -> Simulated:
    return TUMBLE.simulate(scenario, seed)


def _solved(simulated: Simulated) -> Estimate:
    session = Session.of(TUMBLE, simulated)
    return solve_batch(session.problem())


def _errors(estimate: Estimate, truth: dict[str, float] | Any) -> tuple[np.ndarray, np.ndarray]:
    """Errors of what is free and has a truth, and their covariance."""
    free = (np.diag(estimate.covariance) > 0.0) & [name in truth for name in estimate.names]
    error = estimate.values - np.array([truth.get(name, 0.0) for name in estimate.names])
    return error[free], estimate.covariance[np.ix_(free, free)]


def _nees(scenario: TumbleScenario, seeds: Sequence[int]) -> tuple[float, float]:
    """Sum over the seeds of the NEES, and of its degrees of freedom."""
    total, dof = 0.0, 0
    for seed in seeds:
        simulated = _simulated(scenario, seed)
        error, covariance = _errors(_solved(simulated), simulated.truth)
        total += float(error @ np.linalg.solve(covariance, error))
        dof += len(error)
    return total, dof


def _assert_consistent(scenario: TumbleScenario, seeds: Sequence[int]) -> None:
    total, dof = _nees(scenario, seeds)
    assert quantile(0.005, dof) < total < quantile(0.995, dof), f"NEES {total:.1f} for {dof}"


@pytest.mark.parametrize("symmetric", [True, False])
def test_jacobians(symmetric: bool) -> None:
    rng = np.random.default_rng(0)
    time, sigma, raw = np.arange(float(N)), rng.uniform(0.5, 2.0, N), rng.normal(size=(N, 3))

    def triads(d: int) -> np.ndarray:
        near = [1, 0, 0, 1, 0, 1] if d == 9 else np.eye(3).ravel().tolist()
        return np.array([*near, 0.0, 0.0, 0.0]) + 0.2 * rng.normal(size=(N, d))

    d = 9 if symmetric else 12
    strength = StrengthFactor(time, raw, sigma, 0.01 * sigma, symmetric)
    assert_jacobians(strength, [triads(d), rng.uniform(0.5, 2.0, (N, 1))])
    dip = DipFactor(time, rng.normal(size=(N, 3)), raw, sigma, (True, symmetric))
    assert_jacobians(dip, [triads(9), triads(d), rng.uniform(-1.0, 1.0, (N, 1))])
    for m in (3, 6):
        drivers, slope = rng.uniform(-2.0, 8.0, (N, m)), 0.02 * rng.normal(size=(N, m))
        assert_jacobians(replace(strength, drivers=drivers), [triads(d), rng.uniform(0.5, 2.0, (N, 1)), slope])
        assert_jacobians(replace(dip, drivers=drivers), [triads(9), triads(d), rng.uniform(-1.0, 1.0, (N, 1)), slope])


@pytest.mark.parametrize("errors", [0, 18, *(pytest.param(n, marks=pytest.mark.slow) for n in (6, 9, 15))])
def test_jacobians_beside_a_gyro(errors: int) -> None:
    rng, t = np.random.default_rng(errors), np.arange(0.0, 2.0, 0.01)
    rate = np.stack([np.sin(3.0 * t), np.cos(2.0 * t), 0.5 * np.sin(t + 1.0)], axis=1)
    force, warmth = np.cos(rate) + [0.0, 3.0, 9.0], (5.0 * np.sin(t))[:, None]
    drivers = {0: None, 6: None, 9: warmth, 15: force, 18: np.column_stack([force, warmth])}
    gyro = GyroPath(t, rate, [0.01, 0.02, -0.01], drivers[errors])
    anchor = rng.uniform(0.3, 1.5, N)
    time, sigma, raw = anchor + rng.uniform(-0.05, 0.05, N), rng.uniform(0.5, 2.0, N), rng.normal(size=(N, 3))
    aRb, elapsed, earth = so3.exp(rng.normal(size=(N, 3))), rng.uniform(0.0, 600.0, N), 1e-4 * rng.normal(size=3)
    triads = np.append(np.eye(3), np.zeros(3)) + 0.2 * rng.normal(size=(N, 12))
    bias = 0.02 * rng.normal(size=(N, 3)), 2e-3 * rng.normal(size=(N, 1))  # and filter
    strength = rng.uniform(0.5, 2.0, (N, 1))
    own = [1e-2 * rng.normal(size=(N, errors))] if errors else []
    field = FieldFactor(time, anchor, raw, sigma, elapsed, gyro, errors, earth)
    dip, delay = rng.uniform(-1.0, 1.0, (N, 1)), 0.01 * rng.normal(size=(N, 1))
    # Errors are taken to be constant over the way from the anchor, to which they are corrected to first order.
    assert_jacobians(field, [aRb, *bias, triads, strength, dip, delay, *own], rtol=5e-5)
    anywhere = [np.tile(earth, (N, 1))]
    assert_jacobians(replace(field, earth=None), [aRb, *bias, triads, strength, dip, delay, *own, *anywhere], rtol=5e-5)
    at_rest = UpFactor(time, anchor, raw, sigma, elapsed, gyro, errors, earth)
    assert_jacobians(at_rest, [aRb, *bias, triads, strength, *own], rtol=5e-5)
    swung = replace(at_rest, unit=9.8)
    assert_jacobians(swung, [aRb, *bias, triads, strength, *own, rng.normal(size=(N, 3))], rtol=5e-5)
    warm = replace(swung, drivers=rng.uniform(-2.0, 8.0, (N, 6)))
    arm, slope = rng.normal(size=(N, 3)), 0.02 * rng.normal(size=(N, 6))
    assert_jacobians(warm, [aRb, *bias, triads, strength, *own, arm, slope], rtol=5e-5)
    assert_jacobians(replace(warm, unit=None), [aRb, *bias, triads, strength, *own, slope], rtol=5e-5)
    assert_jacobians(replace(warm, earth=None), [aRb, *bias, triads, strength, *own, arm, slope, *anywhere], rtol=5e-5)


def test_without_noise_there_is_no_error() -> None:
    quiet = replace_scenario(
        RESTING,
        magnetometer={"density": 1e-13},
        accelerometer={"density": 5e-10, "arm": 0.0, "square": 0.0, "cube": 0.0},
        field_error=0.0,
        field_measured=None,
        priors={"field_strength": 0.0},
    )
    simulated = _simulated(quiet, 0)
    estimate = _solved(simulated)
    for name, value in zip(estimate.names, estimate.values, strict=True):
        assert value == pytest.approx(simulated.truth[name], rel=2e-6, abs=2e-11), name


def test_a_magnetometer_alone_is_consistent() -> None:
    _assert_consistent(BRIEF, range(6))


def test_a_magnetometer_of_unknown_place_is_consistent() -> None:
    _assert_consistent(replace_scenario(BRIEF, latitude_deg=None), range(4))


def test_both_sensors_are_consistent() -> None:
    _assert_consistent(RESTING, range(4))


def _turned(hz: float, beside: bool) -> TumbleScenario:
    """Never at rest, a gyro of any rate that samples points, and a magnetometer of at most 50 Hz."""
    return TumbleScenario(
        attitudes=20 if hz <= 50.0 else 12,
        turn_rad_s=0.6 if hz < 25.0 else 1.5,
        magnetometer=TumbledMagnetometer(rate_hz=min(hz, 50.0)),
        gyro=TumbledGyro(rate_hz=hz),
        accelerometer=TumbledAccelerometer(rate_hz=hz) if beside else None,
    )


@pytest.mark.parametrize(
    ("hz", "beside"), [(5.0, False), pytest.param(25.0, True, marks=pytest.mark.slow), (400.0, False)]
)
def test_gyro_of_any_rate_is_consistent(hz: float, beside: bool) -> None:
    """Sensors rotated relative to each other, a late magnetometer, a gyro that is off and feels force."""
    _assert_consistent(_turned(hz, beside), range(2, 4))


def test_the_gyro_bias_does_not_depend_on_the_accelerometers_offset() -> None:
    """The gyro feels force, of which the accelerometer reads 0.3 m/s^2 too much: NEES of the bias was 62 and 3."""
    total, seeds = 0.0, (0, 2)
    for seed in seeds:
        simulated = _simulated(TURNING.model_copy(update={"attitudes": 12, "turn_rad_s": 0.5}), seed)
        estimate = _solved(simulated)
        some = [estimate.names.index(name) for name in BIAS.names]
        error = estimate.values[some] - [simulated.truth[name] for name in BIAS.names]
        total += float(error @ np.linalg.solve(estimate.covariance[np.ix_(some, some)], error))
    dof = 3 * len(seeds)
    assert quantile(0.005, dof) < total < quantile(0.995, dof), f"NEES {total:.1f} for {dof}"


@pytest.mark.slow
@pytest.mark.parametrize("hz", [5.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0])
def test_gyro_of_any_rate_is_consistent_over_many_seeds(hz: float) -> None:
    """Beside an accelerometer from 25 Hz on."""
    if hz >= 25.0:
        _assert_consistent(_turned(hz, beside=True), range(8))
    for latitude in (40.0, None):
        _assert_consistent(_turned(hz, beside=False).model_copy(update={"latitude_deg": latitude}), range(12))


@pytest.mark.parametrize(
    ("hz", "grades", "motions", "seeds"),
    [
        (100.0, ["tactical"], ["flight"], 1),
        pytest.param(5.0, ["tactical"], ["level"], 2, marks=pytest.mark.slow),
        pytest.param(50.0, ["poor"], ["level"], 3, marks=pytest.mark.slow),
        *(
            pytest.param(hz, compass.GRADES, compass.TILTS, 6, marks=pytest.mark.slow)
            for hz in (5.0, 10.0, 25.0, 400.0)
        ),
    ],
)
def test_compass_of_any_grade_and_motion_is_consistent(
    hz: float, grades: Sequence[str], motions: Sequence[str], seeds: int
) -> None:
    for grade, motion in product(grades, motions):
        total, dof = compass.nees(hz, grade, motion, range(seeds))
        low, high = min(0.6, quantile(0.005, dof) / dof), max(1.4, quantile(0.995, dof) / dof)
        assert low < total / dof < high, f"{grade}, {motion}: NEES {total:.1f} for {dof}"


def test_a_rough_minimisation_that_leads_nowhere_near_leaves_the_right_minimum() -> None:
    """Of a level compass at 10 Hz; with its few iterations spent on corrections the NEES was 145 of 24."""
    total, dof = compass.nees(10.0, "poor", "level", [3])
    assert quantile(0.005, dof) < total < quantile(0.995, dof)


@pytest.mark.slow
def test_tumbling_with_rests_and_a_gyro_is_consistent_over_many_seeds() -> None:
    _assert_consistent(replace_scenario(TURNING, rest_s=1.5, **AT_50), range(24))


@pytest.mark.slow
def test_offsets_that_follow_the_temperature_are_consistent() -> None:
    """Of the accelerometer and of the gyro beside it."""
    warming = TURNING.model_copy(update={"temperature": Warming(rise_k=15.0, time_constant_s=30.0)})
    _assert_consistent(replace_scenario(warming, rest_s=1.5, **AT_50), range(24))


def _counted(rests: int, seed: int) -> tuple[float, int]:
    """NEES of K and b from so many rests of an accelerometer in counts, whose noise nobody states."""
    simulated = _simulated(replace_scenario(RESTING, attitudes=rests, magnetometer=None), seed)
    counts = replace(simulated.data, accel=1671.0 * simulated.data.accel, accel_density=None)
    estimate = solve_batch(TUMBLE.problem(counts, load_config(simulated.config.encode())))
    truth = {name: value / 1671.0 if "_k" in name else value for name, value in simulated.truth.items()}
    own = {name: value for name, value in truth.items() if name[:7] in ("accel_k", "accel_b")}
    rows = [i for i, name in enumerate(estimate.names) if name in own]
    error = estimate.values[rows] - np.array([own[estimate.names[i]] for i in rows])
    return float(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error)), len(rows)


def _at_rests(scenario: TumbleScenario, seed: int, size: float = 0.0, step: float = 0.0) -> Simulated:
    """Accelerometer that reads something else by `size` at every rest, in steps, m/s^2; nobody states so."""
    simulated = _simulated(scenario, seed)
    data, config = simulated.data, load_config(simulated.config.encode())
    assert data.accel is not None
    assert data.accel_t is not None
    spans = static_rests(data, config)
    assert spans is not None
    error = size * np.random.default_rng(seed).standard_normal((len(spans), 3))
    accel = data.accel + error[np.searchsorted(0.5 * (spans[1:, 0] + spans[:-1, 1]), data.accel_t)]
    accel = step * np.round(accel / step) if step else accel
    unstated = simulated.config.replace("accel_repeatability: 0.0", "accel_repeatability: null")
    return replace(simulated, data=replace(data, accel=accel, accel_density=None), config=unstated)


@pytest.mark.parametrize(("size", "step"), [(3e-2, 0.0), (0.0, 0.05), pytest.param(3e-3, 0.0, marks=pytest.mark.slow)])
def test_rests_that_repeat_worse_than_white_noise_are_consistent(size: float, step: float) -> None:
    """White noise of their means is 1 mm/s^2; a good part of the rests was rejected for it."""
    total, dof, rejected = 0.0, 0, 0
    for seed in range(16):
        simulated = _at_rests(replace_scenario(RESTING, magnetometer=None), seed, size, step)
        estimate = _solved(simulated)
        error, covariance = _errors(estimate, simulated.truth)
        total += float(error @ np.linalg.solve(covariance, error))
        dof += len(error)
        rejected += sum(estimate.rejected.values())
    assert quantile(0.005, dof) < total < quantile(0.995, dof), f"NEES {total:.1f} for {dof}"
    assert not rejected


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.4, 1.0])
def test_error_of_readings_in_steps_is_what_noise_leaves_of_it(noise: float) -> None:
    step, rng, t = 0.05, np.random.default_rng(0), np.arange(0.0, 400.0, 0.02)
    exact = 9.8 * _directions(200, rng)
    samples = np.repeat(exact, 100, axis=0) + noise * step * rng.standard_normal((len(t), 3))
    raw = step * np.round(samples / step)
    common = (raw - samples).reshape(200, 100, 3).mean(axis=1)
    # What is new in every sample averages out, but for a tenth.
    left = 0.1 * (raw - samples).reshape(200, 100, 3).std(axis=1).mean()
    found = quantisation(t, raw, np.stack([t[::100], t[99::100]], axis=1))
    assert np.hypot(found, left) == pytest.approx(np.sqrt((common**2).mean()), abs=0.02 * step)


def test_bias_of_readings_in_counts_is_shown_in_counts() -> None:
    """A bias in g printed as mg/9.8, before: the unit m/s^2/count has two slashes."""
    simulated = _simulated(replace_scenario(RESTING, magnetometer=None), 1)
    assert simulated.data.accel is not None
    in_g = replace(simulated, data=replace(simulated.data, accel=simulated.data.accel / 9.80665, accel_density=None))
    calibration = Session.of(TUMBLE, in_g).calibrate(report=False)
    (card,) = result_cards(calibration)
    scale, *_, bias = card.groups
    K, b = triad_of("accel", calibration.values)
    assert (scale.title, scale.unit, bias.unit) == ("Scale", "counts/g", "counts")
    counts = 9.80665 / np.linalg.norm(np.linalg.inv(K), axis=1) ** -1
    assert [row.value for row in scale.rows] == pytest.approx(counts.tolist())
    assert [row.value for row in bias.rows] == pytest.approx((-np.linalg.solve(K, b)).tolist())
    assert any("if it is in g, state `units: {accel: g}`" in note for note in calibration.notes)


@pytest.mark.parametrize("rests", [10, pytest.param(12, marks=pytest.mark.slow)])
def test_few_rests_in_counts_are_consistent(rests: int) -> None:
    """One residual or three say little of the noise: what lengths scatter by within the rests does."""
    total, dof = np.sum([_counted(rests, seed) for seed in range(16)], axis=0)
    assert quantile(0.005, dof) < total < quantile(0.995, dof), f"NEES {total:.1f} for {dof:.0f}"


def test_a_gyro_makes_few_attitudes_enough() -> None:
    """Within 10 deg of level the field's length tells K to 17 %, its direction beside a gyro to 1.3 %."""
    narrow = replace_scenario(TURNING, tilt_deg=10.0, accelerometer=None)
    simulated = _simulated(narrow, 1)
    beside, alone = (
        solve_batch(TUMBLE.problem(data, load_config(simulated.config.encode())))
        for data in (simulated.data, replace(simulated.data, gyro_t=None, gyro=None))
    )
    sigmas = [dict(zip(each.names, each.sigmas, strict=True))["mag_k33"] for each in (beside, alone)]
    assert sigmas[0] < 0.15 * sigmas[1]
    error, covariance = _errors(beside, simulated.truth)
    assert np.abs(error / np.sqrt(np.diag(covariance))).max() < 4.0


@pytest.mark.slow
def test_the_incremental_solver_agrees_beside_a_gyro() -> None:
    session = Session.of(TUMBLE, _simulated(replace_scenario(TURNING, attitudes=12), 3))
    batch, step_by_step = solve_batch(session.problem()), solve_incremental(session.problem(), 1.0)
    assert np.abs((step_by_step.values - batch.values) / np.maximum(batch.sigmas, 1e-12)).max() < 1.0


@pytest.mark.parametrize("accelerometer", [pytest.param(None, marks=pytest.mark.slow), {"rate_hz": 50.0}])
def test_gyro_at_an_unknown_place_is_consistent(accelerometer: dict[str, float] | None) -> None:
    """The earth's rate is a parameter with a prior of its size; without an accelerometer the field defines y."""
    scenario = replace_scenario(TURNING, latitude_deg=None, attitudes=12)
    _assert_consistent(scenario.model_copy(update={} if accelerometer else {"accelerometer": None}), range(2))


def _compass_error_deg(motion: str, seconds: float, seed: int, config: Config) -> float:
    recording = compass.drawn(compass.MOTIONS[motion], seconds, seed)
    return recording.angle_rms_deg(compass.by_tumble(recording, config))


def test_slow_gyro_of_little_motion_is_used() -> None:
    """10 Hz, tilts of 5 deg: an ellipsoid alone is 7 to 22 deg off."""
    assert _compass_error_deg("middle", 120.0, 0, Config()) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("motion", compass.MOTIONS)
def test_compass_error_of_three_motions(motion: str) -> None:
    """.11 to .24, .29 to .36 and .15 to .24 deg; .05 to .24 with the gyro that MAGYC assumes, which has 1.5 to 7.5."""
    for config, most in ((Config(), 0.37), (compass.PERFECT, 0.25)):
        errors = [_compass_error_deg(motion, 600.0, seed, config) for seed in range(3)]
        assert max(errors) <= most, errors


@pytest.mark.parametrize("seconds", [60.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_heading_that_nothing_determines_is_fixed(seconds: float) -> None:
    """Free but for its prior it trades with the earth's rate: 63 iterations had no minimum where 3 do."""
    data = compass.drawn(compass.MOTIONS["middle"], seconds, 0).data
    estimate = solve_batch(TUMBLE.problem(data, Config()))
    assert estimate.converged
    assert int(re.findall(r"\d+", estimate.message)[0]) <= 6
    found = dict(zip(estimate.names, zip(estimate.values, estimate.sigmas, strict=True), strict=True))
    # The gyro's samples are means up to their stamps.
    assert found["mag_delay"][0] == pytest.approx(0.05, abs=4.0 * found["mag_delay"][1])


def test_a_gyro_that_does_not_turn_with_the_field_is_not_used() -> None:
    simulated = _simulated(replace_scenario(TURNING, accelerometer=None), 0)
    assert simulated.data.gyro is not None
    backwards = replace(simulated.data, gyro=simulated.data.gyro[::-1])
    assert "does not turn as the field does" in " ".join(TUMBLE.problem(backwards, Config()).premises)


def test_an_accelerometer_that_moved_upright_is_left_out_beside_a_gyro_that_is_not_used() -> None:
    """Its samples count as at rest then, and what the hand adds to them turned K by half."""
    simulated = _simulated(TURNING, 0)
    assert simulated.data.gyro is not None
    assert simulated.data.accel is not None
    swung = [0.0, 0.0, 9.81] + np.random.default_rng(0).standard_normal(simulated.data.accel.shape)
    backwards = replace(simulated.data, gyro=simulated.data.gyro[::-1], accel=swung)
    problem = TUMBLE.problem(backwards, Config())
    assert "The accelerometer is left out" in " ".join(problem.premises)
    assert "accel_k11" not in [quantity.name for quantity in problem.quantities]


def test_a_gyro_in_degrees_is_not_used_and_that_is_told(tmp_path: Path) -> None:
    simulated = _simulated(TURNING, 0)
    assert simulated.data.gyro is not None
    TUMBLE.write(tmp_path / "s.mcap", replace(simulated, data=replace(simulated.data, gyro=57.3 * simulated.data.gyro)))
    session = Session.read(open_recording(tmp_path / "s.mcap"), "tumble", None)
    assert "is it in deg/s, or in counts?" in " ".join(session.problem().premises)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "named"),
    [
        ([[1, 0, 0], [0, -1, 0], [0, 0, 1]], True),
        ([[0, 1, 0], [1, 0, 0], [0, 0, 1]], True),
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], False),
    ],
)
def test_an_accelerometer_of_other_axes_is_calibrated_beside_a_gyro(axes: list[list[int]], named: bool) -> None:
    """One axis inverted, two swapped: left-handed, and named; turned by half a turn: right-handed."""
    simulated, P = _simulated(TURNING, 2), np.array(axes, dtype=float)
    assert simulated.data.accel is not None
    data = replace(simulated.data, accel=simulated.data.accel @ P.T)
    calibration = Session.of(TUMBLE, replace(simulated, data=data)).calibrate(report=False)
    names = [f"accel_k{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    K = np.array([simulated.truth[name] for name in names]).reshape(3, 3) @ P.T
    at = [calibration.estimate.names.index(name) for name in names]
    error = calibration.estimate.values[at] - K.ravel()
    assert np.abs(error / calibration.estimate.sigmas[at]).max() < 4.0
    assert ("the accelerometer's axes are left-handed" in " ".join(calibration.notes)) == named


def test_left_handed_axes_are_told_beside_a_gyro() -> None:
    simulated = _simulated(replace_scenario(TURNING, rest_s=1.5), 2)
    assert simulated.data.mag is not None
    mirrored = replace(simulated.data, mag=simulated.data.mag * np.array([1.0, 1.0, -1.0]))
    problem = TUMBLE.problem(mirrored, load_config(simulated.config.encode()))
    assert "left-handed" in " ".join(problem.premises)
    estimate = solve_batch(problem)
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    assert values["mag_k33"] == pytest.approx(-simulated.truth["mag_k33"], abs=0.02)


def _in_counts(scenario: TumbleScenario, seed: int) -> Simulated:
    """Magnetometer of 10 nT a count that states no noise."""
    simulated = _simulated(scenario, seed)
    assert simulated.data.mag is not None
    data = replace(simulated.data, mag=simulated.data.mag / 1e-8, mag_density=None)
    return replace(simulated, data=data, config="method: tumble\n")


def _directions(count: int, rng: np.random.Generator) -> Array:
    vectors = rng.standard_normal((count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _with_outliers(simulated: Simulated, kind: str) -> Simulated:
    rng, mag = np.random.default_rng(0), simulated.data.mag
    assert mag is not None
    mag = mag.copy()
    if kind == "error codes":
        mag[rng.choice(len(mag), 10, replace=False)] = -32768.0
    else:
        bad = rng.random(len(mag)) < 0.05
        mag[bad] += 30.0 * 4500.0 * _directions(int(bad.sum()), rng)
    return replace(simulated, data=replace(simulated.data, mag=mag))


@pytest.mark.parametrize(
    ("kind", "scenario"),
    [
        ("error codes", BRIEF),
        ("5 % at 30 radii", BRIEF),
        ("5 % at 30 radii", replace_scenario(TURNING, accelerometer=None)),
    ],
)
def test_outliers_of_a_magnetometer_in_counts_are_rejected(kind: str, scenario: TumbleScenario) -> None:
    clean = _in_counts(replace_scenario(scenario, latitude_deg=None), 1)
    found, expected = (
        Session.of(TUMBLE, each).calibrate(report=False) for each in (_with_outliers(clean, kind), clean)
    )
    assert (found.status, found.estimate.names) == (expected.status, expected.estimate.names)
    off = (found.estimate.values - expected.estimate.values)[:9] / expected.estimate.sigmas[:9]
    assert np.abs(off).max() < 1.0


@pytest.mark.parametrize("resting", [0, 20])
def test_first_guess_is_that_of_the_readings_without_outliers(resting: int) -> None:
    """And distant readings of a recording that is mostly at rest are none: 95 % of it in one attitude."""
    rng = np.random.default_rng(0)
    directions = _directions(500, rng)
    raw = [300.0, -200.0, 100.0] + 400.0 * np.concatenate([directions, np.tile(directions[:1], (500 * resting, 1))])
    raw += rng.standard_normal(raw.shape)
    if not resting:
        raw[::20] = -32768.0
    S, centre = first_guess(raw, None, 10.0)
    np.testing.assert_allclose(400.0 * S, np.eye(3), atol=0.02)
    np.testing.assert_allclose(centre, [300.0, -200.0, 100.0], atol=8.0)


def test_much_noise_biases_an_algebraic_ellipsoid_and_not_the_graph() -> None:
    # 4 % of the field in each sample: what the mean length has too much is 0.16 % of it.
    loud = replace_scenario(
        BRIEF,
        magnetometer={"density": 5e-7, "rate_hz": 20.0},
        field_error=0.0,
        attitudes=60,
        priors={"field_strength": 0.0},
    )
    sums = {"graph": 0.0, "published": 0.0}
    sigma = 0.0
    for seed in range(5):
        simulated = _simulated(loud, seed)
        session = Session.of(TUMBLE, simulated)
        problem = session.problem()
        found = {
            "graph": solve_batch(problem),
            "published": TUMBLE.published(session.data, session.config, problem),
        }
        for name, estimate in found.items():
            gains = dict(zip(estimate.names, estimate.values, strict=True))
            true = sum(simulated.truth[f"mag_k{i}{i}"] for i in "123")
            sums[name] += sum(gains[f"mag_k{i}{i}"] for i in "123") / true - 1.0
        graph = found["graph"]
        rows = [graph.names.index(f"mag_k{i}{i}") for i in "123"]
        sigma += float(graph.covariance[np.ix_(rows, rows)].sum()) / 9.0
    assert abs(sums["graph"]) < 3.0 * sigma**0.5
    assert sums["published"] < -10.0 * sigma**0.5


def test_few_directions_are_told_and_not_guessed() -> None:
    """A device that stays within 20 deg of level sees a strip of the ellipsoid."""
    narrow = replace_scenario(BRIEF, tilt_deg=20.0)
    simulated = _simulated(narrow, 1)
    calibration = Session.of(TUMBLE, simulated).calibrate()
    assert calibration.status in ("weak", "unobservable")
    error = calibration.estimate.values - np.array([simulated.truth[n] for n in calibration.estimate.names])
    assert np.abs(error / calibration.estimate.sigmas).max() < 4.0
    (row,) = calibration.tables["coverage"]
    assert "turn it there too" in str(row["says"])


def test_the_incremental_solver_agrees() -> None:
    session = Session.of(TUMBLE, _simulated(BRIEF, 3))
    batch, step_by_step = solve_batch(session.problem()), solve_incremental(session.problem(), 1.0)
    assert np.abs((step_by_step.values - batch.values) / batch.sigmas).max() < 0.3
    np.testing.assert_allclose(step_by_step.sigmas, batch.sigmas, rtol=0.1)


def test_a_recording_gives_the_data_back(tmp_path: Path) -> None:
    simulated = _simulated(RESTING, 0)
    TUMBLE.write(tmp_path / "s.mcap", simulated)
    data: TumbleData = read_tumble(open_recording(tmp_path / "s.mcap"), Config())
    for name in ("mag_t", "mag", "accel", "latitude", "longitude"):
        np.testing.assert_allclose(getattr(data, name), getattr(simulated.data, name), rtol=1e-12, atol=1e-15)
    assert data.mag_density == pytest.approx(simulated.data.mag_density, rel=1e-6)


def test_readings_that_a_logger_repeats_are_used_once(tmp_path: Path) -> None:
    data = _simulated(replace_scenario(TURNING, attitudes=3), 5).data
    repeated = replace(data, **{name: np.repeat(getattr(data, name), 3, axis=0) for name in ("gyro", "accel")})
    t = data.accel_t[:, None] + np.linspace(0.0, 0.02, 3, endpoint=False)
    write_session(tmp_path / "s.mcap", tumble_topics(replace(repeated, accel_t=t.ravel(), gyro_t=t.ravel())), {})
    back = read_tumble(open_recording(tmp_path / "s.mcap"), Config())
    for name in ("gyro", "gyro_t", "accel", "accel_t"):
        np.testing.assert_allclose(getattr(back, name), getattr(data, name), rtol=1e-12, atol=1e-9)


def test_left_handed_axes_are_told() -> None:
    simulated = _simulated(RESTING, 2)
    mirrored = replace(simulated.data, mag=simulated.data.mag * np.array([1.0, 1.0, -1.0]))
    calibration = Session.of(TUMBLE, replace(simulated, data=mirrored)).calibrate(report=False)
    assert "left-handed" in calibration.headline + " ".join(calibration.notes)
    values = dict(zip(calibration.estimate.names, calibration.estimate.values, strict=True))
    for i in "123":
        error = values[f"mag_k{i}3"] + simulated.truth[f"mag_k{i}3"]
        assert abs(error) < 4.0 * calibration.parameters[f"mag_k{i}3"].sigma


@pytest.mark.parametrize("beside_a_gyro", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_accelerometer_that_shows_gravity_down_is_told_and_the_magnetometer_keeps_its_signs(
    beside_a_gyro: bool,
) -> None:
    simulated = _simulated(replace_scenario(TURNING, rest_s=1.5) if beside_a_gyro else RESTING, 2)
    data = replace(simulated.data, accel=-simulated.data.accel)
    calibration = Session.of(TUMBLE, replace(simulated, data=data)).calibrate(report=False)
    assert calibration.status == "calibrated"
    assert "shows gravity down" in " ".join(calibration.notes)
    found = calibration.parameters
    for name, sign in {
        f"{sensor}_k{i}{i}": sign for sensor, sign in (("accel", -1.0), ("mag", 1.0)) for i in "123"
    }.items():
        assert abs(found[name].value - sign * simulated.truth[name]) < 4.0 * found[name].sigma, name
    assert found["field_dip"].value == pytest.approx(simulated.truth["field_dip"], abs=4.0 * found["field_dip"].sigma)


def test_a_field_that_rises_at_an_unknown_place_is_told() -> None:
    simulated = _simulated(RESTING, 2)
    nowhere = replace(simulated.data, latitude=None, longitude=None)
    for sign in (1.0, -1.0):
        assert nowhere.accel is not None
        problem = TUMBLE.problem(replace(nowhere, accel=sign * nowhere.accel), Config())
        assert ("The field rises" in " ".join(problem.premises)) == (sign < 0.0)


def test_a_magnetometer_on_other_axes_is_turned_into_those_of_the_accelerometer() -> None:
    simulated = _simulated(RESTING, 4)
    turned = so3.exp(np.array([np.pi, 0.0, 0.0]))
    calibration = Session.of(
        TUMBLE, replace(simulated, data=replace(simulated.data, mag=so3.rotate(turned, simulated.data.mag)))
    ).calibrate(report=False)
    assert calibration.status == "calibrated"
    K = np.array([[calibration.parameters[f"mag_k{i}{j}"].value for j in "123"] for i in "123"])
    true = np.array([[simulated.truth[f"mag_k{i}{j}"] for j in "123"] for i in "123"]) @ so3.matrix(turned).T
    np.testing.assert_allclose(K, true, atol=0.01)


def _write(path: Path, data: TumbleData, mag: bool = True, accel: bool = True) -> None:
    topics: dict[str, series.Topic] = {}
    if mag and data.mag is not None and data.mag_t is not None:
        topics["/mag"] = series.MagneticSeries(nanoseconds(data.mag_t, data.epoch_ns), data.mag)
    if accel and data.accel is not None and data.accel_t is not None:
        still = np.zeros((len(data.accel_t), 3))
        topics["/imu"] = series.ImuSeries(nanoseconds(data.accel_t, data.epoch_ns), still, data.accel)
    write_session(path, topics, {})


def test_the_command_finds_it_by_itself_and_says_what_there_is(tmp_path: Path, alidade: Command) -> None:
    _write(tmp_path / "phone.mcap", _simulated(RESTING, 1).data)
    assert "tumble: yes" in alidade("info", tmp_path / "phone.mcap").out
    run = alidade("calibrate", tmp_path / "phone.mcap", "--out", tmp_path / "out")
    assert run.code == 0
    assert "field's strength is unknown, and K and b are in units of it" in run.out.replace("\n", " ")
    yaml = (tmp_path / "out" / "calibration.yaml").read_text()
    assert "hard iron" in yaml
    assert "* mag + [mag_b1, mag_b2, mag_b3]" in yaml
    assert (tmp_path / "out" / "report.html").read_text().count("Directions covered by the") == 2


def test_an_accelerometer_alone_if_asked_for(tmp_path: Path) -> None:
    simulated = _simulated(RESTING, 5)
    _write(tmp_path / "s.mcap", simulated.data, mag=False)
    with pytest.raises(InputError, match="topics alone do not select a method; use --method cube or --method tumble"):
        Session.read(open_recording(tmp_path / "s.mcap"), None, None)
    calibration = Session.read(open_recording(tmp_path / "s.mcap"), "tumble", None).calibrate(report=False)
    for name, parameter in calibration.parameters.items():
        if name.startswith("accel"):
            assert abs(parameter.value - simulated.truth[name]) < 4.0 * parameter.sigma, name
            # Gravity is known to 2e-3 where the latitude is not.
            assert parameter.sigma > 1e-3 or not name.endswith(("11", "22", "33"))


@pytest.mark.parametrize("stated", [5e-8, 5e-7, None])
def test_a_magnetometer_that_did_not_turn_is_refused(stated: float | None) -> None:
    data: TumbleData = _simulated(BRIEF, 0).data
    assert data.mag is not None
    rest = [2e-5, 0.0, -4e-5] + 1e-7 * np.random.default_rng(0).standard_normal(data.mag.shape)
    with pytest.raises(InputError, match=r"topic /mag: the device did not turn, .*; turn it slowly through all"):
        TUMBLE.problem(replace(data, mag=rest, mag_density=stated), Config())


def test_turns_within_the_noise_that_is_stated_are_none() -> None:
    """Readings of many attitudes become one where messages state ten times as much noise as these are apart."""
    data: TumbleData = _simulated(BRIEF, 0).data
    assert data.mag is not None
    nearly = data.mag.mean(axis=0) + 0.05 * (data.mag - data.mag.mean(axis=0))
    with pytest.raises(InputError, match="topic /mag: the device did not turn"):
        TUMBLE.problem(replace(data, mag=nearly, mag_density=5e-6), Config())


@pytest.mark.parametrize("scenario", [RESTING, TURNING])
def test_an_accelerometer_that_did_not_turn_is_left_out(scenario: TumbleScenario) -> None:
    data: TumbleData = _simulated(scenario, 0).data
    assert data.accel is not None
    rest = [0.0, 0.0, 9.81] + 1e-2 * np.random.default_rng(0).standard_normal(data.accel.shape)
    problem = TUMBLE.problem(replace(data, accel=rest), Config())
    assert "The accelerometer is left out" in " ".join(problem.premises)
    assert "accel_k11" not in [quantity.name for quantity in problem.quantities]
    with pytest.raises(InputError, match="topic /imu: the device did not turn"):
        TUMBLE.problem(replace(data, accel=rest, mag=None, mag_t=None), Config())


@pytest.mark.parametrize("size", [1.0, 16384.0 / 9.81])
def test_accelerometer_at_rest_is_refused_in_counts_too(size: float) -> None:
    """In counts the ellipsoid through its noise did not converge."""
    data: TumbleData = _simulated(RESTING, 0).data
    assert data.accel is not None
    rest = size * ([-0.1, -0.5, 9.8] + 4e-2 * np.random.default_rng(0).standard_normal(data.accel.shape))
    with pytest.raises(InputError, match="topic /imu: the device did not turn"):
        TUMBLE.problem(replace(data, accel=rest, accel_density=None, mag=None, mag_t=None), Config())


def test_other_methods_go_first(tmp_path: Path) -> None:
    t = T0 + np.arange(0, 10**9, 10**7)
    still, zeros = np.zeros((100, 3)), np.zeros((100, 2))
    topics: dict[str, series.Topic] = {"/mag": series.MagneticSeries(t, still)}
    write_session(tmp_path / "alone.mcap", topics, {})
    assert resolve_method(None, open_recording(tmp_path / "alone.mcap"), Config()) == "tumble"
    topics["/imu"] = series.ImuSeries(t, still)
    topics["/indexer/joint_states"] = series.JointSeries(t, zeros, ("outer_x", "inner_z"))
    write_session(tmp_path / "turns.mcap", topics, {})
    assert resolve_method(None, open_recording(tmp_path / "turns.mcap"), Config(latitude_deg=40.0)) == "indexer"


def test_whoever_turns_it_is_told_where_to() -> None:
    narrow = _simulated(replace_scenario(RESTING, tilt_deg=60.0), 0)
    items = {item.what: item for item in TUMBLE.guidance.checklist(narrow.data, Config())}
    # Up never came near -z.
    assert re.match(r"rest it with this side up: -z", items["sides up"].wanted)
    whole = _simulated(replace_scenario(BRIEF, attitudes=60), 0)
    assert [item.wanted for item in TUMBLE.guidance.checklist(whole.data, Config())] == [""]


def test_a_plan_that_falls_short_turns_it_upside_down(tmp_path: Path) -> None:
    (tmp_path / "narrow.yaml").write_text("{attitudes: 20, tilt_deg: 25.0, magnetometer: {rate_hz: 10.0}}")
    plan = alidade.plan("tumble", str(tmp_path / "narrow.yaml"), most_steps=1)
    assert plan.now.missing
    assert [step.change for step in plan.steps] == ["turned upside down too"]
    assert not plan.best.missing


def test_too_little_is_an_input_error(tmp_path: Path) -> None:
    data = _simulated(BRIEF, 0).data
    few = replace(data, mag_t=data.mag_t[:8], mag=data.mag[:8])
    with pytest.raises(InputError, match="mag: 8 readings, at least 10"):
        TUMBLE.problem(few, Config())
    write_session(tmp_path / "n.mcap", {"/other": series.MagneticSeries(np.arange(9), np.ones((9, 3)))}, {})
    with pytest.raises(InputError, match="neither /mag"):
        Session.read(open_recording(tmp_path / "n.mcap"), "tumble", None)


def test_the_mean_of_points_of_an_ellipsoid_lies_inside_it() -> None:
    rng = np.random.default_rng(5)
    K, b = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=3)
    numbers = np.concatenate([K.ravel(), b])
    about = rng.normal(size=(20, 1, 3)) + 0.05 * rng.normal(size=(20, 400, 3))
    points = np.linalg.solve(K, (about / np.linalg.norm(about, axis=-1, keepdims=True) - b)[..., None])[..., 0]
    means = points.mean(axis=1)
    apart = points - means[:, None]
    scatter = np.einsum("nki,nkj->nij", apart, apart) / 400
    distance = StrengthFactor(np.arange(20.0), means, np.ones(20), np.zeros(20), symmetric=False)
    inside = -distance(np.tile(numbers, (20, 1)), np.ones((20, 1)))[0][:, 0]
    np.testing.assert_allclose(sagitta(means, scatter, numbers), inside, rtol=0.03)


SECOND = TumbleScenario(attitudes=20, rest_s=1.0, gyro=TumbledGyro(), accelerometer=TumbledAccelerometer())


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_rests_of_a_second_are_found_and_turning_points_are_none(seed: int) -> None:
    for rest_s, found in ((1.0, True), (0.0, False)):
        simulated = _simulated(replace_scenario(SECOND, rest_s=rest_s), seed)
        model = prepare(simulated.data, load_config(simulated.config.encode()))
        assert model.sensors[0].rested is found
        assert not found or len(model.sensors[0].time) == 20


def test_slow_turns_that_look_like_rests_are_none() -> None:
    """A dozen, in each of which gravity turned by degrees: errors of a hundred sigmas."""
    simulated = _simulated(
        TumbleScenario(
            attitudes=20,
            turn_rad_s=0.2,
            magnetometer=TumbledMagnetometer(rate_hz=20.0),
            accelerometer=TumbledAccelerometer(rate_hz=50.0, density=0.015),
        ),
        0,
    )
    assert static_rests(simulated.data, load_config(simulated.config.encode())) is None
    error, covariance = _errors(_solved(simulated), simulated.truth)
    assert np.abs(error / np.sqrt(np.diag(covariance))).max() < 4.0


@pytest.mark.parametrize("seed", [3, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_nothing_changed_in_a_clean_recording_with_rests_of_a_second(seed: int) -> None:
    simulated = _simulated(replace_scenario(SECOND, **AT_50), seed)
    calibration = Session.of(TUMBLE, simulated).calibrate(report=False)
    assert calibration.status == "calibrated"
    found = {name: each for name, each in calibration.parameters.items() if each.sigma}
    off = [(found[name].value - true) / found[name].sigma for name, true in simulated.truth.items() if name in found]
    assert np.abs(off).max() < 4.0


def test_gyro_clipped_at_its_range_is_noticed(tmp_path: Path) -> None:
    """Scale errors of -7.7 % were blamed."""
    simulated = _simulated(replace_scenario(SECOND, **AT_50), 2)
    clipped = replace(simulated.data, gyro=np.clip(simulated.data.gyro, -2.0, 2.0))
    TUMBLE.write(tmp_path / "s.mcap", replace(simulated, data=clipped))
    calibration = Session.read(open_recording(tmp_path / "s.mcap"), "tumble", None).calibrate(report=False)
    assert calibration.status == "calibrated"
    assert re.search("saturated: [0-9]+ samples left out", " ".join(calibration.notes))
    for axis in "xyz":
        found = calibration.parameters[f"gyro_scale_{axis}"]
        assert abs(found.value - simulated.truth[f"gyro_scale_{axis}"]) < 4.0 * found.sigma


@pytest.mark.parametrize(
    ("seed", "subtracted", "rest_s", "step"),
    [
        pytest.param(1, 0.3, 1.0, 0.0, marks=pytest.mark.slow),
        (2, 0.3, 0.0, 1.0 / 16.4),
        *(
            pytest.param(seed, subtracted, rest_s, step, marks=pytest.mark.slow)
            for seed in (3, 4)
            for subtracted in (0.0, 0.3)
            for rest_s in (0.0, 1.0)
            for step in (0.0, 1.0 / 16.4)
        ),
        *(pytest.param(seed, 1.0, 0.0, 0.0, marks=pytest.mark.slow) for seed in (1, 2)),
    ],
)
def test_gyro_that_subtracts_its_dead_band(seed: int, subtracted: float, rest_s: float, step: float) -> None:
    """Unnoticed, .3 deg/s put gyro_scale 19 to 33 sigmas off, gyro_bias 14 with rests; 1/16.4 deg/s is a usual step."""
    simulated = _simulated(replace_scenario(SECOND, rest_s=rest_s), seed)
    gyro, band = simulated.data.gyro, np.deg2rad(subtracted)
    left = np.where(np.abs(gyro) < max(band, np.deg2rad(0.3)), 0.0, gyro - band * np.sign(gyro))
    left = np.round(left / np.deg2rad(step)) * np.deg2rad(step) if step else left
    calibration = Session.of(TUMBLE, replace(simulated, data=replace(simulated.data, gyro=left))).calibrate(
        report=False
    )
    assert calibration.status == "calibrated"
    assert "The gyro has a dead band" in " ".join(calibration.notes)
    found = {name: each for name, each in calibration.parameters.items() if each.sigma}
    truth = {**simulated.truth, "gyro_dead_band": band}
    off = {name: abs(found[name].value - true) / found[name].sigma for name, true in truth.items() if name in found}
    assert "gyro_dead_band" in off
    assert max(off.values()) < 4.0
    assert found["gyro_dead_band"].sigma < 1e-3


@pytest.mark.parametrize("step", [0.0, 1.0 / 131.0, 1.0 / 16.4, 0.3])
@pytest.mark.parametrize("rest_s", [0.0, 1.0])
def test_gyro_that_counts_has_no_dead_band(step: float, rest_s: float) -> None:
    data = _simulated(replace_scenario(SECOND, rest_s=rest_s), 1).data
    read = np.round(data.gyro / np.deg2rad(step)) * np.deg2rad(step) if step else data.gyro
    assert dead_band(data.gyro_t, read)[0] == 0.0


def test_a_rest_counts_as_one_attitude() -> None:
    data = _simulated(TumbleScenario(attitudes=4, rest_s=3.0), 1).data
    (sensor,) = prepare(data, Config.model_validate({"noise": {"mag_density": 5e-8}})).sensors
    means = unturned(sensor)
    assert len(means.raw) < 0.1 * len(sensor.raw)
    # ... and no sample counts for more or less than before.
    assert (means.sigma**-2.0).sum() == pytest.approx((sensor.sigma**-2.0).sum())
    # An outlier stays alone, and does not pull the others with it.
    rest = int(np.argmax(means.sigma**-2.0))
    row = int(np.searchsorted(sensor.time, means.time[rest]))
    raw = sensor.raw.copy()
    raw[row] += 0.2 * sensor.radius
    spoiled = unturned(replace(sensor, raw=raw))
    assert spoiled.sigma[np.flatnonzero(spoiled.time == sensor.time[row])] == pytest.approx(sensor.sigma[row])
    # Where nobody states the noise, what scatters may be motion.
    (sensor,) = prepare(replace(data, mag_density=None), Config()).sensors
    assert unturned(sensor) is sensor


def test_the_figures_of_a_published_example(tmp_path: Path) -> None:
    """MATLAB's reference page of magcal: points on an ellipsoid of which it says a field strength of 31.0723."""
    centre, axes = np.array([-50.0, 20.0, 100.0]), np.array([30.0, 20.0, 50.0])
    around, up = np.meshgrid(np.linspace(-np.pi, np.pi, 21), np.linspace(-0.5 * np.pi, 0.5 * np.pi, 21))
    unit = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1).reshape(-1, 3)
    rows = [f"{0.02 * k:.2f},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate((centre + axes * unit).tolist())]
    (tmp_path / "mag.csv").write_text("\n".join(["t,x,y,z", *rows]))
    config = Config.model_validate({"columns": {"/mag": {"time": "t", "field": ["x", "y", "z"]}}})
    estimate = Session.read(open_recording(tmp_path / "mag.csv"), None, config).calibrate(report=False).estimate
    K, b, _ = _centre_with_sigmas(estimate)
    assert np.linalg.det(K) ** (-1.0 / 3.0) == pytest.approx(31.0723, abs=5e-5)
    np.testing.assert_allclose(-np.linalg.solve(K, b), centre, atol=1e-4)
    np.testing.assert_allclose(np.linalg.inv(K), np.diag(axes), atol=1e-4)


def test_a_real_magnetometer_alone() -> None:
    """ICM-20948 counts, tumbled by hand indoors: the published centre to 0.2 % of the field, and within its sigmas."""
    path = _shared("icm20948") / "mag3_raw.csv"
    calibration = Session.read(*_concluded(path)).calibrate(report=False)
    assert calibration.method.name == "tumble"
    K, b, spread = _centre_with_sigmas(calibration.estimate)
    centre = -np.linalg.solve(K, b)
    published = np.array([9955.15, -7948.26, 8511.80])
    radius = np.linalg.det(K) ** (-1.0 / 3.0)
    assert np.linalg.norm(centre - published) < 2e-3 * radius
    assert np.all(np.abs(centre - published) < 3.0 * spread)
    # Soft iron as published, for a sphere of 1000, within sigmas and to 0.2 %.
    soft = np.array([[0.25060, 0.02942, -0.02955], [0.02942, 0.31692, 0.00789], [-0.02955, 0.00789, 0.30592]])
    np.testing.assert_allclose(1e3 * K, soft, atol=7e-4)


def _concluded(path: Path) -> tuple[Recording, None, Config]:
    """A table as a new user opens it."""
    recording, config = with_columns(open_recording(path), Config())
    return recording, None, config


@pytest.mark.parametrize("alone", [True, False])
def test_halves_of_a_real_magnetometer_agree(alone: bool) -> None:
    """Indoors the field varies along the way of the hand: both halves of both takes agree within three sigmas.

    By the autocorrelation of residuals, of which the fit hides half, they were 4.6 sigmas apart.
    """
    folder = _shared("icm20948")
    names = ["mag3_raw.csv"] if alone else ["mag.csv", "acc.csv"]
    mag, *accel = (np.loadtxt(folder / name, delimiter=",") for name in names)
    halves = []
    for rows in (slice(len(mag) // 2), slice(len(mag) // 2, None)):
        t: Array = 0.2 * np.arange(len(mag[rows]), dtype=float)
        data = TumbleData(0, mag_t=t, mag=mag[rows])
        data = replace(data, accel_t=t, accel=accel[0][rows]) if accel else data
        halves.append(Session.of(TUMBLE, Simulated(data, {}, "method: tumble\n")).calibrate(report=False))
    first, second = (half.parameters for half in halves)
    for name in [name for name in first if re.fullmatch("(mag|accel)_[kb][0-9]+", name)]:
        apart = first[name].value - second[name].value
        assert abs(apart) < 3.0 * np.hypot(first[name].sigma, second[name].sigma), name


def test_noise_of_a_coarse_magnetometer_is_as_coloured_as_drawn() -> None:
    """6 % of the field, and axes twice as sensitive as others, as of a QMC5883L turned by hand.

    With noise in the Jacobians, too, it was found correlated over a quarter of the recording, 3000 measurements as one.
    """
    rng, n, a = np.random.default_rng(0), 6000, np.exp(-1.0 / 50.0)
    phase = np.linspace(0.0, 60.0, n)
    attitude = so3.exp(np.stack([3.0 * np.sin(phase), 2.0 * np.cos(0.37 * phase), 2.5 * np.sin(0.61 * phase)], axis=1))
    felt = so3.rotate(so3.inverse(attitude), np.array([0.4, 0.0, 0.9]))
    colour = lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], rng.standard_normal((n + 300, 3)), axis=0)[300:]
    noise = 55.0 * (np.sqrt(0.9) * rng.standard_normal((n, 3)) + np.sqrt(0.1) * colour)
    mag = felt / [0.93e-3, 1.37e-3, 0.62e-3] + [6000.0, -20.0, 3400.0] + noise
    data = TumbleData(0, mag_t=np.linspace(0.0, 0.02 * n, n), mag=mag)
    found = Session.of(TUMBLE, Simulated(data, {}, "method: tumble\n")).calibrate(report=False).estimate
    assert found.colours["magnetometer"] == pytest.approx(1.0 + 2.0 * 0.1 * 50.0, rel=0.4)


def test_one_ring_determines_nothing() -> None:
    """HMC5883L, turned about one axis."""
    path = _shared("reports") / "files" / "ring_mag_sample.txt"
    assert Session.read(*_concluded(path)).calibrate(report=False).status in ("weak", "unobservable")


def _centre_with_sigmas(estimate: Estimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K, b, and the sigmas of the centre -K^-1 b, by differences."""
    names = triad_names("mag", symmetric=True)
    rows = [estimate.names.index(name) for name in names]
    values = estimate.values[rows]

    def centre(numbers: np.ndarray) -> np.ndarray:
        K, b = triad_of("mag", dict(zip(names, numbers.tolist(), strict=True)))
        return -np.linalg.solve(K, b)

    steps = 1e-3 * np.diag(estimate.sigmas[rows])
    J = np.array([(centre(values + s) - centre(values - s)) / (2.0 * s.max()) for s in steps]).T
    spread = np.sqrt(np.diag(J @ estimate.covariance[np.ix_(rows, rows)] @ J.T))
    return *triad_of("mag", dict(zip(names, values.tolist(), strict=True))), spread


def test_a_real_pair_of_accelerometer_and_magnetometer(tmp_path: Path) -> None:
    """The same device's other take: its data sheet says that the magnetometer's y and z are opposite."""
    folder = _shared("icm20948")
    accel, mag = (np.loadtxt(folder / name, delimiter=",") for name in ("acc.csv", "mag.csv"))
    stamps = 200_000_000 * np.arange(len(mag))
    topics: dict[str, series.Topic] = {
        "/imu": series.ImuSeries(stamps, np.zeros_like(accel), accel),
        "/mag": series.MagneticSeries(stamps, mag),
    }
    write_session(tmp_path / "s.mcap", topics, {})
    calibration = Session.read(open_recording(tmp_path / "s.mcap"), None, None).calibrate(report=False)
    K = np.array([[calibration.parameters[f"mag_k{i}{j}"].value for j in "123"] for i in "123"])
    K /= np.cbrt(abs(np.linalg.det(K)))
    np.testing.assert_allclose(K, np.diag([1.0, -1.0, -1.0]), atol=0.04)
    # 16384 counts a g by the data sheet, whose scale is good to 2.5 % or so.
    for i in "123":
        assert calibration.parameters[f"accel_k{i}{i}"].value * 16384.0 == pytest.approx(9.80665, rel=0.03)


def test_a_real_accelerometer_alone() -> None:
    """38 static poses of an ADXL355 against the published calibration, in the axes in which that K is symmetric."""
    path = _shared("openaxes_imu9") / "adxl.mcap"
    calibration, straight = (
        Session.read(open_recording(path), "tumble", Config.model_validate({"latitude_deg": 52.38} | each)).calibrate(
            report=False
        )
        for each in ({}, {"sensors": {"accel": {"square": 0.0, "cube": 0.0}}})
    )
    # Rests of one attitude repeat to 1.3 mm/s^2. A line is off by 3, by attitude: cubic terms, and no square ones.
    for each, scatter in ((calibration, 9e-4), (straight, 2.9e-3)):
        (repeats,) = (level for level in each.estimate.levels if level.noise.beside)
        assert repeats.used == pytest.approx(scatter, rel=0.3)
        assert not any(each.estimate.rejected.values())
        assert each.status == "calibrated"
    for name in ACCEL_CURVATURE[0].names:
        assert abs(calibration.parameters[name].value) < 2.0 * calibration.parameters[name].sigma
    cubes = (calibration.parameters[name] for name in ACCEL_CURVATURE[1].names)
    assert max(abs(each.value) / each.sigma for each in cubes) > 5.0
    scale = 9.8126 / 9.81744
    K = scale * np.array([[0.96276, 0.0015751, -0.00018891], [0.0, 0.96732, 0.000859], [0.0, 0.0, 0.97079]])
    squares, axes = np.linalg.eigh(K.T @ K)
    symmetric = (axes * np.sqrt(squares)) @ axes.T
    b = symmetric @ np.linalg.solve(K, -scale * np.array([0.064447, 0.011034, 0.034253]))
    published = [*symmetric[np.triu_indices(3)], *b]
    for name, value in zip(triad_names("accel", symmetric=True), published, strict=True):
        for each in (calibration, straight):
            assert abs(each.parameters[name].value - value) < 3.0 * each.parameters[name].sigma, name


def test_half_the_attitudes_of_a_real_accelerometer(shared_data: Path) -> None:
    """Rests of half a sphere do not tell cubic terms from offsets: without them they were 3 to 6.5 sigmas off."""
    session = Session.read(open_recording(shared_data / "openaxes_imu9" / "adxl.mcap"), "tumble", None)
    data, whole = session.data, session.calibrate(report=False)
    smooth = uniform_filter1d(data.accel, 100, axis=0)
    for axis, sign in product(range(3), (1.0, -1.0)):
        kept = sign * smooth[:, axis] > -1.0
        half = replace(data, accel_t=data.accel_t[kept], accel=data.accel[kept])
        found = Session.of(TUMBLE, Simulated(half, {}, "")).calibrate(report=False)
        assert found.status in ("calibrated", "weak")
        for name, each in found.parameters.items():
            off = abs(each.value - whole.parameters[name].value)
            assert off <= 2.5 * np.hypot(each.sigma, whole.parameters[name].sigma), (axis, sign, name)


def test_ten_real_rests_by_hand_in_counts(shared_data: Path) -> None:
    """MPU-6050, 16,384 counts per g to 3 %; no rest lies between x and y, so that their cross term hardly shows."""
    session = Session.read(open_recording(shared_data / "suarez_mpu6050" / "cal.mcap"), "tumble", None)
    calibration = session.calibrate("batch", report=False)
    values, sigmas = (
        dict(zip(calibration.estimate.names, each, strict=True))
        for each in (calibration.estimate.values, calibration.estimate.sigmas)
    )
    assert calibration.status == "weak"
    for name in ("accel_k11", "accel_k22", "accel_k33"):
        assert values[name] * 16384.0 / 9.80665 == pytest.approx(1.0, abs=0.03)
    for name in ("accel_k12", "accel_k13", "accel_k23"):
        assert abs(values[name]) < 3.0 * sigmas[name]
    assert sigmas["accel_k12"] > 0.02 * values["accel_k11"]


def test_fewer_real_rests_by_hand_determine_little(shared_data: Path) -> None:
    """Half the recording has seven rests: what lies between is handling, in which |a| is not g, and no data."""
    session = Session.read(open_recording(shared_data / "suarez_mpu6050" / "cal.mcap"), "tumble", None)
    late = session.data.accel_t > session.data.accel_t.mean()
    half = replace(session.data, accel_t=session.data.accel_t[late], accel=session.data.accel[late])
    whole, part = (Session.of(TUMBLE, Simulated(data, {}, "")).calibrate(report=False) for data in (session.data, half))
    assert part.status == "unobservable"
    for name, each in part.parameters.items():
        assert abs(each.value - whole.parameters[name].value) <= 3.0 * each.sigma


@pytest.mark.parametrize("beside", ["", "accel", pytest.param("accel gyro", marks=pytest.mark.slow)])
def test_a_cube_recording_without_all_the_rest(beside: str, tmp_path: Path) -> None:
    """K of the cube's truth up to the rotation that nothing tells here: K'K and the offset of the raw numbers."""
    source = _shared("contract") / "cube_nominal.mcap"
    recording = open_recording(source)
    field = recording.magnetic("/mag")
    topics: dict[str, series.Topic] = {"/mag": series.MagneticSeries(field.t_ns, field.field)}
    if beside:
        imu = recording.imu("/imu")
        gyro = imu.gyro if "gyro" in beside else np.zeros_like(imu.gyro)
        topics["/imu"] = series.ImuSeries(imu.t_ns, gyro, imu.accel)
    write_session(tmp_path / "mag.mcap", topics, {})
    at = {"latitude_deg": 40.0, "longitude_deg": 116.3, "altitude_m": 50.0, "date": "2026-11-20"}
    place = Config.model_validate(at)
    calibration = Session.read(open_recording(tmp_path / "mag.mcap"), None, place).calibrate(report=False)
    truth = json.loads((_shared("contract") / "cube_nominal.truth.json").read_text())
    values = dict(zip(calibration.estimate.names, calibration.estimate.values.tolist(), strict=True))
    for name in ("accel", "mag") if beside else ("mag",):
        (K, b), (true_K, true_b) = triad_of(name, values), triad_of(name, truth)
        np.testing.assert_allclose(np.linalg.solve(K, b), np.linalg.solve(true_K, true_b), atol=0.01 * abs(b).max())
        np.testing.assert_allclose(K.T @ K, true_K.T @ true_K, atol=0.012)
    assert ("gyro_bias_x" in values) == ("gyro" in beside)


@pytest.mark.parametrize("magnetometer", [None, pytest.param({}, marks=pytest.mark.slow)])
def test_an_accelerometer_that_reads_a_square_term_beside_what_it_feels(magnetometer: dict[str, float] | None) -> None:
    """Of 6e-4 at 1 g, which is twice what consumer parts have: left out, offsets were 22 to 30 sigmas off."""
    scenario = {"attitudes": 24, "rest_s": 2.0, "magnetometer": magnetometer}
    bent = TumbleScenario.model_validate(scenario | {"accelerometer": {"square": 6e-5, "density": 3e-4}})
    for seed in (1, 2):
        simulated = _simulated(bent, seed)
        calibration = Session.of(TUMBLE, simulated).calibrate(report=False)
        assert calibration.status == "calibrated"
        for name, each in calibration.parameters.items():
            assert abs(each.value - simulated.truth[name]) <= 4.0 * each.sigma + 1e-12, name


def test_the_formula_of_the_rate_subtracts_g_sensitivity_times_the_calibrated_force() -> None:
    K = np.array([[1.1, 0.02, 0.0], [0.0, 0.9, 0.1], [-0.05, 0.0, 1.0]])
    given = {f"accel_k{i + 1}{j + 1}": float(K[i, j]) for i in range(3) for j in range(3)}
    given |= {f"accel_b{i}": 0.1 for i in "123"}
    given |= dict.fromkeys([*SENSITIVITY.names, *BIAS.names], 0.0) | {"gyro_g_xy": 1e-3, "gyro_bias_x": 0.02}
    force, rate = np.array([[1.0, 9.0, -3.0]]), np.array([[0.1, 0.2, 0.3]])
    inputs = {"accel": (force - 0.1) @ np.linalg.inv(K).T, "gyro": rate + [1e-3 * 9.0 + 0.02, 0.0, 0.0]}
    np.testing.assert_allclose(apply(formulas(given), given, inputs)["w_b"], rate, atol=1e-12)


def test_a_swung_accelerometer_that_turns_about_one_axis_stays_as_it_is() -> None:
    """K and b are not determined; a solution of the least misfit alone was 1 to 10 m/s^2 off."""
    t = np.arange(0.0, 60.0, 0.02)
    generator, rate = np.random.default_rng(3), np.zeros((len(t), 3))
    rate[:, 1] = 0.8 * np.sin(0.5 * t)
    path = GyroPath(t, rate)
    up = so3.rotate(so3.inverse(path.attitude(t)), np.array([0.0, 0.0, 9.8]))
    read = up + [0.3, -0.2, 0.25] + generator.normal(0.0, 0.05, up.shape)
    accel = Seen(t, up / 9.8, read, 9.8, True)
    assert np.abs(calibrated_force(t, accel, path) - up).max() < np.abs(read - up).max() + 0.1


def test_the_formula_takes_the_curvature_off() -> None:
    K, curvature = (f"accel_k{ij}" for ij in ("11", "12", "13", "22", "23", "33")), (e.names for e in ACCEL_CURVATURE)
    given = dict.fromkeys([*K, *chain.from_iterable(curvature), *(f"accel_b{i}" for i in "123")], 0.0)
    given |= {
        "accel_k11": 1.01,
        "accel_k22": 0.99,
        "accel_k33": 1.0,
        "accel_square_1": 4e-5,
        "accel_cube_2": 1e-5,
        "accel_b2": 0.1,
    }
    force = np.array([[9.0, -3.0, 2.0]])
    raw = (force + [4e-5 * 81.0, 1e-5 * -3.0 * (9.0 - 85.1795), 0.0] - [0.0, 0.1, 0.0]) / [1.01, 0.99, 1.0]
    np.testing.assert_allclose(apply(formulas(given), given, {"accel": raw})["f_b"], force, atol=1e-5)
