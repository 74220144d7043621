"""The indexer simulator against kinematics done another way, and through a file and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.earth import EARTH_RATE
from alidade.pipelines.config import load_config
from alidade.pipelines.methods import simulate
from alidade.pipelines.methods.indexer.recording import read_indexer
from alidade.pipelines.methods.indexer.simulation import (
    ARCSEC,
    IndexerNoise,
    IndexerScenario,
    Position,
    simulate_indexer,
)
from alidade.pipelines.methods.indexer.windows import axis_motion
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.scenario import load_scenario

QUIET = IndexerNoise(gyro_density=0.0)
SHORT = [Position(axis="outer", other_deg=0, turns=1), Position(axis="inner", other_deg=180, turns=1)]
NAMES = ["nominal", "ideal", "rough", "large_angles", "two_positions", "hour", "long"]


def _scenario(**settings: object) -> IndexerScenario:
    return IndexerScenario.model_validate(
        {"positions": SHORT, "noise": QUIET, "gyro_bias_deg_h": 0, "mounting_deg": (0, 0, 0), **settings}
    )


def test_at_rest_the_gyro_sees_the_earth_and_turning_the_axis() -> None:
    data, _ = simulate_indexer(_scenario(latitude_deg=30.0), 1)
    earth = EARTH_RATE * np.array([0.0, np.cos(np.pi / 6), 0.5])
    np.testing.assert_allclose(data.gyro[10], earth, atol=1e-12)
    np.testing.assert_allclose(data.gyro[2000, 0], np.deg2rad(10.0), atol=1e-9)


def test_gyro_integrates_to_the_attitude_put_out() -> None:
    """The product of the samples' rotations is the attitude against inertial space, whatever the axes do."""
    data, _ = simulate_indexer(
        _scenario(
            attitude_noise_arcsec=0,
            mounting_deg=(3, -2, 1),
            ripple=0.02,
            wobble_arcsec=50,
            encoder_harmonics_arcsec=[30],
            axis_nonperpendicularity_arcsec=600,
            base_attitude=(0.5, 0.5, -0.5, 0.5),
            gyro_rate_hz=2000,
        ),
        1,
    )
    assert data.attitude is not None
    end = 40000
    step = 1.0 / 2000.0
    turns = so3.exp(0.5 * (data.gyro[:end] + data.gyro[1 : end + 1]) * step)
    while len(turns) > 1:
        if len(turns) % 2:
            turns = np.concatenate([turns, so3.identity(1)])
        turns = so3.multiply(turns[::2], turns[1::2])
    (total,) = turns
    latitude = np.deg2rad(40.0)
    turned = so3.exp(EARTH_RATE * end * step * np.array([0.0, np.cos(latitude), np.sin(latitude)]))
    expected = so3.compose(so3.inverse(data.attitude[0]), turned, data.attitude[end])
    assert np.linalg.norm(so3.log(so3.multiply(so3.inverse(expected), total))) < 2e-7


def test_runs_are_found_wrapped_or_not_and_drives_turn_what_they_are_told() -> None:
    for wrapped in (False, True):
        data, _ = simulate_indexer(_scenario(encoder_wrapped=wrapped, ripple=0.02), 1)
        runs = [run for run in axis_motion(data).runs if run.axis != "none"]
        assert [run.axis for run in runs] == ["outer", "outer", "outer", "inner", "inner"]
        turned = np.rad2deg([run.turned for run in runs])
        np.testing.assert_allclose(turned, [360, -360, 180, 360, -360], atol=0.02)
        assert [run.whole_turns for run in runs] == [1, 1, 0, 1, 1]
        assert np.rad2deg(runs[-1].other) == pytest.approx(180.0, abs=0.02)


def test_gyro_scale_bias_and_noise_are_as_stated() -> None:
    noise = IndexerNoise(gyro_density=1e-5)
    exact, _ = simulate_indexer(_scenario(), 3)
    data, truth = simulate_indexer(
        _scenario(
            noise=noise,
            gyro_bias_deg_h=100,
            effects={"gyro_scale_x": 1e-3, "gyro_scale_y": -2e-3, "gyro_scale_z": 3e-3},
        ),
        3,
    )
    scale, bias = ([truth[f"{name}_{a}"] for a in "xyz"] for name in ("gyro_scale", "gyro_bias"))
    white = data.gyro - (1.0 + np.array(scale)) * exact.gyro - bias
    assert white.std() == pytest.approx(1e-5 * np.sqrt(200.0), rel=0.02)
    assert np.abs(white.mean(axis=0)).max() < 4.0 * white.std() / np.sqrt(len(white))


def test_encoders_read_harmonics_quantised() -> None:
    """The drives follow the encoders: the reading is smooth, and the true angle departs from it."""
    plain, _ = simulate_indexer(_scenario(attitude_noise_arcsec=0), 1)
    data, _ = simulate_indexer(_scenario(attitude_noise_arcsec=0, encoder_harmonics_arcsec=[20.0], encoder_bits=20), 1)
    assert np.abs(data.outer - plain.outer).max() <= np.pi / 2**20 + 1e-12
    assert data.attitude is not None
    assert plain.attitude is not None
    away = np.linalg.norm(so3.log(so3.multiply(so3.inverse(plain.attitude), data.attitude)), axis=1)
    assert 20.0 < away.max() / ARCSEC < 40.0


def test_unrecorded_moves_leave_gaps() -> None:
    data, _ = simulate_indexer(_scenario(record_moves=False), 1)
    assert len(axis_motion(data).gaps) == 1
    assert axis_motion(data).gaps[0][1] - axis_motion(data).gaps[0][0] == pytest.approx(18.5, abs=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenarios_load(name: str) -> None:
    load_scenario(IndexerScenario, f"indexer_{name}")


def test_written_and_read_back_gives_the_same_arrays(tmp_path: Path) -> None:
    settings = tmp_path / "short.yaml"
    settings.write_text(
        "positions: [{axis: inner, other_deg: 0, turns: 1}]\nattitude_noise_arcsec: 1\nencoder_phase: 0.3\n"
        "priors: {gyro_scale_x: 1.0e-3}\n"
    )
    simulate("indexer", str(settings), 5, tmp_path / "s.mcap", images=False)
    recording = open_recording(tmp_path / "s.mcap")
    config = load_config(recording.attachment("alidade.yaml"))
    data, _ = simulate_indexer(load_scenario(IndexerScenario, settings), 5)
    read = read_indexer(recording, config)
    for name in ("gyro_t", "gyro", "encoder_t", "outer", "inner", "attitude"):
        np.testing.assert_array_equal(getattr(read, name), getattr(data, name), err_msg=name)
    assert read.latitude_deg == data.latitude_deg
    assert data.gyro_density is not None
    assert read.gyro_density == pytest.approx(data.gyro_density, rel=1e-9)
    assert config.priors == {"gyro_scale_x": 1e-3}
