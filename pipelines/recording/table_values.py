"""Units of the columns of tables, as headers write them; times as integer ns, dates and counters that run over.

A number is read as it is written, to the nanosecond. A counter of 16, 24 or 32 bits that ran over goes on. A clock time
without a date counts from midnight, over midnight.
"""

from __future__ import annotations

import datetime
import math
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Stamps
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.checks import likely_time_unit

# SI unit of a quantity -> its units, in SI.
COMPATIBLE = {
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "mdeg/s": math.pi / 180e3},
    "m/s^2": {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3},
    "T": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3},
    "m": {"m": 1.0, "mm": 1e-3},
}
UNITS = {unit: size for units in COMPATIBLE.values() for unit, size in units.items()}
# Nanoseconds of a unit of time.
TIME_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
# Other spellings, lower case, without blanks: `_plain` has made u of a micro sign and deg of a degree sign.
_SPELLINGS = {
    "rad/s": "rad/s rad/sec rads radps rads^-1 rad*s^-1 rads-1 radian/s radians/s rad_s rad.s^-1",
    "deg/s": "deg/s dps deg/sec degs degps degree/s degrees/s degs^-1 deg_s deg.s^-1",
    "mdeg/s": "mdeg/s mdps mdeg/sec",
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
# What columns of times are called, by `bare_name`.
TIME_NAME = re.compile(
    r"^t_|^(t|ts|time|timestamp|stamp|sec|secs|seconds|s|ms|us|ns|millis|micros|clock|epoch|datetime|date)$"
    r"|time|stamp|elapsed|utc|millis|micros"
)
# Endings of names that say a unit without brackets.
_ENDINGS = ("dps", "mdps", "rads", "radps", "mps2", "ms2", "mg", "g", "ut", "nt", "mgauss", "gauss", "ns", "us", "ms")


def unit_named(text: str) -> str:
    """Return the unit that a text names, as UNITS and TIME_UNITS spell it; empty for any other text."""
    plain = _plain(text)
    return plain if plain in UNITS or plain in TIME_UNITS else _KNOWN.get(plain.lower(), "")


def unit_in(name: str) -> str:
    """The unit in brackets at the end of a column's name, `Gyroscope x (rad/s)`; empty where there is none."""
    found = re.search(r"[(\[{]([^()\[\]{}]+)[)\]}]\s*$", name)
    return unit_named(found[1]) if found else ""


def unit_hinted(name: str) -> str:
    """The unit in a column's name, in brackets or as its last word, `acc_x_mg`; empty where there is none."""
    words = re.split(r"[_\s.]+", name.strip().lower())
    last = words[-1] if len(words) > 1 and words[-1] in _ENDINGS else ""
    return unit_in(name) or unit_named(last)


def bare_name(name: str) -> str:
    """A column's name without its unit and the `field.` that `rostopic echo -p` begins all names with, lower case."""
    plain = re.sub(r"^field\.(?=\w\w)", "", name.strip().lower())
    return re.sub(r"\s*[(\[{][^()\[\]{}]*[)\]}]$", "", plain) if unit_hinted(name) else plain


def unit_of(quantity: str, unit: str) -> str:
    """Return the unit that is meant for a quantity: an accelerometer's G is g, a magnetometer's g is gauss."""
    return _OF_QUANTITY.get((quantity, unit), unit)


def _plain(text: str) -> str:
    """Return the text of a unit without brackets and blanks, in ASCII."""
    for sign, letters in {
        "\u00b5": "u",
        "\u03bc": "u",
        "\u00b0": "deg",
        "\u00b2": "^2",
        "\u00b7": "*",
        "\u207b\u00b9": "^-1",
    }.items():
        text = text.replace(sign, letters)
    return re.sub(r"[\s()\[\]{}]+", "", text)


# Stamps beyond these, s, are of another unit: the year 5138; the first too many for integer ns.
_LATEST_S, _DAY_NS = 1e11, 86_400_000_000_000
_DATED = re.compile(r"(\d{4})[-/](\d\d?)[-/](\d\d?)[T ]+(\d\d?):(\d\d)(?::(\d\d))?(?:[.,](\d+))? ?(.*)")
_CLOCK = re.compile(r"(\d\d?):(\d\d)(?::(\d\d))?(?:[.,](\d+))?")
_ZONE = re.compile(r"([+-])(\d\d):?(\d\d)")
# A counter runs over from the last to the first of so many parts of its range.
_BITS, _PART = (16, 24, 32), 8


def nanoseconds(path: Path, texts: NDArray[np.str_], unit: str) -> Stamps:
    """Convert times as written to integer ns, exactly. Raises InputError at one that is no time, or of another unit."""
    if not len(texts):
        return np.empty(0, np.int64)
    if any(":" in text for text in texts[:2].tolist()):
        return _of_clock(path, texts)
    size = TIME_UNITS[unit]
    try:
        ticks = texts.astype(np.int64)
        _check_size(path, float(np.abs(ticks).max()) * size, unit)
        return _unwrapped(ticks) * size
    except (ValueError, OverflowError):  # with a fraction or an exponent, or too large
        pass
    try:
        numbers = [Decimal(text) for text in texts.tolist()]
        _check_size(path, float(max(map(abs, numbers))) * size, unit)
        # What is beyond the nanosecond is left out.
        return np.array([int(number * size) for number in numbers], dtype=np.int64)
    except (ArithmeticError, ValueError) as error:
        raise _no_time(path, texts, unit) from error


def of_rate(count: int, rate_hz: float) -> Stamps:
    """Return stamps (n,), ns, from 0 on, of rows at a constant rate."""
    return np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def check_steps(path: Path, name: str, t_ns: Stamps, unit: str, slowest_s: float) -> None:
    """Raise InputError where steps between stamps are plausible for a sensor only in another unit of time.

    `name` is the topic's, `unit` the one used, `slowest_s` the longest usual step of such a sensor, s.
    """
    likely = likely_time_unit(t_ns, slowest_s)
    if likely is None:
        return
    step = float(np.median(np.diff(t_ns))) * 1e-9
    meant = next((one for one, size in TIME_UNITS.items() if size == round(TIME_UNITS[unit] * likely)), None)
    if meant is not None:
        raise InputError(
            f"{path}: columns.{name}: by `unit: {unit}` rows are {step:.3g} s apart (median); is the unit {meant}? "
            f"`unit: {meant}`"
        )


def _check_size(path: Path, largest_ns: float, unit: str) -> None:
    if largest_ns * 1e-9 <= _LATEST_S and largest_ns < 2.0**63:
        return
    seconds = largest_ns * 1e-9
    meant = next(
        (one for one in ("ms", "us", "ns") if seconds * TIME_UNITS[one] / TIME_UNITS[unit] <= 0.1 * _LATEST_S), "ns"
    )
    raise InputError(
        f"{path}: a time of {largest_ns / TIME_UNITS[unit]:.4g} {unit} is no date; is the unit {meant}? `unit: {meant}`"
    )


def _unwrapped(ticks: Stamps) -> Stamps:
    """Return ticks of a counter without its overflows; unchanged where backward steps are no overflows."""
    steps = np.diff(ticks)
    back = np.flatnonzero(steps < 0)
    if not len(back) or ticks.min() < 0:
        return ticks
    bits = int(ticks.max()).bit_length()
    size = 1 << bits
    if bits not in _BITS or (ticks[back] < size - size // _PART).any() or (ticks[back + 1] > size // _PART).any():
        return ticks
    return ticks + size * np.concatenate([[0], np.cumsum(steps < 0)])


def _of_clock(path: Path, texts: NDArray[np.str_]) -> Stamps:
    """Convert ISO 8601 dates, or times of day, to integer ns."""
    out = np.empty(len(texts), np.int64)
    dated = _DATED.fullmatch(str(texts[0])) is not None
    for i, text in enumerate(texts.tolist()):
        found = (_DATED if dated else _CLOCK).fullmatch(text)
        if found is None:
            raise _no_time(path, texts[i : i + 1], "s or as 2026-11-20T10:00:00.000")
        try:
            out[i] = _dated_ns(found) if dated else _clock_ns(*found.groups())
        except ValueError as error:
            raise InputError(f"{path}: {text!r} is no time ({error})") from error
    return out if dated else out + _DAY_NS * np.concatenate([[0], np.cumsum(np.diff(out) < -_DAY_NS // 2)])


def _dated_ns(found: re.Match[str]) -> int:
    year, month, day, hour, minute, second, fraction, zone = found.groups()
    midnight = datetime.datetime(int(year), int(month), int(day), tzinfo=datetime.UTC)
    shift = _ZONE.search(zone or "")
    if zone and shift is None and zone.strip() not in ("Z", "UTC", "GMT"):
        raise ValueError(f"its zone {zone!r} is not read")
    late = (int(shift[2]) * 60 + int(shift[3])) * (-1 if shift[1] == "-" else 1) if shift else 0
    whole_ns = (round(midnight.timestamp()) - 60 * late) * 1_000_000_000
    return whole_ns + _clock_ns(hour, minute, second, fraction)


def _clock_ns(hour: str, minute: str, second: str | None, fraction: str | None) -> int:
    whole = (int(hour) * 60 + int(minute)) * 60 + int(second or 0)
    return whole * 1_000_000_000 + int((fraction or "0")[:9].ljust(9, "0"))


def _no_time(path: Path, texts: NDArray[np.str_], unit: str) -> InputError:
    wrong = next((text for text in texts.tolist() if not _is_finite(text)), str(texts[0]))
    return InputError(f"{path}: a time that is no number in {unit}: {wrong[:40]!r}")


def _is_finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
