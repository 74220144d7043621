"""A magnetometer disturbed for a while: named with its time, and sigmas true all the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors.chi_square import quantile
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.diagnose import disturbances
from alidade.pipelines.estimation.problem import Estimate, Residuals
from alidade.pipelines.estimation.robust import onsets
from alidade.pipelines.methods import method
from alidade.pipelines.methods.tumble.simulation import TumbleScenario
from alidade.pipelines.simulation.scenario import Simulated
from tests.support.command import Command

TUMBLE = method("tumble")
SCENARIO = {"attitudes": 30, "turn_rad_s": 1.5, "magnetometer": {"rate_hz": 20.0}}
_BEGIN, _END = 12.3, 15.8


def _disturbed(kind: str, gyro: bool, seed: int) -> Simulated:
    """A motor's current, 8 uT in the device; a ring that comes near, up to 20 uT; nothing."""
    scenario = TumbleScenario.model_validate({**SCENARIO, "gyro": {"rate_hz": 50.0} if gyro else None})
    simulated = TUMBLE.simulate(scenario, seed)
    t = simulated.data.mag_t
    shape = {
        "motor": 8e-6 * ((t >= _BEGIN) & (t <= _END)),
        "ring": 2e-5 / (1.0 + ((t - 14.0) / 0.6) ** 2) ** 1.5,
        "": 0.0 * t,
    }[kind]
    mag = simulated.data.mag + shape[:, None] * np.array([0.6, -0.64, 0.48])
    return replace(simulated, data=replace(simulated.data, mag=mag))


def _named(found: Any) -> list[tuple[float, float]]:
    return [(f.evidence["since_s"], f.evidence["time_s"]) for f in found if f.kind == "disturbance"]


@pytest.mark.parametrize(
    ("kind", "gyro"),
    [
        *((kind, False) for kind in ("", "motor", "ring")),
        ("ring", True),
        *(pytest.param(kind, True, marks=pytest.mark.slow) for kind in ("", "motor")),
    ],
)
def test_disturbed_interval_is_named_and_the_rest_is_calibrated(kind: str, gyro: bool) -> None:
    calibration = Session.of(TUMBLE, _disturbed(kind, gyro, 0)).calibrate(report=False)
    assert calibration.status == "calibrated"
    named = _named(calibration.findings)
    if not kind:
        assert named == []
        return
    ((since, until),) = named
    # What a ring adds exceeds the gate from 12.6 to 15.5 s; of vectors half of that at either end is left out too.
    begin, end = {"motor": (_BEGIN, _END), "ring": (11.1, 17.0) if gyro else (12.5, 15.5)}[kind]
    assert since == pytest.approx(begin, abs=0.7)
    assert until == pytest.approx(end, abs=0.7)


@pytest.mark.parametrize(("since", "until", "status"), [(0.0, 0.15, "calibrated"), (0.85, 1.0, "weak")])
def test_nothing_shows_that_a_calibration_holds_after_a_disturbed_end(since: float, until: float, status: str) -> None:
    """A field of 15 uT along with errors correlated over .3 s, so that neither part fits the noise as stated."""
    simulated = TUMBLE.simulate(TumbleScenario(), 1)
    t, mag, rng = simulated.data.mag_t, simulated.data.mag.copy(), np.random.default_rng(2)
    share, error = (t - t[0]) / (t[-1] - t[0]), np.zeros(3)
    mag[(share >= since) & (share < until)] += 1.5e-5 * np.array([0.6, -0.64, 0.48])
    for k, kept in enumerate(np.exp(-np.diff(t, prepend=-np.inf) / 0.3)):
        error = kept * error + np.sqrt(1.0 - kept**2) * rng.standard_normal(3)
        mag[k] += 5e-7 * error
    calibration = Session.of(TUMBLE, replace(simulated, data=replace(simulated.data, mag=mag))).calibrate(report=False)
    assert len(_named(calibration.findings)) == 1
    assert calibration.status == status


@pytest.mark.parametrize(
    ("kind", "gyro", "seeds"),
    [
        ("motor", False, 4),
        pytest.param("motor", False, 8, marks=pytest.mark.slow),
        pytest.param("motor", True, 4, marks=pytest.mark.slow),
        pytest.param("ring", True, 4, marks=pytest.mark.slow),
    ],
)
def test_sigmas_are_true_beside_a_disturbance(kind: str, gyro: bool, seeds: int) -> None:
    total, dof = 0.0, 0
    for seed in range(seeds):
        simulated = _disturbed(kind, gyro, seed)
        estimate: Estimate = Session.of(TUMBLE, simulated).calibrate(report=False).estimate
        rows = [i for i, n in enumerate(estimate.names) if n in simulated.truth and estimate.covariance[i, i] > 0.0]
        error = estimate.values[rows] - [simulated.truth[estimate.names[i]] for i in rows]
        total += float(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error))
        dof += len(rows)
    assert quantile(0.005, dof) < total < quantile(0.995, dof), f"NEES {total:.1f} for {dof}"


@pytest.mark.parametrize("smooth", [True, False])
def test_only_smooth_ends_of_a_disturbance_are_left_out(smooth: bool) -> None:
    rng, t = np.random.default_rng(0), np.arange(0.0, 40.0, 0.05)
    shape = 90.0 / (1.0 + ((t - 14.0) / 0.6) ** 2) ** 1.5 if smooth else 36.0 * (abs(t - 14.0) < 1.7)
    norms = np.abs(shape + rng.standard_normal(len(t)))
    excluded = t[onsets(t, norms, norms > 4.0)]
    if not smooth:
        assert not len(excluded)
        return
    assert excluded[0] == pytest.approx(14.0 - 3.2, abs=0.4)
    assert excluded[-1] == pytest.approx(14.0 + 3.2, abs=0.4)
    # Half a sigma is left.
    assert shape[~np.isin(t, excluded)].max() < 1.0


def test_independent_outliers_are_no_disturbance() -> None:
    """At any share; and a dozen of them one after the other are one."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 40.0, 0.02)
    for share in np.repeat([0.002, 0.02, 0.1, 0.2], 25):
        used = rng.random(len(t)) >= share
        assert _named(disturbances(_residuals(t, used))) == []
    used = rng.random(len(t)) >= 0.02
    used[1000:1012] = False
    ((since, until),) = _named(disturbances(_residuals(t, used)))
    assert since == pytest.approx(20.0, abs=0.1)
    assert until == pytest.approx(20.22, abs=0.1)


def _residuals(t: np.ndarray, used: np.ndarray) -> Estimate:
    residuals = {"magnetometer": Residuals(t, np.zeros((len(t), 1)), used)}
    return Estimate("batch", (), np.zeros(0), np.zeros((0, 0)), True, "", residuals=residuals)


def test_the_command_says_when(tmp_path: Path, alidade: Command) -> None:
    TUMBLE.write(tmp_path / "s.mcap", _disturbed("motor", True, 0))
    run = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out")
    assert "magnetometer disturbed 12.3 to 15." in " ".join(run.out.split())
    assert "magnetometer disturbed 12.3 to 15." in (tmp_path / "out" / "report.html").read_text()
