"""Real sensors whose noise nobody states: the numbers are right, and their sigmas honest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import alidade
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.write import write_results
from datasets.broad import read_trial, score_results, to_session
from tests.support.broad_trials import TRIALS, converted
from tests.support.solved import calibrate

# An accelerometer turned by hand, as its authors published it (OpenAXES imu9), scaled to gravity as it is here.
_GRAVITY = 9.8126 / 9.81744
ACCEL_K = _GRAVITY * np.array([[0.96276, 0.0015751, -0.00018891], [0.0, 0.96732, 0.000859], [0.0, 0.0, 0.97079]])
ACCEL_B = -_GRAVITY * np.array([0.064447, 0.011034, 0.034253])


def test_a_cube_turned_by_hand_without_a_word_about_noise(shared_data: Path, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("latitude_deg: 52.38\n")
    recording = shared_data / "openaxes_imu9" / "adxl.mcap"
    (found,) = calibrate(recording, ["batch"], "cube", tmp_path / "c.yaml", report=True)
    assert found.status in ("calibrated", "weak"), found.headline
    rows = [(f"accel_k{i + 1}{j + 1}", ACCEL_K[i, j]) for i in range(3) for j in range(i, 3)]
    rows += [(f"accel_b{i + 1}", ACCEL_B[i]) for i in range(3)]
    for name, published in rows:
        p = found.parameters[name]
        assert abs(p.value - published) < 3.0 * p.sigma, name
        assert p.sigma < 3e-3
    # All 38 poses, and a pause of a second on the way.
    assert len(found.tables["static_poses"]) == 39
    used = {noise.name: noise.used for noise in found.noises}
    # Poses repeat to millimetres a second squared, which white noise over their duration does not say.
    assert 1e-3 < used["accel_repeatability"] < 8e-3


@pytest.mark.parametrize("at", [0.3, 0.7])
def test_an_accelerometer_whose_offset_stepped(at: float, shared_data: Path) -> None:
    """By .05 of gravity: the rests on one side are no outliers of a calibration by the others."""
    imu = open_recording(shared_data / "openaxes_imu9" / "adxl.mcap").imu("/imu")
    time, accel = 1e-9 * (imu.t_ns - imu.t_ns[0]), imu.accel.copy()
    healthy = alidade.open({"accel_t": time, "accel": accel}, method="tumble").calibrate(report=False)
    assert healthy.status == "calibrated", healthy.headline
    accel[int(at * len(accel)) :] += 0.49 * np.array([0.6, -0.64, 0.48])
    found = alidade.open({"accel_t": time, "accel": accel}, method="tumble").calibrate(report=False)
    assert found.status == "inconsistent"
    assert "change" in {finding.kind for finding in found.findings}


def test_a_magnetometer_that_rests_before_it_is_turned(shared_data: Path) -> None:
    """At rest it repeats one error, which is no step of its offset."""
    trial = loadmat(str(shared_data / "broad" / "07_undisturbed_fast_rotation_B.mat"))
    field, rate = 1e-6 * trial["imu_mag"], float(trial["sampling_rate"].item())
    field = field[: len(field) // 2]
    arrays = {"mag_t": np.arange(len(field)) / rate, "mag": field}
    found = alidade.open(arrays, method="tumble").calibrate(report=False)
    assert found.status in ("calibrated", "weak"), found.headline
    assert found.stability is not None
    assert found.stability.level > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIALS)
def test_a_helmet_without_a_word_about_noise(name: str, shared_data: Path, tmp_path: Path) -> None:
    trial = shared_data / "broad" / f"{name}.mat"
    converted(trial, tmp_path / "s.mcap")
    (tmp_path / "c.yaml").write_text("noise: {gyro_density: null, vision_attitude: null, gyro_bias_walk: null}\n")
    (found,) = calibrate(tmp_path / "s.mcap", ["batch"], config=tmp_path / "c.yaml")
    assert found.status == "calibrated", found.headline
    write_results(tmp_path / "results", found)
    score = score_results(read_trial(trial), tmp_path / "results")
    sigmas = [found.parameters[f"gyro_bias_{axis}"].sigma for axis in "xyz"]
    assert (np.abs(score.bias_error) < 3.0 * np.array(sigmas)).all()


@pytest.mark.slow
def test_mounts_of_one_device_agree_between_slow_and_fast_trials(shared_data: Path) -> None:
    """Errors of motion capture by attitude, which a trial does not show, set them 8 sigmas apart."""
    found = []
    for name in ("12_undisturbed_slow_translation_C", "21_undisturbed_fast_combined"):
        data = to_session(read_trial(shared_data / "broad" / f"{name}.mat"), 0, 0.0)
        result = alidade.open(replace(data, truth_t=None, truth_wxyz=None), method="head").calibrate(report=False)
        mounts = [result.estimate.names.index(f"helmet_mount_{axis}") for axis in "xyz"]
        found.append((result.estimate.values[mounts], result.estimate.covariance[np.ix_(mounts, mounts)]))
    (slow, P), (fast, Q) = found
    assert (slow - fast) @ np.linalg.solve(P + Q, slow - fast) < 11.3  # 99 %, three numbers


@pytest.mark.slow
def test_a_gyro_that_saturates_in_silence(shared_data: Path) -> None:
    """No minimum at the noise assumed, which 17 % of the samples exceed; with that found the mount is within sigmas."""
    (found,) = calibrate(shared_data / "repoimu" / "tstick_05.mcap", ["batch"], "head")
    assert found.status in ("weak", "inconsistent")
    for axis, truth in zip("xyz", np.deg2rad([-3.06, -0.04, 0.35]), strict=True):
        p = found.parameters[f"helmet_mount_{axis}"]
        assert abs(p.value - truth) < 3.0 * p.sigma
        assert p.sigma < np.deg2rad(3.0)


def test_a_cube_held_in_a_hand(shared_data: Path, tmp_path: Path) -> None:
    """MPU-6050 in counts, ten rests, nine of them in a hand that trembles six times above the noise.

    Scales as published by the authors (tomisuarez2/ImuCalibration, params_acc.csv, params_gyro.csv): z of the
    accelerometer, y and z of the gyro; of the others their rests of 20 ms and less leave the cross terms at 7 deg.
    """
    (tmp_path / "c.yaml").write_text(
        "latitude_deg: 48.0\ncube: {raw: {accel: {scale: 5.985504e-4}, gyro: {scale: 1.332312e-4}}}\n"
    )
    recording = shared_data / "suarez_mpu6050" / "cal.mcap"
    (found,) = calibrate(recording, ["batch"], "cube", tmp_path / "c.yaml", report=True)
    assert found.status in ("calibrated", "weak"), found.headline
    assert len(found.tables["static_poses"]) == 10
    for name, published in (("accel_k33", 0.97911 * 9.80665 / 16384), ("gyro_k22", 1.3292e-4), ("gyro_k33", 1.3394e-4)):
        p = found.parameters[name]
        assert abs(p.value - published) < 4.0 * p.sigma, name
        assert p.sigma < 3e-3 * p.value
