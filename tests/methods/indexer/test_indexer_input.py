"""What an indexer recording may lack: one clear line each, and what is left is used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.indexer.model import problem
from alidade.pipelines.methods.indexer.recording import INDEXER, JOINTS, IndexerData, read_indexer
from alidade.pipelines.methods.indexer.report import validate
from alidade.pipelines.methods.indexer.simulation import (
    IndexerNoise,
    IndexerScenario,
    Position,
    indexer_config,
    simulate_indexer,
)
from alidade.pipelines.methods.indexer.windows import axis_motion
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch

SCENARIO = IndexerScenario(
    positions=[
        Position(axis="outer", other_deg=0, turns=2),
        Position(axis="inner", other_deg=0, turns=2),
    ],
    gyro_rate_hz=100,
    noise=IndexerNoise(gyro_density=1e-6, encoder=1e-6),
    encoder_bits=26,
)


@pytest.fixture(scope="module")
def session() -> Simulated:
    return simulate_indexer(SCENARIO, 1)


def _config(extra: str = "") -> Config:
    return load_config((indexer_config(SCENARIO) + extra).encode())


def _errors(data: IndexerData, truth: dict[str, float], config: Config | None = None) -> np.ndarray:
    estimate = solve_batch(problem(data, config or _config()))
    expected = np.array([truth[name] for name in estimate.names])
    return np.asarray((estimate.values - expected) / estimate.sigmas)


def test_no_rotation(session: Simulated) -> None:
    data, _ = session
    still = replace(data, outer=0.0 * data.outer, inner=1e-3 * np.sin(data.encoder_t))
    with pytest.raises(
        InputError, match=r"no rotation found, the outer axis moves by 0 deg and the inner by 0.115 deg"
    ):
        problem(still, _config())


@pytest.mark.parametrize(("name", "axis"), [("outer", "outer_x"), ("inner", "inner_z")])
def test_encoder_that_counts_the_other_way_is_named(session: Simulated, name: str, axis: str) -> None:
    data, _ = session
    with pytest.raises(InputError, match=f"the axis {axis} disagree in sign"):
        problem(replace(data, **{name: -getattr(data, name)}), _config())


def test_gear_that_is_off_by_two_percent_is_named(session: Simulated) -> None:
    data, _ = session
    with pytest.raises(InputError, match=r"about the axis outer_x the gyro turns at 98.0\d* % of the encoder's rate"):
        problem(replace(data, outer=1.02 * data.outer), _config())
    problem(replace(data, outer=1.009 * data.outer), _config())


def test_missing_latitude_is_refused_when_the_earth_shows(session: Simulated) -> None:
    data, truth = session
    blind = replace(data, latitude_deg=None)
    with pytest.raises(InputError, match=r"latitude is not known; record /fix or give latitude_deg"):
        problem(blind, _config())
    noise = _config().noise.model_copy(update={"gyro_density": 1e-3})
    coarse = _config().model_copy(update={"noise": noise, "noise_known": 0.0})
    assert np.abs(_errors(blind, truth, coarse)).max() < 1.0


def test_unknown_parameter_names_the_nearest(session: Simulated) -> None:
    config = _config().model_copy(update={"priors": {"tetha_x": 0.1}})
    with pytest.raises(InputError, match=r"priors.tetha_x; the nearest known key is theta_x"):
        problem(session.data, config)


@pytest.mark.parametrize("stream", ["gyro", "encoder"])
def test_gap_in_a_turn_is_told_and_the_rest_is_used(session: Simulated, stream: str) -> None:
    data, truth = session
    if stream == "gyro":
        keep = (data.gyro_t < 20.0) | (data.gyro_t > 27.0)
        damaged = replace(data, gyro_t=data.gyro_t[keep], gyro=data.gyro[keep])
    else:
        keep = (data.encoder_t < 20.0) | (data.encoder_t > 27.0)
        damaged = replace(data, encoder_t=data.encoder_t[keep], outer=data.outer[keep], inner=data.inner[keep])
    found = problem(damaged, _config())
    assert any("cut by a gap" in reason for reason in found.dropped)
    assert np.abs(_errors(damaged, truth)).max() < 4.0


def test_turn_in_which_the_gyro_stuck_is_rejected(session: Simulated) -> None:
    data, truth = session
    gyro = data.gyro.copy()
    gyro[(data.gyro_t > 20.0) & (data.gyro_t < 25.0)] = 0.0
    stuck = replace(data, gyro=gyro)
    turns = solve_batch(problem(stuck, _config())).residuals["turn"]
    assert 0 < np.count_nonzero(~turns.used) <= 8  # windows of a turn that begin at each eighth of it
    assert np.abs(turns.time[~turns.used] - 22.5).max() < 36.0
    assert np.abs(_errors(stuck, truth)).max() < 4.0


@pytest.mark.parametrize("rows", [slice(None), slice(7, 8)])
def test_an_orientation_that_is_not_there_throughout_is_none(session: Simulated, rows: slice, tmp_path: Path) -> None:
    data, _ = session
    turning = so3.exp(np.outer(data.gyro_t, [0.0, 0.0, 0.1]))
    lacking = turning.copy()
    lacking[rows] = np.nan
    for wxyz, there in ((turning, True), (lacking, False)):
        method("indexer").write_data(tmp_path / "s.mcap", replace(data, attitude=wxyz))
        found = read_indexer(open_recording(tmp_path / "s.mcap"), _config())
        assert (found.attitude is not None) is there


def test_fixes_that_never_came_are_none(session: Simulated, tmp_path: Path) -> None:
    method("indexer").write_data(tmp_path / "s.mcap", session.data)
    whole = open_recording(tmp_path / "s.mcap")
    none = series.FixSeries(np.empty(0, np.int64), np.empty(0), np.empty(0))
    topics: dict[str, series.Topic] = {
        "/imu": whole.imu("/imu"),
        INDEXER.name: whole.joints(INDEXER.name, JOINTS),
        "/fix": none,
    }
    write_session(tmp_path / "empty.mcap", topics)
    recording = open_recording(tmp_path / "empty.mcap")
    assert "/fix" in recording.topics
    assert read_indexer(recording, load_config(None)).latitude_deg is None


def test_fixes_without_a_position_are_refused(session: Simulated, tmp_path: Path) -> None:
    method("indexer").write_data(tmp_path / "s.mcap", session.data)
    whole = open_recording(tmp_path / "s.mcap")
    topics: dict[str, series.Topic] = {
        "/imu": whole.imu("/imu"),
        INDEXER.name: whole.joints(INDEXER.name, JOINTS),
        "/fix": replace(whole.fixes("/fix"), status=np.array([-1])),
    }
    write_session(tmp_path / "lost.mcap", topics)
    with pytest.raises(InputError, match=r"topic /fix: none of 1 messages has a position fix"):
        read_indexer(open_recording(tmp_path / "lost.mcap"), load_config(None))


@pytest.mark.parametrize("wrap", [np.pi, 2.0 * np.pi])
def test_wrapped_and_continuous_encoders_give_the_same(session: Simulated, wrap: float) -> None:
    data, _ = session
    low = wrap - 2.0 * np.pi
    wrapped = replace(data, outer=(data.outer - low) % (2 * np.pi) + low, inner=(data.inner - low) % (2 * np.pi) + low)
    assert np.ptp(wrapped.outer) < 6.3
    expected, got = solve_batch(problem(data, _config())), solve_batch(problem(wrapped, _config()))
    np.testing.assert_allclose(got.values, expected.values, atol=1e-3 * expected.sigmas.min())


@pytest.mark.parametrize(("gyro_hz", "encoder_hz"), [(50, 10), (37, 1000), (400, 23.7)])
def test_any_rates(gyro_hz: float, encoder_hz: float) -> None:
    scenario = SCENARIO.model_copy(
        update={"gyro_rate_hz": gyro_hz, "encoder_rate_hz": encoder_hz, "encoder_phase": 0.37}
    )
    assert np.abs(_errors(*simulate_indexer(scenario, 4))).max() < 4.0


def test_reversal_without_a_rest() -> None:
    """Forward and back are two runs even when the axis stops for no longer than it takes to turn round."""
    scenario = SCENARIO.model_copy(update={"dwell_s": 0.02})
    data, truth = simulate_indexer(scenario, 2)
    turning = [run for run in axis_motion(data).runs if run.axis != "none"]
    assert [run.whole_turns * run.direction for run in turning] == [2, -2, 2, -2]
    assert np.abs(_errors(data, truth)).max() < 4.0


def test_coarse_encoders_are_slow_errors() -> None:
    """Sixteen bits, 20 arc seconds a step: the resting encoder shows no scatter."""
    scenario = SCENARIO.model_copy(
        update={"encoder_bits": 16, "noise": IndexerNoise(gyro_density=1e-6), "gyro_rate_hz": 200.0}
    )
    data, truth = simulate_indexer(scenario, 3)
    config = load_config(indexer_config(scenario).encode())
    assert np.abs(_errors(data, truth, config)).max() < 3.0


def test_runs_cut_in_the_middle_of_a_turn(session: Simulated) -> None:
    """A recording that starts and stops while an axis turns."""
    data, truth = session
    g = (data.gyro_t > 13.0) & (data.gyro_t < data.gyro_t[-1] - 30.0)
    e = (data.encoder_t > 12.0) & (data.encoder_t < data.encoder_t[-1] - 31.0)
    part = replace(
        data,
        gyro_t=data.gyro_t[g],
        gyro=data.gyro[g],
        encoder_t=data.encoder_t[e],
        outer=data.outer[e],
        inner=data.inner[e],
    )
    assert axis_motion(part).runs[0].axis == "outer"
    assert np.abs(_errors(part, truth)).max() < 4.0


def test_validation_without_an_attitude_looks_at_the_turns(session: Simulated) -> None:
    data, truth = session
    (turns,) = validate(data, _config(), truth)
    assert np.abs(turns.after).max() < 1e-4 < np.abs(turns.before).max()
