"""The walking bias: how its stretches are cut, also where they would be shorter than the time between keyframes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.estimation.walking_bias import WalkingBias
from alidade.pipelines.methods.head.model import problem as head_problem
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los.model import problem as los_problem
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.builders import IDEAL

Made = tuple[Problem, dict[str, float]]


def _walking(config_yaml: str, walk: float) -> Config:
    config = load_config(config_yaml.encode())
    return config.model_copy(update={"noise": config.noise.model_copy(update={"gyro_bias_walk": walk})})


def _head() -> Made:
    scenario = HeadScenario(duration_s=12, vision_rate_hz=20, gyro_rate_hz=200)
    data, truth = simulate_head(scenario, 1)
    return head_problem(data, _walking(head_config(scenario), 1e-2)), truth


def _los() -> Made:
    # With a bias as loose as this and a time offset free, either takes up the noise of the pictures.
    scenario = LosScenario(duration_s=15.0, image_rate_hz=25.0, gyro_rate_hz=200.0, gimbal_rate_hz=100.0, sensors=IDEAL)
    data, truth = simulate_los(scenario, 1)
    return los_problem(data, _walking(los_config(scenario), 1e-3)), truth


def _deviations(estimate: Estimate, truth: dict[str, float]) -> Array:
    free = estimate.sigmas > 0.0
    return np.asarray((estimate.values - [truth[name] for name in estimate.names])[free] / estimate.sigmas[free])


@pytest.mark.parametrize("solve", [solve_batch, pytest.param(solve_incremental, marks=pytest.mark.slow)])
@pytest.mark.parametrize("made", [_head, _los])
def test_a_walk_faster_than_keyframes_follow_is_solved(
    made: Callable[[], Made], solve: Callable[[Problem], Estimate]
) -> None:
    graph, truth = made()
    estimate = solve(graph)
    assert estimate.converged
    assert np.abs(_deviations(estimate, truth)).max() < 4.0


@pytest.mark.parametrize("walk", [0.0, 1e-5, 1e-3, 1e-2, 1.0])
def test_every_node_is_in_force_at_some_keyframe(walk: float) -> None:
    time = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 400))
    time[200:] += 15.0
    middles = 0.5 * (time[1:] + time[:-1])
    bias = WalkingBias.over(time[0], time[-1], middles, walk, 1e-4)
    np.testing.assert_array_equal(np.unique(bias.node_at(middles)), np.arange(bias.nodes))
    assert bias.edges[0] == time[0]
    assert (np.diff(bias.edges) > 0.0).all()


def test_stretches_behind_stay_while_a_recording_grows() -> None:
    middles = np.arange(0.02, 40.0, 0.04)
    whole = WalkingBias.over(0.0, 40.0, middles, 1e-2, 1e-4).edges
    half = WalkingBias.over(0.0, 20.0, middles[middles < 20.0], 1e-2, 1e-4).edges
    np.testing.assert_array_equal(half[:-1], whole[: len(half) - 1])


def test_smoothed_sigma_of_the_first_stretch_is_its_own_not_that_of_the_mean() -> None:
    """A stretch at the end has one neighbour to learn from and is known less well than the next one."""
    scenario = HeadScenario(duration_s=30, vision_rate_hz=20, gyro_rate_hz=200)
    data, _ = simulate_head(scenario, 1)
    estimate = solve_batch(head_problem(data, _walking(head_config(scenario), 1e-5)))
    assert estimate.smoothed is not None
    sigmas = estimate.smoothed.sigmas[:, :3]
    assert (np.diff(sigmas[:4], axis=0) < 0.0).all()
    np.testing.assert_allclose(sigmas[-1], estimate.sigmas[:3], rtol=1e-9)
