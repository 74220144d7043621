"""Calibrations of arrays in one call, under the names that other tools have for them.

    A, b, field = alidade.magcal(m)                         # MATLAB: (m - b) @ A lies on a sphere of radius field
    K, bias, K_gyro, bias_gyro = alidade.imu_static(acc, gyro, t, latitude_deg=48.1)
    R, delay = alidade.hand_eye(gyro, t, wxyz, t_wxyz)

Each is a tuple that has the whole `Calibration` behind it: `alidade.magcal(m).calibration`. An inconsistent or
unobservable result raises a UserWarning.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.applications.api import calibrate
from alidade.pipelines.config import Settings, load_config

if TYPE_CHECKING:
    from alidade.pipelines.reports.result import Calibration

# Rate of samples without stamps, Hz.
_RATE_HZ = 50.0


class _Result:
    """Base of the results below: the calibration that their numbers are from."""

    calibration: Calibration

    def _with(self, calibration: Calibration) -> Self:
        if calibration.status in ("inconsistent", "unobservable"):
            warnings.warn(f"{calibration.status}: {calibration.headline}", stacklevel=3)
        self.calibration = calibration
        return self


class MagnetometerResult(tuple[Array, Array, float], _Result):
    """Result of a compass calibration: A (3, 3), b (3,), field; details are in `.calibration`."""


class StaticResult(tuple[Array, Array, Array, Array], _Result):
    """K and bias of the accelerometer, K and bias of the gyro; the whole is in `.calibration`."""


class HandEyeResult(tuple[Array, float], _Result):
    """Result of a hand-eye calibration: R (3, 3), delay; details are in `.calibration`."""


def magcal(m: ArrayLike, t: ArrayLike | None = None, *, config: Settings = None) -> MagnetometerResult:
    """Hard and soft iron of a magnetometer from readings in all directions, method `tumble`.

    (m - b) @ A lies on a sphere: A (3, 3) symmetric with determinant 1, b (3,) hard iron and `field`, the radius, in
    the unit of m. Sigmas and verdicts are in `.calibration`.

    Args:
        m: (N, 3) readings, in any unit.
        t: (N,) s; without it 50 Hz.
        config: as `alidade.open` has it.

    Raises:
        InputError: arrays or config cannot be used.
    """
    readings = np.asarray(m, dtype=float)
    stamps = np.arange(len(readings)) / _RATE_HZ if t is None else t
    found = calibrate({"mag_t": stamps, "mag": m}, method="tumble", config=config)
    K = found.matrix("mag")
    scale = float(np.linalg.det(K) ** (-1.0 / 3.0))
    strength = found.parameters["field_strength"].value
    return MagnetometerResult((scale * K, found.bias("mag"), scale * strength))._with(found)


def imu_static(
    acc: ArrayLike, gyro: ArrayLike, t: ArrayLike, *, latitude_deg: float, config: Settings = None
) -> StaticResult:
    """Accelerometer and gyro of an IMU laid down in many attitudes, method `cube` without camera and reference.

    nominal = K (raw - bias) of either sensor, (3, 3) and (3,), SI, along the body's axes.

    Args:
        acc: (N, 3) m/s^2.
        gyro: (N, 3) rad/s.
        t: (N,) s.
        latitude_deg: of the place: gravity is 9.780 m/s^2 at the equator and 9.832 at the poles.
        config: as `alidade.open` has it.

    Raises:
        InputError: arrays or config cannot be used.
    """
    keys = {"latitude_deg": latitude_deg, **load_config(None, config).model_dump(exclude_unset=True)}
    found = calibrate({"imu_t": t, "gyro": gyro, "accel": acc}, method="cube", config=keys)
    numbers = (found.matrix("accel"), found.bias("accel"), found.matrix("gyro"), found.bias("gyro"))
    return StaticResult(numbers)._with(found)


def hand_eye(
    gyro: ArrayLike, t: ArrayLike, wxyz: ArrayLike, t_wxyz: ArrayLike, *, config: Settings = None
) -> HandEyeResult:
    """Rotation and delay between a gyro and a tracked body that are fixed to each other, method `head`.

    R (3, 3) maps coordinates in the tracked body to those of the gyro; delay, s, is positive where attitudes were taken
    later than their stamps say. Translations are not estimated.

    Args:
        gyro: (N, 3) rad/s.
        t: (N,) s.
        wxyz: (M, 4) attitudes of the body in the tracker's frame, unit quaternions w, x, y, z.
        t_wxyz: (M,) s.
        config: as `alidade.open` has it.

    Raises:
        InputError: arrays or config cannot be used.
    """
    arrays: dict[str, Any] = {"head_t": t, "head_gyro": gyro, "vision_t": t_wxyz, "vision_wxyz": wxyz}
    found = calibrate(arrays, method="head", config=config)
    R = so3.matrix(np.array(found.rotations["helmet_mount"].wxyz))
    return HandEyeResult((R, found.parameters["time_offset"].value))._with(found)
