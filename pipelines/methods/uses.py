"""Uses of calibrated accelerometers, gyros and magnetometers, of whatever method.

The applied side of every error is the method's own formulas; the reading of a sensor with true parameters is a function
of the method, `Sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Applied, Coefficients, Line, Truth, Use
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.methods.triads import gain_names

G = 9.80665
# Readings (..., U, 3) by sensor of nominal vectors (U, 3) by sensor.
Sensors = Callable[[Truth, Mapping[str, Array]], dict[str, Array]]
_EZ = np.array([0.0, 0.0, 1.0])
# Dip that is assumed where nothing says it, rad.
_DIP = 1.0
_DEVIATION = "deviation = magnetic heading − compass heading = −e = A + B sin h + C cos h + D sin 2h + E cos 2h"


def raw_of(true: Truth, sensor: str, nominal: Array) -> Array:
    """Raw reading (..., U, 3) of a triad with nominal = K raw + b, for nominal vectors."""
    K = true.matrix(gain_names(sensor, true.index), 1.0)
    b = true.vector(*(f"{sensor}_b{i}" for i in "123"))
    return along(np.asarray(np.linalg.inv(K)), nominal - b[..., None, :])


def along(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices (..., 3, 3) by vectors (..., U, 3)."""
    return np.asarray(vectors @ np.swapaxes(matrices, -1, -2))


def gyro_reading(true: Truth, rate: Array, force: Array) -> Array:
    """Gyro reading (I + S) w + G f + bias, (..., U, 3); missing parameters are 0."""
    S = true.matrix(
        [[f"gyro_scale_{i}" if i == j else f"gyro_skew_{min(i, j)}{max(i, j)}" for j in "xyz"] for i in "xyz"]
    )
    sensitivity = true.matrix([[f"gyro_g_{i}{j}" for j in "xyz"] for i in "xyz"])
    return rate + along(S, rate) + along(sensitivity, force) + true.xyz("gyro_bias")[..., None, :]


def triad_uses(true: Truth, sensors: Sensors) -> list[Use]:
    """Uses for the sensors present: heading, rate and specific force."""
    found = [_heading(true, sensors)] if "mag_k11" in true else []
    found += [_rate(sensors)] if "gyro_k11" in true or "gyro_bias_x" in true else []
    return found + ([_force(sensors)] if "accel_k11" in true else [])


def _heading(true: Truth, sensors: Sensors) -> Use:
    psi = np.arange(0.0, 361.0, 5.0)
    tilted = "accel_k11" in true
    usual = float(true.get("field_dip", _DIP))

    def error(roll_deg: float) -> Callable[[Applied, Truth], Array]:
        nRb = so3.multiply(so3.exp(-np.deg2rad(psi)[:, None] * _EZ), so3.exp(np.deg2rad([roll_deg, 0.0, 0.0])))
        up = so3.rotate(so3.inverse(nRb), G * _EZ)
        ahead = so3.rotate(nRb, np.array([1.0, 0.0, 0.0]))
        truth = np.arctan2(-ahead[:, 1], ahead[:, 0])

        def compute(applied: Applied, true: Truth) -> Array:
            field = so3.rotate(so3.inverse(nRb), _field(true, usual)[..., None, :])
            found = applied(**sensors(true, {"mag": field, "accel": up}))
            m = found["m_b"]
            zenith = found["f_b"] / np.linalg.norm(found["f_b"], axis=-1, keepdims=True) if tilted else _EZ
            west = np.cross(zenith, m)
            north = np.cross(west, zenith)
            e = np.arctan2(-west[..., 0], north[..., 0]) - truth
            return np.asarray((e + np.pi) % (2.0 * np.pi) - np.pi)

        return compute

    lines = [Line("level", error(0.0))] + ([Line("rolled 30 deg", error(30.0), "series1")] if tilted else [])
    north, _, up = _field(true, usual)
    dip = np.degrees(np.arctan2(-up, north))
    return Use(
        "heading",
        "Heading from the magnetometer",
        psi,
        "heading, deg",
        "heading error, deg",
        "deg",
        float(np.degrees(1.0)),
        tuple(lines),
        "e = ψ(f, m) − ψ_true, ψ = atan2(−w_x, n_x), w = f/|f| × m, n = w × f/|f|; m = m_b, f = f_b of the formulas",
        f"dip {dip:.1f} deg, {'tilt from the accelerometer' if tilted else 'level'}",
        "heading, any direction",
        signed=True,
        coefficients=Coefficients(tuple("ABCDE"), deviation_coefficients, _DEVIATION),
    )


def _field(true: Truth, dip: float) -> Array:
    """Field (..., 3) to magnetic north, west and up, in the strength's unit; `dip`, rad, if not a parameter."""
    if "field_n" in true:
        north, up = np.hypot(true.get("field_e"), true.get("field_n")), true.get("field_u")
    else:
        strength, dips = true.get("field_strength", 1.0), true.get("field_dip", dip)
        north, up = strength * np.cos(dips), -strength * np.sin(dips)
    return np.stack([north, 0.0 * north, up], axis=-1)


def deviation_coefficients(e: Array) -> Array:
    """Deviation coefficients A to E (..., 5), rad, of heading errors (..., U), rad: first and second harmonic of -e.

    The first and the last error are of one heading. nan where the hard iron is stronger than the horizontal field,
    so that the compass does not turn once with the heading. Formula: Archibald Smith, in the Admiralty Manual for
    Ascertaining and Applying the Deviations of the Compass.
    """
    turned = np.unwrap(e, axis=-1)
    closed = np.abs(turned[..., -1] - turned[..., 0]) < np.pi
    h = np.linspace(0.0, 2.0 * np.pi, e.shape[-1])[:-1]
    waves = np.stack([0.5 * np.ones_like(h), np.sin(h), np.cos(h), np.sin(2.0 * h), np.cos(2.0 * h)], axis=1)
    return np.where(closed[..., None], -2.0 / len(h) * turned[..., :-1] @ waves, np.nan)


def _rate(sensors: Sensors) -> Use:
    rate = np.linspace(-200.0, 200.0, 41)
    force = np.tile(G * _EZ, (len(rate), 1))

    def error(axis: int) -> Callable[[Applied, Truth], Array]:
        w = np.deg2rad(rate)[:, None] * np.eye(3)[axis]
        return lambda applied, true: applied(**sensors(true, {"gyro": w, "accel": force}))["w_b"] - w

    return Use(
        "rate",
        "Rate from the gyro",
        rate,
        "rate, deg/s",
        "length of the rate error, deg/s",
        "deg/s",
        float(np.degrees(1.0)),
        tuple(Line(f"about {axis}", error(i), axis) for i, axis in enumerate(AXES)),
        "e = w_b(gyro, accel) − ω; f = 1 g along z",
        "turning about one body axis, z up, at the first temperature",
        "rate, at 100 deg/s",
        at=30,
    )


def _force(sensors: Sensors) -> Use:
    angle = np.arange(0.0, 361.0, 5.0)
    cosine, sine = (G * wave(np.deg2rad(angle)) for wave in (np.cos, np.sin))

    def error(axis: int) -> Callable[[Applied, Truth], Array]:
        f = np.zeros((len(angle), 3))
        f[:, (axis + 1) % 3], f[:, (axis + 2) % 3] = cosine, sine
        return lambda applied, true: applied(**sensors(true, {"accel": f}))["f_b"] - f

    return Use(
        "force",
        "Specific force from the accelerometer",
        angle,
        "direction of gravity in the plane, deg",
        "length of the error, mg",
        "mg",
        1e3 / G,
        tuple(
            Line(f"{plane} plane", error(i), axis) for i, (axis, plane) in enumerate(zip(AXES, _PLANES, strict=True))
        ),
        "e = f_b(accel) − f, |f| = 1 g",
        "at rest, gravity turned through the planes of the body, each in the colour of its normal",
        "specific force, at 1 g",
    )


_PLANES = ("yz", "zx", "xy")
