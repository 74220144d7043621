"""Numbers as people read them: degrees, arc seconds, milliseconds, with as many digits as the sigma warrants."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from alidade.pipelines.estimation.problem import Quantity

_G = 9.80665  # standard gravity, m/s^2

_DEG = math.degrees(1.0)
# SI unit of a quantity -> unit people read, empty for a plain number, and what to multiply SI by.
_UNITS: dict[str, tuple[str, float]] = {
    "rad": ("deg", _DEG),
    "rad/s": ("deg/s", _DEG),
    "s": ("ms", 1e3),
    "T": ("nT", 1e9),
    "": ("%", 100.0),
    "rad/s/K": ("deg/s/K", _DEG),
    "rad/s/(m/s^2)": ("deg/s/g", _DEG * _G),
    "m/s^2": ("m/s²", 1.0),
    "m/s^2/K": ("m/s²/K", 1.0),
    "T/K": ("nT/K", 1e9),
    "s^2/m": ("µg/g²", 1e6 * _G),
    "s^4/m^2": ("µg/g³", 1e6 * _G**2),
    "1": ("", 1.0),
}
# What is wanted to better than this, rad or rad/s, is read in arc seconds or degrees per hour.
_FINE = 2e-4
# A plain number whose usual prior is smaller than this is read in millionths.
_SMALL, _PPM = 1e-3, ("ppm", 1e6)
_FINE_UNITS = {**_UNITS, "rad": ("arcsec", _DEG * 3600.0), "rad/s": ("deg/h", _DEG * 3600.0)}


def human_unit(quantity: Quantity) -> tuple[str, float]:
    """Return the unit to show a quantity in, empty for a plain number, and the factor from its SI value."""
    small = quantity.unit == "" and quantity.prior_scale < _SMALL
    return _PPM if small else shown_unit(quantity.unit, quantity.require)


def shown_unit(unit: str, require: float | None) -> tuple[str, float]:
    """Return the unit to show numbers of an SI unit in, finer for a small required sigma, and the factor from SI."""
    units = _FINE_UNITS if require is not None and require < _FINE else _UNITS
    return units.get(unit, (unit, 1.0))


_ARW = ("deg/√h", math.degrees(60.0))
_RRW = ("deg/h/√h", math.degrees(60.0) * 3600.0)
# Noises by their names in the config -> unit people use, and what to multiply SI by.
_NOISE: dict[str, tuple[str, float]] = {
    "gyro_density": _ARW,
    "platform_gyro_density": _ARW,
    "gyro_bias_walk": _RRW,
    "gyro_repeatability": ("deg/h", math.degrees(3600.0)),
    "accel_density": ("µg/√Hz", 1e6 / _G),
    "accel_repeatability": ("µg", 1e6 / _G),
    "mag_density": ("nT/√Hz", 1e9),
    "mag_repeatability": ("nT", 1e9),
    "los_error": ("µrad", 1e6),
    "los_roll": ("µrad", 1e6),
    "los_map": ("µrad", 1e6),
    "encoder": ("arcsec", math.degrees(3600.0)),
    "vision_attitude": ("deg", math.degrees(1.0)),
    "vision_rate_noise": ("ms", 1e3),
    "vision_correlated": ("deg", math.degrees(1.0)),
    "vision_map": ("deg", math.degrees(1.0)),
    "turn_rate": ("deg/h", math.degrees(3600.0)),
    "move_rate": ("deg/h", math.degrees(3600.0)),
    "dwell_rate": ("deg/h", math.degrees(3600.0)),
}


def noise_unit(name: str, si: str) -> tuple[str, float]:
    """Return the unit to show a noise of the config in, and the factor from its SI value."""
    return _NOISE.get(name, (si, 1.0))


def signed(value: float, decimals: int = 1) -> str:
    """A number with its sign, 0 without one."""
    text = f"{value:+.{decimals}f}"
    return text[1:] if float(text) == 0.0 else text


def rounded(value: float, digits: int = 2) -> str:
    """Format a number to so many digits, without an exponent from 1e-5 to 1e7."""
    if value == 0.0 or not math.isfinite(value) or not 1e-5 < abs(value) < 1e7:
        return f"{value:.{digits}g}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def significant(value: float, digits: int) -> str:
    """Format a number to so many digits, never with an exponent or trailing zeros."""
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-")


def minute(date: str) -> str:
    """Format an ISO 8601 date to the minute."""
    return date[:16].replace("T", " ")


def format_estimate(quantity: Quantity, value: float, sigma: float) -> str:
    """Format a value with its sigma, both SI, in the unit people read: "1.234 ± 0.056 deg"."""
    unit, factor = human_unit(quantity)
    number, spread = (to_digits_of(factor * each, factor * sigma) for each in (value, sigma))
    return f"{number} ± {spread} {unit}".strip()


# What rounding leaves of a fixed parameter, in any unit people read.
_NOTHING = 1e-9


def to_digits_of(value: float, sigma: float) -> str:
    """Format a number down to the second digit of its sigma; to six digits where the sigma is zero."""
    if not (sigma > 0.0 and math.isfinite(sigma)):
        return f"{value:.6g}" if abs(value) > _NOTHING else "0"
    decimals = 1 - math.floor(math.log10(sigma))
    if decimals > 9:
        return f"{value:.2e}"
    text = f"{value:.{max(decimals, 0)}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text
