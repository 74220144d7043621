"""The indexer's own figures say what the recording holds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np

from alidade.pipelines.config import load_config
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.methods.indexer.model import problem
from alidade.pipelines.methods.indexer.report import indexer_plots
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, Position, indexer_config, simulate_indexer
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.batch import solve_batch


def _plots(scenario: IndexerScenario) -> dict[str, Plot]:
    data, _ = simulate_indexer(scenario, 1)
    config = load_config(indexer_config(scenario).encode())
    graph = problem(data, config)
    estimate = solve_batch(graph)
    found = indexer_plots(data, cast(Calibration, SimpleNamespace(config=config, problem=graph, estimate=estimate)))
    return {plot.title: plot for plot in found}


def test_figures_of_a_whole_schedule() -> None:
    plots = _plots(IndexerScenario(attitude_noise_arcsec=1, gyro_rate_hz=100))
    assert list(plots) == ["Attitude output", "Half differences", "Misfit by turn", "What each position says"]
    half = plots["Half differences"].figure
    measured, compensated = (mark.columns["high"] for mark in half.marks)
    assert list(half.x_labels) == ["1 yt", "1 zt", "2 yt", "2 zt", "3 xt", "3 yt", "4 xt", "4 yt"]
    assert np.abs(compensated).max() < 1.0 < 500.0 < np.abs(measured).max()
    *_, last = plots["What each position says"].figure.marks
    np.testing.assert_allclose(last.columns["high"], 100.0)


def test_figures_without_attitude_and_without_a_published_position() -> None:
    plots = _plots(IndexerScenario(positions=[Position(axis="outer", other_deg=90, turns=1)], gyro_rate_hz=100))
    assert list(plots) == ["Misfit by turn", "What each position says"]
