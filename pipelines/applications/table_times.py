"""Times of a table's rows: which columns hold times, in which unit, and which one dates a sensor's readings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.recording.checks import SLOWEST_S
from alidade.pipelines.recording.table_values import TIME_NAME, TIME_UNITS, bare_name, unit_named
from alidade.pipelines.recording.tables import TableHead

# In a preamble: a rate by name, or, as Vicon's, a number alone in its line.
_RATE = re.compile(r"(?:rate|\bfs\b|freq\w*|sampling)\W*(\d+(?:\.\d+)?)|^(\d+(?:\.\d+)?)\W*$", re.IGNORECASE)
# Endings of a stamp's whole seconds, and of the nanoseconds to be added; a message's stamp, after its topic's name.
_SECONDS, _NANOSECONDS = ("secs", "sec", "seconds"), ("nsecs", "nsec", "nanosec", "nanoseconds")
_STAMP = re.compile(r"(.*?)header\W+stamp")
# Rows in which two times are compared, at least.
_FEWEST_TIMES = 10
# Unix time of the years 1985 to 2128, s.
_UNIX_S = (0.5e9, 5e9)
# Rates by steps and by a preamble are alike up to this power of ten, 5 %.
_ALIKE = 0.02


@dataclass(frozen=True, eq=False)
class Times:
    """Columns of a table that are times.

    Attributes:
        form: names and units of its columns.
        texts, values: of each column, its first rows: as written, and as numbers or NaN.
        where: what begins a sentence about the table.
        reasons, doubts: sentences, added to when a time is used for the first time.
    """

    form: TableHead
    texts: Sequence[NDArray[np.str_]]
    values: Sequence[Array]
    where: str
    reasons: list[str]
    doubts: list[str]
    _given: dict[int | None, dict[str, Any]] = field(default_factory=dict)

    def increases(self, i: int) -> bool:
        """Whether a column's numbers increase from row to row as times do, or are dates or times of day."""
        return ":" in str(self.texts[i][0] if len(self.texts[i]) else "") or _rises(self.values[i])

    @cached_property
    def _rate_hz(self) -> float:
        """Rate of the rows by the preamble, Hz; 0 where it has none."""
        rate = next((found for line in self.form.preamble if (found := _RATE.search(line))), None)
        return float(rate[rate.lastindex or 0]) if rate else 0.0

    @cached_property
    def columns(self) -> list[int]:
        """Columns that are times: increasing ones, by their names; without names the first column."""
        later = self._nanoseconds_of.values()
        increasing = [i for i in range(len(self.values)) if self.increases(i) and i not in later]
        called = {i for i in increasing if TIME_NAME.search(bare_name(self.form.names[i]))}
        times = sorted(called | self._nanoseconds_of.keys())
        times += [i for i in increasing if self.form.stated_unit(i) in TIME_UNITS and i not in times]
        if not times and self.form.names[0] == "column 1" and increasing[:1] == [0]:
            return [0]
        if not times:
            still = [name for name in self.form.names if TIME_NAME.search(bare_name(name))]
            self.doubts.extend(f"{self.where}{name} is no time: it does not increase from row to row" for name in still)
        return times

    def of(self, columns: Sequence[int]) -> dict[str, Any]:
        """Return keys of a `TableTopic` for the time of a sensor in some columns: its column and unit, or the rate.

        The stamp of its message if there is one; else the last time before its columns, if that is another clock than
        the table's first time, as of devices side by side, or if its rows have that one alone.
        """
        names, times = [bare_name(name) for name in self.form.names], self.columns
        stamps = {i: found[1] for i in times if (found := _STAMP.match(names[i]))}
        own = [i for i, prefix in stamps.items() if names[columns[0]].startswith(prefix)]
        if own or not times:
            return self._described(next(iter(own), None))
        last = max((i for i in times if i < min(columns)), default=times[0])
        rows = np.isfinite(self.values[columns[0]])
        no_first, no_last = (np.count_nonzero(self.texts[i][rows] == "") > 0.5 * rows.sum() for i in (times[0], last))
        if no_first and not no_last:
            return self._described(last)
        if not self._is_another_clock(times[0], last):
            return self._described(times[0])
        return self._described(next(i for i in times if i == last or not self._is_another_clock(i, last)))

    def _is_another_clock(self, i: int, other: int) -> bool:
        """Whether two times differ by more than a constant, and have more than half of the longer one in common."""
        if i == other or np.isfinite(self.values[i] + self.values[other]).sum() < _FEWEST_TIMES:
            return False  # nor are dates compared
        a, b = self._seconds(i), self._seconds(other)
        if np.nanstd(b - a) < 0.5 * _median_step(a):
            return False
        (first, last), (begin, end) = ((np.nanmin(x), np.nanmax(x)) for x in (a, b))
        return bool(min(last, end) - max(first, begin) > 0.5 * max(last - first, end - begin))

    def _seconds(self, i: int) -> Array:
        """Times in a column of the table, with the nanoseconds beside it if there are such, converted to s."""
        if i in self._nanoseconds_of:
            return np.asarray(self.values[i] + 1e-9 * self.values[self._nanoseconds_of[i]])
        return np.asarray(self.values[i] * (1e-9 * TIME_UNITS[self._unit_of_time(i)[0]]))

    @cached_property
    def _nanoseconds_of(self) -> dict[int, int]:
        """Columns of whole seconds, as of a message's stamp, and the columns of the nanoseconds to be added."""
        names, found = [bare_name(name) for name in self.form.names], {}
        for i, name in enumerate(names):
            parts = {f"{name.removesuffix(end)}{ns}" for end in _SECONDS if name.endswith(end) for ns in _NANOSECONDS}
            near = sorted((abs(j - i), j) for j, other in enumerate(names) if other in parts)
            if not near:
                continue
            _, j = near[0]
            both = np.stack([self.values[i], self.values[j]])
            seconds, ns = both[:, np.isfinite(both).all(axis=0)]
            if (seconds == np.rint(seconds)).all() and ((ns >= 0.0) & (ns < 1e9)).all() and _rises(seconds + 1e-9 * ns):
                found[i] = j
        return found

    def _described(self, chosen: int | None) -> dict[str, Any]:
        """Return column and unit of a time, or the rate where there is none; its reason or doubt is given once."""
        if chosen not in self._given:
            self._given[chosen] = self._timed(chosen)
        return self._given[chosen]

    def _unit_of_time(self, i: int) -> tuple[str, str]:
        """Return the time unit of a column (s, ms, us, ns), and by what: its header, or its steps."""
        stated = self.form.stated_unit(i) or _unit_word(bare_name(self.form.names[i]))
        unit = stated if stated in TIME_UNITS else _time_unit(self.values[i])
        return unit, "header" if stated == unit else "steps"

    def _timed(self, chosen: int | None) -> dict[str, Any]:
        """Return column and unit of a time, or the rate where there is none, with its reason or doubt."""
        if chosen is None:
            if self._rate_hz:
                self.reasons.append(f"{self.where}no column of time; {self._rate_hz:g} Hz by its preamble")
            else:
                self.doubts.append(f"{self.where}no column of time: 100 Hz is assumed; correct `rate`")
            return {"rate": self._rate_hz or 100.0}
        if chosen in self._nanoseconds_of:
            both = self.form.called([chosen, self._nanoseconds_of[chosen]])
            self.reasons.append(f"{self.where}{both[0]} and {both[1]} are the time, in s and ns")
            return {"time": both}
        name = self.form.called([chosen])[0]
        if ":" in str(self.texts[chosen][0]):
            self.reasons.append(f"{self.where}{name} is the time, as a date or clock time")
            return {"time": name}
        unit, by = self._unit_of_time(chosen)
        # Another unit than these, as the 0.1 ms of Xsens's SampleTimeFine: other numbers are of something else.
        steps = 1e-9 * TIME_UNITS[unit] * _median_step(self.values[chosen]) * self._rate_hz
        power = float(np.log10(steps)) if steps > 0.0 and by == "steps" else 0.0
        if round(power) != 0 and abs(power - round(power)) < _ALIKE:
            self.doubts.append(
                f"{self.where}{name} is in no known unit by the preamble's {self._rate_hz:g} Hz: not used"
            )
            return self._timed(None)
        self.reasons.append(f"{self.where}{name} is the time, in {unit} by its {by}")
        return {"time": name} if unit == "s" else {"time": name, "unit": unit}


def _rises(values: Array) -> bool:
    """Whether numbers increase as times do: a counter may run over, a logger start again, two sensors share a stamp."""
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 2 and bool(np.mean(steps >= 0.0) > 0.99) and bool(np.mean(steps > 0.0) > 0.4)


def _unit_word(name: str) -> str:
    """Return the time unit (s, ms, us, ns) that a column's name spells as a word, as `millis`; empty for none."""
    words = (unit_named(word) for word in re.split(r"[_ ]", name))
    return next((unit for unit in words if unit in TIME_UNITS), "")


def _time_unit(values: Array) -> str:
    """Return the unit of times: by their size where they are Unix times, else by their median step."""
    step, values = _median_step(values), values[np.isfinite(values)]
    for unit, size in TIME_UNITS.items():
        second = 1e9 / size
        if _UNIX_S[0] * second < float(np.median(values)) < _UNIX_S[1] * second and step < SLOWEST_S * second:
            return unit
    if step < 0.9:
        return "s"
    return "ms" if step < 500.0 else "us" if step < 5e5 else "ns"


def _median_step(values: Array) -> float:
    """Return the median step of times; 0 without any."""
    steps = np.diff(values[np.isfinite(values)])
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
