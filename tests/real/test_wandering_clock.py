"""A robot's clock that wanders by 16 ms against that of the gyro: the clock is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import alidade
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config


@pytest.mark.parametrize("every", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_the_clock_is_named(shared_data: Path, every: int) -> None:
    recording = shared_data / "openaxes_robot" / "circle-100_radius.mcap"
    whole = alidade.open(recording, method="head").data
    assert whole.head_force is not None
    thinned = replace(
        whole,
        head_t=whole.head_t[::every],
        head_gyro=whole.head_gyro[::every],
        head_force=whole.head_force[::every],
    )
    found = Session(methods.method("head"), thinned, load_config(None)).calibrate("batch", report=False)
    assert found.status == "inconsistent", found.headline
    assert "clock_skew" in found.headline
