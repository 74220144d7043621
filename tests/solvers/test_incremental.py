"""The initialisation phase of the incremental solver: weak directions keep their priors, errors fit the covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from scipy.stats import chi2

import alidade
from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.sensors import EulerMotion
from alidade.pipelines.solvers import incremental as online
from alidade.pipelines.solvers.batch import solve, solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, IncrementalSolver, solve_incremental
from alidade.pipelines.solvers.weak_directions import at_prior
from benchmarks.batch import solve as minimum
from benchmarks.initialisation import CASES, beginning, drawn_los, followed, made, nees, report, run

MOUNT = slice(3, 6)
PRIOR = 0.35
SCENARIO = HeadScenario(vision_rate_hz=10.0, gyro_rate_hz=100.0, sensors=Sensors(), helmet_mount_deg=(12.0, -8.0, 10.0))

# s at rest, and noise of the gyro over its rate afterwards, 1/sqrt(Hz).
REST_S, RATE_NOISE = 14.3, 2.8e-3


def _made(seed: int, **changes: object) -> tuple[Problem, Array]:
    """The problem and the true values of its parameters."""
    return made("head", SCENARIO.model_copy(update=changes), seed)


def _rest_first(rest_s: float) -> EulerMotion:
    return beginning(SCENARIO.head, dict.fromkeys(("yaw", "pitch", "roll"), rest_s))


def assert_consistent(nees: Array, numbers: int, recordings: int, level: float = 0.999) -> None:
    """The mean joint errors (k,) over recordings lie inside the two-sided interval of chi-square."""
    low, high = chi2.ppf([0.5 - 0.5 * level, 0.5 + 0.5 * level], numbers * recordings) / recordings
    assert (nees > low).all(), nees
    assert (nees < high).all(), nees


def _apart(one: Estimate, other: Estimate) -> float:
    """Largest difference in sigmas."""
    free = other.sigmas > 0.0
    return float(np.abs((one.values - other.values)[free] / other.sigmas[free]).max())


def test_nothing_is_made_up_at_rest_nor_about_the_only_axis_of_motion() -> None:
    """At rest the mount keeps its prior, later the part about the axis. Few pictures: each is solved anew at first."""
    rates = {"vision_rate_hz": 4.0, "gyro_rate_hz": 50.0, "platform_gyro_rate_hz": 50.0}
    problem, _ = _made(1, duration_s=6.0, head=beginning(SCENARIO.head, {"yaw": 3.5}), **rates)
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    history = incremental.history
    assert history is not None
    rest = (history.time > 1.0) & (history.time < 3.4)
    assert rest.sum() >= 5
    assert (history.sigmas[rest, MOUNT] > 0.97 * PRIOR).all()
    assert (np.abs(history.values[rest, MOUNT]) < 0.2 * PRIOR).all()
    for estimate in (batch, incremental):
        variances = np.linalg.eigvalsh(estimate.covariance[MOUNT, MOUNT])
        assert np.sqrt(variances[-1]) > 0.99 * PRIOR
        assert np.sqrt(variances[1]) < 0.1 * PRIOR
    assert _apart(incremental, batch) < 0.1


@pytest.mark.slow
def test_outliers_from_the_first_picture_on_are_judged_again_when_more_is_known() -> None:
    problem, _ = _made(3, duration_s=6.0, outlier_fraction=0.2)
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    assert _apart(incremental, batch) < 0.1
    assert incremental.rejected == batch.rejected


@pytest.mark.slow
def test_errors_fit_their_covariance_at_all_times() -> None:
    moments = np.array([2.0, 5.0, 8.0, 12.0, 16.0, 19.0])
    found = [followed(*_made(seed, duration_s=20.0, head=_rest_first(10.0)), moments) for seed in range(3)]
    assert not any(each.message for each in found)
    assert_consistent(np.mean([each.nees for each in found], axis=0), found[0].numbers, len(found))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "case", "from_moment"),
    [
        ("head", "rest", 0),
        ("head", "one axis", 0),
        ("head", "dropouts", 0),
        ("head", "outliers", 0),
        ("head", "mount", 0),
        ("los", "rest", 0),
        ("los", "one axis", 0),
        ("los", "slow", 0),
        ("los", "outliers", 0),
        ("indexer", "mount", 0),
        # Truths are drawn from a tenth of the priors: errors are smaller while a prior is all there is.
        ("tumble", "slow", 3),
    ],
)
def test_errors_fit_their_covariance_from_both_sides(method: str, case: str, from_moment: int) -> None:
    """Linear about the last solution, heads that turn about one axis were at 155 of 24, slow gimbals at 1,000 of 35.

    The other two angles of the mount follow the unknown one along a curve: without second order 8 times as much.
    """
    found = [run(method, case, seed) for seed in range(4)]
    assert not any(each.message for each in found)
    mean = np.mean([each.nees for each in found], axis=0)
    assert_consistent(mean[from_moment:], found[0].numbers, len(found), 0.9999)


@pytest.mark.slow
def test_a_minute_at_rest_is_not_marginalised_while_noise_moves_the_mount() -> None:
    """Marginalised after 55 s it was 1500 sigmas off when motion began."""
    settings, _ = CASES["head"]["rest"](3)
    problem, truth = made("head", settings.model_copy(update={"duration_s": 64.0}), 3)
    found = followed(problem, truth, np.array([30.0, 57.0, 63.5]))
    assert not found.message
    assert max(found.nees) < chi2.ppf(0.999, found.numbers)


def test_noise_levels_of_a_rest_are_not_those_of_the_motion_to_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """With those found at the first motion, a level that grows with the rate is its default, 50 times too small."""
    monkeypatch.setattr(online, "FIRST_SOLVE", REST_S - 1.2)  # solutions of the rest alone end nothing
    scenario = SCENARIO.model_copy(
        update={
            "duration_s": 40.0,
            "head": _rest_first(REST_S),
            "platform": None,
            "noise": SCENARIO.noise.model_copy(update={"vision_attitude": 5e-4, "gyro_density": 2e-4}),
        }
    )
    data, _ = simulate_head(scenario, 1)
    rate = np.linalg.norm(data.head_gyro, axis=1, keepdims=True)
    white = RATE_NOISE * np.random.default_rng(1).standard_normal(data.head_gyro.shape) * scenario.gyro_rate_hz**0.5
    noisy = {**vars(data), "head_gyro": data.head_gyro + rate * white, "gyro_density": None, "vision_cov": None}
    problem = alidade.open(noisy, method="head").problem()
    following = IncrementalSolver(problem, DEFAULT_WINDOW)
    for step in problem.steps(1):
        following.add_step(step)
        if not following.initialising:
            break
    assert not following.initialising
    levels = {level.noise.name: level.used for level in following.state.levels}
    assert levels["gyro_rate_noise"] == pytest.approx(RATE_NOISE, rel=0.5)


FEW = {"image_rate_hz": 5.0, "gyro_rate_hz": 50.0}


@pytest.mark.slow
def test_a_second_axis_after_45_s_of_one() -> None:
    """No picture is so near to the gate that one of both solvers alone rejects it, which moves skews by .3 sigma."""
    since = {"yaw": 0.0, "pitch": 45.0, "roll": 45.0}
    problem, truth = _made(5, duration_s=60.0, head=beginning(SCENARIO.head, since))
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    assert incremental.rejected == batch.rejected
    assert _apart(incremental, batch) < 0.1
    assert np.abs((incremental.values - truth) / np.maximum(incremental.sigmas, 1e-12))[MOUNT].max() < 4.0


@pytest.mark.parametrize(("seed", "rates", "systems"), [pytest.param(27, {}, 60, marks=pytest.mark.slow), (3, FEW, 80)])
def test_a_valley_that_bends_between_bias_and_mount_is_followed_to_its_end(
    seed: int, rates: dict[str, float], systems: int
) -> None:
    """At rest a gimbal's bias is known by its mount alone: from the mount of the motion to come to that of the rest.

    With few pictures it took 127 linear systems before steps along the floor were lengthened.
    """
    settings, _ = CASES["los"]["rest"](seed)
    problem, _ = made("los", settings.model_copy(update=rates), seed)
    compiled = Compiled.of(problem, steps=[step for step in problem.steps(1) if step.time <= 47.0])
    found = minimum(compiled)
    assert found.converged, found.message
    assert found.iterations < systems


@pytest.mark.slow
def test_errors_fit_their_covariance_where_motion_begins_after_a_rest() -> None:
    """Linear about what rest told of the mounts, their joint error is hundreds as soon as anything moves."""
    for seed in (6, 46):
        settings, _ = CASES["los"]["rest"](seed)
        problem, truth = made("los", settings.model_copy(update={"duration_s": 33.0}), seed)
        found = followed(problem, truth, 30.0 + np.array([0.5, 1.4, 2.0, 2.8]))
        assert not found.message
        assert np.mean(found.nees) < chi2.ppf(0.999, found.numbers)


def test_outliers_among_few_pictures_lead_to_no_far_minimum() -> None:
    """Plain least squares ends where assumptions are tens of their priors' sigmas off."""
    settings, _ = CASES["los"]["outliers"](4001)
    problem, truth = made("los", settings.model_copy(update={"duration_s": 5.0}), 4001)
    first = [step for step in problem.steps(1) if step.time <= 3.4]
    estimate = solve_batch(replace(problem, steps=lambda _: iter(first)))
    size, numbers = nees(estimate.values, estimate.covariance, truth)
    assert estimate.converged
    assert size < chi2.ppf(0.999, numbers)
    assert 0 < estimate.rejected["los"] < 0.4 * len(first)


@pytest.mark.parametrize("seed", [2000, pytest.param(2046, marks=pytest.mark.slow)])
def test_no_sigma_is_far_beyond_its_prior(seed: int) -> None:
    """Some directions of the ellipsoid are known a million times better than others; it was 5,000 times the prior."""
    settings, _ = CASES["tumble"]["slow"](seed)
    problem, _ = made("tumble", settings, seed)
    widest = 0.0
    following = IncrementalSolver(problem, 1.0)
    for step in islice(problem.steps(1), 11):
        following.add_step(step)
        if following.started:
            sigmas = np.sqrt(np.diag(following.covariance()))
            widest = max(widest, float(np.max(sigmas / [q.scale for q in problem.quantities])))
    assert 0.9 < widest < 1.05


def test_the_study_follows_a_recording_to_its_end() -> None:
    found = run("indexer", "one axis", 0)
    assert len(found.moments) == len(found.nees) == 10
    assert not found.message
    assert found.numbers == 17
    assert found.worst < 4.0
    assert len(list(report([found]))) == 3


def test_the_first_attitudes_of_a_tumbled_magnetometer_are_at_their_priors() -> None:
    """Their covariance of second order does not go far enough: of some recordings it is off by hundreds.

    One moment is left out: of four attitudes, at 5.6 s, rounding alone decides between a NEES of 20 and of 32.
    """
    settings, _ = CASES["tumble"]["rest"](2)
    problem, truth = made("tumble", settings, 2)
    following = IncrementalSolver(problem, 1.0)
    scale, sizes = np.array([q.scale for q in problem.quantities[:9]]), []
    for step in problem.steps(1):
        if step.time > 22.0:
            break
        following.add_step(step)
        sigmas = np.sqrt(np.diag(following.covariance()))[:9]
        size, numbers = nees(following.values(), following.covariance(), truth)
        sizes.append(size)
        if step.time < 5.0:
            assert (sigmas[:6] > 0.5 * scale[:6]).all()
    assert sorted(sizes)[-2] < chi2.ppf(0.999, numbers)
    assert (sigmas < 0.5 * scale).any()


def test_outliers_among_few_pictures_leave_everything_at_its_prior() -> None:
    """Three of eleven pictures are rejected: which ones are wrong cannot be told."""
    settings, _ = CASES["los"]["outliers"](4010)
    problem, _ = made("los", settings, 4010)
    following = IncrementalSolver(problem, 1.0)
    for step in problem.steps(1):
        if step.time > 1.05:
            break
        following.add_step(step)
    sigmas = np.sqrt(np.diag(following.covariance()))
    prior = np.array([q.prior_sigma for q in problem.quantities], dtype=float)
    np.testing.assert_allclose(sigmas, prior, rtol=1e-9)


def test_a_number_without_prior_keeps_its_posterior() -> None:
    settings, _ = CASES["indexer"]["mount"](3001)
    problem, _ = made("indexer", settings, 3001)
    following = IncrementalSolver(problem, 1.0)
    for step in problem.steps(1):
        following.add_step(step)
        if following.started:
            break
    free = np.array([q.prior_sigma is None for q in problem.quantities])
    assert free.any()
    posterior = solve(Compiled.of(problem, steps=following.steps_since)).posterior
    fixed = at_prior(posterior, posterior.reported.bounded)
    some = np.array([bool(q.prior_sigma) for q in problem.quantities])
    means = [q.prior_mean for q in problem.quantities if q.prior_sigma]
    np.testing.assert_allclose(fixed.reported.numbers[some], means, atol=1e-12)
    np.testing.assert_allclose(np.diag(fixed.covariance)[free], np.diag(posterior.covariance)[free])
    assert not fixed.covariance[np.ix_(some, free)].any()


@cache
def _two_minutes(seed: int) -> tuple[bool, Estimate, Estimate, Array]:
    """Whether a run of two minutes, in which nothing determines the roll, is in its initialisation phase; estimates."""
    problem, truth = made("los", drawn_los(seed, duration_s=120.0), seed)
    following = IncrementalSolver(problem, DEFAULT_WINDOW)
    for step in problem.steps(1):
        following.add_step(step)
    return following.initialising, following.finish(0.0), solve_batch(problem), truth


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 4])
def test_after_two_minutes_an_answer_is_as_good_as_batch_though_nothing_tells_the_roll(seed: int) -> None:
    """In the initialisation phase or after it."""
    _, estimate, batch, truth = _two_minutes(seed)
    assert _apart(estimate, batch) < 0.5
    size, numbers = nees(estimate.values, estimate.covariance, truth)
    assert size < chi2.ppf(0.9995, numbers)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [1, 3, pytest.param(4, marks=pytest.mark.xfail(strict=True, reason="one sigma is 16 % below batch's"))]
)
def test_after_two_minutes_sigmas_are_those_of_batch_though_nothing_tells_the_roll(seed: int) -> None:
    """In the initialisation phase or after it."""
    _, estimate, batch, _ = _two_minutes(seed)
    np.testing.assert_allclose(estimate.sigmas, batch.sigmas, rtol=0.05)


_GOES_ON = pytest.mark.xfail(strict=True, reason=".08 of a variance is of second order; it ends at .001")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(1, marks=_GOES_ON), pytest.param(3, marks=_GOES_ON), 4])
def test_the_initialisation_phase_ends_though_nothing_tells_the_roll(seed: int) -> None:
    """Else the recording would be solved anew until the tenth minute."""
    initialising, *_ = _two_minutes(seed)
    assert not initialising
