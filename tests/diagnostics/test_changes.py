"""Steps of a device between recordings: found, not made up, told in words; how it walks."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.factors.array import Array
from alidade.pipelines.applications.joint import calibrate_together
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.device_changes import LEVEL, Changes, changes
from alidade.pipelines.estimation.problem import SqrtInformation
from alidade.pipelines.reports.joint_report import forecasts
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.joint import join
from tests.support.short_problems import COARSE

NAMES = ("arm_mount_x", "arm_mount_y", "arm_mount_z", "own")
RATES = dict.fromkeys(NAMES[:3], 0.0)


def history(rng: np.random.Generator, n: int, step: float = 0.0, walk: float = 0.0) -> list[SqrtInformation]:
    """Recordings that each know the device to one sigma; half way through its y makes a step."""
    sqrt_info, device = [], np.zeros(3)
    for i in range(n):
        device = device + walk * rng.standard_normal(3) + np.array([0.0, step * (i == n // 2), 0.0])
        sqrt_info.append(one(rng, device))
    return sqrt_info


def one(rng: np.random.Generator, device: Array) -> SqrtInformation:
    """A recording by itself, its own number told along with the device's."""
    R = np.eye(4)
    R[3, 1] = 0.7
    truth = np.append(device, rng.standard_normal())
    prior = np.eye(4)[:3] / 100.0
    return SqrtInformation(
        NAMES, np.zeros(4), R, R @ truth + rng.standard_normal(4), prior, np.zeros(3), np.full(4, 100.0)
    )


def of(sqrt_info: list[SqrtInformation]) -> Changes:
    days = [float(i) for i in range(len(sqrt_info))]
    return changes(join(sqrt_info, RATES, days), days, {})


def test_a_step_is_least_squares_of_both_sides() -> None:
    """Of a number known by itself: mean after less mean before, with the sigma of that."""
    rng = np.random.default_rng(0)
    sqrt_info = history(rng, 6, step=4.0)
    values = np.array([each.d[0] for each in sqrt_info])
    found = of(sqrt_info)
    step = next(s for s in found.steps if s.name == "arm_mount_x" and s.after == 1)
    assert step.sigma == pytest.approx((1.0 / 2.0 + 1.0 / 4.0) ** 0.5, rel=1e-3)
    assert step.size == pytest.approx(values[2:].mean() - values[:2].mean(), abs=1e-3)


def test_two_steps_are_two() -> None:
    rng = np.random.default_rng(1)
    device = [np.array([0.0, 8.0 * (i >= 4), -9.0 * (i >= 9)]) for i in range(12)]
    found = {(s.name, s.after): s for s in of([one(rng, each) for each in device]).found}
    assert found.keys() == {("arm_mount_y", 3), ("arm_mount_z", 8)}
    assert found["arm_mount_y", 3].size == pytest.approx(8.0, abs=4.0 * found["arm_mount_y", 3].sigma)


def test_what_did_not_change_is_estimated_beside_what_did() -> None:
    """Where two numbers are known by their sum, a step of one would be most of a step of the other."""
    rng, R = np.random.default_rng(4), np.eye(4)
    R[0, 1] = 0.9
    devices = [np.array([0.0, 40.0 * (i >= 4), 0.0, 0.0]) for i in range(8)]
    each = [replace(one(rng, np.zeros(3)), R=R, d=R @ device) for device in devices]
    found = of(each)
    assert [(step.name, step.after) for step in found.found] == [("arm_mount_y", 3)]
    others = [step.z for step in found.steps if step not in found.found]
    assert len(others) > 10
    assert np.abs(others).max() < 1e-3
    assert found.found[0] in found.steps


def test_coloured_noise_makes_steps_less_sure() -> None:
    sqrt_info = history(np.random.default_rng(2), 6, step=5.0)
    days = [float(i) for i in range(6)]
    plain, grown = (changes(join(sqrt_info, RATES, days), days, dict.fromkeys(NAMES, by)) for by in (1.0, 3.0))
    assert plain.any
    assert not grown.any
    assert grown.steps[0].sigma == pytest.approx(3.0 * plain.steps[0].sigma)


def test_one_recording_tells_of_no_change() -> None:
    assert not of(history(np.random.default_rng(0), 1)).steps


@pytest.mark.slow
def test_false_alarms_are_as_many_as_stated() -> None:
    """Over 200 histories of six recordings: within what chance allows about the level, 99 %."""
    alarms = sum(of(history(np.random.default_rng(seed), 6)).any for seed in range(200))
    assert alarms <= 200 * LEVEL + 2.6 * (200 * LEVEL * (1.0 - LEVEL)) ** 0.5


@pytest.mark.slow
def test_steps_of_three_sigmas_are_found() -> None:
    """Of one recording, half way through a history of ten: 19 of 20."""
    found = [of(history(np.random.default_rng(seed), 10, step=3.0)) for seed in range(100)]
    assert sum(each.any for each in found) >= 95
    assert sum(any(s.name == "arm_mount_y" for s in each.found) for each in found) >= 90


@pytest.mark.slow
def test_no_test_of_that_level_finds_many_more() -> None:
    """The best one, on average over numbers, dates and signs, is the mixture's likelihood ratio (Neyman, Pearson)."""
    n, count = 6, 200
    steps = np.tri(n, n, -1).T[:-1]  # (n - 1, n) one after a recording
    steps = steps - steps.mean(axis=1, keepdims=True)
    sizes = 3.0 * np.linalg.norm(steps, axis=1)

    def ratio(values: Array) -> Array:
        """Of values (k, n, 3) of three numbers, each known to one sigma."""
        z = np.einsum("sn,knm->kms", 3.0 * steps / sizes[:, None], values)
        return np.asarray(np.log(np.cosh(z * sizes) * np.exp(-0.5 * sizes**2)).reshape(len(values), -1).sum(axis=1))

    rng = np.random.default_rng(21)
    limit = np.quantile(ratio(rng.standard_normal((20_000, n, 3))), 0.95)
    shifted = rng.standard_normal((20_000, n, 3))
    shifted[:, n // 2 :, 1] += 3.0
    best = float((ratio(shifted) > limit).mean())
    found = sum(of(history(rng, n, step=3.0)).any for _ in range(count))
    assert found > count * best - 3.0 * (count * best * (1.0 - best)) ** 0.5


def test_the_rate_of_a_walk_is_estimated() -> None:
    rates = [of(history(np.random.default_rng(seed), 16, walk=0.7)).rates["arm_mount"] for seed in range(30)]
    assert np.mean([r.rate for r in rates]) == pytest.approx(0.7, abs=0.1)
    assert np.mean([r.upper > 0.7 for r in rates]) > 0.85
    still = [of(history(np.random.default_rng(seed), 16)).rates["arm_mount"] for seed in range(30)]
    assert np.median([r.rate for r in still]) < 0.1
    assert np.median([r.upper for r in still]) < 0.6


@pytest.fixture(scope="module")
def moved() -> Calibration:
    """Four recordings, a month apart, of an IMU that was knocked in between."""
    sessions = []
    for seed in range(4):
        mounting = [0.5, -0.3 - 0.5 / 3600.0 * (seed > 1), 0.4]
        simulated = alidade.simulate("indexer", {**COARSE, "mounting_deg": mounting}, seed=seed)
        config = load_config(simulated.config.encode(), load_config(b"sensors: ideal"))
        later = replace(simulated.data, epoch_ns=simulated.data.epoch_ns + seed * 30 * 86_400 * 10**9)
        sessions.append(alidade.open(later, method="indexer", config=config))

    def opened(session: Session) -> Session:
        return session

    return calibrate_together([partial(opened, session) for session in sessions])


def test_a_change_is_told_in_words_and_numbers(moved: Calibration, tmp_path: Path) -> None:
    assert moved.status == "inconsistent"
    assert "theta_y by -0.5" in moved.headline
    assert moved.headline.startswith("Change of the device between 20 December 2026 and 19 January 2027: ")
    moved.write(tmp_path)
    found = json.loads((tmp_path / "result.json").read_text())["changes"]
    (step,) = [s for s in found["steps"] if s["found"]]
    assert step["parameter"] == "theta_y"
    assert step["step"] == pytest.approx(-np.deg2rad(0.5 / 3600.0), abs=4.0 * step["sigma"])
    assert set(found["rates"]) == {"theta"}
    page = (tmp_path / "report.html").read_text()
    assert "theta over time" in page
    assert "Calibration interval" in page


def test_when_it_leaves_what_is_required_is_told(moved: Calibration) -> None:
    sqrt_info = dict(forecasts(moved))
    assert "in the root of a day (at most" in sqrt_info["theta_y"]
    assert "within what is required" in sqrt_info["theta_y"]
