"""The indexer method turn by turn: the same answer as batch, at a cost that does not grow."""

from __future__ import annotations

import json
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.indexer.model import problem
from alidade.pipelines.methods.indexer.recording import read_indexer
from alidade.pipelines.methods.indexer.simulation import ARCSEC, IndexerScenario, indexer_config, simulate_indexer
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.builders import IDEAL


def _problem(scenario: IndexerScenario, seed: int) -> tuple[Problem, dict[str, float]]:
    """With the noise stated: levels, which both solvers find to 1 %, are compared elsewhere."""
    data, truth = simulate_indexer(scenario, seed)
    config = load_config(indexer_config(scenario).encode()).model_copy(update={"noise_known": 0.0})
    return problem(data, config), truth


@cache
def _in_batch(name: str) -> tuple[Problem, dict[str, float], Estimate]:
    """Of ideal sensors, and no more samples than it takes."""
    coarse = {"gyro_rate_hz": 100.0, "encoder_rate_hz": 100.0}
    scenario = load_scenario(IndexerScenario, f"indexer_{name}").model_copy(update={"sensors": IDEAL, **coarse})
    graph, truth = _problem(scenario, 1)
    return graph, truth, solve_batch(graph)


def _assert_same(estimate: Estimate, batch: Estimate, apart: float = 0.02) -> None:
    """Values and the angles' sigmas as in batch.

    The bias is reported as its mean, which is carried from turn to turn: over hundreds its sigma gathers rounding.
    """
    assert np.abs((estimate.values - batch.values) / batch.sigmas).max() < apart
    ratio = estimate.sigmas / batch.sigmas
    assert np.abs(ratio[:3] - 1.0).max() < 1e-3
    assert np.abs(ratio - 1.0).max() < 0.2


@pytest.mark.parametrize(
    ("name", "window"),
    [
        pytest.param("ideal", 1.0, marks=pytest.mark.slow),
        pytest.param("two_positions", None, marks=pytest.mark.slow),
        pytest.param("large_angles", 1.0, marks=pytest.mark.slow),
        pytest.param("rough", None, marks=pytest.mark.slow),
        pytest.param("ideal", None, marks=pytest.mark.slow),
        pytest.param("rough", 1.0, marks=pytest.mark.slow),
        pytest.param("large_angles", None, marks=pytest.mark.slow),
        pytest.param("two_positions", 1.0, marks=pytest.mark.slow),
    ],
)
def test_ends_where_batch_does(name: str, window: float | None) -> None:
    graph, truth, batch = _in_batch(name)
    incremental = solve_incremental(graph, window)
    _assert_same(incremental, batch)
    error = incremental.values - np.array([truth[n] for n in incremental.names])
    assert np.abs(error / incremental.sigmas).max() < 3.0
    if name in ("ideal", "large_angles"):
        assert np.abs(error[:3]).max() < 0.1 * ARCSEC


@pytest.mark.slow
def test_independent_simulator_within_three_sigma(shared_data: Path) -> None:
    recording = open_recording(shared_data / "contract" / "indexer_nominal.mcap")
    config = load_config(recording.attachment("alidade.yaml")).model_copy(update={"sensors": IDEAL})
    truth = json.loads((shared_data / "contract" / "indexer_nominal.truth.json").read_text())
    estimate = solve_incremental(problem(read_indexer(recording, config), config))
    expected = np.array([truth[name] for name in estimate.names])
    assert np.abs((estimate.values - expected) / estimate.sigmas).max() < 3.0


@pytest.mark.usefixtures("few_solutions")
def test_ends_where_batch_does_with_real_sensors() -> None:
    scenario = load_scenario(IndexerScenario, "indexer_nominal").model_copy(
        update={"sensors": Sensors(), "gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0}
    )
    graph, truth = _problem(scenario, 1)
    batch, incremental = solve_batch(graph), solve_incremental(graph)
    _assert_same(incremental, batch)
    error = incremental.values - np.array([truth[n] for n in incremental.names])
    assert np.abs(error / incremental.sigmas).max() < 3.0


@pytest.mark.slow
def test_hours_of_indexing_cost_the_same_per_turn() -> None:
    """The last quarter's steps cost what those of the second quarter do, when the window has filled.

    The quickest tenth of them, by processor time: whatever else the machine does only adds to it.
    """
    # Of seed 1 the gate takes one of 3,072 turns.
    graph, _ = _problem(load_scenario(IndexerScenario, "indexer_long"), 2)
    batch = solve_batch(graph)
    moments: list[float] = []

    def clocked(chunk: int) -> object:
        for step in graph.steps(chunk):
            if chunk == 1:  # others are read when the initialisation phase is solved again
                moments.append(time.process_time())
            yield step

    timed = Problem(**{**graph.__dict__, "steps": clocked})
    estimate = solve_incremental(timed)
    cost = np.diff(moments)
    quarter = len(cost) // 4
    early, late = (np.percentile(part, 10.0) for part in (cost[quarter : 2 * quarter], cost[-quarter:]))
    assert late < 1.2 * early
    # Over hours two weak angles gather .036 sigma of linearisation, which adds .1 % to their error.
    _assert_same(estimate, batch, apart=0.05)
