"""Whether the past of a run may be folded into a Gaussian."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.los.simulation import LosScenario
from alidade.pipelines.solvers.assembly import CHUNK, Assembly
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.gauss_newton import Solution
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, Run, in_use
from alidade.pipelines.solvers.linearity import is_linear
from alidade.pipelines.solvers.noise_levels import weigh
from alidade.pipelines.solvers.weighing import optimize
from benchmarks.young import LOS, beginning, drawn_los, made, nees


def _solved(scenario: LosScenario) -> tuple[Problem, Solution, Sequence[int], Sequence[int]]:
    """A problem, its solution, the variables that hold its parameters, and all those in use at the end."""
    problem, _ = made("los", scenario, 3)
    whole = Assembly.of(problem.steps(CHUNK))
    shared = whole.shared(problem)
    solution = optimize(weigh(whole.factors, problem.noises), whole.initial, shared, problem.loss, held=problem.assumed)
    return problem, solution, shared, in_use(solution.values, whole.timestamps)


def test_states_that_leave_the_floor_are_no_bend() -> None:
    """Along a camera's roll, which nothing tells, they do where they follow by the linearisation alone."""
    problem, solution, shared, kept = _solved(drawn_los(3, duration_s=15.0))
    assert is_linear(problem, solution, shared, kept)
    assert not is_linear(problem, solution, shared, solution.values.keys())


def test_motion_about_one_axis_bends() -> None:
    one_axis = beginning(LOS.carrier, {"yaw": 0.0})
    assert not is_linear(*_solved(drawn_los(3, duration_s=10.0, carrier=one_axis)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 4])
def test_a_run_is_folded_though_nothing_tells_the_roll(seed: int) -> None:
    """After two minutes the answer is as good as batch; else it would be solved anew until the tenth one."""
    problem, truth = made("los", drawn_los(seed, duration_s=120.0), seed)
    run = Run(problem, DEFAULT_WINDOW)
    for step in problem.steps(1):
        run.add_step(step)
        assert run.base is None or step.time >= 40.0
    assert run.base is not None
    batch, estimate = solve_batch(problem), run.finish(0.0)
    assert (np.abs(estimate.values - batch.values) < 0.5 * batch.sigmas).all()
    np.testing.assert_allclose(estimate.sigmas, batch.sigmas, rtol=0.05)
    assert nees(estimate.values, estimate.covariance, truth)[0] < 70.0


@pytest.mark.slow
def test_a_second_axis_after_a_minute_of_one() -> None:
    """It is solved anew while knowledge grows tenfold, and folded once the last attitude follows as foreseen, too.

    Between solutions, three seconds apart, the joint error was 94 of 35; folded at once sigmas were 0.67 of batch's.
    With seeds 2 and 3 all was rejected for a second, the joint error 100 and 96.
    """
    for seed in (2, 3, 4, 7):
        carrier = beginning(LOS.carrier, {"yaw": 0.0, "pitch": 62.0, "roll": 62.0})
        problem, truth = made("los", drawn_los(seed, duration_s=86.0, carrier=carrier), seed)
        run = Run(problem, DEFAULT_WINDOW)
        for step in problem.steps(1):
            run.add_step(step)
            if step.time > 62.3:
                assert nees(run.values(), run.covariance(), truth)[0] < 66.0
        batch = solve_batch(problem)
        np.testing.assert_allclose(np.sqrt(np.diag(run.covariance())), batch.sigmas, rtol=0.1)
