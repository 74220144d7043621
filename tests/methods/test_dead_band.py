"""A gyro that reads one value at small rates, and subtracts it from larger ones: found, and nothing else is wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import alidade

BAND = np.deg2rad(0.3)
SHORT: dict[str, tuple[str, dict[str, Any]]] = {
    "head": ("head_gyro", {"duration_s": 20.0, "gyro_rate_hz": 200.0, "vision_rate_hz": 20.0, "priors": {}}),
    "los": ("gyro", {"duration_s": 20.0, "gyro_rate_hz": 200.0, "image_rate_hz": 20.0}),
}


@pytest.mark.parametrize("solver", ["batch", pytest.param("incremental", marks=pytest.mark.slow)])
@pytest.mark.parametrize("subtracted", [BAND, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", ["los", pytest.param("head", marks=pytest.mark.slow)])
def test_dead_band_of_a_gyro_is_found(method: str, subtracted: float, solver: Any) -> None:
    """Unnoticed it puts scales 8 and 58 sigmas off and is named as noise of the gyro, or nothing converges."""
    name, scenario = SHORT[method]
    simulated = alidade.simulate(method, scenario, 1)
    rate = getattr(simulated.data, name)
    left = np.where(np.abs(rate) < BAND, 0.0, rate - subtracted * np.sign(rate))
    found = alidade.open(replace(simulated, data=replace(simulated.data, **{name: left}))).calibrate(
        solver, report=False
    )
    assert found.status in ("calibrated", "weak"), found.headline
    assert any("has a dead band" in note for note in found.notes)
    truth = {**simulated.truth, "gyro_dead_band": subtracted}
    off = {n: abs(p.value - truth[n]) / p.sigma for n, p in found.parameters.items() if p.sigma > 0.0}
    assert max(off.values()) < 4.0, off
    assert found.parameters["gyro_dead_band"].sigma < 0.3 * BAND
