"""The sequential history of the batch solver agrees with solving only the past."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.indexer import model as indexer
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, indexer_config, simulate_indexer
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.solvers import chain
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.builders import IDEAL
from tests.support.short_problems import head_problem, los_problem


def _until(problem: Problem, stop: float) -> Problem:
    """The steps of one measurement each until then; all of them would be one."""
    return replace(
        problem, steps=lambda _: (step for step in problem.steps(1) if step.time <= stop), refined_graph=None
    )


@pytest.mark.parametrize("make", [los_problem, pytest.param(head_problem, marks=pytest.mark.slow)])
def test_history_agrees_with_solving_the_past_alone(
    make: Callable[[], Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every keyframe is a moment, so that both have the same ones.
    monkeypatch.setattr(chain, "SEQUENTIAL_STATES", 10_000)
    problem = make()
    whole = solve_batch(problem, history=True)
    history = whole.history
    assert history is not None
    assert (np.abs(history.values[-1] - whole.values) <= 1e-3 * whole.sigmas).all()
    np.testing.assert_allclose(history.sigmas[-1], whole.sigmas, rtol=1e-6)
    middle = len(history.time) // 2
    past = solve_batch(_until(problem, float(history.time[middle])), history=True)
    assert past.history is not None
    # The last step of a session reports the mean of a bias that walks, so the moment before is compared.
    (then,) = np.flatnonzero(history.time == past.history.time[-2])
    values, sigmas = history.values[then], history.sigmas[then]
    np.testing.assert_allclose(past.history.sigmas[-2], sigmas, rtol=0.1)
    assert np.abs((past.history.values[-2] - values) / sigmas).max() < 0.3


def test_history_where_sigmas_are_below_what_gtsam_takes_for_a_constraint() -> None:
    """A quiet gyro, or hours of one, ties the session's mean bias to less than 1e-8 rad/s: no constraint for that."""
    ideal = load_scenario(IndexerScenario, "indexer_rough")
    noise = ideal.noise.model_copy(update={"gyro_density": 1e-8, "gyro_bias_walk": 1e-12})
    scenario = ideal.model_copy(update={"noise": noise, "sensors": IDEAL})
    data, _ = simulate_indexer(scenario, 1)
    whole = solve_batch(indexer.problem(data, load_config(indexer_config(scenario).encode())), history=True)
    assert whole.history is not None
    np.testing.assert_allclose(whole.history.values[-1], whole.values, atol=1e-3 * whole.sigmas.min())
    np.testing.assert_allclose(whole.history.sigmas[-1], whole.sigmas, rtol=1e-6)
