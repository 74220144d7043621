"""Replaying a second recording with the angles found in a first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.cross_validation import peak, rms
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.methods.los.report import validate
from alidade.pipelines.methods.los.simulation import LosNoise, LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.builders import IDEAL

SILENT = LosNoise(gyro_density=0.0, gyro_bias_walk=0.0, encoder=0.0, los_error=0.0, los_roll=0.0)


def test_replay_without_noise_at_the_truth_leaves_nothing() -> None:
    scenario = LosScenario(noise=SILENT, gyro_turn_on_bias=1e-3, gyro_rate_hz=1000, duration_s=30.0)
    data, truth = simulate_los(scenario, 1)
    drifting, steady = validate(data, Config(), truth)
    assert rms(drifting.before) > 5e-3
    # The acquisition error turns about the rolling line of sight, and the gyro is integrated as if linear in between.
    assert peak(drifting.after) < 0.02 * peak(drifting.before)
    assert peak(steady.after) <= peak(drifting.after) + 1e-12


def test_replay_with_nothing_compensated_is_the_recording() -> None:
    data, _ = simulate_los(LosScenario(duration_s=20.0), 1)
    drifting, _ = validate(data, Config(), {})
    np.testing.assert_allclose(drifting.after, drifting.before, atol=1e-12)
    np.testing.assert_allclose(drifting.before, data.error[:, :2] - data.error[0, :2])


@pytest.mark.parametrize("name", [pytest.param("los_nominal", marks=pytest.mark.slow), "los_outliers"])
def test_second_recording_is_stabilised_by_the_angles_of_the_first(name: str) -> None:
    scenario = load_scenario(LosScenario, name).model_copy(update={"image_rate_hz": 25.0, "sensors": IDEAL})
    first, _ = simulate_los(scenario, 1)
    config = load_config(los_config(scenario).encode())
    estimate = solve_batch(problem(first, config))
    found = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    second, _ = simulate_los(scenario.model_copy(update={"azimuth_deg": -15.0, "elevation_deg": 35.0}), 2)
    _, steady = validate(second, config, found)
    assert rms(steady.after) < 0.3 * rms(steady.before)
    assert peak(steady.after) < 0.3 * peak(steady.before)
    turned = validate(second, config, {key: -value for key, value in found.items()})[1]
    assert rms(turned.after) > 1.5 * rms(turned.before)


def test_outliers_are_left_out_and_counted() -> None:
    data, _ = simulate_los(LosScenario(duration_s=20.0), 1)
    error = data.error.copy()
    error[[100, 500], 0] += 0.05
    drifting, steady = validate(replace(data, error=error), Config(), {})
    assert peak(drifting.before) < 0.02
    assert "of 1000 LOS errors left out as outliers" in steady.note


def test_turn_on_bias_is_reestimated_given_the_calibrated_device(tmp_path: Path) -> None:
    """As stored, the error has the gyro bias of the other recording, which turns the line of sight away."""
    short = LosScenario(duration_s=20.0, gyro_rate_hz=100.0, image_rate_hz=10.0)
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for seed, path in ((1, first), (2, second)):
        method("los").write(path, simulate_los(short, seed))
    alidade.calibrate(first).write(tmp_path / "out")
    held = alidade.validate(second, tmp_path / "out" / "calibration.yaml")
    stored, applied, expected = (each[0] for each in (held.validations, held.device, held.best))
    assert rms(applied.after) < 0.5 * min(rms(stored.after), rms(stored.before))
    assert rms(applied.after) < 3.0 * rms(expected.after)
