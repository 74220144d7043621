"""The los simulator against closed forms: it shares no code with the factors it is to test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from alidade.factors import so3
from alidade.pipelines.methods.los import simulation
from alidade.pipelines.methods.los.parameters import NUISANCE
from alidade.pipelines.methods.los.simulation import (
    LosAngles,
    LosNoise,
    Loss,
    LosScenario,
    carrier_attitude,
    picture_of,
    simulate_los,
    simulate_motion,
)
from alidade.pipelines.simulation.sensors import EulerMotion

SILENT = LosNoise(gyro_density=0.0, gyro_bias_walk=0.0, encoder=0.0, los_error=0.0, los_roll=0.0)
STRAIGHT = LosAngles(delta_px=0, delta_pz=0, delta_gx=0, delta_gy=0, delta_gz=0)
IDEAL: dict[str, Any] = {"noise": SILENT, "gyro_turn_on_bias": 0.0, "duration_s": 20.0, "acquisition_error": 0.0}
PERFECT = {name: 0.0 for each in NUISANCE for name in each.names}


def test_gyro_samples_multiply_to_the_carriers_attitude() -> None:
    scenario = LosScenario(**IDEAL, angles_deg=STRAIGHT, latitude_deg=40.0)
    motion = simulate_motion(scenario, PERFECT, np.random.default_rng(0))
    attitude = carrier_attitude(scenario, motion.edges)
    q = attitude[0]
    for sample in motion.gyro:
        q = so3.multiply(q, so3.exp(sample / scenario.gyro_rate_hz))
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(q), attitude[-1])), 0.0, atol=1e-11)


@pytest.mark.parametrize("elevation", [-30.0, 0.0, 45.0])
def test_straight_mounts_hold_the_line_of_sight_but_let_the_camera_roll(elevation: float) -> None:
    scenario = LosScenario(**IDEAL, angles_deg=STRAIGHT, elevation_deg=elevation, measures_roll=True)
    data, _ = simulate_los(scenario, 1)
    # What a loop at 500 Hz leaves of a sway of 6 deg.
    assert np.abs(data.error[:, :2]).max() < 1e-7
    assert np.ptp(data.error[:, 2]) > 0.05


def test_drift_follows_the_exact_kinematics_to_first_order() -> None:
    """d(phx, phz)/dt against eq. (2) of the publication, differentiated numerically at small angles."""
    small = LosAngles(delta_px=0.02, delta_pz=0.01, delta_gx=-0.015, delta_gy=0.02, delta_gz=-0.01)
    scenario = LosScenario(**IDEAL, angles_deg=small, gyro_rate_hz=1000, image_rate_hz=100)
    data, truth = simulate_los(scenario, 1)
    motion = simulate_motion(scenario, PERFECT, np.random.default_rng(1))
    middle = 0.5 * (data.image_t[1:] + data.image_t[:-1])
    azimuth, elevation = motion.gimbal_at(middle).T
    wx, wy, wz = (np.interp(middle, motion.gyro_t, motion.gyro[:, i]) for i in range(3))
    ahead, right = np.cos(azimuth) * wy - np.sin(azimuth) * wx, np.cos(azimuth) * wx + np.sin(azimuth) * wy
    px, gx, gy, dz = (truth[n] for n in ("delta_px", "delta_gx", "delta_gy", "delta_z"))
    drift_x = dz * ahead + wz * (gy * np.cos(azimuth) - gx * np.sin(azimuth))
    tilt = gx * wy - gy * wx
    drift_z = -px * ahead / np.cos(elevation) + np.cos(elevation) * tilt
    drift_z += np.sin(elevation) * (dz * right + wz * (gx * np.cos(azimuth) + gy * np.sin(azimuth)))
    measured = np.diff(data.error[:, :2], axis=0) / np.diff(data.image_t)[:, None]
    # The camera's roll turns errors of 4e-4 rad at 0.1 rad/s: the rest is second order.
    np.testing.assert_allclose(measured[:, 0], drift_x, atol=2e-5)
    np.testing.assert_allclose(measured[:, 1], drift_z, atol=2e-5)
    assert np.abs(drift_x).max() > 1e-5
    assert np.abs(drift_z).max() > 5e-5


def test_the_loop_really_integrates_the_gyro() -> None:
    """A gyro bias, and nothing else, makes the line of sight drift at the rate of the bias."""
    still = EulerMotion()
    scenario = LosScenario(**{**IDEAL, "gyro_turn_on_bias": 1e-4}, carrier=still, angles_deg=STRAIGHT)
    scenario = scenario.model_copy(update={"azimuth_deg": 0.0, "elevation_deg": 0.0})
    data, truth = simulate_los(scenario, 3)
    rate = (data.error[-1, :2] - data.error[0, :2]) / (data.image_t[-1] - data.image_t[0])
    np.testing.assert_allclose(rate, [-truth["gyro_bias_x"], -truth["gyro_bias_z"]], atol=1e-6)


def test_noise_is_as_stated() -> None:
    noisy, _ = simulate_los(LosScenario(measures_roll=True), 5)
    clean, _ = simulate_los(LosScenario(measures_roll=True, noise=SILENT), 5)
    # The loop follows its gyro's noise; encoder noise is what is left between neighbours.
    steps = np.diff(noisy.gimbal - clean.gimbal, axis=0)
    assert steps.std() == pytest.approx(np.sqrt(2.0) * 5e-6, rel=0.1)
    steps = np.diff(noisy.error - clean.error, axis=0)
    np.testing.assert_allclose(steps.std(axis=0), np.sqrt(2.0) * np.array([2e-5, 2e-5, 2e-4]), rtol=0.1)
    white = np.diff(noisy.gyro - clean.gyro, axis=0).std() / np.sqrt(2.0)
    assert white == pytest.approx(3e-5 * np.sqrt(500.0), rel=0.02)


def test_encoder_steps_gaps_outliers_and_other_targets() -> None:
    scenario = LosScenario(
        encoder_step=1e-4,
        dropouts_s=[(5.0, 6.0)],
        losses=[Loss(start_s=10.0, end_s=12.0, elevation_step_deg=10.0)],
        outlier_share=0.1,
        outlier_size=0.05,
    )
    data, _ = simulate_los(scenario, 2)
    np.testing.assert_allclose(data.gimbal / 1e-4, np.round(data.gimbal / 1e-4), atol=1e-6)
    t = data.image_t
    assert not ((t >= 5.0) & (t < 6.0)).any()
    assert not ((t >= 10.0) & (t < 12.0)).any()
    assert np.mean(np.abs(data.error[:, :2]).max(axis=1) > 0.02) == pytest.approx(0.085, abs=0.02)
    rise = np.interp(12.1, data.gimbal_t, data.gimbal[:, 1]) - np.interp(9.9, data.gimbal_t, data.gimbal[:, 1])
    assert np.rad2deg(rise) == pytest.approx(10.0, abs=6.0)
    assert np.isnan(data.error[:, 2]).all()


def test_earth_rate_is_part_of_the_bias() -> None:
    scenario = LosScenario(**IDEAL, carrier=EulerMotion(), angles_deg=STRAIGHT, latitude_deg=30.0)
    data, truth = simulate_los(scenario, 0)
    rate = 7.292115e-5 * np.array([0.0, np.cos(np.pi / 6), np.sin(np.pi / 6)])
    np.testing.assert_allclose(data.gyro.mean(axis=0), rate, atol=1e-12)
    np.testing.assert_allclose([truth[f"gyro_bias_{a}"] for a in "xyz"], rate, atol=1e-12)


def test_pictures_later_than_their_stamps() -> None:
    early, _ = simulate_los(LosScenario(**IDEAL), 1)
    late, _ = simulate_los(LosScenario(**IDEAL, effects={"time_offset": 0.02}), 1)
    moved = early.error[1:, :2] - early.error[1, :2]
    # Another target, another roll of the picture about it: alike to a part in a hundred.
    assert len(late.error) == len(moved)
    assert np.abs(late.error[:, :2] - moved).max() < 0.01 * np.abs(moved).max()
    assert np.abs(late.error[:, :2] - early.error[:-1, :2]).max() > 0.02 * np.abs(moved).max()


def test_roll_is_right_handed_about_the_line_of_sight() -> None:
    turned = so3.inverse(so3.exp([0.0, 0.3, 0.0]))
    np.testing.assert_allclose(picture_of(turned[None]), [[0.0, 0.0, 0.3]], atol=1e-12)


def test_same_seed_same_session() -> None:
    (a, truth_a), (b, truth_b) = (simulate_los(LosScenario(duration_s=5.0), 4) for _ in range(2))
    other, _ = simulate_los(LosScenario(duration_s=5.0), 5)
    np.testing.assert_array_equal(a.error, b.error)
    assert truth_a == truth_b
    assert not np.array_equal(a.gyro, other.gyro)
    assert replace(a).gyro_density == 3e-5


def test_gaps_that_end_before_they_start_are_refused() -> None:
    with pytest.raises(ValidationError, match="starts before it ends"):
        LosScenario(dropouts_s=[(5.0, 4.0)])


@pytest.mark.parametrize("latitude_deg", [None, 50.0])
def test_long_recordings_are_simulated_block_by_block(
    latitude_deg: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss = Loss(start_s=0.4, end_s=0.7, azimuth_step_deg=5.0)
    scenario = LosScenario(duration_s=2.0, latitude_deg=latitude_deg, losses=[loss])
    whole, truth = simulate_los(scenario, 0)
    # Few rows are multiplied in another way than many, with other rounding.
    for block, rounding in ((640, 0.0), (123, 1e-12)):
        monkeypatch.setattr(simulation, "_BLOCK", block)
        blocks, its_truth = simulate_los(scenario, 0)
        for name in ("gyro", "force", "gimbal", "error"):
            np.testing.assert_allclose(getattr(blocks, name), getattr(whole, name), rtol=0.0, atol=rounding)
        assert its_truth == pytest.approx(truth, rel=1e-12)


def test_a_slow_gyro_is_the_mean_of_a_loop_at_200_hz() -> None:
    """Its rates are those of the fast one, averaged, and the gimbal turns without the kinks of a loop at 25 Hz."""
    slow, fast = (simulate_los(LosScenario(**IDEAL, gyro_rate_hz=hz, gimbal_rate_hz=200), 1).data for hz in (25, 200))
    np.testing.assert_allclose(slow.gyro_t, fast.gyro_t[: 8 * len(slow.gyro_t)].reshape(-1, 8).mean(axis=1))
    np.testing.assert_allclose(slow.gyro, fast.gyro[: 8 * len(slow.gyro_t)].reshape(-1, 8, 3).mean(axis=1))
    np.testing.assert_allclose(slow.gimbal, fast.gimbal)
