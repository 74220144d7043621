"""Whether readings can be what they are taken for: units by their size, gravity that was taken off, wrapped counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SI = {"accel": "m/s^2", "gyro": "rad/s", "mag": "T"}
# Median norms that an accelerometer in m/s^2 and a magnetometer in T show, and in which unit others are likely to be.
_PLAUSIBLE = {"accel": (3.0, 30.0), "mag": (1e-6, 1e-3)}
_ACCEL_UNITS = {"g": (0.5, 2.0), "mg": (500.0, 2000.0), "raw counts": (2000.0, np.inf)}
_MAG_UNITS = {"gauss": (0.05, 5.0), "uT": (5.0, 1000.0), "mG or raw counts": (1000.0, 2e4), "nT": (2e4, np.inf)}
_LIKELY = {"accel": _ACCEL_UNITS, "mag": _MAG_UNITS}
# With gravity in it the norm of a specific force is seldom below half its median, which a vector of noise and motion
# alone is in 13 of 100 readings (the share for a normal one in three axes: median 1.54, chi(3) below 0.77 is 0.13).
_LOW, _LOW_SHARE = 0.5, 0.08
# Gravity in m/s^2, with the largest offset of a sensor, and in g: norms that are those of gravity.
_WITH_GRAVITY = ((8.0, np.inf), (0.8, 1.25))
GRAVITY_REMOVED = (
    "gravity has been taken off (linear acceleration, user acceleration): record the accelerometer with gravity in it"
)
# A gyro at rest reads its bias: in rad/s below 0.2, in deg/s often above; a magnetometer reads the field.
_FEWEST = 50
# Unsigned counts that are signed ones: taken as such they vary by less than so much of what they do as they are.
_LESS = 0.5


def implausible(kind: str, values: Array) -> str:
    """What is wrong with the unit of readings (N, 3), as a phrase; empty if nothing is, and of a gyro.

    Args:
        kind: accel, gyro or mag.
        values: m/s^2, rad/s or T, as they should be; rows with NaN do not count.
    """
    if kind not in _PLAUSIBLE:
        return ""
    norms = np.linalg.norm(values[np.isfinite(values).all(axis=1)], axis=1)
    if not len(norms):
        return ""
    norm = float(np.median(norms))
    what = {"accel": "acceleration", "mag": "field"}[kind]
    said = f"{what} has a norm of {norm:.4g} (median), implausible in {SI[kind]}"
    if kind == "accel" and lacks_gravity(norms):
        return f"{said}; {GRAVITY_REMOVED}"
    low, high = _PLAUSIBLE[kind]
    if low <= norm <= high:
        return ""
    likely = next((unit for unit, (a, b) in _LIKELY[kind].items() if a <= norm < b), None)
    return f"{said}{f'; is it in {likely}?' if likely else ''}"


def lacks_gravity(norms: Array) -> bool:
    """Whether norms (N,) of what an accelerometer read, in m/s^2 or g, are those of motion without gravity."""
    norm = float(np.median(norms))
    if len(norms) < _FEWEST or norm > _PLAUSIBLE["accel"][1] or any(low < norm < high for low, high in _WITH_GRAVITY):
        return False
    return bool(np.mean(norms < _LOW * norm) > _LOW_SHARE)


def wrapped_bits(values: Array) -> int:
    """Bits of counts (N, 3) of a signed sensor that were written as unsigned ones; 0 where they were not."""
    first = values[:_FEWEST]
    if not len(first) or not (np.isfinite(first).all() and (first >= 0).all() and (first == np.rint(first)).all()):
        return 0
    if not (np.isfinite(values).all() and (values >= 0).all() and (values == np.rint(values)).all()):
        return 0
    bits = int(values.max()).bit_length()
    if bits not in (8, 10, 12, 14, 16, 20, 24, 32):
        return 0
    signed = to_signed(values, bits)
    before, after = (np.abs(np.diff(one, axis=0)).sum() for one in (values, signed))
    return bits if after < _LESS * before else 0


def to_signed(values: Array, bits: int) -> Array:
    """Counts of so many bits as signed numbers, by two's complement."""
    return np.where(values >= 1 << (bits - 1), values - (1 << bits), values)
