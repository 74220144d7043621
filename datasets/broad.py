"""BROAD trials as sessions of the `head` method.

BROAD (Laidig, Caruso, Cereatti, Seel, Data 6(7):72, 2021) moves an IMU in front of a motion-capture system. Here its
gyro plays the helmet IMU; its motion capture, thinned out and with noise added, plays the vision, and undisturbed it is
the truth:

    python -m datasets.broad 01_undisturbed_slow_rotation_A.mat --out broad01.mcap
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.report import carried, helmet_gyro

EPOCH_NS = 1_600_000_000_000_000_000  # the trials carry no date
VISION_RATE_HZ = 25.0
VISION_SIGMA = float(np.deg2rad(0.5))  # noise added to the motion capture, rad per axis

# White noise at rest is 1.1e-4 rad/s/sqrt(Hz); the rest up to this density is what motion adds beside constant scale
# and skew, which are estimated. Motion capture makes its angles by no focal length and keeps the IMU's time.
CONFIG = f"""\
method: head
noise:
  gyro_density: 1.5e-3
  gyro_bias_walk: 1.0e-5
  vision_attitude: {VISION_SIGMA:.4e}
sensors: {{camera: {{scale: 0}}, clock: {{skew: 0}}}}
"""


@dataclass(frozen=True)
class Trial:
    """One trial of the BROAD data set, all arrays at common stamps.

    Attributes:
        t: (N,) s.
        gyro: (N, 3) rad/s.
        force: (N, 3) m/s^2, specific force by the accelerometer.
        attitude: (N, 4) marker body to world; NaN where the cameras lost the markers.
        moving: (N,) whether the IMU was being moved.
    """

    t: Array
    gyro: Array
    force: Array
    attitude: Array
    moving: Mask


def read_trial(path: Path) -> Trial:
    """Read a trial's Matlab file.

    Raises:
        InputError: the file is not there or is not a BROAD trial.
    """
    from scipy.io import loadmat

    try:
        content = loadmat(str(path), appendmat=False)
        gyro = content["imu_gyr"]
        return Trial(
            t=np.arange(len(gyro)) / float(content["sampling_rate"].item()),
            gyro=gyro,
            force=content["imu_acc"],
            attitude=content["opt_quat"],
            moving=content["movement"][:, 0].astype(bool),
        )
    except (OSError, ValueError, KeyError) as error:
        needed = "a Matlab file with imu_gyr, imu_acc, opt_quat, movement and sampling_rate"
        raise InputError(f"{path}: not a BROAD trial ({needed}): {error}") from error


def gyro_bias_at_rest(trial: Trial) -> Array:
    """Mean gyro reading (3,), rad/s, over the samples at rest: the bias, earth rate included."""
    return np.asarray(trial.gyro[~trial.moving].mean(axis=0))


def to_session(trial: Trial, seed: int, sigma: float = VISION_SIGMA, rate_hz: float = VISION_RATE_HZ) -> HeadData:
    """Convert a trial to a session; b: the motion capture's world, h: its marker body, v: the IMU.

    Vision is the motion-capture sample nearest to each 1/`rate_hz` s, at that sample's own stamp, times Exp(delta) with
    Gaussian delta of `sigma` rad an axis; without any the session states no covariance. The truth is the motion capture
    itself: bRh, at its own clock. It stands in for bRv to within the mount vRh (below a degree) and the time offset,
    both of which a calibration estimates.
    """
    seen = np.isfinite(trial.attitude[:, 0])
    half_sample = 0.5 * (trial.t[1] - trial.t[0])
    nearest = np.searchsorted(trial.t + half_sample, np.arange(0.0, trial.t[-1], 1.0 / rate_hz))
    vision = nearest[seen[nearest]]
    noise = sigma * np.random.default_rng(seed).standard_normal((len(vision), 3))
    return HeadData(
        epoch_ns=EPOCH_NS,
        head_t=trial.t,
        head_gyro=trial.gyro,
        head_force=trial.force,
        platform_t=None,
        platform_gyro=None,
        vision_t=trial.t[vision],
        vision_wxyz=so3.multiply(trial.attitude[vision], so3.exp(noise)),
        vision_cov=np.tile(sigma**2 * np.eye(3), (len(vision), 1, 1)) if sigma else None,
        truth_t=trial.t[seen],
        truth_wxyz=trial.attitude[seen],
        dropped={},
        gyro_density=None,
        platform_gyro_density=None,
    )


@dataclass(frozen=True)
class Score:
    """Errors of a calibration of a trial's session against the reference that it did not use.

    Attributes:
        attitude_rms: rad, of the fused attitude against the undisturbed motion capture.
        slow_rms: rad, of the same error averaged over 1 s, since motion capture's noise is in truth and measurement.
        bias_error: (3,) rad/s, gyro bias and what it is by gravity at rest, less the mean gyro at rest.
        time_offset: s.
    """

    attitude_rms: float
    slow_rms: float
    bias_error: Array
    time_offset: float


def score(trial: Trial, values: Mapping[str, float], attitude_t: Array, attitude_wxyz: Array) -> Score:
    """Score parameter values and the trajectory bRv (times in s from the trial's start, on the gyro's clock).

    The trajectory is carried to every motion-capture sample by the gyro; interpolation alone errs by .1 to 1 deg.
    """
    seen = np.flatnonzero(np.isfinite(trial.attitude[:, 0]))
    at = trial.t[seen] + values["time_offset"]
    inside = (at >= attitude_t[0]) & (at <= attitude_t[-1])
    seen, at = seen[inside], at[inside]
    estimated = marker_attitudes(trial, values, attitude_t, attitude_wxyz, at)
    error = so3.local(trial.attitude[seen], estimated)
    return Score(
        attitude_rms=_rms(error),
        slow_rms=_rms(_averaged(error, round(1.0 / (trial.t[1] - trial.t[0])))),
        bias_error=at_rest(trial, values) - gyro_bias_at_rest(trial),
        time_offset=values["time_offset"],
    )


def marker_attitudes(
    trial: Trial, values: Mapping[str, float], attitude_t: Array, attitude_wxyz: Array, at: Array
) -> Array:
    """Marker attitudes bRh (n, 4) by motion capture at times (n,), s, of the gyro's clock.

    bRv carried by the gyro less its bias and errors, then the rotation that motion capture's own filter adds,
    Exp(vision_filter * angular acceleration), and the mount.
    """
    data = to_session(trial, 0)
    gyro = helmet_gyro(data, values)
    h = 2.0 * (trial.t[1] - trial.t[0])
    filtered = values.get("vision_filter", 0.0) * (gyro.rate(at + h) - gyro.rate(at - h)) / (2.0 * h)
    vRh = so3.exp(np.array([values[f"helmet_mount_{axis}"] for axis in "xyz"]))
    bRv = carried(data, Attitudes(attitude_t, attitude_wxyz), values, at)
    return so3.compose(bRv, so3.exp(filtered), np.broadcast_to(vRh, (len(at), 4)))


def at_rest(trial: Trial, values: Mapping[str, float]) -> Array:
    """Gyro reading (3,), rad/s, at rest by the calibration: bias plus g-sensitivity times gravity."""
    bias = np.array([values[f"gyro_bias_{axis}"] for axis in "xyz"])
    return np.asarray(bias + _g(values) @ trial.force[~trial.moving].mean(axis=0))


def _g(values: Mapping[str, float]) -> Array:
    """Matrix (3, 3) of g-sensitivity, rad/s per m/s^2, from parameter values."""
    return np.array([[values.get(f"gyro_g_{row}{column}", 0.0) for column in "xyz"] for row in "xyz"])


def _rms(error: Array) -> float:
    """Root mean square length of rotation vectors (n, 3)."""
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _averaged(error: Array, n: int) -> Array:
    """Running means of errors over n consecutive samples."""
    sums = np.cumsum(np.concatenate([np.zeros((1, 3)), error]), axis=0)
    return np.asarray((sums[n:] - sums[:-n]) / n)


def score_results(trial: Trial, folder: Path) -> Score:
    """Score the output folder of `alidade calibrate --out` for a trial's session."""
    result = json.loads((folder / "result.json").read_text())
    values = {p["name"]: p["value"] for p in result["parameters"]}
    tum = np.loadtxt(folder / "attitude.tum", ndmin=2)
    return score(trial, values, tum[:, 0] - EPOCH_NS * 1e-9, tum[:, [7, 4, 5, 6]])


def main() -> None:
    """Convert one trial, or score the results of the trial's session."""
    parser = argparse.ArgumentParser(
        description="Turn a BROAD trial into a session of the head method, or score its calibration."
    )
    parser.add_argument("trial", type=Path, help="the trial's .mat file")
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--out", type=Path, help="the session to write (.mcap)")
    task.add_argument("--score", type=Path, help="folder of `alidade calibrate --out`: compare it with the trial")
    parser.add_argument("--seed", type=int, default=0, help="of the noise added to the motion capture")
    options = parser.parse_args()
    try:
        if options.score is not None:
            found = score_results(read_trial(options.trial), options.score)
            print(f"attitude against motion capture: {np.rad2deg(found.attitude_rms):.3f} deg RMS")
            print(f"the same, averaged over 1 s: {np.rad2deg(found.slow_rms):.3f} deg RMS")
            print(f"gyro bias less mean rate at rest: {np.rad2deg(found.bias_error).round(3).tolist()} deg/s")
            print(f"time offset: {1e3 * found.time_offset:.2f} ms")
            return
        method("head").write_data(options.out, to_session(read_trial(options.trial), options.seed), config_yaml=CONFIG)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
