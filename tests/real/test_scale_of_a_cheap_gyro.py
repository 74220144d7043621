"""A real gyro 5 to 9 % off its data sheet, against motion capture: its scale is named, and the mount is right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications.session import calibrate
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.reports.result import Calibration

# Found by an independent fit with the scales free, repeatable to 0.05 deg on another recording of the device.
MOUNT_DEG = (-0.32, -0.38, -0.10)


def calibrated(recording: Path, config: str, tmp_path: Path) -> Calibration:
    (tmp_path / "c.yaml").write_text(config)
    return calibrate(recording, ["batch"], "head", tmp_path / "c.yaml")[0]


@pytest.fixture
def recording(shared_data: Path) -> Path:
    return shared_data / "upenn_imu_vicon" / "u1.mcap"


def test_the_scale_is_named_first(recording: Path, tmp_path: Path) -> None:
    found = calibrated(recording, "{}", tmp_path)
    assert found.status == "inconsistent"
    first = next(finding for finding in found.findings if finding.severity == Severity.INCONSISTENT)
    assert first.kind == "prior_conflict"
    assert first.evidence["parameter"].startswith("gyro_scale_")


def test_with_its_true_data_sheet_the_mount_is_right(recording: Path, tmp_path: Path) -> None:
    found = calibrated(recording, "sensors: {gyro: {scale: 0.1}}", tmp_path)
    mount = [found.parameters[f"helmet_mount_{axis}"] for axis in "xyz"]
    off = [p.value - np.deg2rad(true) for p, true in zip(mount, MOUNT_DEG, strict=True)]
    assert max(abs(error) / p.sigma for error, p in zip(off, mount, strict=True)) < 3.0
    scales = [found.parameters[f"gyro_scale_{axis}"] for axis in "xyz"]
    assert all(abs(p.value) > 5.0 * p.sigma for p in scales)
