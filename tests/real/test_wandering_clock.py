"""A robot's clock that wanders by 16 ms against that of the gyro: the clock is named."""

from __future__ import annotations

from pathlib import Path

import alidade


def test_the_clock_is_named(shared_data: Path) -> None:
    recording = shared_data / "openaxes_robot" / "circle-100_radius.mcap"
    found = alidade.open(recording, method="head").calibrate(report=False)
    assert found.status == "inconsistent", found.headline
    assert "clock_skew" in found.headline
