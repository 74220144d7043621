"""Devices that cannot be turned through all attitudes, or are read now and then: cars, ships, riders, sparse poses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import method
from alidade.pipelines.methods.triads import triad_of
from alidade.pipelines.methods.tumble.first_guess import first_guess, ring
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.methods.tumble.simulation import TumbleScenario
from alidade.pipelines.simulation.scenario import EPOCH_NS, Simulated
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.command import Command

TUMBLE = method("tumble")
Array = np.ndarray
FIELD = np.array([0.0, 2.8e-5, -4.7e-5])
K = np.array([[0.96, 0.03, -0.05], [0.03, 1.05, 0.02], [-0.05, 0.02, 1.03]])
HARD = np.array([9e-6, -2.1e-5, 1.6e-5])
# Roll, pitch and heading, deg, over the time, s.
FIGURE_EIGHT = (
    20.0,
    lambda t: (50.0 * np.sin(2.1 * t), 35.0 * np.sin(4.2 * t + 0.4), 70.0 * np.sin(2.1 * t + 1.0) + 6 * t),
)
RIDER = 120.0, lambda t: (22.0 * np.sin(0.16 * t) + 2.0 * np.sin(4.8 * t), 4.0 * np.sin(0.27 * t), 9 * t)
CAR = TumbleScenario.model_validate(
    {"tilt_deg": 0.5, "attitudes": 12, "turn_rad_s": 0.8, "magnetometer": {"rate_hz": 20.0}}
)


BESIDE: tuple[dict[str, Any], ...] = ({}, {"gyro": {}}, {"accelerometer": {}}, {"gyro": {}, "accelerometer": {}})


def _recorded(seconds: float, angles: Callable[[Array], tuple[Array, Array, Array]], gyro: bool) -> TumbleData:
    """A magnetometer at 50 Hz, .4 uT, whose calibration is K and HARD, and a gyro of 1 mrad/s."""
    rng, t = np.random.default_rng(1), np.arange(0.0, seconds, 0.02)

    def nRb(t: Array) -> Array:
        roll, pitch, heading = (
            so3.exp(np.outer(np.deg2rad(a), axis)) for a, axis in zip(angles(t), np.eye(3), strict=True)
        )
        return so3.multiply(so3.multiply(heading, pitch), roll)

    field = so3.rotate(so3.inverse(nRb(t)), FIELD)
    mag = (field - HARD) @ np.linalg.inv(K).T + 4e-7 * rng.standard_normal(field.shape)
    rate = so3.log(so3.multiply(so3.inverse(nRb(t - 1e-3)), nRb(t + 1e-3))) / 2e-3
    measured = rate + [0.01, -0.02, 0.005] + 1e-3 * rng.standard_normal(rate.shape)
    return TumbleData(EPOCH_NS, t, mag, gyro_t=t if gyro else None, gyro=measured if gyro else None)


def _calibrated(data: TumbleData) -> Any:
    return Session.of(TUMBLE, Simulated(data, {}, "method: tumble\n")).calibrate(report=False)


def _triad(calibration: Any) -> tuple[Array, Array]:
    estimate = calibration.estimate
    return triad_of("mag", dict(zip(estimate.names, estimate.values.tolist(), strict=True)))


@pytest.mark.parametrize(
    ("motion", "gyro", "most_deg"),
    [
        (FIGURE_EIGHT, False, 0.3),
        (FIGURE_EIGHT, True, 0.3),
        (RIDER, False, 4.0),
        pytest.param(RIDER, True, 0.6, marks=pytest.mark.slow),
    ],
)
def test_figure_eight_and_rider_are_calibrated_within_their_sigmas(motion: Any, gyro: bool, most_deg: float) -> None:
    """Strength unknown; the rider's bank of 22 deg leaves the vertical weak, which a gyro mends."""
    data = _recorded(motion[0], motion[1], gyro)
    assert data.mag is not None
    calibration = _calibrated(data)
    assert calibration.status in (("calibrated", "weak") if gyro else ("weak",))
    gains, offset = _triad(calibration)
    found, true = data.mag @ gains.T + offset, data.mag @ K.T + HARD
    cosine = (found * true).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(true, axis=1)
    assert np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < most_deg
    strength = float(np.linalg.norm(FIELD))
    sigmas = dict(zip(calibration.estimate.names, calibration.estimate.sigmas, strict=True))
    off = (offset - HARD / strength) / [sigmas[f"mag_b{i}"] for i in "123"]
    assert np.abs(off).max() < 4.0


@pytest.mark.parametrize(
    ("beside", "latitude"),
    [
        pytest.param(
            beside, latitude, marks=[pytest.mark.slow] * (len(beside) == 1 or (latitude is None) == bool(beside))
        )
        for beside in BESIDE
        for latitude in (40.0, None)
    ],
)
def test_car_turning_on_the_spot_has_its_hard_iron_across_and_right_headings(
    beside: dict[str, Any], latitude: float | None
) -> None:
    scenario = TumbleScenario.model_validate({**CAR.model_dump(), "latitude_deg": latitude, **beside})
    simulated = TUMBLE.simulate(scenario, 3)
    session = Session.of(TUMBLE, simulated)
    calibration = session.calibrate(report=False)
    assert calibration.status in ("weak", "unobservable")
    assert not any(calibration.estimate.rejected.values())
    notes = " ".join(session.problem().premises)
    assert "The magnetometer was turned about one axis only" in notes
    assert ("The accelerometer is left out" in notes) == ("accelerometer" in beside)
    assert ("The gyro counts as mounted straight to the magnetometer" in notes) == ("gyro" in beside)
    gains, offset = triad_of("mag", simulated.truth)
    found_gains, found_offset = _triad(calibration)
    mag = simulated.data.mag
    true, found = _about(mag @ gains.T + offset), _about(mag @ found_gains.T + found_offset)
    # The mounting about the axis is another matter.
    assert min(np.rad2deg(np.unwrap(found - sign * true).std()) for sign in (-1.0, 1.0)) < 1.0


def _about(field: Array) -> Array:
    """Angle about the axis that a field (n, 3) turned about."""
    axes = np.linalg.svd(field - field.mean(axis=0), full_matrices=False)[2]
    return np.arctan2(*(field @ axes[:2].T).T)


@pytest.mark.parametrize(
    ("latitude", "gyro", "seeds"),
    [
        (40.0, {}, 4),
        pytest.param(None, {}, 4, marks=pytest.mark.slow),
        pytest.param(40.0, {"gyro": {}}, 8, marks=pytest.mark.slow),
        pytest.param(None, {"gyro": {}}, 8, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_confidently_wrong_about_one_axis(latitude: float | None, gyro: dict[str, Any], seeds: int) -> None:
    scenario = TumbleScenario.model_validate({**CAR.model_dump(), "latitude_deg": latitude, **gyro})
    worst = []
    for seed in range(seeds):
        simulated = TUMBLE.simulate(scenario, seed)
        estimate = solve_batch(Session.of(TUMBLE, simulated).problem())
        known = [i for i, name in enumerate(estimate.names) if name in simulated.truth]
        error = estimate.values[known] - [simulated.truth[estimate.names[i]] for i in known]
        worst.append(np.abs(error / np.maximum(estimate.sigmas[known], 1e-12)).max() if estimate.converged else 0.0)
    assert np.sort(worst)[-2] < 3.0
    assert max(worst) < 5.0


def test_ring_has_its_centre_within_its_sigma() -> None:
    rng, angle = np.random.default_rng(0), np.linspace(0.0, 12.0, 600)
    axes = so3.matrix(so3.exp(np.array([0.1, -0.2, 0.3])))
    raw = [5.0, -3.0, 8.0] + np.stack([2.0 * np.cos(angle), 2.4 * np.sin(angle), 0.0 * angle], axis=1) @ axes.T
    found = ring(raw + 0.02 * rng.standard_normal(raw.shape))
    assert found is not None
    assert abs(found.axis @ axes[:, 2]) > 0.999
    across = axes[:, :2].T @ (found.centre - [5.0, -3.0, 8.0])
    assert 1e-4 < found.sigma < 0.01
    assert np.abs(across).max() < 4.0 * found.sigma
    assert found.ratio == pytest.approx(1.2, abs=0.01)
    assert ring(rng.standard_normal((100, 3))) is None


def test_first_guess_of_a_ring_has_the_known_strength() -> None:
    angle = np.linspace(0.0, 6.0, 100)
    ringed = [1.0, 2.0, 3.0] + np.stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.0 * angle], axis=1)
    S, centre = first_guess(ringed, 5.0, 10.0)
    np.testing.assert_allclose(5.0 * S, np.eye(3), atol=0.01)
    np.testing.assert_allclose(np.abs(centre - [1.0, 2.0, 3.0]), [0.0, 0.0, 4.0], atol=0.03)


def test_poses_now_and_then_are_enough() -> None:
    """Thirty readings, one every 3 s, between which the gyro has turned."""
    scenario = {"attitudes": 30, "turn_rad_s": 1.0, "rest_s": 1.5, "magnetometer": {"rate_hz": 0.35}}
    gyros: list[dict[str, float] | None] = [None, {}]
    for gyro in gyros:
        simulated = TUMBLE.simulate(TumbleScenario.model_validate({**scenario, "gyro": gyro}), 3)
        assert Session.of(TUMBLE, simulated).calibrate(report=False).status == "calibrated"


def test_no_reading_during_a_rest_leaves_the_relative_rotation_unobservable() -> None:
    scenario = {"rest_s": 1.5, "turn_rad_s": 1.0, "magnetometer": {"rate_hz": 0.45}, "accelerometer": {}}
    session = Session.of(TUMBLE, TUMBLE.simulate(TumbleScenario.model_validate(scenario), 3))
    assert "no reading during a rest" in " ".join(session.problem().premises)
    assert session.calibrate(report=False).status == "unobservable"


def test_the_command_tells_what_a_car_knows(tmp_path: Path, alidade: Command) -> None:
    (tmp_path / "car.yaml").write_text(json.dumps(CAR.model_dump()))
    where = tmp_path / "s.mcap"
    assert alidade("simulate", "tumble", "--scenario", tmp_path / "car.yaml", "--seed", "3", "--out", where).code == 0
    run = alidade("calibrate", where, "--out", tmp_path / "out")
    assert run.code == 3
    assert "turned about one axis only, +z. Across it the hard iron is x " in " ".join(run.out.split())
