"""Uses of a los result: pointing, and stabilising the line of sight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.methods.formula import passive
from alidade.pipelines.methods.los.parameters import ONCE_PER_TURN
from alidade.pipelines.methods.uses import G, gyro_reading
from alidade.pipelines.settings import Config

_AZIMUTH_DEG = np.linspace(-90.0, 90.0, 37)
_ELEVATIONS_DEG = (-30.0, 15.0, 60.0)
# Of the stabilisation: elevation, and rate of the carrier.
_ELEVATION_DEG, _RATE_DEG = 20.0, 10.0
_FORCE = np.array([[0.0, 0.0, G]])


def uses(_true: Truth, _config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a los calibration: pointing over azimuth and elevation, and residual LOS rate under stabilisation."""
    pointing = Use(
        "pointing",
        "Line of sight against the IMU",
        _AZIMUTH_DEG,
        "azimuth, deg",
        "pointing error, mrad",
        "mrad",
        1e3,
        tuple(Line(f"elevation {e:.0f} deg", _pointing(e), f"series{i}") for i, e in enumerate(_ELEVATIONS_DEG)),
        "e = (v_x, v_z)/v_y, v = cRm_true (cRm_applied)ᵀ e_y, cRm = lRb M of the formulas",
        "direction of the optical axis in the IMU's frame, cross-elevation and elevation together",
        "pointing, any azimuth and elevation",
    )
    stabilisation = Use(
        "stabilisation",
        "Line-of-sight rate left by stabilisation",
        _AZIMUTH_DEG,
        "azimuth, deg",
        "residual LOS rate, mrad/s",
        "mrad/s",
        1e3,
        tuple(Line(f"carrier about {axis}", _stabilisation(i), axis) for i, axis in enumerate(AXES)),
        "e = (ω_x, ω_z) of ω_l = Rx(ε + px)(Rz(η) w_b + η' e_z) + ε' e_x; ε', η' commanded with applied M, px, gyro",
        f"carrier turning at {_RATE_DEG:g} deg/s about one axis, elevation {_ELEVATION_DEG:g} deg",
        f"LOS rate, carrier at {_RATE_DEG:g} deg/s",
    )
    return pointing, stabilisation


def _imu_to_carrier(true: Truth) -> Array:
    """Mounting rotation M (..., 4) from IMU to carrier."""
    z = true.get("delta_z") if "delta_z" in true else true.get("delta_pz") - true.get("delta_gz")
    return so3.compose(passive(2, z), passive(0, -true.get("delta_gx")), passive(1, -true.get("delta_gy")))


def _camera(true: Truth, azimuth: Array, elevation: Array) -> Array:
    """Camera attitude cRm (..., U, 4) at encoder readings (U,), rad."""
    one = {name: true.get(name)[..., None] for name in (*ONCE_PER_TURN.names, *_TURNS)}
    angles = []
    for reading, (sine, cosine) in ((azimuth, ONCE_PER_TURN.names[:2]), (elevation, ONCE_PER_TURN.names[2:])):
        angles.append(reading - one[sine] * np.sin(reading) - one[cosine] * np.cos(reading))
    return so3.compose(
        passive(1, one["camera_roll"]),
        passive(2, one["collimation"]),
        passive(0, angles[1] + one["delta_px"]),
        passive(1, one["axis_nonperpendicularity"]),
        passive(2, angles[0]),
        _imu_to_carrier(true)[..., None, :],
    )


_TURNS = ("camera_roll", "collimation", "delta_px", "axis_nonperpendicularity")


def _pointing(elevation_deg: float) -> Callable[[Applied, Truth], Array]:
    azimuth = np.deg2rad(_AZIMUTH_DEG)
    elevation = np.full_like(azimuth, np.deg2rad(elevation_deg))

    def compute(applied: Applied, true: Truth) -> Array:
        found = applied(azimuth=azimuth, elevation=elevation)
        axis = so3.rotate(so3.inverse(so3.multiply(found["lRb"], found["M"])), np.array([0.0, 1.0, 0.0]))
        v = so3.rotate(_camera(true, azimuth, elevation), axis)
        return np.stack([np.arctan2(v[..., 0], v[..., 1]), np.arctan2(v[..., 2], v[..., 1])], axis=-1)

    return compute


def _stabilisation(axis: int) -> Callable[[Applied, Truth], Array]:
    azimuth, elevation = np.deg2rad(_AZIMUTH_DEG), np.deg2rad(_ELEVATION_DEG)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    w = np.deg2rad(_RATE_DEG) * np.eye(3)[axis : axis + 1]

    def compute(applied: Applied, true: Truth) -> Array:
        found = applied(gyro=gyro_reading(true, w, _FORCE), accel=_FORCE)["w_b"]
        real = so3.rotate(_imu_to_carrier(true)[..., None, :], w)
        elevation_rate = -(cosine * found[..., 0] + sine * found[..., 1])
        forward = cosine * found[..., 1] - sine * found[..., 0]
        azimuth_rate = np.tan(elevation + applied.values.get("delta_px", 0.0)) * forward - found[..., 2]
        angle = elevation + true.get("delta_px")[..., None]
        x = cosine * real[..., 0] + sine * real[..., 1] + elevation_rate
        z = np.cos(angle) * (real[..., 2] + azimuth_rate) - np.sin(angle) * (
            cosine * real[..., 1] - sine * real[..., 0]
        )
        return np.stack([x, z], axis=-1)

    return compute
