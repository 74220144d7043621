"""Long chains part by part: the same numbers as of rows that are all kept, and memory that R takes alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import alidade
from alidade.factors import model
from alidade.pipelines.solvers import chain, linearization

RECORDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "los": ("los", {"duration_s": 6.0, "image_rate_hz": 15.0, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 50.0}),
    "head": ("head", {"duration_s": 20.0}),
    "indexer": ("indexer", {}),
    "cube": ("cube", {}),
    "a bias that walks": (
        "head",
        {"duration_s": 14.0, "vision_rate_hz": 10.0, "gyro_rate_hz": 100.0, "noise": {"gyro_bias_walk": 3e-4}},
    ),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "a bias that walks")) for name in RECORDINGS]
)
def test_parts_give_what_the_whole_gives(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    method, scenario = RECORDINGS[name]
    simulated = alidade.simulate(method, scenario)
    whole = alidade.open(simulated).calibrate(report=False)
    monkeypatch.setattr(linearization, "KEPT_BYTES", 0)
    for module in (chain, linearization):
        monkeypatch.setattr(module, "PART_STATES", 30)
    for module in (model, linearization):
        monkeypatch.setattr(module, "TOGETHER", 10)
    parts = alidade.open(simulated).calibrate(report=False)
    sigmas = whole.estimate.sigmas
    assert (np.abs(parts.estimate.values - whole.estimate.values) <= 1e-5 * sigmas).all()
    np.testing.assert_allclose(parts.estimate.sigmas, sigmas, rtol=1e-6)
    assert parts.estimate.chi_square is not None
    assert whole.estimate.chi_square is not None
    assert parts.estimate.chi_square.dof == pytest.approx(whole.estimate.chi_square.dof, rel=1e-9)
    assert parts.status == whole.status
