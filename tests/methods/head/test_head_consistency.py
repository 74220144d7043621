"""Whether the head method's numbers mean what they say: errors against sigmas, chi-square, outliers, outages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.head.model import problem
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.judged import Judged, judge

Solve = Callable[[Problem], Estimate]
SOLVERS = pytest.mark.parametrize("solve", [solve_batch, solve_incremental])
# The incremental one takes long.
BATCH_FIRST = pytest.mark.parametrize("solve", [solve_batch, pytest.param(solve_incremental, marks=pytest.mark.slow)])
# Quick enough a platform for short runs.
SHORT = {
    "platform": {
        "yaw": [{"rate_deg_s": 3}, {"amplitude_deg": 10, "frequency_hz": 0.21}],
        "pitch": [{"amplitude_deg": 12, "frequency_hz": 0.17}],
        "roll": [{"amplitude_deg": 30, "frequency_hz": 0.11}, {"amplitude_deg": 3, "frequency_hz": 0.41}],
    },
    "duration_s": 20,
    "vision_rate_hz": 10,
    "gyro_rate_hz": 100,
    # Errors of the sensors are drawn from what the solver assumes of them.
    "sensors": {},
}


def scenario(**changes: object) -> HeadScenario:
    return HeadScenario.model_validate(load_scenario(HeadScenario, "head_mounts").model_dump() | SHORT | changes)


def _drifting(duration_s: float, skew: float) -> HeadScenario:
    """A long recording whose pictures' clock drifts."""
    rates = {"vision_rate_hz": 4, "gyro_rate_hz": 50, "platform_gyro_rate_hz": 50}
    return scenario(duration_s=duration_s, effects={"clock_skew": skew}, **rates)


class Run:
    """A simulated session solved."""

    def __init__(self, settings: HeadScenario, seed: int, solve: Solve, noise: str = "", known: float = 0.1) -> None:
        data, truth = simulate_head(settings, seed)
        config = load_config(head_config(settings).encode())
        config = config.model_copy(update={"noise_known": known})
        if noise:
            changed = config.noise.model_copy(update={noise: getattr(config.noise, noise) / 3.0})
            config = config.model_copy(update={"noise": changed})
        self.problem = problem(data, config)
        self.settings = settings
        self.estimate = solve(self.problem)
        self.error = self.estimate.values - np.array([truth[name] for name in self.estimate.names])

    @property
    def assessment(self) -> Judged:
        e = self.estimate
        return judge(self.problem.quantities, e.covariance, e.chi_square, self.problem.advice, e.levels)

    @property
    def worst(self) -> float:
        """Largest error in sigmas."""
        return float(np.abs(self.error / self.estimate.sigmas).max())

    @property
    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.estimate.covariance, self.error))

    def attitude_error(self) -> tuple[Array, Array]:
        """Times, and angles between bRv and its truth, deg."""
        found = self.estimate.attitudes
        assert found is not None
        true = self.settings.head.attitude(found.time)
        return found.time, np.rad2deg(np.linalg.norm(so3.log(so3.multiply(so3.inverse(true), found.wxyz)), axis=1))


@cache
def clean(solve: Solve) -> Run:
    return Run(scenario(duration_s=12, gyro_rate_hz=50, platform_gyro_rate_hz=50), 1, solve)


def assert_consistent(runs: Sequence[Run]) -> None:
    """Mean NEES and summed chi-square within their 99 % intervals."""
    parameters = len(runs[0].error)
    low, high = chi2.ppf([0.005, 0.995], parameters * len(runs)) / len(runs)
    assert low < np.mean([run.nees for run in runs]) < high
    fits = [run.estimate.chi_square for run in runs]
    low, high = chi2.ppf([0.005, 0.995], sum(f.dof for f in fits if f))
    assert low < sum(f.value for f in fits if f) < high


def test_batch_errors_fit_their_covariance() -> None:
    assert_consistent([Run(scenario(), seed, solve_batch) for seed in range(2)])


@pytest.mark.slow
def test_batch_errors_fit_their_covariance_over_many_runs() -> None:
    assert_consistent([Run(scenario(), seed, solve_batch) for seed in range(100, 150)])


@pytest.mark.slow
def test_incremental_errors_fit_their_covariance() -> None:
    assert_consistent([Run(scenario(), seed, solve_incremental) for seed in range(15)])


@pytest.mark.slow
@pytest.mark.parametrize("density", [1e-4, 2e-3])
@pytest.mark.parametrize("vision", [3e-4, 5e-3])
@pytest.mark.parametrize("amplitude", [0.3, 1.0])
@pytest.mark.parametrize(("solve", "seeds"), [(solve_batch, 10), (solve_incremental, 4)])
def test_scales_are_true_whatever_the_noises_and_the_motion(
    density: float, vision: float, amplitude: float, solve: Solve, seeds: int
) -> None:
    """What multiplies a noisy measurement is biased where noise is whitened in other units than its own."""
    moves = scenario().head.model_dump()
    slighter = {
        axis: [swing | {"amplitude_deg": amplitude * swing["amplitude_deg"]} for swing in moves[axis]]
        for axis in ("yaw", "pitch", "roll")
    }
    settings = scenario(noise={"gyro_density": density, "vision_attitude": vision}, head=moves | slighter)
    runs = [Run(settings, seed, solve) for seed in range(seeds)]
    some = [i for i, name in enumerate(runs[0].estimate.names) if "scale" in name]
    assert len(some) == 7
    covariances = [run.estimate.covariance[np.ix_(some, some)] for run in runs]
    size = sum(run.error[some] @ np.linalg.solve(P, run.error[some]) for run, P in zip(runs, covariances, strict=True))
    assert chi2.ppf(0.0005, 7 * seeds) < size < chi2.ppf(0.9995, 7 * seeds)
    mean = np.sum([run.error / run.estimate.sigmas for run in runs], axis=0)[some] / np.sqrt(seeds)
    assert np.abs(mean).max() < 4.0


@pytest.mark.usefixtures("few_solutions")
def test_incremental_agrees_with_batch() -> None:
    """With the noise as stated: that both find the same levels is another matter."""
    brief = scenario(duration_s=6, vision_rate_hz=6, gyro_rate_hz=50, platform_gyro_rate_hz=50)
    batch, incremental = (Run(brief, 1, solve, known=0.0).estimate for solve in (solve_batch, solve_incremental))
    assert np.abs((incremental.values - batch.values) / batch.sigmas).max() < 0.2
    np.testing.assert_allclose(incremental.sigmas, batch.sigmas, rtol=0.05)


@BATCH_FIRST
def test_right_noise_is_consistent(solve: Solve) -> None:
    assert clean(solve).assessment.status == "calibrated"
    assert clean(solve).worst < 3.0


@pytest.mark.slow
@SOLVERS
def test_vision_noise_set_too_small_is_found(solve: Solve) -> None:
    """Three times."""
    run = Run(scenario(), 1, solve, "vision_attitude")
    assert run.assessment.status == "calibrated"
    (vision,) = (level for level in run.estimate.levels if level.noise.name == "vision_attitude")
    assert vision.contradicted
    assert vision.scale == pytest.approx(3.0, rel=0.1)
    right = Run(scenario(), 1, solve)
    np.testing.assert_allclose(run.estimate.sigmas, right.estimate.sigmas, rtol=0.1)


def test_vision_noise_known_exactly_and_too_small_is_inconsistent() -> None:
    assessment = Run(scenario(), 1, solve_batch, "vision_attitude", known=0.0).assessment
    assert assessment.status == "inconsistent"
    assert "noise" in assessment.headline
    assert "vision" in assessment.headline


@pytest.mark.slow
def test_gyro_noise_set_too_small_is_found_in_the_residuals() -> None:
    """Where the gyro's noise, and not vision's, is what they are made of."""
    settings = scenario(noise={"gyro_density": 2e-3, "vision_attitude": 5e-4})
    right, run = Run(settings, 1, solve_batch), Run(settings, 1, solve_batch, "gyro_density")
    assert run.assessment.status == "calibrated"
    np.testing.assert_allclose(run.estimate.sigmas, right.estimate.sigmas, rtol=0.1)
    assert Run(settings, 1, solve_batch, "gyro_density", known=0.0).assessment.status == "inconsistent"


@BATCH_FIRST
def test_without_platform_motion_only_the_product_of_the_mounts_is_known(solve: Solve) -> None:
    """The head turned about one attitude only says how cRb and vRh act together at rest; the report names them."""
    priors = {f"camera_mount_{axis}": 0.35 for axis in "xyz"}
    run = Run(scenario(platform=None, priors=priors), 1, solve)
    assessment = run.assessment
    assert assessment.status == "unobservable"
    named = {name for direction in assessment.directions for name in direction.evidence["weights"]}
    assert {f"camera_mount_{axis}" for axis in "xyz"} <= named
    assert all("turn the platform" in direction.evidence["advice"] for direction in assessment.directions)
    time, _ = run.attitude_error()
    found = run.estimate.attitudes
    assert found is not None
    values = dict(zip(run.estimate.names, run.estimate.values, strict=True))
    cRb = so3.exp(np.array([values[f"camera_mount_{axis}"] for axis in "xyz"]))
    true = so3.multiply(so3.exp(np.deg2rad(run.settings.camera_mount_deg)), run.settings.head.attitude(time))
    miss = so3.log(so3.multiply(so3.inverse(true), so3.multiply(cRb, found.wxyz)))
    late = time > 5.0
    assert np.rad2deg(np.sqrt((miss[late] ** 2).sum(axis=1).mean())) < 0.5
    _, alone = run.attitude_error()
    assert np.sqrt((alone[late] ** 2).mean()) > 1.0


@pytest.mark.parametrize("fraction", [pytest.param(0.05, marks=pytest.mark.slow), 0.2])
def test_outliers_cost_no_more_than_the_frames_they_spoil(fraction: float) -> None:
    """At known noise the solution is the one without the spoilt frames, as if these had been known beforehand."""
    settings = scenario(duration_s=30, outlier_fraction=fraction)
    assert Run(settings, 1, solve_batch).worst < 3.0
    run = Run(settings, 1, solve_batch, known=0.0)
    assert run.worst < 3.0
    assert run.assessment.status == "calibrated"
    (spoilt, _), (good, _) = simulate_head(settings, 1), simulate_head(scenario(duration_s=30), 1)
    left = np.linalg.norm(so3.log(so3.multiply(so3.inverse(good.vision_wxyz), spoilt.vision_wxyz)), axis=1) < 0.1
    assert run.estimate.rejected == {"vision": int((~left).sum())}
    assert spoilt.vision_cov is not None
    known = replace(
        spoilt,
        vision_t=spoilt.vision_t[left],
        vision_wxyz=spoilt.vision_wxyz[left],
        vision_cov=spoilt.vision_cov[left],
    )
    config = load_config(head_config(settings).encode()).model_copy(update={"noise_known": 0.0})
    best = solve_batch(problem(known, config))
    assert np.abs((run.estimate.values - best.values) / best.sigmas).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.05, 0.2])
def test_outliers_do_not_lead_the_smoother_astray(fraction: float) -> None:
    run = Run(scenario(duration_s=30, outlier_fraction=fraction), 1, solve_incremental)
    batch = Run(scenario(duration_s=30, outlier_fraction=fraction), 1, solve_batch).estimate
    assert run.worst < 3.0
    assert run.assessment.status == "calibrated"
    assert np.abs((run.estimate.values - batch.values) / batch.sigmas).max() < 0.2


OUTAGES = [(10.0, 20.0), (28.0, 38.0)]


def after_outages(seed: int, solve: Solve) -> tuple[Run, Array, Array]:
    """A recording with outages, its errors of attitude over time, deg, and those at the first frames after outages."""
    run = Run(scenario(duration_s=45, vision_rate_hz=10, vision_outages_s=OUTAGES), seed, solve)
    time, error = run.attitude_error()
    return run, np.stack([time, error]), np.array([error[np.flatnonzero(time > end)[0]] for _, end in OUTAGES])


def test_back_to_normal_at_the_first_frame_after_an_outage() -> None:
    run, (time, error), first = after_outages(1, solve_batch)
    assert run.worst < 3.0
    assert run.assessment.status == "calibrated"
    assert first.max() <= error[time > 8.0].max()


@pytest.mark.slow
def test_the_first_frame_after_an_outage_is_no_worse_online_than_its_picture_alone() -> None:
    found = [after_outages(seed, solve_incremental) for seed in (1, 2, 3)]
    assert all(run.assessment.status == "calibrated" for run, *_ in found)
    picture = np.rad2deg(found[0][0].settings.noise.vision_attitude)
    squares = np.concatenate([first for *_, first in found]) ** 2 / picture**2
    assert squares.sum() < chi2.ppf(0.999, 3 * len(squares))


@BATCH_FIRST
@pytest.mark.parametrize("mount", [(20.0, -15.0, 17.0), pytest.param((-30.0, 0.0, 0.0), marks=pytest.mark.slow)])
def test_mounts_thirty_degrees_off_converge(solve: Solve, mount: tuple[float, float, float]) -> None:
    run = Run(scenario(helmet_mount_deg=mount, camera_mount_deg=mount[::-1]), 1, solve)
    assert run.worst < 3.0
    assert run.assessment.status == "calibrated"


def test_keyframes_stand_where_pictures_of_a_drifting_clock_were_taken() -> None:
    rates = {"gyro_rate_hz": 25.0, "platform_gyro_rate_hz": 25.0}
    settings = _drifting(600.0, 1e-3).model_copy(update=rates)
    data, truth = simulate_head(settings, 1)
    made = problem(data, load_config(head_config(settings).encode()))
    taken = np.array([step.time for step in made.steps(1)])
    late = truth["time_offset"] - truth["clock_skew"] * (data.vision_t - data.vision_t[0])
    off = np.abs((data.vision_t + late)[:, None] - taken).min(axis=1)
    assert late.min() < -0.5
    assert off.max() < 0.02


@pytest.mark.parametrize("early", [0.7, -1.4])
def test_keyframes_stand_where_pictures_of_another_clock_were_taken(early: float) -> None:
    """Fitted from zero, the clock stays a swing off."""
    settings = scenario()
    data, truth = simulate_head(settings, 1)
    moved = replace(data, vision_t=data.vision_t - early)
    graph = problem(moved, load_config(head_config(settings).encode()))
    assert graph.keyframes is not None
    late = graph.keyframes.clock.late(moved.vision_t - moved.vision_t[0])
    assert np.abs(late - early - truth["time_offset"]).max() < 0.02


def test_errors_fit_their_covariance_over_two_minutes_of_a_clock_that_drifts() -> None:
    run = Run(_drifting(120.0, -1.5e-3), 2, solve_batch)
    assert run.nees < chi2.ppf(1 - 1e-3, len(run.error))


@pytest.mark.slow
def test_errors_fit_their_covariance_over_an_hour() -> None:
    runs = [Run(_drifting(3600.0, skew), seed, solve_batch) for seed, skew in enumerate((1e-4, -1e-4, 3e-4))]
    assert sum(run.nees for run in runs) < chi2.ppf(1 - 1e-3, sum(len(run.error) for run in runs))


@pytest.mark.slow
def test_an_hour_on_a_swaying_platform_shows_no_error_of_the_models() -> None:
    """With the helmet's own acceleration behind the filter the platform's scales were off by 22 sigmas."""
    swings = {
        axis: [{"amplitude_deg": 12, "frequency_hz": hz, "phase_deg": 100 * hz} for hz in (f, 0.65)]
        for axis, f in (("yaw", 0.5), ("pitch", 0.43), ("roll", 0.23))
    }
    rates = {"vision_rate_hz": 24, "gyro_rate_hz": 200, "platform_gyro_rate_hz": 100}
    noise = {"vision_attitude": 0.0026, "gyro_density": 3e-5}
    long = scenario(duration_s=3600, platform=swings, noise=noise, effects={"vision_filter": 1e-4}, **rates)
    assert Run(long, 3, solve_batch).worst < 3.5
