"""Columns of tables, inferred from headers and numbers, as proposals for the config's `columns:`.

Names say what a column is; where there are none, numbers do as far as they can: gravity and the earth's field have
sizes that identify an accelerometer or a magnetometer and its unit. Nothing is taken silently: a proposal comes with
its reasons, and with what could not be concluded.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import flow_yaml
from alidade.pipelines.recording.checks import MAX_RATE_RAD_S, SLOWEST_S
from alidade.pipelines.recording.message_tables import message_tables
from alidade.pipelines.recording.messages import IMU
from alidade.pipelines.recording.plausibility import GRAVITY_REMOVED, PLAUSIBLE, lacks_gravity
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.table_topics import Table, TableTopic, tables_of
from alidade.pipelines.recording.table_values import (
    COMPATIBLE,
    TIME_NAME,
    TIME_UNITS,
    UNITS,
    bare_name,
    unit_hinted,
    unit_named,
    unit_of,
)
from alidade.pipelines.recording.tables import numbers
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.settings import Config

# What the names of three columns along x, y and z begin with or are, lower case; `gx` is a gyro's as often as not.
_WORDS = {
    "gyro": r"gyr|angular.?(vel|rate)|omega|rotation.?rate|^w(?=_|$)|^g(?=_|$)|ang.?vel|\brate",
    "accel": r"acc|^a(?=_|$)|specific.?force|^f(?=_|$)|^g.?f(?=_|$|orce)",
    "field": r"mag|^m(?=_|$)|^b(?=_|$)|^h(?=_|$)|field",
}
# SI units of the sensors.
_SI = {"gyro": "rad/s", "accel": "m/s^2", "field": "T"}
_LINEAR = re.compile(r"lin|free|user|without.?g|gravity|acceleration.?no.?g")
# In a preamble: a rate by name, or, as Vicon's, a number alone in its line.
_RATE = re.compile(r"(?:rate|\bfs\b|freq\w*|sampling)\W*(\d+(?:\.\d+)?)|^(\d+(?:\.\d+)?)\W*$", re.IGNORECASE)
_VISION = re.compile(r"vision|visual|pose|mocap|vicon|optitrack|tracker|ground|trajectory")
# Median norms, in a unit; of an accelerometer gravity, of a magnetometer the earth's field and some iron.
_SIZES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "accel": {"m/s^2": (8.0, 12.0), "g": (0.8, 1.25), "mg": (800.0, 1250.0)},
    "field": {"uT": (15.0, 120.0), "G": (0.15, 1.2), "mG": (150.0, 1200.0), "T": (1.5e-5, 1.2e-4)},
}
# Without names these alone are taken: others are counts as often as not.
_UNNAMED = {"accel": ("m/s^2", "g"), "field": ("uT",)}
# Names of yaw, pitch and roll, of a rotation vector, and the keys of both.
_ANGLES = (r"yaw(?!.*rate)|^heading$", r"pitch(?!.*rate)", r"roll(?!.*rate)")
_ROTATION_VECTOR = re.compile(r"^r$|rot\w*.?vec|helical|axis.?angle")
_TURNS = ("yaw_pitch_roll", "rotation_vector")
_OTHERS = ("wxyz", *_TURNS, "vector", "joints", "latitude_deg")
# Names of latitude and longitude.
_PLACE = (r"^lat", r"^lon|^lng")
# Errors of a tracker in elevation, about x, and in azimuth, about z.
_LOS_ERRORS = (r"^el\w*err|^err\w*_el", r"^az\w*err|^err\w*_az")
_JOINTS = {"/gimbal/joint_states": ("azimuth", "elevation"), "/indexer/joint_states": ("outer_x", "inner_z")}
_QUATERNION = "q|quat|orientation|rot|attitude"
# Endings of a stamp's whole seconds, and of the nanoseconds to be added; a message's stamp, after its topic's name.
_SECONDS, _NANOSECONDS = ("secs", "sec", "seconds"), ("nsecs", "nsec", "nanosec", "nanoseconds")
_STAMP = re.compile(r"(.*?)header\W+stamp")
# Rows in which two times are compared, at least.
_FEWEST_TIMES = 10
# Unix time of the years 1985 to 2128, s.
_UNIX_S = (0.5e9, 5e9)
# The axes of a device that is turned about vary by so much of what it feels (all directions alike: 0.58).
_TURNED = 0.1
# Rates by steps and by a preamble are alike up to this power of ten, 5 %.
_ALIKE = 0.02
# Rows looked at.
_ROWS = 20_000
# Rates beyond a gyro's in rad/s are in deg/s up to what a gyro of 4000 deg/s may read on three axes; beyond, counts.
_MOST_DEG_S = 7000.0


@dataclass(frozen=True)
class Columns:
    """Proposed meaning of a table's columns.

    Attributes:
        columns: topic -> its columns, as under `columns:`.
        topics: key -> its source, where a gyro and an accelerometer are in two tables.
        reasons: sentences about what was concluded.
        doubts: sentences about what could not be, or is assumed.
    """

    columns: dict[str, TableTopic]
    topics: dict[str, TopicSource]
    reasons: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def yaml(self) -> str:
        """Config sections that describe the columns, to paste."""
        lines = ["columns:"]
        for topic, table in self.columns.items():
            given = {k: v for k, v in table.model_dump(exclude_defaults=True).items() if v is not None}
            lines.append(f"  {topic}: {flow_yaml(given)}")
        if self.topics:
            lines.append("topics:")
            lines += [f"  {key}: {flow_yaml(source.model_dump())}" for key, source in self.topics.items()]
        return "\n".join(lines)

    def applied(self, recording: Recording, config: Config) -> tuple[Recording, Config]:
        """The recording and config with these columns."""
        more = config.model_copy(update={"columns": self.columns, "topics": {**self.topics, **config.topics}})
        return recording.with_config(more.topics.values(), more.columns), more


def propose_columns(recording: Recording) -> Columns | None:
    """Propose the columns of a recording's tables that no config describes; None if there is no such table.

    Messages of types that are not known count as tables where they have something that is.
    """
    files = tables_of(recording.container)
    found = [_Table(table, len(files) > 1) for table in files.values()]
    made = [one.topics() for one in found]
    for table in message_tables(recording.container).values():
        with suppress(InputError):  # what cannot be read is no proposal
            if table.is_proposed:
                one = _Table(table, True)
                if topics := one.topics():
                    found, made = [*found, one], [*made, topics]
    columns: dict[str, TableTopic] = {}
    for one, topics in zip(found, made, strict=True):
        for topic, described in topics.items():
            columns[_free(topic, one.path, {*columns, *recording.topics})] = described
    if not found:
        return None
    gyros = [name for name, table in columns.items() if table.gyro and not table.accel]
    accels = [name for name, table in columns.items() if table.accel and not table.gyro]
    sources = {"imu": TopicSource(gyro=gyros[0], accel=accels[0])} if len(gyros) == len(accels) == 1 else {}
    recorded = any(each.type == IMU for each in recording.topics.values())
    if len(gyros) + len(accels) == 1 and "/imu" not in columns and not recorded:
        sources = {"imu": TopicSource(topic=(gyros or accels)[0])}
    reasons = tuple(reason for one in found for reason in one.reasons)
    return Columns(columns, sources, reasons, tuple(doubt for one in found for doubt in one.doubts))


def with_columns(recording: Recording, config: Config) -> tuple[Recording, Config]:
    """Return recording and config with proposed columns where the config has none; noted in the recording.

    Raises InputError where nothing can be concluded.
    """
    found = None if config.columns else propose_columns(recording)
    if found is None:
        return recording, config
    if not found.columns:
        raise InputError(f"{recording.path}: no columns could be concluded: {'; '.join(found.doubts)}")
    recording, config = found.applied(recording, config)
    assumed = f"; assumed: {'; '.join(found.doubts)}" if found.doubts else ""
    recording.remark(f"columns as `alidade info` proposes them{assumed}")
    return recording, config


class _Table:
    """Sensors, units and time that are recognised in one table."""

    def __init__(self, table: Table, is_named: bool) -> None:
        self.path, self._form = table.form.path, table.form
        self._file = table.name if is_named else None
        self._where = f"{table.name}: " if is_named else ""
        self.reasons: list[str] = []
        self.doubts: list[str] = []
        names = [f"column {i + 1}" for i in range(len(self._form.names))]
        rate = next((found for line in self._form.preamble if (found := _RATE.search(line))), None)
        self._rate = float(rate[rate.lastindex or 0]) if rate else 0.0  # Hz, by its preamble
        texts, *_ = table.read(names, _ROWS)
        self._texts = list(texts.values())
        self._values = [self._numbers(i) for i in range(len(names))]
        self._clocks: dict[int | None, dict[str, Any]] = {}

    def topics(self) -> dict[str, TableTopic]:
        """Return topic -> its columns."""
        times = self._times()
        triads = self._triads()
        named = {kind: columns for kind, columns in triads.items() if kind in _WORDS}
        out: dict[str, TableTopic] = {}

        def add(topic: str, of: Sequence[int], **given: Any) -> None:
            chosen = {key: value for key, value in given.items() if value}
            try:
                out[topic] = TableTopic(file=self._file, **self._time_of(of, times), **chosen)
            except ValueError as error:
                self.doubts.append(f"{self._where}{topic}: {error}")

        clocks = {kind: self._time_of(columns, times) for kind, columns in named.items()}
        units = {kind: self._unit(kind, columns) for kind, columns in named.items()}
        imu = {kind: columns for kind, columns in named.items() if kind != "field"}
        together = all(clocks[kind] == clocks[other] for kind, other in pairwise(imu))
        alone = {"gyro": "/imu/gyro", "accel": "/imu/accel"} if self._file or not together else {}
        for kinds in filter(None, [list(imu)] if together else [[kind] for kind in imu]):
            own = {kind: units[kind] for kind in kinds if units[kind] and UNITS[units[kind]] != 1.0}
            given = {kind: self._names(imu[kind]) for kind in kinds}
            add(alone.get("".join(kinds), "/imu"), imu[kinds[0]], **given, units=own)
        if "field" in named:
            unit, field = units["field"], named["field"]
            own = {"field": unit} if unit and UNITS[unit] != 1.0 else {}
            add("/mag", field, field=self._names(field), units=own)
        attitude = "/vision/attitude" if _VISION.search(self.path.stem.lower()) else "/attitude"
        if wxyz := self._quaternion():
            add(attitude, wxyz, wxyz=self._names(wxyz))
        for key, angles in self._angles().items() if not wxyz else ():
            unit = self._unit(key, angles)
            add(attitude, angles, **{key: self._names(angles)}, units={key: unit} if unit == "deg" else {})
        errors = self._first_of(_LOS_ERRORS)
        if len(errors) == len(_LOS_ERRORS):
            (x, z), unit = self._names(errors), self._common_unit(errors)
            self.doubts.append(f"{self._where}{x} and {z} are angles, in {unit or 'rad'}, about x and z")
            add("/los/error", errors, vector=[x, None, z], units={"vector": unit} if unit in ("deg", "mrad") else {})
        for topic, joints in _JOINTS.items():
            there = self._first_of([rf"^{joint}" for joint in joints])
            if len(there) == len(joints):
                named_so = dict(zip(joints, self._names(there), strict=True))
                add(topic, there, joints=named_so, units={"joints": "deg"} if self._common_unit(there) == "deg" else {})
        if len(place := self._first_of(_PLACE)) == len(_PLACE):
            latitude, longitude = self._names(place)
            height = next(iter(self._names(self._first_of([r"^(alt|height|elev)"]))), "")
            add("/fix", place, latitude_deg=latitude, longitude_deg=longitude, height=height)
        for topic, table in out.items():
            has = [kind for kind in (*_WORDS, *_OTHERS) if getattr(table, kind)]
            self.reasons.append(f"{self._where}{topic} has {' and '.join(has)}")
        if not out:
            self._described_time(next(iter(times), None))
            self.doubts.append(f"{self._where}nothing known in {', '.join(self._form.names[:20])}")
        return out

    def _numbers(self, i: int) -> Array:
        try:
            return numbers(self.path, {"c": self._texts[i]}, ["c"])[:, 0]
        except InputError:
            return np.full(len(self._texts[i]), np.nan)

    def _names(self, columns: Sequence[int]) -> list[str]:
        """Return the names of columns, numbers in place of names that occur twice."""
        names = self._form.names
        return [names[i] if names.count(names[i]) == 1 else f"column {i + 1}" for i in columns]

    def _first_of(self, words: Sequence[str]) -> list[int]:
        """Return the first column that each word is in the name of, without those that are in none."""
        names = [bare_name(name) for name in self._form.names]
        found = (next((i for i, name in enumerate(names) if re.search(word, name)), None) for word in words)
        return [i for i in found if i is not None]

    def _times(self) -> list[int]:
        """Return the columns that are times: increasing ones, by their names; without names the first column."""
        later = self._nanoseconds_of.values()
        increasing = [i for i in range(len(self._values)) if self._increases(i) and i not in later]
        called = {i for i in increasing if TIME_NAME.search(bare_name(self._form.names[i]))}
        times = sorted(called | self._nanoseconds_of.keys())
        times += [i for i in increasing if self._stated(i) in TIME_UNITS and i not in times]
        if not times and self._form.names[0] == "column 1" and increasing[:1] == [0]:
            return [0]
        if not times:
            still = [name for name in self._form.names if TIME_NAME.search(bare_name(name))]
            self.doubts += [f"{self._where}{name} is no time: it does not increase from row to row" for name in still]
        return times

    def _time_of(self, columns: Sequence[int], times: Sequence[int]) -> dict[str, Any]:
        """Return column and unit of a sensor's time, or its rate.

        The stamp of its message if there is one; else the last time before its columns, if that is another clock than
        the table's first time, as of devices side by side.
        """
        names = [bare_name(name) for name in self._form.names]
        stamps = {i: found[1] for i in times if (found := _STAMP.match(names[i]))}
        own = [i for i, prefix in stamps.items() if names[columns[0]].startswith(prefix)]
        if own or not times:
            return self._described_time(next(iter(own), None))
        last = max((i for i in times if i < min(columns)), default=times[0])
        if not self._is_another_clock(times[0], last):
            return self._described_time(times[0])
        return self._described_time(next(i for i in times if i == last or not self._is_another_clock(i, last)))

    def _is_another_clock(self, i: int, other: int) -> bool:
        """Whether two times differ by more than a constant, and have more than half of the longer one in common."""
        if i == other or np.isfinite(self._values[i] + self._values[other]).sum() < _FEWEST_TIMES:
            return False  # nor are dates compared
        a, b = self._seconds(i), self._seconds(other)
        if np.nanstd(b - a) < 0.5 * _median_step(a):
            return False
        (first, last), (begin, end) = ((np.nanmin(x), np.nanmax(x)) for x in (a, b))
        return bool(min(last, end) - max(first, begin) > 0.5 * max(last - first, end - begin))

    def _seconds(self, i: int) -> Array:
        """Times of a column, s."""
        if i in self._nanoseconds_of:
            return np.asarray(self._values[i] + 1e-9 * self._values[self._nanoseconds_of[i]])
        return np.asarray(self._values[i] * (1e-9 * TIME_UNITS[self._unit_of_time(i)[0]]))

    @cached_property
    def _nanoseconds_of(self) -> dict[int, int]:
        """Columns of whole seconds, as of a message's stamp, and the columns of the nanoseconds to be added."""
        names, found = [bare_name(name) for name in self._form.names], {}
        for i, name in enumerate(names):
            parts = {f"{name.removesuffix(end)}{ns}" for end in _SECONDS if name.endswith(end) for ns in _NANOSECONDS}
            near = sorted((abs(j - i), j) for j, other in enumerate(names) if other in parts)
            if not near:
                continue
            _, j = near[0]
            both = np.stack([self._values[i], self._values[j]])
            seconds, ns = both[:, np.isfinite(both).all(axis=0)]
            if (seconds == np.rint(seconds)).all() and ((ns >= 0.0) & (ns < 1e9)).all() and _rises(seconds + 1e-9 * ns):
                found[i] = j
        return found

    def _described_time(self, chosen: int | None) -> dict[str, Any]:
        """Return column and unit of a time, or the rate where there is none; its reason or doubt is given once."""
        if chosen not in self._clocks:
            self._clocks[chosen] = self._timed(chosen)
        return self._clocks[chosen]

    def _unit_of_time(self, i: int) -> tuple[str, str]:
        """Return the unit of a time, and by what: its header, or its steps."""
        stated = self._stated(i) or _unit_word(bare_name(self._form.names[i]))
        unit = stated if stated in TIME_UNITS else _time_unit(self._values[i])
        return unit, "header" if stated == unit else "steps"

    def _timed(self, chosen: int | None) -> dict[str, Any]:
        """Return column and unit of a time, or the rate where there is none, with its reason or doubt."""
        if chosen is None:
            if self._rate:
                self.reasons.append(f"{self._where}no column of time; {self._rate:g} Hz by its preamble")
            else:
                self.doubts.append(f"{self._where}no column of time: 100 Hz is assumed; correct `rate`")
            return {"rate": self._rate or 100.0}
        if chosen in self._nanoseconds_of:
            both = self._names([chosen, self._nanoseconds_of[chosen]])
            self.reasons.append(f"{self._where}{both[0]} and {both[1]} are the time, in s and ns")
            return {"time": both}
        name = self._names([chosen])[0]
        if ":" in str(self._texts[chosen][0]):
            self.reasons.append(f"{self._where}{name} is the time, as a date or clock time")
            return {"time": name}
        unit, by = self._unit_of_time(chosen)
        # Another unit than these, as the 0.1 ms of Xsens's SampleTimeFine: other numbers are of something else.
        steps = 1e-9 * TIME_UNITS[unit] * _median_step(self._values[chosen]) * self._rate
        power = float(np.log10(steps)) if steps > 0.0 and by == "steps" else 0.0
        if round(power) != 0 and abs(power - round(power)) < _ALIKE:
            self.doubts.append(f"{self._where}{name} is in no known unit by the preamble's {self._rate:g} Hz: not used")
            return self._timed(None)
        self.reasons.append(f"{self._where}{name} is the time, in {unit} by its {by}")
        return {"time": name} if unit == "s" else {"time": name, "unit": unit}

    def _stated(self, i: int) -> str:
        """Return the unit of column `i` by its header; empty where there is none."""
        return self._form.units[i] or unit_hinted(self._form.names[i])

    def _common_unit(self, columns: Sequence[int], kind: str = "") -> str:
        """Return the unit that all columns have by their header, as a kind of sensor's; empty where they differ."""
        stated = {unit_of(kind, self._stated(i)) for i in columns}
        return stated.pop() if len(stated) == 1 else ""

    def _increases(self, i: int) -> bool:
        return ":" in str(self._texts[i][0] if len(self._texts[i]) else "") or _rises(self._values[i])

    def _triads(self) -> dict[str, tuple[int, ...]]:
        """Return kind -> columns along x, y, z: by names, as a file's only three, or, without a header, by numbers."""
        out: dict[str, tuple[int, ...]] = {}
        along = _along_axes(self._form.names)
        first = 1 if self._increases(0) else 0
        if self._form.names[0] == "column 1" and len(self._values) == first + 3 and _kind(self.path.stem.lower()):
            along = [("", (first, first + 1, first + 2))]
            self.doubts.append(f"{self._where}no header: the sensor is that of the file's name")
        elif self._form.names[0] == "column 1":
            for i in range(first, len(self._values) - 2, 3):
                columns: tuple[int, ...] = (i, i + 1, i + 2)
                if not self._moves(columns):
                    continue
                sized = {kind for kind, units in _UNNAMED.items() if self._size(kind, columns) in units}
                for kind in sized - out.keys():
                    out[kind] = columns
                    where = f"{self._where}columns {i + 1} to {i + 3}"
                    self.doubts.append(f"{where} are {kind} by their size")
            return out
        for name, columns in along:
            name = name or self.path.stem.lower()  # x, y, z alone: the file is named after the sensor
            if "covariance" in name:
                continue
            kind = _kind(name) or self._kind_of_units(columns)
            norms, size = self._norms(columns), UNITS.get(self._common_unit(columns, kind))
            if len(norms) > 1 and not any(np.ptp(self._values[i]) for i in columns):
                continue  # a placeholder
            if (
                kind == "accel"
                and len(norms)
                and (lacks_gravity(norms * (size or 1.0), size is not None) or self._is_linear(name, columns))
            ):
                self.doubts.append(f"{self._where}{self._form.names[columns[0]]} is not used: {GRAVITY_REMOVED}")
            elif kind and kind not in out:
                out[kind] = columns
            elif kind:
                more = ", ".join(self._names(columns))
                self.doubts.append(f"{self._where}{more} are another {kind}, not used: name them instead if meant")
        return out

    def _is_linear(self, name: str, columns: Sequence[int]) -> bool:
        """Whether a name says that gravity has been taken off, and the size does not deny it.

        ROS calls linear acceleration, beside angular velocity, what has gravity in it.
        """
        if not _LINEAR.search(name) or self._size("accel", columns):
            return False
        ros = "linear_acceleration" in name and any("angular_velocity" in other for other in self._form.names)
        return not (
            ros and _SIZES["accel"]["m/s^2"][0] < float(np.median(self._norms(columns))) < PLAUSIBLE["accel"][1]
        )

    def _kind_of_units(self, columns: Sequence[int]) -> str:
        """Return the kind of sensor that measures in the unit of three columns; empty for none."""
        units = self._common_unit(columns)
        return next((kind for kind, si in _SI.items() if units in COMPATIBLE[si]), "")

    def _norms(self, columns: Sequence[int]) -> Array:
        norms = np.linalg.norm(np.stack([self._values[i] for i in columns]), axis=0)
        return norms[np.isfinite(norms)]

    def _moves(self, columns: Sequence[int]) -> bool:
        """Whether the vector in three columns turned: each component varies by a good part of the norm."""
        norms = self._norms(columns)
        spread = min(float(np.nanstd(self._values[i])) for i in columns) if len(norms) else 0.0
        return bool(spread > _TURNED * float(np.median(norms))) if len(norms) else False

    def _size(self, kind: str, columns: Sequence[int]) -> str:
        """Return the unit in which the columns' median norm is plausible for that kind of sensor; empty for none."""
        norms = self._norms(columns)
        norm = float(np.median(norms)) if len(norms) else 0.0
        return next((unit for unit, (low, high) in _SIZES[kind].items() if low < norm < high), "")

    def _unit(self, kind: str, columns: Sequence[int]) -> str:
        """Return the unit of three columns: by their header, else by their numbers; empty for counts."""
        unit = self._common_unit(columns, kind)
        if unit in UNITS:
            self.reasons.append(f"{self._where}{kind} is in {unit} by its header")
            return unit
        if kind != "gyro" and any("adc" in self._form.names[i].lower() for i in columns):
            self.reasons.append(f"{self._where}{kind} is in counts by its name")  # Betaflight's magADC
            return ""
        norms = self._norms(columns)
        most = float(norms.max()) if len(norms) else 0.0
        if kind in _TURNS:
            found = "rad" if most < 2.0 * np.pi else "deg"
        elif kind == "gyro":
            found = "rad/s" if most < MAX_RATE_RAD_S else "deg/s" if most < _MOST_DEG_S else ""
        else:
            found = self._size(kind, columns)
            low, high = PLAUSIBLE["accel"]
            if kind == "accel" and not found and len(norms) and low < float(np.median(norms)) < high:
                found = "m/s^2"  # of a fast motion
        self.doubts.append(f"{self._where}{kind} is in {found or 'counts'} by its size")
        return found

    def _quaternion(self) -> list[int]:
        """Return the columns w, x, y, z of a quaternion of unit norm, or those numbered so; empty without one."""
        names = [re.sub(r"\W", "", bare_name(name)) for name in self._form.names]
        for axes in ("wxyz", "0123", "1234"):
            last = re.compile(rf"({_QUATERNION})\w*{axes[0]}$")
            for stem in [name[:-1] for name in names if last.search(name) or (axes == "wxyz" and name in ("w", "rw"))]:
                if not all(f"{stem}{axis}" in names for axis in axes):
                    continue
                columns = [names.index(f"{stem}{axis}") for axis in axes]
                each = np.stack([self._values[i] for i in columns])
                each = each[:, np.isfinite(each).all(axis=0)]
                if not each.size or abs(float(np.median(np.linalg.norm(each, axis=0))) - 1.0) >= 0.01:
                    continue
                if each.shape[1] > 1 and not np.ptp(each, axis=1).any():
                    self.doubts.append(f"{self._where}{', '.join(self._names(columns))} are constant: not used")
                    continue
                if axes != "wxyz":
                    self.doubts.append(f"{self._where}{', '.join(self._names(columns))} are taken as w, x, y, z")
                return columns
        return []

    def _angles(self) -> dict[str, Sequence[int]]:
        """Return the columns of yaw, pitch and roll, or of a rotation vector in rad or deg, by their config key."""
        columns: Sequence[int] = self._first_of(_ANGLES)
        key, how = "yaw_pitch_roll", "turns about z, the new y and the new x"
        if len(columns) < len(_ANGLES):
            triads = [triad for name, triad in _along_axes(self._form.names) if _ROTATION_VECTOR.search(name)]
            columns = next((triad for triad in triads if self._common_unit(triad) in ("rad", "deg")), ())
            key, how = "rotation_vector", "axis times angle"
        if not columns:
            return {}
        self.doubts.append(f"{self._where}{', '.join(self._names(columns))} are {how}")
        return {key: columns}


def _rises(values: Array) -> bool:
    """Whether numbers increase as times do: a counter may run over, a logger start again, two sensors share a stamp."""
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > 2 and bool(np.mean(steps >= 0.0) > 0.99) and bool(np.mean(steps > 0.0) > 0.4)


def _kind(name: str) -> str:
    """Return the kind of sensor that a lower-case name mentions; empty for none."""
    return next((kind for kind, words in _WORDS.items() if re.search(words, name)), "")


def _unit_word(name: str) -> str:
    """Return the unit of time that is a word of a name (millis, seconds_elapsed); empty for none."""
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


def _along_axes(names: Sequence[str]) -> list[tuple[str, tuple[int, ...]]]:
    """Return lower-case names without their axis, and columns whose names differ only in x, y, z (0, 1, 2; p, q, r)."""
    there = {name: i for i, name in reversed(list(enumerate(names)))}
    found: list[tuple[str, tuple[int, ...]]] = []
    for name in names:
        for at, letter in enumerate(name):
            axes = {"x": "xyz", "X": "XYZ", "0": "012", "p": "pqr"}.get(letter)
            if axes is None:
                continue
            three = [f"{name[:at]}{axis}{name[at + 1 :]}" for axis in axes]
            fourth = f"{name[:at]}{'W' if letter == 'X' else 'w'}{name[at + 1 :]}"
            # Of a quaternion the last three are no vector.
            if all(one in there for one in three) and fourth not in there:
                stem = f"{name[:at]}{name[at + 1 :]}"
                found.append((bare_name(stem).strip(" _.-[]"), tuple(there[one] for one in three)))
                break
    return found


def _free(topic: str, path: Path, taken: Collection[str]) -> str:
    """Return the topic's name, extended by the table's name if another table has a topic of that name."""
    longer = topic if topic not in taken else f"{topic}/{re.sub(r'[^a-z0-9]+', '_', path.stem.lower())}"
    return longer if longer not in taken else next(n for i in count(2) if (n := f"{longer}_{i}") not in taken)
