"""An incremental run ends with all measurements solved together, as batch has them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import alidade
from alidade.pipelines.applications.cli import app
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head

# The gyro's noise is 30 times the default, and nobody says so.
SCENARIO = HeadScenario.model_validate(
    {
        "duration_s": 8,
        "gyro_rate_hz": 50,
        "vision_rate_hz": 8,
        "noise": {"gyro_density": 1.5e-3, "vision_attitude": 1e-3},
    }
)


IDEAL = alidade.Config.model_validate({"sensors": "ideal"})


@pytest.fixture(scope="module")
def session() -> Session:
    data, _ = simulate_head(SCENARIO, 1)
    return alidade.open({**vars(data), "gyro_density": None, "vision_cov": None}, method="head", config=IDEAL)


@pytest.mark.usefixtures("few_solutions")
def test_numbers_noise_and_verdicts_are_those_of_batch_and_the_course_is_that_of_the_run(session: Session) -> None:
    concluded, online = (session.calibrate("incremental", check=check, report=False) for check in (True, False))
    batch = session.calibrate("batch", report=False)
    assert (concluded.estimate.solver, concluded.status) == ("incremental", batch.status)
    np.testing.assert_array_equal(concluded.estimate.values, batch.estimate.values)
    np.testing.assert_array_equal(concluded.estimate.sigmas, batch.estimate.sigmas)
    assert [level.used for level in concluded.estimate.levels] == [level.used for level in batch.estimate.levels]
    used = {level.noise.name: level.used for level in concluded.estimate.levels}
    rate = np.sqrt((session.data.head_gyro**2).sum(axis=1).mean())
    assert np.hypot(used["gyro_density"], used["gyro_rate_noise"] * rate) == pytest.approx(1.5e-3, rel=0.25)
    history, of_run = concluded.estimate.history, online.estimate.history
    assert history is not None
    assert of_run is not None
    np.testing.assert_array_equal(history.values[:-1], of_run.values[:-1])
    np.testing.assert_array_equal(history.sigmas[-1], concluded.estimate.sigmas)
    assert concluded.solver_difference is not None
    assert online.solver_difference is None
    assert not online.estimate.concluded
    assert online.innovations
    assert not concluded.innovations


@pytest.mark.slow
def test_the_command_says_so(tmp_path: Path) -> None:
    data, truth = simulate_head(SCENARIO.model_copy(update={"duration_s": 4.0}), 1)
    method("head").write_data(tmp_path / "s.mcap", data, truth, "sensors: ideal")
    command = ["calibrate", str(tmp_path / "s.mcap"), "--solver", "incremental", "--out", str(tmp_path / "o")]
    assert CliRunner().invoke(app, command).exit_code in (0, 3, 4)
    text = (tmp_path / "o" / "result.json").read_text()
    assert "at the end all measurements were solved together" in text
    assert json.loads(text)["self_check"] is not None
