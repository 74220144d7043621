"""The noise of a gyro that drives a gimbal at rest moves nothing that it does not tell."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from alidade.pipelines.estimation.problem import Array, Problem
from alidade.pipelines.simulation.motion import EulerMotion
from alidade.pipelines.solvers import batch
from alidade.pipelines.solvers.assembly import CHUNK, Assembly
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.gauss_newton import Solution
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, solve_incremental
from alidade.pipelines.solvers.marginals import joint_covariance, joint_information
from alidade.pipelines.solvers.noise_levels import weigh
from alidade.pipelines.solvers.pull import without_pull
from alidade.pipelines.solvers.spurious import information_of_noise
from alidade.pipelines.solvers.weighing import optimize, with_levels
from alidade.pipelines.solvers.window import Window
from benchmarks.young import drawn_los, made

MOUNTS, PRIOR = slice(0, 4), 0.1


@cache
def resting(seed: int, duration_s: float = 40.0) -> tuple[Problem, Array]:
    """A gimbal on a carrier at rest, mounted as its priors let it be."""
    still = {"carrier": EulerMotion(), "image_rate_hz": 5.0, "gyro_rate_hz": 50.0}
    return made("los", drawn_los(seed, duration_s=duration_s, **still), seed)


def minimum(problem: Problem) -> tuple[Solution, Solution]:
    """Where the error of a graph is least, and where it is without what noise alone tells.

    Afterwards other variables hold the parameters, as they do when a run goes on.
    """
    whole = Assembly.of(problem.steps(CHUNK))
    factors = weigh(whole.factors, problem.noises)
    solution = optimize(factors, whole.initial, whole.shared(problem), problem.loss)
    solution, _, about, _ = with_levels(problem, whole.factors, solution, problem.noises)
    covariance = joint_covariance(problem, about, whole.current_keys)
    noise = information_of_noise(problem, about, covariance, whole.current_keys)
    current_keys = dict(whole.current_keys)
    held = without_pull(problem, solution, noise, current_keys)
    current_keys.update({p.key: p.key + 1000 for p in problem.parameters})
    return solution, held


@pytest.mark.parametrize("seed", [3, 39])
def test_at_rest_mounts_stay_where_their_priors_have_them(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = resting(seed)
    found = solve_batch(problem)
    assert found.converged
    assert np.abs(found.values[MOUNTS]).max() < 0.1 * PRIOR
    assert np.sqrt(np.diag(found.covariance)[MOUNTS]).min() > 0.98 * PRIOR
    assert found.course is not None
    assert np.abs(found.course.values[-1] - found.values)[MOUNTS].max() < 0.05 * PRIOR
    monkeypatch.setattr(batch, "without_pull", lambda _, solution, *__: solution)
    assert np.abs(solve_batch(problem).values[MOUNTS]).max() > PRIOR


@pytest.mark.parametrize(
    ("duration_s", "window"),
    [
        (4.0, DEFAULT_WINDOW),
        pytest.param(12.0, DEFAULT_WINDOW, marks=pytest.mark.slow),
        pytest.param(4.0, None, marks=pytest.mark.slow),
    ],
)
def test_nor_do_they_move_online(duration_s: float, window: Window) -> None:
    problem, _ = resting(3, duration_s)
    found = solve_incremental(problem, window)
    assert np.abs(found.values[MOUNTS]).max() < 0.2 * PRIOR
    assert np.sqrt(np.diag(found.covariance)[MOUNTS]).min() > 0.98 * PRIOR
    if found.course is not None:
        assert np.abs(found.course.values[-1] - found.values)[MOUNTS].max() < 0.05 * PRIOR


def test_it_is_a_minimum_that_says_nothing_more() -> None:
    problem, _ = resting(3)
    solution, held = minimum(problem)
    assert held is not solution
    linear = held.system.linearized(held.values)
    step = linear.step()[0]
    # As near as any minimum is found: at rest sigmas are the priors'.
    assert max(np.abs(step.at(p.key)).max() for p in problem.parameters) < 0.005 * PRIOR
    keys = [p.key for p in problem.parameters]
    without = solution.system.linearized(held.values)
    own, added = (joint_information(each.graph, each.system.ordering, keys) for each in (without, linear))
    units = np.array([q.prior_scale for q in problem.quantities])
    assert np.linalg.eigvalsh((added - own) * np.outer(units, units)).max() < 1e-2


def test_all_that_is_made_of_a_solution_is_made_of_it() -> None:
    problem, _ = resting(3)
    names = {q.name for q in problem.quantities}
    found = solve_batch(problem, budget=True, changed=[("the same", problem)], device=names)
    assert found.told is not None
    assert found.budget is not None
    assert all("held" not in sources for sources in found.budget.values())
    assert found.moved is not None
    assert max(map(abs, found.moved["the same"].values())) < 1e-3 * PRIOR


def test_what_motion_tells_is_not_held() -> None:
    problem, truth = made("los", drawn_los(3, duration_s=10.0), 3)
    solution, held = minimum(problem)
    assert held is solution
    assert np.abs(solve_batch(problem).values - truth)[MOUNTS].max() < 0.2 * PRIOR
