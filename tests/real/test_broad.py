"""The converter of BROAD trials, on a made-up trial and on the real ones where they are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from datasets.broad import CONFIG, VISION_SIGMA, Trial, gyro_bias_at_rest, read_trial, to_session
from tests.support.broad_trials import BIAS, LOST, RATE_HZ, TRIALS, converted


@pytest.fixture
def trial_file(tmp_path: Path) -> Path:
    """20 s: at rest to 5 s, then turning about z at 1 rad/s; markers lost for a while."""
    n = round(20.0 * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    rate = np.where(t < 5.0, 0.0, 1.0)
    quat = so3.exp(np.outer(np.clip(t - 5.0, 0.0, None), [0.0, 0.0, 1.0]))
    quat[LOST] = np.nan
    path = tmp_path / "trial.mat"
    savemat(
        path,
        {
            "imu_gyr": BIAS + np.outer(rate, [0.0, 0.0, 1.0]),
            "imu_acc": np.tile([0.0, 0.0, 9.8], (n, 1)),
            "opt_quat": quat,
            "sampling_rate": np.array([[RATE_HZ]]),
            "movement": (rate > 0.0)[:, None].astype(np.uint8),
        },
    )
    return path


def test_trial_becomes_a_session(trial_file: Path, tmp_path: Path) -> None:
    data = converted(trial_file, tmp_path / "s.mcap")
    trial = read_trial(trial_file)
    np.testing.assert_allclose(data.head_t, trial.t, atol=1e-9)
    np.testing.assert_array_equal(data.head_gyro, trial.gyro)
    np.testing.assert_array_equal(data.head_force, trial.force)
    assert data.platform_t is None
    assert data.truth_t is not None
    assert data.truth_wxyz is not None
    lost = trial.t[LOST]
    for t in (data.vision_t, data.truth_t):
        assert not ((t >= lost[0] - 1e-6) & (t <= lost[-1] + 1e-6)).any()
    assert len(data.truth_t) == len(trial.t) - len(lost)
    assert len(data.vision_t) == pytest.approx(25.0 * (20.0 - len(lost) / RATE_HZ), abs=2)
    steps = np.diff(data.vision_t[data.vision_t < lost[0]]) * RATE_HZ
    assert set(np.round(steps, 4)) == {11.0, 12.0}  # of the motion capture's own stamps, nothing interpolated


def test_vision_is_the_truth_with_the_noise_asked_for(trial_file: Path) -> None:
    data = to_session(read_trial(trial_file), seed=1)
    assert data.truth_t is not None
    assert data.truth_wxyz is not None
    at_vision = np.searchsorted(data.truth_t, data.vision_t)
    np.testing.assert_array_equal(data.truth_t[at_vision], data.vision_t)
    delta = so3.log(so3.multiply(so3.inverse(data.truth_wxyz[at_vision]), data.vision_wxyz))
    np.testing.assert_allclose(delta.std(axis=0), VISION_SIGMA, rtol=0.12)
    again, other = (to_session(read_trial(trial_file), seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(again.vision_wxyz, data.vision_wxyz)
    assert not np.array_equal(other.vision_wxyz, data.vision_wxyz)


def test_bias_is_the_mean_at_rest(trial_file: Path) -> None:
    np.testing.assert_allclose(gyro_bias_at_rest(read_trial(trial_file)), BIAS, atol=1e-12)


def test_config_is_valid() -> None:
    config = load_config(CONFIG.encode())
    assert config.method == "head"
    assert config.noise.vision_attitude == pytest.approx(VISION_SIGMA, rel=1e-4)


def test_other_files_are_refused_in_one_line(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.mat"
    savemat(wrong, {"something": np.zeros(3)})
    for path in (wrong, tmp_path / "absent.mat", Path(__file__)):
        with pytest.raises(InputError, match="not a BROAD trial"):
            read_trial(path)


@pytest.mark.parametrize("name", TRIALS)
def test_real_trials(name: str, shared_data: Path) -> None:
    trial = read_trial(shared_data / "broad" / f"{name}.mat")
    np.testing.assert_allclose(np.rad2deg(gyro_bias_at_rest(trial)), TRIALS[name], atol=6e-4)
    data = to_session(trial, seed=0)
    assert np.isfinite(data.vision_wxyz).all()
    assert np.diff(data.vision_t).min() > 0.0385 - 1e-9


def turns_unlike_the_gyro(trial: Trial, offset: float) -> float:
    """Median angle (deg) between turns of gyro and motion capture over 1 s, its pictures taken `offset` after stamp."""
    n = 286
    known = np.isfinite(trial.attitude[:, 0])
    # Windows with markers in view a few samples beyond both ends.
    clear = np.convolve(~known, np.ones(9), mode="same") == 0
    start = np.flatnonzero(clear[:-n] & clear[n:] & trial.moving[:-n])[::50]
    turned = so3.identity(len(start))
    for k in range(n):
        rate = 0.5 * (trial.gyro[start + k] + trial.gyro[start + k + 1]) - gyro_bias_at_rest(trial)
        turned = so3.multiply(turned, so3.exp(rate / RATE_HZ))
    # The truth at t is the motion capture stamped t - offset.
    attitude = np.where(known[:, None], trial.attitude, so3.identity())
    a, b = (so3.interpolate(trial.t, attitude, trial.t[i] - offset) for i in (start, start + n))
    difference = so3.log(so3.multiply(so3.inverse(turned), so3.multiply(so3.inverse(a), b)))
    return float(np.rad2deg(np.median(np.linalg.norm(difference, axis=1))))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if i else []) for i, name in enumerate(TRIALS)]
)
def test_motion_capture_of_the_real_trials_is_stamped_early(name: str, shared_data: Path) -> None:
    """Frames (BROAD gives them as equal to 2 deg) and the sign of the offset, about 4 ms."""
    trial = read_trial(shared_data / "broad" / f"{name}.mat")
    unlike = {offset: turns_unlike_the_gyro(trial, offset) for offset in (-0.004, 0.0, 0.004)}
    assert unlike[0.0] < 2.0
    assert unlike[0.004] < unlike[0.0] < unlike[-0.004]
