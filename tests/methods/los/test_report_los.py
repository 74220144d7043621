"""The los method's own figures say what the calibration explains."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.methods.los.report import los_plots
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.batch import solve_batch

SCENARIO = LosScenario(duration_s=20.0, image_rate_hz=20.0, gyro_rate_hz=200.0, gimbal_rate_hz=100.0)


def _plots(priors: str) -> list[Plot]:
    data, _ = simulate_los(SCENARIO, 1)
    config = load_config(los_config(SCENARIO).replace("priors: {}", f"priors: {priors}").encode())
    graph = problem(data, config)
    estimate = solve_batch(graph)
    return los_plots(data, cast(Calibration, SimpleNamespace(config=config, problem=graph, estimate=estimate)))


@pytest.mark.parametrize("priors", ["{time_offset: 0.01}", pytest.param("{}", marks=pytest.mark.slow)])
def test_the_prediction_follows_the_measured_error(priors: str) -> None:
    both, left = _plots(priors)
    measured, predicted = ({mark.name.split()[0]: mark.y for mark in both.figure.marks[i::2]} for i in (0, 1))
    for axis in ("phx", "phz"):
        assert np.abs(measured[axis]).max() > 1.0  # mrad
        # 30 urad/sqrt(s) of gyro over 20 s, and 20 urad of picture.
        np.testing.assert_allclose(predicted[axis], measured[axis], atol=0.5)
    spread = {mark.name: np.std(mark.y) for mark in left.figure.marks}
    assert spread["phx, mounting angles found"] < 150.0 < 500.0 < spread["phx, mounting angles zero"]
    assert "µrad" in left.caption
