"""A mount of half a turn through the commands that compare, join and believe it."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications.joint import calibrate_together
from alidade.pipelines.applications.session import Session, open_session
from alidade.pipelines.applications.validate import validate
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.write import write_results

SCENARIO = {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0, "helmet_mount_deg": [180.0, 0.0, 0.0]}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, chosen = tmp_path_factory.mktemp("half"), method("head")
    paths = []
    for seed in (1, 3):
        simulated = chosen.simulate(chosen.scenario.model_validate(SCENARIO), seed, False)
        data: HeadData = simulated.data
        paths.append(folder / f"r{seed}.mcap")
        config = "method: head\npriors: {helmet_mount_x: null, helmet_mount_y: null, helmet_mount_z: null}\n"
        method("head").write_data(paths[-1], data, None, config)
    return paths


@pytest.mark.slow
def test_two_recordings_of_one_half_turn_agree(recordings: list[Path], tmp_path: Path) -> None:
    alone = [Session.read(open_recording(path), None, None).calibrate(report=False) for path in recordings]
    mounts = [[c.parameters[f"helmet_mount_{a}"].value for a in "xyz"] for c in alone]
    assert all(abs(np.linalg.norm(mount) - np.pi) < 0.02 for mount in mounts)
    assert mounts[0][0] < 0.0 < mounts[1][0], "the two are reported a whole turn apart"
    write_results(tmp_path / "first", alone[0])
    held = validate(recordings[1], tmp_path / "first" / "calibration.yaml")
    assert held.verdict == "holds", held.sentence
    prior = Session.read(open_recording(recordings[1]), None, None, prior=tmp_path / "first" / "calibration.yaml")
    believed = prior.calibrate(report=False)
    joint = calibrate_together([partial(open_session, path) for path in recordings])
    for calibration in (believed, joint):
        assert calibration.status in ("calibrated", "weak")
        vector = np.array([calibration.parameters[f"helmet_mount_{a}"].value for a in "xyz"])
        sigma = max(calibration.parameters[f"helmet_mount_{a}"].sigma for a in "xyz")
        assert abs(np.linalg.norm(vector) - np.pi) < 5.0 * sigma
