"""`follow` under clients that misbehave, a bridge that drops and a disk that fills: nothing is lost, memory is flat."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.soak import soak
from tests.support.solved import calibrate


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "clients"), [(15.0, 20), (150.0, 200)], ids=["small", "long"])
def test_nothing_is_lost_and_memory_is_flat_under_attack(seconds: float, clients: int, tmp_path: Path) -> None:
    """For the time that `python -m tests.support.soak --minutes 30` takes, see there."""
    found = soak(tmp_path, seconds, clients)
    assert found.failed == []
    assert found.full > 0, "the disk was full"
    assert found.attacks > seconds
    assert found.astray == 0
    again = calibrate(found.kept, ["incremental"], None, tmp_path / "c.yaml")[0]
    assert found.calibration.facts.duration_s == again.facts.duration_s > 0.9 * seconds
    if seconds > 60.0:  # before that the first batch solutions take turns
        assert found.peak(0.6, 1.0) < 1.25 * found.peak(0.2, 0.6)
