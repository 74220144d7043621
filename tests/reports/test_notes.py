"""What a reader is told beside the headline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from alidade.pipelines.applications.session import calibrate
from alidade.pipelines.methods.los.recording import write_los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from tests.support.builders import make_calibration


def test_a_gyro_turned_by_90_degrees_is_found_and_told(tmp_path: Path) -> None:
    """The graph finds the turn, however far from the prior; that is no mounting error, and the reader is told."""
    scenario = LosScenario(duration_s=15.0, image_rate_hz=20.0, gyro_rate_hz=200.0)
    data, _ = simulate_los(scenario, 1)
    turned = np.stack([data.gyro[:, 1], -data.gyro[:, 0], data.gyro[:, 2]], axis=1)
    write_los(tmp_path / "s.mcap", replace(data, gyro=turned), None, los_config(scenario))
    (found,) = calibrate(tmp_path / "s.mcap", ["batch"])
    told = [note for note in found.notes if "of its prior away" in note]
    assert len(told) == 1
    assert "delta_z by 15.6" in told[0]


def test_what_is_where_it_was_said_to_be_is_no_note() -> None:
    assert make_calibration().notes == ()
