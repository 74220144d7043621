"""Recordings in which nothing moves, or not yet: they say what is missing, not that the solver failed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.sensors import EulerMotion
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.judged import judge

STILL = EulerMotion()
HEAD = HeadScenario(duration_s=12.0, head=STILL, vision_rate_hz=10.0, gyro_rate_hz=100.0, sensors=Sensors())
LOS = LosScenario(duration_s=10.0, carrier=STILL, image_rate_hz=10.0, gyro_rate_hz=100.0, gimbal_rate_hz=100.0)


def head_at_rest(seed: int) -> Problem:
    return head.problem(simulate_head(HEAD, seed).data, load_config(head_config(HEAD).encode()))


def los_at_rest(seed: int) -> Problem:
    return los.problem(simulate_los(LOS, seed).data, load_config(los_config(LOS).encode()))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 5))])
@pytest.mark.parametrize(
    ("make", "missing"),
    [(head_at_rest, "nod and shake the head"), (los_at_rest, "sway")],
    ids=["head", "los"],
)
def test_batch_names_the_motion_that_is_missing(make: Callable[[int], Problem], missing: str, seed: int) -> None:
    problem = make(seed)
    estimate = solve_batch(problem)
    assert estimate.converged, estimate.message
    judged = judge(problem.quantities, estimate.covariance, estimate.chi_square, problem.advice)
    assert judged.status == "unobservable"
    assert missing in judged.headline
    # Nothing is made up: what is not known is within what the prior allows.
    prior = np.array([q.scale for q in problem.quantities])
    assert (np.abs(estimate.values) < 2.5 * prior).all()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_vision_better_than_the_gyro_tells_no_time_offset_at_rest(seed: int) -> None:
    """Gyro noise turns what is seen by the time offset: 320 pictures of 50 urad once gave it to 2 ms."""
    noise = HEAD.noise.model_copy(update={"vision_attitude": 5e-5})
    clean = HEAD.model_copy(update={"duration_s": 8.0, "vision_rate_hz": 40.0, "noise": noise})
    problem = head.problem(simulate_head(clean, seed).data, load_config(head_config(clean).encode()))
    estimate = solve_batch(problem)
    assert estimate.converged, estimate.message
    offset = estimate.names.index("time_offset")
    assert estimate.sigmas[offset] == pytest.approx(problem.quantities[offset].scale, rel=1e-3)
    assert judge(problem.quantities, estimate.covariance, None, problem.advice).status == "unobservable"
