"""What a reader is told beside the headline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from tests.support.builders import make_calibration
from tests.support.solved import calibrate


@pytest.mark.slow
def test_a_gyro_turned_by_90_degrees_is_found_and_told(tmp_path: Path) -> None:
    """The graph finds the turn, however far from the prior; that is no mounting error, and the reader is told."""
    scenario = LosScenario(duration_s=15.0, image_rate_hz=20.0, gyro_rate_hz=200.0)
    data, _ = simulate_los(scenario, 1)
    turned = np.stack([data.gyro[:, 1], -data.gyro[:, 0], data.gyro[:, 2]], axis=1)
    method("los").write_data(tmp_path / "s.mcap", replace(data, gyro=turned), None, los_config(scenario))
    (found,) = calibrate(tmp_path / "s.mcap", ["batch"])
    far = [f.evidence for f in found.findings if f.kind == "prior_conflict" and f.evidence["parameter"] == "delta_z"]
    assert [round(each["z"], 1) for each in far] in ([15.6], [-15.6])
    assert any(note.startswith("delta_z is far from its prior: ") for note in found.notes)


def test_what_is_where_it_was_said_to_be_is_no_note() -> None:
    assert make_calibration().notes == ()
