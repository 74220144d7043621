"""Whether the sensors of a cube session are in the units that they have to be in."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipelines.errors import InputError
from pipelines.methods.cube.data import Array

# Norms at rest that no accelerometer in m/s^2 and no magnetometer in T shows, and what they are likely to be.
_ACCEL_RANGE, _MAG_RANGE = (3.0, 30.0), (1e-6, 1e-3)
_ACCEL_UNITS = {"g": (0.5, 2.0), "mg": (500.0, 2000.0), "raw counts": (2000.0, np.inf)}
_MAG_UNITS = {"gauss": (0.05, 5.0), "uT": (5.0, 1000.0), "mG or raw counts": (1000.0, 2e4), "nT": (2e4, np.inf)}


def check_accel(topic: str, values: Array) -> None:
    """Raise InputError if the specific force (n, 3) is not in m/s^2."""
    _check_norm(f"{topic}: acceleration", values, _ACCEL_RANGE, "m/s^2", _ACCEL_UNITS)


def check_mag(topic: str, values: Array) -> None:
    """Raise InputError if the magnetic field (n, 3) is not in T."""
    _check_norm(f"{topic}: field", values, _MAG_RANGE, "T", _MAG_UNITS)


def _check_norm(
    what: str, values: Array, plausible: tuple[float, float], unit: str, units: Mapping[str, tuple[float, float]]
) -> None:
    """Raise InputError if the median norm is no such quantity in that unit; says in which unit it would be one."""
    norm = float(np.median(np.linalg.norm(values, axis=1)))
    if plausible[0] <= norm <= plausible[1]:
        return
    likely = next((name for name, (low, high) in units.items() if low <= norm < high), None)
    hint = f"; is it in {likely}?" if likely else ";"
    raise InputError(
        f"topic {what} has a norm of {norm:.4g} (median), implausible in {unit}{hint} It has to be in {unit}, or "
        "its conversion in the config under cube.raw"
    )
