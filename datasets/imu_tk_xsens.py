"""The Xsens MTi recording of imu_tk as a session of the `cube` method without camera, magnetometer and reference.

imu_tk (D. Tedaldi, A. Pretto, E. Menegatti, ICRA 2014) comes with raw counts of a hand-held Xsens MTi: one minute at
rest, then 37 further static poses.

    python -m datasets.imu_tk_xsens imu_tk_xsens --out xsens.mcap
"""

from __future__ import annotations

import argparse
import gzip
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.recording import CubeData

EPOCH_NS = 1_400_000_000_000_000_000  # the recording carries no date

# Nominal conversions with one scale and offset a sensor, as a data sheet has them: a 16-bit converter's middle, ranges
# rounded. The latitude is the one where WGS 84 gravity at height 0 is the 9.81744 m/s^2 that the authors used. White
# noise at rest is 5.7e-4 rad/s and 8e-4 m/s^2 per sqrt(Hz); the gyro's mean at rest changes by 1.5e-3 rad/s from pose
# to pose, however long the turn between, and the densities stand for what that and non-linearity do.
CONFIG = """\
method: cube
latitude_deg: 57.834
noise:
  gyro_density: 2.2e-3
  gyro_bias_walk: 6.0e-4
  accel_density: 3.0e-3
cube:
  raw:
    accel: {scale: 2.4e-3, offset: 32768}
    gyro: {scale: 2.1e-4, offset: 32768}
"""


@dataclass(frozen=True)
class Sheet:
    """Factory calibration of one sensor of this device, rounded as printed.

    raw = diag(scale) misalignment nominal + offset; scale in counts per m/s^2 or rad/s, offset in counts (the gyro's
    drifts with temperature and is not compared).
    """

    scale: Array
    misalignment: Array
    offset: Array | None = None


ACCEL_SHEET = Sheet(
    np.array([415.0, 413.0, 415.0]),
    np.array([[1.0, 0.0, -0.01], [0.01, 1.0, 0.01], [0.02, 0.01, 1.0]]),
    np.array([33123.0, 33276.0, 32360.0]),
)
GYRO_SHEET = Sheet(
    np.array([4778.0, 4758.0, 4766.0]), np.array([[1.0, -0.01, -0.02], [0.0, 1.0, 0.04], [-0.01, 0.01, 1.0]])
)


def to_session(folder: Path) -> CubeData:
    """Convert the recording to a session, in counts.

    Raises:
        InputError: the files are not there or do not belong together.
    """
    accel, gyro = (_table(folder / f"xsens_{name}.mat.gz") for name in ("acc", "gyro"))
    if accel.shape != gyro.shape or not np.array_equal(accel[:, 0], gyro[:, 0]):
        raise InputError(f"{folder}: accelerometer and gyro do not have the same stamps")
    t = np.round((accel[:, 0] - accel[0, 0]) * 1e9) / 1e9
    return CubeData(EPOCH_NS, t, gyro[:, 1:], accel[:, 1:], latitude=None)


def _table(path: Path) -> Array:
    try:
        with gzip.open(path) as stream:
            return np.loadtxt(stream)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not the table t, x, y, z of counts: {error}") from error


def as_on_sheet(values: Mapping[str, float]) -> tuple[Sheet, Sheet]:
    """Convert calibrated parameters to the data sheet's form, for accelerometer and gyro.

    The body frame is turned so that the accelerometer's misalignment comes as near to the sheet's as a rotation can.
    """
    found = []
    for name in ("accel", "gyro"):
        K = np.array([[values[f"{name}_k{i}{j}"] for j in "123"] for i in "123"])
        A = np.linalg.inv(K)
        scale = np.linalg.norm(A, axis=1)
        found.append(Sheet(scale, A / scale[:, None], -A @ [values[f"{name}_b{i}"] for i in "123"]))
    turn = so3.matrix(so3.align(found[0].misalignment, ACCEL_SHEET.misalignment))
    accel, gyro = (Sheet(s.scale, s.misalignment @ turn, s.offset) for s in found)
    return accel, gyro


def main() -> None:
    """Convert the recording to a session file."""
    parser = argparse.ArgumentParser(description="Turn imu_tk's Xsens recording into a session of the cube method.")
    parser.add_argument("folder", type=Path, help="with xsens_acc.mat.gz and xsens_gyro.mat.gz")
    parser.add_argument("--out", type=Path, required=True, help="the session to write (.mcap)")
    options = parser.parse_args()
    try:
        method("cube").write_data(options.out, to_session(options.folder), config_yaml=CONFIG)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
