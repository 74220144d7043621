"""The last online estimate beside batch's, in the result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from alidade.pipelines.applications.cli import app
from alidade.pipelines.diagnostics.goodness_of_fit import solver_difference
from alidade.pipelines.estimation.problem import Estimate, Quantity
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from tests.support.builders import IDEAL

SCENARIO = LosScenario(duration_s=6.0, image_rate_hz=6.0, gyro_rate_hz=50.0, gimbal_rate_hz=50.0, sensors=IDEAL)


_REQUIRED = [Quantity(name, "rad", 1.0, 1.0, 0.1) for name in "ab"]


def _estimate(values: list[float]) -> Estimate:
    return Estimate("batch", ("a", "b", "pinned"), np.array(values), np.diag([0.04, 0.25, 0.0]), True, "")


def test_the_largest_difference_is_told() -> None:
    batch = _estimate([1.0, 2.0, 0.0])
    found = solver_difference(
        replace(_estimate([1.1, 3.0, 0.0]), covariance=np.diag([0.04, 0.16, 0.0])), batch, _REQUIRED
    )
    assert found is not None
    assert found.parameter == "b"
    assert found.z == pytest.approx(2.5)
    assert found.sigma_ratio == pytest.approx(0.8)
    assert solver_difference(batch, replace(batch, converged=False), _REQUIRED) is None
    only = solver_difference(_estimate([1.1, 3.0, 0.0]), batch, _REQUIRED[:1])
    assert only is not None
    assert only.parameter == "a"


@pytest.mark.usefixtures("few_solutions")
@pytest.mark.parametrize("option", [[], pytest.param(["--no-check"], marks=pytest.mark.slow)])
def test_the_result_has_it_unless_it_is_not_wanted(option: list[str], tmp_path: Path) -> None:
    data, truth = simulate_los(SCENARIO, 1)
    method("los").write_data(tmp_path / "s.mcap", data, truth, los_config(SCENARIO))
    command = ["calibrate", str(tmp_path / "s.mcap"), "--solver", "incremental", "--out", str(tmp_path), *option]
    assert CliRunner().invoke(app, command).exit_code in (0, 3)
    found = json.loads((tmp_path / "result.json").read_text())["self_check"]
    if option:
        assert found is None
    else:
        assert abs(found["difference"]) < 0.3
