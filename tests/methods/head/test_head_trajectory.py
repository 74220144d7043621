"""Attitudes at the gyro's rate, carried from those by vision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.applications.cli import app
from alidade.pipelines.estimation.problem import Attitudes
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.report import between, carried
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.simulation.scenario import load_scenario

FAST = {axis: [{"amplitude_deg": 25, "frequency_hz": f}] for axis, f in {"yaw": 1, "pitch": 0.8, "roll": 0.7}.items()}


def made(**changes: object) -> tuple[HeadScenario, HeadData, dict[str, float]]:
    """A moving platform, mounts, 5 attitudes a second of a head that is shaken."""
    known = load_scenario(HeadScenario, "head_mounts").model_dump()
    given = {"duration_s": 14, "gyro_rate_hz": 200, "vision_rate_hz": 5, "head": FAST, **changes}
    scenario = HeadScenario.model_validate(known | given)
    return scenario, *simulate_head(scenario, 1)


def error(scenario: HeadScenario, time: Array, wxyz: Array) -> float:
    """RMS angle to the truth, deg."""
    off = so3.log(so3.multiply(so3.inverse(scenario.head.attitude(time)), wxyz))
    return float(np.rad2deg(np.sqrt((off**2).sum(axis=1).mean())))


@pytest.mark.parametrize("gaps", [pytest.param([], marks=pytest.mark.slow), [[6.0, 9.0]]], ids=["whole", "gap"])
def test_as_near_to_the_truth_as_at_the_frames(gaps: list[list[float]]) -> None:
    scenario, data, _ = made(vision_outages_s=gaps)
    session = alidade.open(data, method="head")
    at_frames, dense = (
        replace(session, attitude_rate=rate).calibrate(report=False).estimate.attitudes for rate in ("vision", "gyro")
    )
    assert at_frames is not None
    assert dense is not None
    inside = (data.head_t >= at_frames.time[0]) & (data.head_t <= at_frames.time[-1])
    np.testing.assert_array_equal(dense.time, data.head_t[inside])
    slerp = so3.interpolate(at_frames.time, at_frames.wxyz, dense.time)
    reached = error(scenario, at_frames.time, at_frames.wxyz)
    assert error(scenario, dense.time, dense.wxyz) < 1.1 * reached
    assert error(scenario, dense.time, slerp) > 3.0 * reached


def test_what_the_gyro_misses_is_distributed_evenly() -> None:
    """Between attitudes that are right a bias that is off cancels but for how its axis turns; beyond, it does not."""
    quiet = {"gyro_density": 0.0, "gyro_bias_walk": 0.0, "platform_gyro_density": 0.0, "vision_attitude": 0.0}
    scenario, data, truth = made(noise=quiet)
    time = np.arange(1.0, 11.0)
    known = Attitudes(time, scenario.head.attitude(time))
    inside, after = np.linspace(1.0, 10.0, 500), np.array([11.0])
    right = carried(data, known, truth, inside)
    assert error(scenario, inside, right) < 2e-3
    off = {**truth, "gyro_bias_z": truth["gyro_bias_z"] + np.deg2rad(0.5)}
    from_one_side = 0.5 / np.sqrt(3.0)  # deg RMS over the second from one attitude to the next
    assert error(scenario, inside, carried(data, known, off, inside)) < 0.2 * from_one_side
    assert error(scenario, after, carried(data, known, off, after)) == pytest.approx(0.5, rel=0.1)
    shuffled = Attitudes(time[::-1], known.wxyz[::-1])
    np.testing.assert_array_equal(carried(data, shuffled, truth, inside), right)


def written(folder: Path, seed: int = 1) -> Path:
    scenario, *_ = made(duration_s=4)
    path = folder / f"{seed}.mcap"
    data, truth = simulate_head(scenario, seed)
    method("head").write_data(path, data, truth, head_config(scenario))
    return path


def test_the_command_writes_one_for_each_sample(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["calibrate", str(written(tmp_path)), "--attitude-rate", "gyro", "--out", str(out), "--quiet"]
    assert CliRunner().invoke(app, command).exit_code in (0, 3)
    time = np.loadtxt(out / "attitude.tum")[:, 0]
    np.testing.assert_allclose(np.diff(time), 1.0 / 200.0, atol=1e-6)
    assert len(time) > 3.5 * 200
    text = f"attitude.tum has {len(time)} attitudes at the gyro's samples"
    assert text in (out / "result.json").read_text()


def test_several_recordings_each_have_it(tmp_path: Path) -> None:
    paths = [str(written(tmp_path, seed)) for seed in (1, 2)]
    command = ["calibrate", *paths, "--attitude-rate", "gyro", "--out", str(tmp_path / "out"), "--quiet"]
    assert CliRunner().invoke(app, command).exit_code in (0, 3)
    for name in "12":
        assert len(np.loadtxt(tmp_path / "out" / "recordings" / name / "attitude.tum")) > 3.5 * 200


def test_other_methods_and_rates_are_refused_in_a_line() -> None:
    simulated = alidade.simulate("los", {"duration_s": 10.0}, seed=1)
    with pytest.raises(alidade.InputError, match="attitude rate gyro: los has no attitudes between"):
        alidade.calibrate(simulated, attitude_rate="gyro")
    with pytest.raises(alidade.InputError, match="no attitude rate 'imu'; there are vision, gyro"):
        alidade.calibrate(simulated, attitude_rate="imu")  # type: ignore[arg-type]


def test_first_attitudes_in_a_gap_of_more_than_a_turn() -> None:
    """Two pictures two seconds apart, 8 rad: between them the gyro tells, not the shortest way."""
    t, rate = np.arange(0.0, 4.0, 0.01), np.array([0.5, -1.0, 4.0])
    gyro = GyroPath(t, np.tile(rate, (len(t), 1)))
    truth = so3.exp(np.linspace(0.5, 3.5, 25)[:, None] * rate)
    seen = so3.multiply(so3.exp(np.array([0.3, 0.2, 0.1])), truth[[0, 4, 20, 24]])
    found = between(gyro, None, np.linspace(0.5, 3.5, 25)[[0, 4, 20, 24]], seen, np.linspace(0.5, 3.5, 25))
    expected = so3.multiply(so3.exp(np.array([0.3, 0.2, 0.1])), truth)
    assert np.linalg.norm(so3.log(so3.multiply(so3.inverse(expected), found)), axis=1).max() < 1e-6
