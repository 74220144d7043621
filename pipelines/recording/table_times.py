"""Times of tables as integer ns: numbers in a unit, dates and clock times, counters that run over, rows without a time.

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

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.checks import likely_time_unit
from alidade.pipelines.recording.table_units import TIME_UNITS

Stamps = NDArray[np.int64]

# Stamps beyond these, s, are of another unit: the year 5138; the first too many for integer ns.
_LATEST_S, _DAY_NS = 1e11, 86_400_000_000_000
_DATED = re.compile(r"(\d{4})[-/](\d\d?)[-/](\d\d?)[T ]+(\d\d?):(\d\d)(?::(\d\d))?(?:[.,](\d+))? ?(.*)")
_CLOCK = re.compile(r"(\d\d?):(\d\d)(?::(\d\d))?(?:[.,](\d+))?")
_ZONE = re.compile(r"([+-])(\d\d):?(\d\d)")
# A counter runs over from the last to the first of so many parts of its range.
_BITS, _PART = (16, 24, 32), 8


def nanoseconds(path: Path, texts: NDArray[np.str_], unit: str) -> Stamps:
    """Times as written, exactly, as integer ns. Raises InputError at one that is no time, or of another unit."""
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
    """Times of rows that come at a rate, from 0 on."""
    return np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def check_steps(path: Path, name: str, t_ns: Stamps, unit: str, slowest_s: float) -> None:
    """Raise InputError where steps between stamps are no sensor's, but would be in another unit of time.

    Args:
        path: of the table.
        name: of the topic.
        t_ns: stamps, by a unit.
        unit: the one that was taken.
        slowest_s: the longest usual step that the sensor may have, s.
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
    """A counter that ran over, counted on; as it is where its steps back are others."""
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
    """Dates as ISO 8601 has them, or times of a day."""
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
