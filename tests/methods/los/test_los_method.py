"""The los method end to end, on simulated recordings and on an independent simulator's."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.methods.los.parameters import NUISANCE
from alidade.pipelines.methods.los.published import recursive_least_squares
from alidade.pipelines.methods.los.recording import LosData, read_los
from alidade.pipelines.methods.los.simulation import LosAngles, LosNoise, LosScenario, los_config, simulate_los
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config, Noise, Sensors
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.builders import IDEAL
from tests.support.judged import Judged, judge

# Sway swift enough for a short recording.
BRISK = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.31)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.27)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.23)],
)
SHORT = LosScenario(
    duration_s=15.0, carrier=BRISK, image_rate_hz=10.0, gyro_rate_hz=100.0, gimbal_rate_hz=100.0, sensors=IDEAL
)
# The same with errors of the sensors, drawn as their data sheets have them.
REAL = SHORT.model_copy(update={"sensors": Sensors()})


def _config(scenario: LosScenario) -> Config:
    return load_config(los_config(scenario).encode())


def _errors(estimate: Estimate, truth: dict[str, float]) -> Array:
    return np.asarray(estimate.values - [truth[name] for name in estimate.names])


def _nees(estimate: Estimate, truth: dict[str, float]) -> float:
    error = _errors(estimate, truth)
    return float(error @ np.linalg.solve(estimate.covariance, error))


def _assess(data: LosData, config: Config) -> tuple[Estimate, Judged]:
    made = problem(data, config)
    estimate = solve_batch(made)
    return estimate, judge(made.quantities, estimate.covariance, estimate.chi_square, made.advice)


@pytest.mark.parametrize(
    "elevation", [pytest.param(0.0, marks=pytest.mark.slow), 20.0, pytest.param(45.0, marks=pytest.mark.slow)]
)
def test_without_noise_the_angles_come_out_exactly(elevation: float) -> None:
    scenario = load_scenario(LosScenario, "los_noise_free").model_copy(
        update={"elevation_deg": elevation, "image_rate_hz": 10.0}
    )
    data, truth = simulate_los(scenario, 0)
    noise = Noise(gyro_density=1e-6, gyro_bias_walk=0.0, encoder=0.0, los_error=5e-6)
    estimate = solve_batch(problem(data, Config(noise=noise, sensors=IDEAL)))
    assert np.rad2deg(np.abs(_errors(estimate, truth)[:4])).max() < 1e-6


Solve = Callable[[Problem], Estimate]


def _mean_nees(scenario: LosScenario, solve: Solve, runs: int) -> tuple[float, int]:
    total, size = 0.0, 0
    for seed in range(runs):
        data, truth = simulate_los(scenario, 100 + seed)
        estimate = solve(problem(data, _config(scenario)))
        total += _nees(estimate, truth)
        size = len(estimate.values)
    return total / runs, size


@pytest.mark.parametrize(
    ("scenario", "solve", "runs"),
    [
        pytest.param(REAL, solve_batch, 2, id="real"),
        pytest.param(SHORT, solve_batch, 5, id="ideal", marks=pytest.mark.slow),
        pytest.param(
            REAL.model_copy(update={"duration_s": 10.0}),
            solve_incremental,
            2,
            id="real, incremental",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_errors_fit_their_covariance_in_a_few_short_runs(scenario: LosScenario, solve: Solve, runs: int) -> None:
    mean, size = _mean_nees(scenario, solve, runs)
    assert quantile(5e-4, runs * size) < runs * mean < quantile(1 - 5e-4, runs * size)


@pytest.mark.slow
@pytest.mark.parametrize("solve", [solve_batch, solve_incremental])
@pytest.mark.parametrize("sensors", [Sensors(), IDEAL], ids=["real", "ideal"])
def test_errors_fit_their_covariance_over_many_runs(sensors: Sensors, solve: Solve) -> None:
    runs = 20 if solve is solve_batch else 12
    scenario = LosScenario(sensors=sensors, image_rate_hz=25.0, gyro_rate_hz=200.0)
    mean, size = _mean_nees(scenario, solve, runs)
    assert quantile(5e-3, runs * size) < runs * mean < quantile(1 - 5e-3, runs * size)


def _drifting(duration_s: float, skew: float) -> LosScenario:
    """A recording whose pictures' clock drifts by what is usual, or more."""
    return LosScenario(
        duration_s=duration_s,
        gyro_rate_hz=100.0,
        gimbal_rate_hz=100.0,
        image_rate_hz=5.0,
        sensors=Sensors(),
        effects={"clock_skew": skew},
    )


def test_pictures_whose_clock_drifts_are_looked_for_where_they_were_taken() -> None:
    rates = {"image_rate_hz": 2.5, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0}
    scenario = _drifting(400.0, 1e-3).model_copy(update=rates)
    data, truth = simulate_los(scenario, 2)
    estimate = solve_batch(problem(data, _config(scenario)))
    assert _nees(estimate, truth) < quantile(1 - 1e-3, len(estimate.values))
    assert abs(_errors(estimate, truth)[estimate.names.index("clock_skew")]) < 1e-5


def test_a_clock_that_cannot_be_told_is_that_of_the_stamps() -> None:
    data, _ = simulate_los(REAL, 100)
    made = problem(data, _config(REAL))
    assert {step.time for step in made.steps(1)} <= set(data.image_t.tolist())


def test_pictures_close_in_time_share_a_step() -> None:
    scenario = REAL.model_copy(update={"image_rate_hz": 50.0, "dropouts_s": [(4.03, 4.5)]})
    data, _ = simulate_los(scenario, 100)
    made = problem(data, _config(scenario))
    few, many = list(made.steps(1)), list(made.steps(20))
    sizes = np.array([len(step.keyframes) for step in few])
    assert sizes.max() == np.median(sizes) == 5
    assert all(len(step.keyframes) >= 20 for step in many[:-1])
    ends = [step.keyframes.stop for step in few]
    assert {step.keyframes.stop for step in many} < set(ends)
    assert made.steps_after is not None
    later = made.steps_after(few[7].time)
    assert [step.keyframes.stop for step in later] == ends[8:], "a run that goes on takes the same steps"


@pytest.mark.slow
def test_clocks_that_drift_for_a_quarter_of_an_hour() -> None:
    mean, size = _mean_nees(_drifting(900.0, 1e-4), solve_batch, runs := 6)
    assert runs * mean < quantile(1 - 5e-3, runs * size)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_an_hour_is_as_right_as_a_minute(seed: int) -> None:
    """The gyro's noise moves the gimbal: errors of the gimbal that are variables would be 7 sigmas off."""
    scenario = LosScenario(
        duration_s=3600.0, gyro_rate_hz=100.0, gimbal_rate_hz=100.0, image_rate_hz=5.0, sensors=Sensors()
    )
    data, truth = simulate_los(scenario, seed)
    estimate = solve_batch(problem(data, _config(scenario)), error_map=True)
    assert estimate.error_map is None
    size = len(estimate.names)
    assert quantile(5e-3, size) < _nees(estimate, truth) < quantile(1 - 5e-3, size)
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5


@pytest.mark.slow
def test_an_hour_of_ten_pictures_a_second_rolls_no_camera() -> None:
    """With the whitening of first order it rolls by 58 prior sigmas."""
    scenario = LosScenario(duration_s=3600.0, gyro_rate_hz=200.0, gimbal_rate_hz=200.0, image_rate_hz=10.0)
    data, truth = simulate_los(scenario, 0)
    estimate = solve_batch(problem(data, _config(scenario)))
    assert estimate.converged
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5


@pytest.mark.slow
def test_a_clock_is_guessed_over_an_hour() -> None:
    """One that has gone wrong by as much as half a swing takes."""
    scenario = _drifting(3600.0, 5e-4).model_copy(
        update={"image_rate_hz": 2.0, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0}
    )
    data, truth = simulate_los(scenario, 1)
    made = problem(data, _config(scenario))
    taken = np.array([step.time for step in made.steps(20)])
    late = truth["time_offset"] - truth["clock_skew"] * (data.image_t - data.image_t[0])
    where = data.image_t + late
    nearest = where[np.abs(where[:, None] - taken).argmin(axis=0)]
    np.testing.assert_allclose(taken, nearest, rtol=0.0, atol=0.02)


def test_nominal_noise_leaves_a_hundredth_of_a_degree_where_the_published_solver_leaves_a_tenth() -> None:
    scenario = load_scenario(LosScenario, "los_nominal").model_copy(update={"sensors": IDEAL})
    data, truth = simulate_los(scenario, 2)
    estimate, assessment = _assess(data, _config(scenario))
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.0
    assert np.rad2deg(estimate.sigmas[:4]).max() < 0.01
    assert assessment.status == "calibrated"
    published = recursive_least_squares(data).values[-1] - [truth[n] for n in estimate.names[:4]]
    assert np.abs(published).max() > 5.0 * np.abs(_errors(estimate, truth)[:4]).max()


@pytest.mark.parametrize("sensors", [IDEAL, pytest.param(Sensors(), marks=pytest.mark.slow)], ids=["ideal", "real"])
def test_outliers_dropouts_and_another_target(sensors: Sensors) -> None:
    changes = {"image_rate_hz": 25.0, "sensors": sensors}
    scenario = load_scenario(LosScenario, "los_outliers").model_copy(update=changes)
    data, truth = simulate_los(scenario, 1)
    estimate, assessment = _assess(data, _config(scenario))
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5
    assert assessment.status == "calibrated"
    rejected = estimate.rejected["los with roll"]
    assert 0.03 * len(data.image_t) < rejected < 0.06 * len(data.image_t)


def test_an_outlier_as_the_first_sight_of_a_target_does_not_mislead() -> None:
    scenario = SHORT.model_copy(update={"dropouts_s": [(5.0, 6.0)]})
    data, truth = simulate_los(scenario, 3)
    error = data.error.copy()
    error[np.searchsorted(data.image_t, 6.0), :2] += 0.02
    spoiled = problem(replace(data, error=error), _config(scenario))
    assert spoiled.dropped == {"LOS error disagrees with those after it where a target is found": 1}
    estimate = solve_batch(spoiled)
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 4.0


@pytest.mark.usefixtures("few_solutions")
def test_incremental_agrees_with_batch() -> None:
    brief = SHORT.model_copy(update={"duration_s": 10.0, "image_rate_hz": 6.0})
    data, _ = simulate_los(brief, 5)
    made = problem(data, _config(brief))
    batch, incremental = solve_batch(made), solve_incremental(made)
    assert np.abs((incremental.values - batch.values) / batch.sigmas).max() < 0.2
    np.testing.assert_allclose(incremental.sigmas, batch.sigmas, rtol=0.1)


def test_options_gimbal_axes_and_time_offset() -> None:
    scenario = load_scenario(LosScenario, "los_options").model_copy(
        update={"image_rate_hz": 15.0, "gyro_rate_hz": 200.0, "gimbal_rate_hz": 100.0}
    )
    data, truth = simulate_los(scenario, 1)
    estimate, assessment = _assess(data, _config(scenario))
    assert set(estimate.names) >= {"collimation", "axis_nonperpendicularity", "time_offset"}
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5
    assert assessment.status == "calibrated"


def test_earth_rate_stays_in_the_bias() -> None:
    scenario = SHORT.model_copy(update={"latitude_deg": 40.0})
    data, truth = simulate_los(scenario, 7)
    estimate = solve_batch(problem(data, _config(scenario)))
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5


def test_pz_and_gz_cannot_be_told_apart() -> None:
    data, _ = simulate_los(SHORT, 1)
    config = _config(SHORT.model_copy(update={"priors": {"delta_pz": 0.1, "delta_gz": 0.1}}))
    estimate, assessment = _assess(data, config)
    assert "delta_z" not in estimate.names
    assert assessment.status == "unobservable"
    weights = assessment.directions[0].evidence["weights"]
    assert weights["delta_pz"] == pytest.approx(weights["delta_gz"], rel=1e-3)
    assert "ask for delta_z = delta_pz - delta_gz instead" in assessment.directions[0].evidence["advice"]


@pytest.mark.slow
def test_without_azimuth_motion_px_is_weak_against_gx_and_gy() -> None:
    scenario = load_scenario(LosScenario, "los_no_azimuth")
    data, _ = simulate_los(scenario, 1)
    _, assessment = _assess(data, _config(scenario))
    assert assessment.status in ("weak", "unobservable")
    worst = assessment.directions[0]
    assert abs(worst.evidence["weights"]["delta_px"]) > 0.5
    assert abs(worst.evidence["weights"]["delta_gx"]) > 0.3
    assert "sway the carrier in azimuth too" in worst.evidence["advice"]


def test_gaps_of_gyro_and_gimbal_are_stepped_over() -> None:
    data, truth = simulate_los(SHORT, 9)
    gyro = (data.gyro_t < 4.0) | (data.gyro_t > 4.6)
    gimbal = (data.gimbal_t < 9.0) | (data.gimbal_t > 9.6)
    broken = replace(
        data,
        gyro_t=data.gyro_t[gyro],
        gyro=data.gyro[gyro],
        force=None if data.force is None else data.force[gyro],
        gimbal_t=data.gimbal_t[gimbal],
        gimbal=data.gimbal[gimbal],
    )
    made = problem(broken, _config(SHORT))
    assert made.dropped["LOS error in a gap of gyro or gimbal"] > 10
    estimate = solve_batch(made)
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5


def test_a_prior_of_zero_fixes_an_angle() -> None:
    data, _ = simulate_los(SHORT, 1)
    estimate = solve_batch(problem(data, Config(priors={"delta_px": 0.0})))
    assert abs(estimate.values[0]) < 1e-8
    assert estimate.sigmas[0] == 0.0


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (Config(priors={"delta_pz": 0.1}), "delta_pz alone"),
        (Config(priors={"delta_zz": 0.1}), "unknown key priors.delta_zz; the nearest known key is delta_z"),
        (Config(require={"delta_qx": 0.1}), "unknown key require.delta_qx"),
    ],
)
def test_config_that_cannot_be_served(config: Config, said: str) -> None:
    data, _ = simulate_los(SHORT, 1)
    with pytest.raises(InputError, match=said):
        problem(data, config)


def test_too_few_pictures_is_one_clear_line() -> None:
    data, _ = simulate_los(SHORT, 1)
    with pytest.raises(InputError, match="only 0 of 150 LOS errors can be used"):
        problem(replace(data, gyro_t=data.gyro_t + 100.0, gimbal_t=data.gimbal_t + 100.0), Config())


def _contract(path: Path, sensors: Sensors | None = None) -> tuple[Estimate, Judged, Array]:
    recording = open_recording(path)
    config = load_config(recording.attachment("alidade.yaml"), Config(sensors=sensors) if sensors else None)
    estimate, assessment = _assess(read_los(recording, config), config)
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    known = [i for i, name in enumerate(estimate.names) if name in truth]
    error = estimate.values[known] - [truth[estimate.names[i]] for i in known]
    return estimate, assessment, error / estimate.sigmas[known]


def test_independent_recording(shared_data: Path) -> None:
    _, assessment, z = _contract(shared_data / "contract" / "los_nominal.mcap")
    assert np.abs(z).max() < 3.0
    # Forty seconds do not tell mounting angles from a gyro of the usual grade.
    assert assessment.status == "weak"
    dominant = {f.evidence["figure"]: f.evidence["stated"] for f in assessment.findings if f.kind == "dominant_prior"}
    assert dominant["gyro.skew"] == 0.003
    assert "state sensors.gyro.skew (now 0.003)" in assessment.headline
    _, ideal, z = _contract(shared_data / "contract" / "los_nominal.mcap", IDEAL)
    assert np.abs(z).max() < 3.0
    assert ideal.status == "calibrated"


@pytest.mark.slow
def test_independent_pictures(shared_data: Path) -> None:
    _, assessment, z = _contract(shared_data / "contract" / "los_images_tag.mcap")
    assert np.abs(z).max() < 3.0
    assert assessment.status == "weak"
    _, ideal, z = _contract(shared_data / "contract" / "los_images_tag.mcap", IDEAL)
    assert np.abs(z).max() < 3.0
    assert ideal.status == "calibrated"


@pytest.mark.parametrize("solve", [solve_batch, pytest.param(solve_incremental, marks=pytest.mark.slow)])
@pytest.mark.parametrize("start", [SHORT, pytest.param(REAL, marks=pytest.mark.slow)], ids=["ideal", "real"])
def test_large_angles_and_bias_need_no_special_start(start: LosScenario, solve: Callable[[Problem], Estimate]) -> None:
    angles = LosAngles(delta_px=5, delta_pz=4, delta_gx=-5, delta_gy=4, delta_gz=-1)
    changes = {"gyro_turn_on_bias": 0.01, "angles_deg": angles, "outlier_share": 0.1, "outlier_size": 0.02}
    scenario = start.model_copy(update=changes)
    data, truth = simulate_los(scenario, 1)
    estimate = solve(problem(data, _config(scenario)))
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5


def test_gyro_axis_of_opposite_sign_is_inconsistent() -> None:
    data, _ = simulate_los(SHORT, 1)
    known = _config(SHORT).model_copy(update={"noise_known": 0.0})
    _, assessment = _assess(replace(data, gyro=data.gyro * np.array([1.0, -1.0, 1.0])), known)
    assert assessment.status == "inconsistent"


def test_a_walk_stated_too_loose_does_not_drive_the_time_offset_away() -> None:
    """A thousand times: a bias for every other picture. Were it to turn its own picture, the offset would be 0.2 s."""
    scenario = LosScenario(duration_s=5.0, image_rate_hz=50.0, gyro_rate_hz=200.0, gimbal_rate_hz=100.0)
    data, truth = simulate_los(scenario, 0)
    config = load_config(los_config(scenario).encode())
    loose = config.model_copy(update={"noise": config.noise.model_copy(update={"gyro_bias_walk": 1e-3})})
    estimate = solve_batch(problem(data, loose))
    assert estimate.converged
    at = estimate.names.index("time_offset")
    assert abs(estimate.values[at] - truth["time_offset"]) < 3.0 * estimate.sigmas[at]


@pytest.mark.parametrize(
    ("seed", "amplitude_deg", "lowest_hz", "highest_hz"),
    [
        (4, 0.35, 2.0, 5.0),
        *(pytest.param(seed, 0.35, 2.0, 5.0, marks=pytest.mark.slow) for seed in (1, 2, 3)),
        *(pytest.param(seed, 4.0, 1.0, 2.4, marks=pytest.mark.slow) for seed in (1, 2, 3, 4)),
    ],
)
def test_encoders_read_late_while_the_carrier_swings_fast(
    seed: int, amplitude_deg: float, lowest_hz: float, highest_hz: float
) -> None:
    """Where motion around a picture was smoothed over .4 s, some parameter was 43 to 126 sigmas off."""
    frequencies = np.random.default_rng(seed).uniform(lowest_hz, highest_hz, 3)
    swings = [[Swing(amplitude_deg=amplitude_deg, frequency_hz=float(f))] for f in frequencies]
    carrier = EulerMotion(**dict(zip(("roll", "pitch", "yaw"), swings, strict=True)))
    scenario = LosScenario(
        duration_s=20.0, carrier=carrier, image_rate_hz=25.0, sensors=Sensors(), effects={"encoder_delay": 1e-3}
    )
    data, truth = simulate_los(scenario, seed)
    estimate = solve_batch(problem(data, _config(scenario)))
    assert estimate.converged
    assert _nees(estimate, truth) < quantile(1 - 1e-3, len(estimate.values))
    assert np.abs(_errors(estimate, truth) / estimate.sigmas).max() < 3.5
    assert estimate.sigmas[estimate.names.index("encoder_delay")] < 5e-5


# Sensors of three grades: the gyro's bias at the start, rad/s, and noises where they are not those of the simulator.
GRADES: tuple[tuple[float, dict[str, float]], ...] = (
    (2e-5, {"gyro_density": 5e-6, "encoder": 2e-6, "los_error": 1e-5}),
    (1e-4, {}),
    (2e-3, {"gyro_density": 3e-4, "gyro_bias_walk": 2e-6, "encoder": 5e-5, "los_error": 2e-4}),
)


def _combination(seed: int, shortest_s: float, longest_s: float) -> LosScenario:
    """Three to six effects, drawn from their priors and not stated; any mounts, sensors of three grades, any motion."""
    rng, (turn_on_bias, noise) = np.random.default_rng([seed, 77]), GRADES[seed % len(GRADES)]
    specs = [spec for spec in NUISANCE if spec != GYRO_SLOPE]
    chosen = set(rng.choice(len(specs), rng.integers(3, 7), replace=False).tolist())
    effects = {
        name: float(rng.normal(scale=spec.prior)) if i in chosen else 0.0
        for i, spec in enumerate(specs)
        for name in spec.names
    }
    swings = {
        axis: [
            Swing(
                amplitude_deg=float(rng.uniform(2.0, 8.0)),
                frequency_hz=float(np.exp(rng.uniform(np.log(0.08), np.log(0.8)))),
                phase_deg=float(rng.uniform(0.0, 360.0)),
            )
            for _ in range(2)
        ]
        for axis in ("roll", "pitch", "yaw")
    }
    mounts = np.rad2deg(0.1) * rng.normal(size=5)
    return LosScenario(
        duration_s=float(np.exp(rng.uniform(np.log(shortest_s), np.log(longest_s)))),
        carrier=EulerMotion(**swings),
        azimuth_deg=float(rng.uniform(-180.0, 180.0)),
        elevation_deg=float(rng.uniform(-40.0, 50.0)),
        angles_deg=LosAngles(**dict(zip(LosAngles.model_fields, mounts.tolist(), strict=True))),
        noise=LosNoise(**noise),
        gyro_turn_on_bias=turn_on_bias,
        gyro_rate_hz=float(rng.uniform(400.0, 600.0)),
        gimbal_rate_hz=float(rng.uniform(20.0, 400.0)),
        image_rate_hz=float(rng.uniform(5.0, 30.0)),
        effects=effects,
    )


@pytest.mark.parametrize(
    ("seeds", "longest_s"),
    [((1, 2), 16.0), *(pytest.param(range(a, a + 14), 200.0, marks=pytest.mark.slow) for a in (0, 14, 28))],
)
def test_errors_of_several_effects_at_once_stay_within_their_sigmas(seeds: Sequence[int], longest_s: float) -> None:
    found = []
    for seed in seeds:
        scenario = _combination(seed, 15.0, longest_s)
        data, truth = simulate_los(scenario, seed)
        estimate = solve_batch(problem(data, _config(scenario)))
        assert estimate.converged, seed
        found.append(np.abs(_errors(estimate, truth)) / estimate.sigmas)
        assert found[-1][: estimate.names.index("camera_roll")].max() < 4.0, seed
    # Most effects are absent: errors are smaller than sigmas that count with all of them.
    shares = [np.mean(np.concatenate(found) < limit) for limit in (1.0, 2.0, 3.0)]
    assert (np.array(shares) > [0.64, 0.94, 0.985]).all(), shares
