"""The incremental solver while little is known: what the recording does not tell stays where the prior has it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from pipelines.config import load_config
from pipelines.graph.problem import Array, Estimate, Problem
from pipelines.methods.head import graph as head
from pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from pipelines.settings import Sensors
from pipelines.simulation.motion import EulerMotion
from pipelines.solvers.batch import solve_batch
from pipelines.solvers.incremental import Run, solve_incremental

MOUNT = slice(3, 6)
PRIOR = 0.35
SCENARIO = HeadScenario(vision_rate_hz=10.0, gyro_rate_hz=100.0, sensors=Sensors(), helmet_mount_deg=(12.0, -8.0, 10.0))


def _motion(since: dict[str, float]) -> EulerMotion:
    """The nominal head motion, each axis from some second on."""
    axes = {
        axis: [swing.model_copy(update={"start_s": since[axis]}) for swing in getattr(SCENARIO.head, axis)]
        for axis in since
    }
    return EulerMotion(**axes)


def _rest_first(rest_s: float) -> EulerMotion:
    return _motion(dict.fromkeys(("yaw", "pitch", "roll"), rest_s))


def _made(seed: int, **changes: object) -> tuple[Problem, Array]:
    """The problem and the true values of its parameters."""
    scenario = SCENARIO.model_copy(update=changes)
    data, truth = simulate_head(scenario, seed)
    problem = head.problem(data, load_config(head_config(scenario).encode()))
    return problem, np.array([truth[q.name] for q in problem.quantities])


def _nees(problem: Problem, truth: Array, moments: Array) -> list[float]:
    """Joint errors, in sigmas squared, at some times."""
    run = Run(problem, 1.0)
    found: list[float] = []
    for step in problem.steps(1):
        run.add_step(step)
        if len(found) < len(moments) and step.time >= moments[len(found)]:
            error, covariance = run.values() - truth, run.covariance()
            free = np.diag(covariance) > 0.0
            found.append(float(error[free] @ np.linalg.solve(covariance[np.ix_(free, free)], error[free])))
    assert run.finish(0.0).converged
    return found


def _apart(one: Estimate, other: Estimate) -> float:
    """Largest difference in sigmas."""
    free = other.sigmas > 0.0
    return float(np.abs((one.values - other.values)[free] / other.sigmas[free]).max())


def test_nothing_is_made_up_at_rest() -> None:
    problem, _ = _made(1, duration_s=9.0, head=_rest_first(6.0))
    history = solve_incremental(problem).history
    assert history is not None
    rest = (history.time > 1.0) & (history.time < 5.9)
    assert rest.sum() > 15
    assert (history.sigmas[rest, MOUNT] > 0.97 * PRIOR).all()
    assert (np.abs(history.values[rest, MOUNT]) < 0.2 * PRIOR).all()
    assert (history.sigmas[-1, MOUNT] < 0.1 * PRIOR).all()


def test_a_mount_about_the_only_axis_of_motion_keeps_its_prior() -> None:
    problem, _ = _made(2, duration_s=8.0, head=_motion({"yaw": 0.0}))
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    for estimate in (batch, incremental):
        widest = np.linalg.eigvalsh(estimate.covariance[MOUNT, MOUNT])[-1]
        assert np.sqrt(widest) > 0.9 * PRIOR
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
    nees = np.mean([_nees(*_made(seed, duration_s=20.0, head=_rest_first(10.0)), moments) for seed in range(3)], axis=0)
    dof = 3 * 24
    assert (nees * 3 < chi2.ppf(0.9995, dof)).all(), nees


@pytest.mark.slow
def test_a_second_axis_after_the_run_was_folded() -> None:
    since = {"yaw": 0.0, "pitch": 45.0, "roll": 45.0}
    problem, truth = _made(4, duration_s=60.0, head=_motion(since))
    batch, incremental = solve_batch(problem), solve_incremental(problem)
    assert _apart(incremental, batch) < 0.3
    assert np.abs((incremental.values - truth) / np.maximum(incremental.sigmas, 1e-12))[MOUNT].max() < 4.0
