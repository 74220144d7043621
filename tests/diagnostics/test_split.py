"""A change so large that no solution of the whole recording is left is found, in every method, at its time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import alidade
from alidade.pipelines.diagnostics.split_test import change_by_parts
from benchmarks.slips import SIMULATED

QUICK = ("indexer-gyro", "compass-iron")


@pytest.mark.parametrize(
    "what", [pytest.param(what, marks=[pytest.mark.slow] * (what not in QUICK)) for what in SIMULATED]
)
def test_a_slip_is_found_and_nothing_else_is_blamed(what: str) -> None:
    slip = SIMULATED[what]
    simulated = alidade.simulate(slip.method, slip.settings, 1)
    data, at = slip.put_into(simulated.data, slip.sizes[-1], 0.3)
    session = alidade.open(replace(simulated, data=data))
    (start, stop), found = session.method.faults.span(data), session.calibrate(report=False)
    first = found.findings[0]
    assert (found.status, first.kind) == ("inconsistent", "change")
    assert first.evidence["time_s"] == pytest.approx(at, abs=0.04 * (stop - start))  # a turn of the indexer
    assert next(iter(first.evidence["steps"])).startswith(slip.names)
    assert found.stability is not None
    assert found.stability.changed
    assert not any(each.kind in ("prior_conflict", "hypothesis") and each.severity for each in found.findings)


@pytest.mark.slow
def test_a_wrong_sign_is_no_change() -> None:
    simulated = alidade.simulate("los", SIMULATED["gimbal-gyro"].settings, 1)
    data = replace(simulated.data, gyro=simulated.data.gyro * [1.0, -1.0, 1.0])
    found = alidade.open(replace(simulated, data=data)).calibrate(report=False)
    assert found.status == "inconsistent"
    assert not any(each.kind == "change" for each in found.findings)
    assert "the sign of the gyro's y is wrong" in [each.evidence["label"] for each in found.findings[:1]]


def test_a_recording_that_fits_did_not_change() -> None:
    session = alidade.open(alidade.simulate("los", SIMULATED["gimbal-gyro"].settings, 1))
    assert change_by_parts(session.method.graph, session.method.faults, session.data, session.config) is None


def test_an_outlier_is_no_change() -> None:
    """A gyro that stuck for five seconds spoils the windows around them, and the rest agrees."""
    simulated = alidade.simulate("indexer", {}, 1)
    data = simulated.data
    stuck = (data.gyro_t > 100.0) & (data.gyro_t < 105.0)
    data = replace(data, gyro=np.where(stuck[:, None], 0.0, data.gyro))
    found = alidade.open(replace(simulated, data=data)).calibrate(report=False)
    assert found.status == "calibrated"
    assert found.estimate.rejected["turn"] > 0
