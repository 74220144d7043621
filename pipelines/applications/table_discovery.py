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
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.applications.table_times import Times
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import flow_yaml
from alidade.pipelines.recording.checks import MAX_RATE_RAD_S
from alidade.pipelines.recording.messages import IMU
from alidade.pipelines.recording.plausibility import GRAVITY_REMOVED, PLAUSIBLE, lacks_gravity
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.table_topics import Table, TableTopic, measures, tables_of
from alidade.pipelines.recording.table_values import UNITS, bare_name, unit_in, unit_of
from alidade.pipelines.recording.tables import message_tables, numbers
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.settings import Config

# What the names of three columns along x, y and z begin with or are, lower case; `gx` is a gyro's as often as not.
_WORDS = {
    "gyro": r"gyr|angular.?(vel|rate)|omega|rotation.?rate|^w(?=_|$)|^g(?=_|$)|ang.?vel|\brate",
    "accel": r"acc(?!ur|ept)|^a(?=_|$)|specific.?force|^f(?=_|$)|^g.?f(?=_|$|orce)",
    "field": r"mag|^m(?=_|$)|^b(?=_|$)|^h(?=_|$)|field",
}
_LINEAR = re.compile(r"lin|free|user|without.?g|gravity|acceleration.?no.?g")
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
# The axes of a device that is turned about vary by so much of what it feels (all directions alike: 0.58).
_TURNED = 0.1
# Rows looked at; different words of a column that names the sensor of each row, at most.
_ROWS, _MOST_SENSORS = 20_000, 30
_RAW = re.compile(r"raw|uncal|unfilt")
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
    found = [(one, one.topics()) for table in files.values() for one in _sensors(table, len(files) > 1)]
    for table in message_tables(recording.container).values():
        with suppress(InputError):  # what cannot be read is no proposal
            if table.is_proposed:
                one = _whole(table, True)
                if topics := one.topics():
                    found.append((one, topics))
    columns: dict[str, TableTopic] = {}
    for one, topics in found:
        for topic, described in topics.items():
            same = columns.get(topic)
            if same is not None and same.file == described.file and described.where:
                one.doubts.append(
                    f"{', '.join(map(str, described.where.values()))} is not used: {topic} is of another sensor"
                )
                continue
            columns[_free(topic, one.path, {*columns, *recording.topics})] = described
    if not found:
        return None
    gyros = [name for name, table in columns.items() if table.gyro and not table.accel]
    accels = [name for name, table in columns.items() if table.accel and not table.gyro]
    sources = {"imu": TopicSource(gyro=gyros[0], accel=accels[0])} if len(gyros) == len(accels) == 1 else {}
    recorded = any(each.type == IMU for each in recording.topics.values())
    if len(gyros) + len(accels) == 1 and "/imu" not in columns and not recorded:
        sources = {"imu": TopicSource(topic=(gyros or accels)[0])}
    reasons = tuple(reason for one, _ in found for reason in one.reasons)
    return Columns(columns, sources, reasons, tuple(doubt for one, _ in found for doubt in one.doubts))


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


def _sensors(table: Table, is_named: bool) -> list[_Table]:
    """Return a table as one, or, where a column names the sensor that each row is of, one for each sensor."""
    whole, names = _whole(table, is_named), _numbered(table)
    for i in whole.columns_of_words():
        there = list(dict.fromkeys(table.read([names[i]])[0][names[i]].tolist()))
        if sensors := _named_sensors(there, table.form.names[i], table.form.path):
            texts = list(table.read(names)[0].values())
            rows = [np.flatnonzero(texts[i] == sensor)[:_ROWS] for sensor in sensors]
            return [
                _Table(table, is_named, [each[own] for each in texts], (i, sensor))
                for sensor, own in zip(sensors, rows, strict=True)
            ]
    return [whole]


def _whole(table: Table, is_named: bool) -> _Table:
    """Read the first rows of a table, as those of one device."""
    return _Table(table, is_named, list(table.read(_numbered(table), _ROWS)[0].values()))


def _numbered(table: Table) -> list[str]:
    """Return names of a table's columns by their number, which all have, whatever the header says."""
    return [f"column {i + 1}" for i in range(len(table.form.names))]


def _named_sensors(words: Sequence[str], header: str, path: Path) -> list[str]:
    """Return those of a column's words that name sensors; none where the column says something else.

    Of two kinds at least, or of one that the file is not named against. Raw and uncalibrated readings come last.
    """
    kinds = {word: _kind(word.lower()) for word in words}
    named = [word for word in words if kinds[word]]
    found = {kinds[word] for word in named}
    alone = len(found) == 1 and (len(named) > 1 or "sensor" in header.lower())
    if len(words) > _MOST_SENSORS or not (len(found) > 1 or (alone and _kind(path.stem.lower()) in ("", *found))):
        return []
    return sorted(named, key=lambda word: _RAW.search(word.lower()) is not None)


class _Table:
    """Sensors, units and time that are recognised in one table, or in its rows that have a word in a column.

    Args:
        is_named: whether there are other tables.
        texts: (n,) of each column, its first rows or those of the word.
        rows: that column and the word, which names their sensor.
    """

    def __init__(
        self, table: Table, is_named: bool, texts: Sequence[NDArray[np.str_]], rows: tuple[int, str] | None = None
    ) -> None:
        self.path, self._form = table.form.path, table.form
        self._file = table.name if is_named else None
        self._sensor = "" if rows is None else rows[1]
        self._rows: dict[str, str | float | int] = {} if rows is None else {self._form.called(rows[:1])[0]: rows[1]}
        self._where = "".join(f"{each}: " for each in (table.name if is_named else "", self._sensor) if each)
        self.reasons: list[str] = []
        self.doubts: list[str] = []
        self._texts = texts
        self._values = [self._numbers(i) for i in range(len(texts))]
        self._times = Times(self._form, self._texts, self._values, self._where, self.reasons, self.doubts)

    def columns_of_words(self) -> list[int]:
        """Return the columns that hold a few words and no numbers; none where headers name the sensors."""
        if any(_kind(name) for name, _ in _along_axes(self._form.names)):
            return []
        return [
            i
            for i, values in enumerate(self._values)
            if len(values) and np.isnan(values).all() and len(np.unique(self._texts[i])) <= _MOST_SENSORS
        ]

    def topics(self) -> dict[str, TableTopic]:
        """Return topic -> its columns."""
        triads = self._triads()
        named = {kind: columns for kind, columns in triads.items() if kind in _WORDS}
        out: dict[str, TableTopic] = {}

        def add(topic: str, of: Sequence[int], **given: Any) -> None:
            chosen = {key: value for key, value in given.items() if value}
            try:
                out[topic] = TableTopic(file=self._file, where=self._rows, **self._times.of(of), **chosen)
            except ValueError as error:
                self.doubts.append(f"{self._where}{topic}: {error}")

        clocks = {kind: self._times.of(columns) for kind, columns in named.items()}
        units = {kind: self._unit(kind, columns) for kind, columns in named.items()}
        imu = {kind: columns for kind, columns in named.items() if kind != "field"}
        together = all(clocks[kind] == clocks[other] for kind, other in pairwise(imu))
        alone = {"gyro": "/imu/gyro", "accel": "/imu/accel"} if self._file or self._rows or not together else {}
        groups = [list(imu)] if together else [[kind] for kind in imu]
        for kinds in filter(None, [*groups, [kind for kind in named if kind == "field"]]):
            own = {kind: units[kind] for kind in kinds if units[kind] and UNITS[units[kind]] != 1.0}
            given = {kind: self._form.called(named[kind]) for kind in kinds}
            topic = "/mag" if "field" in kinds else alone.get("".join(kinds), "/imu")
            add(topic, named[kinds[0]], **given, units=own)
        attitude = "/vision/attitude" if _VISION.search(self.path.stem.lower()) else "/attitude"
        if wxyz := self._quaternion():
            add(attitude, wxyz, wxyz=self._form.called(wxyz))
        for key, angles in self._angles().items() if not wxyz else ():
            unit = self._unit(key, angles)
            add(attitude, angles, **{key: self._form.called(angles)}, units={key: unit} if unit == "deg" else {})
        if errors := self._each_of(_LOS_ERRORS):
            (x, z), unit = self._form.called(errors), self._common_unit(errors)
            self.doubts.append(f"{self._where}{x} and {z} are angles, in {unit or 'rad'}, about x and z")
            add("/los/error", errors, vector=[x, None, z], units={"vector": unit} if unit in ("deg", "mrad") else {})
        for topic, joints in _JOINTS.items():
            if there := self._each_of([rf"^{joint}" for joint in joints]):
                named_so = dict(zip(joints, self._form.called(there), strict=True))
                add(topic, there, joints=named_so, units={"joints": "deg"} if self._common_unit(there) == "deg" else {})
        if place := self._each_of(_PLACE):
            latitude, longitude = self._form.called(place)
            height = next(iter(self._form.called(self._each_of([r"^(alt|height|elev)"]))), "")
            add("/fix", place, latitude_deg=latitude, longitude_deg=longitude, height=height)
        for topic, table in out.items():
            has = [kind for kind in (*_WORDS, *_OTHERS) if getattr(table, kind)]
            self.reasons.append(f"{self._where}{topic} has {' and '.join(has)}")
        if not out:
            self._times.of([0])
            self.doubts.append(f"{self._where}nothing known in {', '.join(self._form.names[:20])}")
        return out

    def _numbers(self, i: int) -> Array:
        try:
            return numbers(self.path, {"c": self._texts[i]}, ["c"])[:, 0]
        except InputError:
            return np.full(len(self._texts[i]), np.nan)

    def _each_of(self, words: Sequence[str]) -> list[int]:
        """Return, for each regular expression, the first column whose name it matches; empty if one matches no name."""
        names = [bare_name(name) for name in self._form.names]
        found = (next((i for i, name in enumerate(names) if re.search(word, name)), None) for word in words)
        columns = [i for i in found if i is not None]
        return columns if len(columns) == len(words) else []

    def _common_unit(self, columns: Sequence[int], kind: str = "") -> str:
        """Return the unit that all columns have by their header, as a kind of sensor's; empty where they differ."""
        stated = {unit_of(kind, self._form.stated_unit(i) or unit_in(self._sensor)) for i in columns}
        return stated.pop() if len(stated) == 1 else ""

    def _triads(self) -> dict[str, tuple[int, ...]]:
        """Return kind -> columns along x, y, z: by names, as a file's only three, or, without a header, by numbers."""
        out: dict[str, tuple[int, ...]] = {}
        # Columns without numbers in the rows of one sensor are another's.
        own = [not self._sensor or bool(np.isfinite(values).any()) for values in self._values]
        along = _along_axes([name if is_own else "" for name, is_own in zip(self._form.names, own, strict=True)])
        first = 1 if self._times.increases(0) else 0
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
            # Rows are named after their sensor; of x, y, z alone the file is.
            name = f"{self._sensor} {name}".strip().lower() or self.path.stem.lower()
            if "covariance" in name:
                continue
            units = self._common_unit(columns)
            kind = _kind(name) or next((kind for kind in _WORDS if measures(kind, units)), "")
            norms, size = self._norms(columns), UNITS.get(self._common_unit(columns, kind))
            if self._sensor and not len(norms):
                continue
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
                more = ", ".join(self._form.called(columns))
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
                    self.doubts.append(f"{self._where}{', '.join(self._form.called(columns))} are constant: not used")
                    continue
                if axes != "wxyz":
                    self.doubts.append(f"{self._where}{', '.join(self._form.called(columns))} are taken as w, x, y, z")
                return columns
        return []

    def _angles(self) -> dict[str, Sequence[int]]:
        """Return the columns of yaw, pitch and roll, or of a rotation vector in rad or deg, by their config key."""
        columns: Sequence[int] = self._each_of(_ANGLES)
        key, how = "yaw_pitch_roll", "turns about z, the new y and the new x"
        if not columns:
            triads = [triad for name, triad in _along_axes(self._form.names) if _ROTATION_VECTOR.search(name)]
            columns = next((triad for triad in triads if self._common_unit(triad) in ("rad", "deg")), ())
            key, how = "rotation_vector", "axis times angle"
        if not columns:
            return {}
        self.doubts.append(f"{self._where}{', '.join(self._form.called(columns))} are {how}")
        return {key: columns}


def _kind(name: str) -> str:
    """Return the kind of sensor that a lower-case name mentions; empty for none."""
    if _ROTATION_VECTOR.search(name):  # geomagnetic ones too
        return ""
    return next((kind for kind, words in _WORDS.items() if re.search(words, name)), "")


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
