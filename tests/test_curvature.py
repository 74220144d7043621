"""At rest what is known is a curve: the joint covariance has to cover it, not its tangent alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from pipelines.config import load_config
from pipelines.graph.problem import Array, Estimate, Problem
from pipelines.methods.los import graph as los
from pipelines.methods.los.simulation import LosAngles, LosScenario, los_config, simulate_los
from pipelines.settings import Sensors
from pipelines.simulation.motion import EulerMotion
from pipelines.solvers import batch
from pipelines.solvers.batch import solve_batch
from pipelines.solvers.incremental import Run
from tests.builders import IDEAL

BRIEF = LosScenario(gyro_rate_hz=100, image_rate_hz=10, gimbal_rate_hz=50)


def made(seed: int, rest_s: float, duration_s: float, sensors: Sensors = IDEAL) -> tuple[Problem, Array]:
    """A carrier that is at rest first; mounting angles and errors of the sensors are drawn from their priors."""
    axes = {
        axis: [swing.model_copy(update={"start_s": rest_s}) for swing in getattr(BRIEF.carrier, axis)]
        for axis in ("yaw", "pitch", "roll")
    }
    rng = np.random.default_rng([seed, 1])
    # The prior of each angle is 0.1 rad.
    angles = {f"delta_{name}": float(np.rad2deg(rng.normal(0.0, 0.1))) for name in ("px", "gx", "gy", "gz")}
    changes = {"duration_s": duration_s, "carrier": EulerMotion(**axes), "sensors": sensors}
    scenario = BRIEF.model_copy(update={**changes, "angles_deg": LosAngles(delta_pz=0.0, **angles)})
    data, truth = simulate_los(scenario, seed)
    problem = los.problem(data, load_config(los_config(scenario).encode()))
    return problem, np.array([truth[q.name] for q in problem.quantities])


def nees(values: Array, covariance: Array, truth: Array) -> tuple[float, int]:
    """Joint error in sigmas squared, and of how many numbers."""
    free = np.diag(covariance) > 0.0
    error = (values - truth)[free]
    return float(error @ np.linalg.solve(covariance[np.ix_(free, free)], error)), int(free.sum())


def solved(problem: Problem, monkeypatch: pytest.MonkeyPatch | None = None) -> Estimate:
    """By batch; with a patch, as the linear system has it alone."""
    if monkeypatch is None:
        return solve_batch(problem)
    with monkeypatch.context() as patch:
        patch.setattr(batch, "second_order", lambda *_: None)
        return solve_batch(problem)


def test_the_joint_covariance_at_rest_covers_the_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    """Summed over six recordings; the tangent alone is off by several times."""
    bent, flat, numbers = 0.0, 0.0, 0
    for seed in range(6):
        problem, truth = made(seed, 10.0, 6.0)
        curved, linear = solved(problem), solved(problem, monkeypatch)
        np.testing.assert_allclose(curved.sigmas, linear.sigmas, rtol=0.15)
        size, dof = nees(curved.values, curved.covariance, truth)
        bent, numbers = bent + size, numbers + dof
        flat += nees(linear.values, linear.covariance, truth)[0]
    assert bent < chi2.ppf(0.999, numbers), (bent, numbers)
    assert flat > 3.0 * numbers


def test_what_is_determined_needs_no_second_order(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = made(1, 0.0, 15.0)
    np.testing.assert_array_equal(solved(problem).covariance, solved(problem, monkeypatch).covariance)


@pytest.mark.slow
def test_joint_errors_fit_at_rest_and_when_motion_begins() -> None:
    moments = (2.0, 5.0, 8.0, 12.0, 15.0, 20.0)
    found = np.zeros((4, len(moments)))
    for seed in range(len(found)):
        problem, truth = made(seed, 10.0, 21.0, Sensors())
        run = Run(problem, 1.0)
        for step in problem.steps(1):
            run.add_step(step)
            taken = int((found[seed] > 0.0).sum())
            if taken < len(moments) and step.time >= moments[taken]:
                found[seed, taken], dof = nees(run.values(), run.covariance(), truth)
    assert (found.sum(axis=0) < chi2.ppf(0.999, 4 * dof)).all(), found.mean(axis=0)
