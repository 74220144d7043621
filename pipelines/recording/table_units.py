"""Units of the columns of tables: their SI values, and how headers write them."""

from __future__ import annotations

import math
import re

# SI of a unit.
UNITS = {
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "mdeg/s": math.pi / 180e3,
    "m/s^2": 1.0,
    "g": 9.80665,
    "mg": 9.80665e-3,
    "T": 1.0,
    "mT": 1e-3,
    "uT": 1e-6,
    "nT": 1e-9,
    "G": 1e-4,
    "mG": 1e-7,
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "mrad": 1e-3,
    "m": 1.0,
    "mm": 1e-3,
}
# Nanoseconds of a unit of time.
TIME_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
# Units of a quantity, by its SI unit.
COMPATIBLE = {
    "rad/s": ("rad/s", "deg/s", "mdeg/s"),
    "m/s^2": ("m/s^2", "g", "mg"),
    "T": ("T", "mT", "uT", "nT", "G", "mG"),
    "rad": ("rad", "deg", "mrad"),
    "m": ("m", "mm"),
}
# Other spellings, lower case, without blanks: `_plain` has made u of a micro sign and deg of a degree sign.
_SPELLINGS = {
    "rad/s": "rad/sec rads radps rads^-1 rad*s^-1 rads-1 radian/s radians/s rad_s rad.s^-1",
    "deg/s": "dps deg/sec degs degps degree/s degrees/s degs^-1 deg_s deg.s^-1",
    "mdeg/s": "mdps mdeg/sec",
    "m/s^2": "m/s2 m/s/s mps2 ms^-2 m*s^-2 ms-2 ms2 m/sec^2 m/s**2 m_s2 m.s^-2 m/s^2",
    "g": "gs gravity gee g0",
    "mg": "milli-g millig",
    "T": "tesla",
    "mT": "millitesla mt",
    "uT": "microtesla ut mut",
    "nT": "nanotesla nt",
    "G": "gauss gs ga",
    "mG": "milligauss mgauss mga",
    "rad": "radian radians",
    "deg": "degree degrees",
    "ns": "nanosecond nanoseconds nanos nsec nsecs",
    "us": "microsecond microseconds micros usec usecs",
    "ms": "millisecond milliseconds millis msec msecs",
    "s": "second seconds sec secs",
}
_KNOWN = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split()}
# Of a quantity, for units whose letters another quantity has as well.
_OF_QUANTITY = {("accel", "G"): "g", ("accel", "mG"): "mg", ("field", "g"): "G", ("field", "mg"): "mG"}
# Endings of names that say a unit without brackets.
_ENDINGS = ("dps", "mdps", "rads", "radps", "mps2", "ms2", "mg", "g", "ut", "nt", "mgauss", "gauss", "ns", "us", "ms")


def unit_named(text: str) -> str:
    """The unit that a text is the name of, in the words of UNITS and TIME_UNITS; empty where it is none."""
    plain = _plain(text)
    if plain in UNITS or plain in TIME_UNITS:
        return plain
    return _KNOWN.get(plain.lower(), "") or next((unit for unit in UNITS if "/" in unit and unit == plain.lower()), "")


def unit_in(name: str) -> str:
    """The unit in brackets at the end of a column's name, `Gyroscope x (rad/s)`; empty where there is none."""
    found = re.search(r"[(\[{]([^()\[\]{}]+)[)\]}]\s*$", name)
    return unit_named(found[1]) if found else ""


def unit_hinted(name: str) -> str:
    """The unit in a column's name, in brackets or as its last word, `acc_x_mg`; empty where there is none."""
    words = re.split(r"[_\s.]+", name.strip().lower())
    last = words[-1] if len(words) > 1 and words[-1] in _ENDINGS else ""
    return unit_in(name) or unit_named(last)


def unit_of(quantity: str, unit: str) -> str:
    """A unit as it is meant of a quantity: an accelerometer's G is g, a magnetometer's g is gauss."""
    return _OF_QUANTITY.get((quantity, unit), unit)


def _plain(text: str) -> str:
    """A unit without brackets and blanks, in ASCII."""
    text = text.strip().strip("()[]{}").strip()
    for sign, letters in {
        "\u00b5": "u",
        "\u03bc": "u",
        "\u00b0": "deg",
        "\u00b2": "^2",
        "\u00b7": "*",
        "\u207b\u00b9": "^-1",
    }.items():
        text = text.replace(sign, letters)
    return re.sub(r"\s+", "", text)
