"""The indexer method turn by turn: the same answer as batch, at a cost that does not grow."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from pipelines.methods.base import Estimate, Problem
from pipelines.methods.indexer import problem
from pipelines.sessions.config import load_config
from pipelines.sessions.indexer import read_indexer
from pipelines.sessions.reading import open_recording
from pipelines.simulation.indexer import ARCSEC, IndexerScenario, indexer_config, simulate_indexer
from pipelines.simulation.scenario import load_scenario
from pipelines.solvers.batch import solve_batch
from pipelines.solvers.incremental import solve_incremental


def _problem(scenario: IndexerScenario, seed: int) -> tuple[Problem, dict[str, float]]:
    data, truth = simulate_indexer(scenario, seed)
    return problem(data, load_config(indexer_config(scenario).encode())), truth


def _distance(estimate: Estimate, batch: Estimate) -> float:
    """Largest difference in sigmas, of values and of the sigmas themselves."""
    moved = np.abs(estimate.values - batch.values) / batch.sigmas
    return float(max(moved.max(), np.abs(estimate.sigmas / batch.sigmas - 1.0).max()))


@pytest.mark.parametrize("window", [1.0, None], ids=["window", "all"])
@pytest.mark.parametrize("name", ["ideal", "rough", "large_angles", "two_positions"])
def test_ends_where_batch_does(name: str, window: float | None) -> None:
    graph, truth = _problem(load_scenario(IndexerScenario, f"indexer_{name}"), 1)
    batch, incremental = solve_batch(graph), solve_incremental(graph, window)
    assert _distance(incremental, batch) < 0.02
    error = incremental.values - np.array([truth[n] for n in incremental.names])
    assert np.abs(error / incremental.sigmas).max() < 3.0
    if name in ("ideal", "large_angles"):
        assert np.abs(error[:3]).max() < 0.1 * ARCSEC


def test_independent_simulator_within_three_sigma(shared_data: Path) -> None:
    recording = open_recording(shared_data / "contract" / "indexer_nominal.mcap")
    config = load_config(recording.attachment("alidade.yaml"))
    truth = json.loads((shared_data / "contract" / "indexer_nominal.truth.json").read_text())
    estimate = solve_incremental(problem(read_indexer(recording, config), config))
    expected = np.array([truth[name] for name in estimate.names])
    assert np.abs((estimate.values - expected) / estimate.sigmas).max() < 3.0


@pytest.mark.slow
def test_hours_of_indexing_cost_the_same_per_turn() -> None:
    """The last quarter's steps cost what those of the second quarter do, when the window has filled.

    The quickest tenth of them: whatever else the machine does only adds to a step's time.
    """
    graph, _ = _problem(load_scenario(IndexerScenario, "indexer_long"), 1)
    batch = solve_batch(graph)
    moments: list[float] = []

    def clocked(chunk: int) -> object:
        for step in graph.steps(chunk):
            moments.append(time.perf_counter())
            yield step

    timed = Problem(**{**graph.__dict__, "steps": clocked})
    estimate = solve_incremental(timed)
    cost = np.diff(moments)
    quarter = len(cost) // 4
    early, late = (np.percentile(part, 10.0) for part in (cost[quarter : 2 * quarter], cost[-quarter:]))
    assert late < 1.2 * early
    assert _distance(estimate, batch) < 0.02
