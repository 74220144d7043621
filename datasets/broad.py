"""BROAD trials as sessions of the `head` method.

BROAD (Laidig, Caruso, Cereatti, Seel, Data 6(7):72, 2021) moves an IMU in front of a motion-capture system. Here its
gyro plays the helmet IMU; its motion capture, thinned out and with noise added, plays the vision, and undisturbed it is
the truth:

    python -m datasets.broad ../shared/data/broad/01_undisturbed_slow_rotation_A.mat --out broad01.mcap
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factors import so3
from pipelines.errors import InputError
from pipelines.sessions.head import HeadData, write_head

Array = NDArray[np.float64]

EPOCH_NS = 1_600_000_000_000_000_000  # the trials carry no date
VISION_RATE_HZ = 25.0
VISION_SIGMA = float(np.deg2rad(0.5))  # noise added to the motion capture, rad per axis

# At rest the gyro's white noise is 1.1e-4 rad/s/sqrt(Hz). In motion its scale errors (0.1 to 0.5 %) and the motion
# capture's own 0.1 deg are far larger. With this density the residuals of trials 01 and 07 fit; those of 21 stay 6 %
# too large in chi-square, and its bias suffers from the scale error.
CONFIG = f"""\
method: head
noise:
  gyro_density: 3.0e-3
  gyro_bias_walk: 1.0e-5
  vision_attitude: {VISION_SIGMA:.4e}
"""


@dataclass(frozen=True)
class Trial:
    """One BROAD trial, all arrays at the same stamps.

    Attributes:
        t: (N,) s.
        gyro: (N, 3) rad/s.
        attitude: (N, 4) marker body to world; NaN where the cameras lost the markers.
        moving: (N,) whether the IMU was being moved.
    """

    t: Array
    gyro: Array
    attitude: Array
    moving: NDArray[np.bool_]


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
            attitude=content["opt_quat"],
            moving=content["movement"][:, 0].astype(bool),
        )
    except (OSError, ValueError, KeyError) as error:
        needed = "a Matlab file with imu_gyr, opt_quat, movement and sampling_rate"
        raise InputError(f"{path}: not a BROAD trial ({needed}): {error}") from error


def gyro_bias_at_rest(trial: Trial) -> Array:
    """Mean gyro over the samples at rest, (3,) rad/s: the bias, earth rate included."""
    return np.asarray(trial.gyro[~trial.moving].mean(axis=0))


def to_session(trial: Trial, seed: int) -> HeadData:
    """The trial as a session; b is the motion capture's world, h its marker body, and v the IMU.

    Vision is the motion-capture sample nearest to each 1/25 s, at that sample's own stamp, times Exp(delta) with
    Gaussian delta. The truth is the motion capture itself: bRh, at its own clock. It stands in for bRv to within the
    mount vRh (below a degree) and the time offset, both of which a calibration estimates.
    """
    seen = np.isfinite(trial.attitude[:, 0])
    half_sample = 0.5 * (trial.t[1] - trial.t[0])
    nearest = np.searchsorted(trial.t + half_sample, np.arange(0.0, trial.t[-1], 1.0 / VISION_RATE_HZ))
    vision = nearest[seen[nearest]]
    noise = VISION_SIGMA * np.random.default_rng(seed).standard_normal((len(vision), 3))
    return HeadData(
        epoch_ns=EPOCH_NS,
        head_t=trial.t,
        head_gyro=trial.gyro,
        platform_t=None,
        platform_gyro=None,
        vision_t=trial.t[vision],
        vision_wxyz=so3.multiply(trial.attitude[vision], so3.exp(noise)),
        vision_cov=np.tile(VISION_SIGMA**2 * np.eye(3), (len(vision), 1, 1)),
        truth_t=trial.t[seen],
        truth_wxyz=trial.attitude[seen],
        dropped={},
        gyro_density=None,
        platform_gyro_density=None,
    )


def main() -> None:
    """Convert one trial."""
    parser = argparse.ArgumentParser(description="Turn a BROAD trial into a session of the head method.")
    parser.add_argument("trial", type=Path, help="the trial's .mat file")
    parser.add_argument("--out", type=Path, required=True, help="the session to write (.mcap)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise added to the motion capture")
    options = parser.parse_args()
    try:
        write_head(options.out, to_session(read_trial(options.trial), options.seed), config_yaml=CONFIG)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
