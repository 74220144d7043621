"""The incremental solver while little is known: what the recording does not tell stays where the prior has it."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.stats import chi2

from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Array, Estimate, Problem
from alidade.pipelines.methods.head.simulation import HeadScenario
from alidade.pipelines.methods.los import graph as los
from alidade.pipelines.methods.los.simulation import los_config, simulate_los
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.motion import EulerMotion
from alidade.pipelines.solvers import incremental
from alidade.pipelines.solvers.assembly import CHUNK, Assembly
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import IncrementalSolver, solve_incremental
from alidade.pipelines.solvers.noise_levels import weigh
from alidade.pipelines.solvers.weighing import optimize
from benchmarks.batch import IDEAL
from benchmarks.young import CASES, LOS, beginning, followed, made, nees, report, run

MOUNT = slice(3, 6)
PRIOR = 0.35
SCENARIO = HeadScenario(vision_rate_hz=10.0, gyro_rate_hz=100.0, sensors=Sensors(), helmet_mount_deg=(12.0, -8.0, 10.0))

# A run that has not begun is solved anew at each picture.
FEW: dict[str, object] = {"vision_rate_hz": 7.0, "gyro_rate_hz": 50.0, "platform_gyro_rate_hz": 50.0}


def _made(seed: int, **changes: object) -> tuple[Problem, Array]:
    """The problem and the true values of its parameters."""
    return made("head", SCENARIO.model_copy(update=changes), seed)


def _rest_first(rest_s: float) -> EulerMotion:
    return beginning(SCENARIO.head, dict.fromkeys(("yaw", "pitch", "roll"), rest_s))


def _apart(one: Estimate, other: Estimate) -> float:
    """Largest difference in sigmas."""
    free = other.sigmas > 0.0
    return float(np.abs((one.values - other.values)[free] / other.sigmas[free]).max())


def test_nothing_is_made_up_at_rest() -> None:
    problem, _ = _made(1, duration_s=9.0, head=_rest_first(6.0), **FEW)
    history = solve_incremental(problem).history
    assert history is not None
    rest = (history.time > 1.0) & (history.time < 5.9)
    assert rest.sum() > 15
    assert (history.sigmas[rest, MOUNT] > 0.97 * PRIOR).all()
    assert (np.abs(history.values[rest, MOUNT]) < 0.2 * PRIOR).all()
    assert (history.sigmas[-1, MOUNT] < 0.1 * PRIOR).all()


def test_a_mount_about_the_only_axis_of_motion_keeps_its_prior() -> None:
    problem, _ = _made(2, duration_s=6.0, head=beginning(SCENARIO.head, {"yaw": 0.0}), **FEW)
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    for estimate in (batch, incremental):
        widest = np.linalg.eigvalsh(estimate.covariance[MOUNT, MOUNT])[-1]
        assert np.sqrt(widest) > 0.99 * PRIOR
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
    nees = np.sum([each.nees for each in found], axis=0)
    assert (nees < chi2.ppf(0.9995, 3 * found[0].numbers)).all(), nees


@pytest.mark.slow
def test_a_minute_at_rest_is_not_folded_while_noise_moves_the_mount() -> None:
    """Folded after 55 s it was 1500 sigmas off when motion began."""
    settings, _ = CASES["head"]["rest"](3)
    problem, truth = made("head", settings.model_copy(update={"duration_s": 64.0}), 3)
    found = followed(problem, truth, np.array([30.0, 57.0, 63.5]))
    assert not found.message
    assert max(found.nees) < chi2.ppf(0.999, found.numbers)


@pytest.mark.slow
def test_a_second_axis_after_the_run_was_folded() -> None:
    since = {"yaw": 0.0, "pitch": 45.0, "roll": 45.0}
    problem, truth = _made(4, duration_s=60.0, head=beginning(SCENARIO.head, since))
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    assert _apart(incremental, batch) < 0.3
    assert np.abs((incremental.values - truth) / np.maximum(incremental.sigmas, 1e-12))[MOUNT].max() < 4.0


def test_a_valley_that_bends_between_bias_and_mount_is_followed_to_its_end() -> None:
    """At rest a gimbal's bias is known by its mount alone: from the mount of the motion to come to that of the rest."""
    settings, _ = CASES["los"]["rest"](27)
    problem, _ = made("los", settings, 27)
    whole = Assembly.of(step for step in problem.steps(CHUNK) if step.time <= 47.0)
    factors, shared = weigh(whole.factors, problem.noises), whole.shared(problem)
    found = optimize(factors, whole.initial, shared, problem.loss, most=20, held=problem.assumed)
    assert found.converged, found.message


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


@pytest.mark.parametrize("seed", [2000, 2046])
def test_no_sigma_is_far_beyond_its_prior(seed: int) -> None:
    """Some directions of the ellipsoid are known a million times better than others; it was 5,000 times the prior."""
    settings, _ = CASES["tumble"]["slow"](seed)
    problem, _ = made("tumble", settings, seed)
    widest = 0.0
    following = IncrementalSolver(problem, 1.0)
    for step in islice(problem.steps(1), 11):
        following.add_step(step)
        if following.started:
            # As it is though withheld.
            sigmas = np.sqrt(np.diag(following._covariance()))
            widest = max(widest, float(np.max(sigmas / [q.scale for q in problem.quantities])))
    assert 0.9 < widest < 1.5


def test_the_study_follows_a_recording_to_its_end() -> None:
    found = run("indexer", "one axis", 0)
    assert len(found.moments) == len(found.nees) == 10
    assert not found.message
    assert found.numbers == 17
    assert found.worst < 4.0
    assert len(list(report([found]))) == 3


def test_the_first_attitudes_of_a_tumbled_magnetometer() -> None:
    # One by one, the samples of a rest would tell how the ellipsoid lies there, and it is found far away.
    found = [run("tumble", "rest", seed) for seed in range(2, 6)]
    assert not any(f.message for f in found)
    assert np.mean([f.nees for f in found], axis=0).max() < 30.0


def test_a_run_that_rejects_all_is_solved_anew_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not when it has grown by a twentieth, which may take seconds; but not twice for the same reason."""
    for name, never in {"_GROWTH": np.inf, "_MORE": np.inf, "_LOST": np.inf, "_HALF": 0.0}.items():
        monkeypatch.setattr(incremental, name, never)
    scenario = LOS.model_copy(update={"duration_s": 4.0, "sensors": IDEAL})
    data, _ = simulate_los(scenario, 3)
    wrong = (data.image_t > 2.0) & (data.image_t < 3.2)
    moved = data.error + 0.01 * wrong[:, None]
    problem = los.problem(replace(data, error=moved), load_config(los_config(scenario).encode()))
    following, solved = IncrementalSolver(problem, 1.0), []
    for step in problem.steps(1):
        before = following.moments
        following.add_step(step)
        solved += [step.time] if following.moments > before else []
    assert len(solved) == 2
    assert 2.0 < solved[1] < 2.6
