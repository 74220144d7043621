"""Columns of a table by the config's `columns:`, and the topics that they make.

columns:
  /imu: {file: imu.csv, time: t, unit: s, gyro: [wx, wy, wz], accel: [ax, ay, az], units: {gyro: deg/s}}
  /vision/attitude: {file: vision.csv, time: t_ns, unit: ns, wxyz: [qw, qx, qy, qz]}
  /gimbal/joint_states: {time: t, joints: {azimuth: az, elevation: el}, units: {joints: deg}}
  /camera/image: {file: stamps.csv, time: t_ns, unit: ns, video: camera.mp4}
  /imu: {rate: 100, accel: [ax, ay, az], axes: [y, -x, z], where: {sensor: 2}}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from alidade.factors import so3
from alidade.factors.array import Array, Stamps
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer
from alidade.pipelines.recording.checks import SLOWEST_GYRO_S, SLOWEST_S
from alidade.pipelines.recording.container import Container, MultiPartContainer
from alidade.pipelines.recording.images import VideoFile
from alidade.pipelines.recording.table_values import (
    COMPATIBLE,
    TIME_UNITS,
    UNITS,
    check_steps,
    nanoseconds,
    of_rate,
    unit_of,
)
from alidade.pipelines.recording.tables import (
    CsvFile,
    MessageTable,
    TableHead,
    message_tables,
    numbers,
    numbers_or_times,
)
from alidade.pipelines.recording.topics import Axes, along

# Rows of named columns: a text file, or the messages of a topic.
Table = CsvFile | MessageTable
_Three = Annotated[tuple[str, str, str], Field(strict=False)]
_ThreeOrNone = Annotated[tuple[str | None, str | None, str | None], Field(strict=False)]
_Four = Annotated[tuple[str, str, str, str], Field(strict=False)]

_KINDS: dict[str, type[series.Series]] = {
    "gyro": series.ImuSeries,
    "accel": series.ImuSeries,
    "wxyz": series.PoseSeries,
    "yaw_pitch_roll": series.PoseSeries,
    "rotation_vector": series.PoseSeries,
    "field": series.MagneticSeries,
    "vector": series.VectorSeries,
    "latitude_deg": series.FixSeries,
    "celsius": series.TemperatureSeries,
}
# Quantities that are columns of numbers.
_NUMBERS = (*_KINDS, "position", "longitude_deg", "height")
# Quantities that have units, and their SI units.
_QUANTITIES = {"gyro": "rad/s", "accel": "m/s^2", "field": "T", "joints": "rad", "position": "m", "vector": "rad"}
_QUANTITIES |= {"yaw_pitch_roll": "rad", "rotation_vector": "rad"}
# Quantities along the axes of a device.
_VECTORS = ("gyro", "accel", "field")
# What may be as slow as it likes.
_SLOW = ("latitude_deg", "celsius", "video")


class TableTopic(BaseModel):
    """A topic made of columns of a table: where its time and its numbers are.

    Attributes:
        file: name of the file, needed where there are several tables; or of the topic whose messages are the rows.
        time: column of the stamps, numbers or dates as ISO 8601 has them; or two, of whole seconds and of nanoseconds.
        unit: what the numbers of one column count; without it what the header says, else s.
        rate: Hz, of rows without a time.
        gyro, accel: columns of an IMU's rates and accelerations, or of one of them.
        wxyz, position: columns of a pose.
        yaw_pitch_roll: columns of its attitude as turns about z, the new y and the new x; in place of wxyz.
        rotation_vector: columns of the same as axis times angle.
        field: columns of a magnetometer.
        vector: columns of a LOS error; null for one that is not measured.
        latitude_deg, longitude_deg, height: columns of a fix.
        celsius: column of a temperature.
        joints: name of a joint and its column.
        video: name of a video beside the table, whose rows are the stamps of its pictures.
        units: of one of these; without it what the header says, else SI.
        axes: of gyro, accel and field: what is x, y and z, in the axes of the columns; `[y, -x, z]`.
        where: column and the value it has in the rows that are meant.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    file: str | None = None
    time: str | tuple[str, ...] | None = None
    unit: Literal["s", "ms", "us", "ns"] | None = None
    rate: Annotated[float, Field(gt=0.0, le=1e6, strict=False)] | None = None
    gyro: _Three | None = None
    accel: _Three | None = None
    wxyz: _Four | None = None
    yaw_pitch_roll: _Three | None = None
    rotation_vector: _Three | None = None
    position: _Three | None = None
    field: _Three | None = None
    vector: _ThreeOrNone | None = None
    latitude_deg: str | None = None
    longitude_deg: str | None = None
    height: str | None = None
    celsius: str | None = None
    joints: dict[str, str] | None = None
    video: str | None = None
    units: dict[str, str] = {}
    axes: Axes | None = None
    where: dict[str, str | float | int] = {}

    @field_validator("time", mode="before")
    @classmethod
    def _one_or_two(cls, value: object) -> object:
        if value is None or isinstance(value, str):
            return value
        names = value if isinstance(value, (list, tuple)) else ()
        if len(names) != 2 or names[0] == names[1] or not all(isinstance(name, str) for name in names):
            raise ValueError("must be a column, or two: of whole seconds and of nanoseconds")
        return tuple(names)

    @model_validator(mode="after")
    def _complete(self) -> TableTopic:
        kinds = [name for name in (*_KINDS, "joints", "video") if getattr(self, name) is not None]
        if len(kinds) != 1 and kinds != ["gyro", "accel"]:
            found = " and ".join(kinds) or "none"
            raise ValueError(f"exactly one of {', '.join(_KINDS)}, joints, video is needed, not {found}")
        if (self.time is None) == (self.rate is None):
            raise ValueError("either time, the column of the stamps, or rate, in Hz, is needed")
        if self.unit is not None and not isinstance(self.time, str):
            raise ValueError("unit goes with one column of time: two are in s and ns")
        for name, unit in self.units.items():
            if name not in _QUANTITIES:
                raise ValueError(f"units.{name}: only {', '.join(_QUANTITIES)} have units")
            if not measures(name, unit):
                known = ", ".join(COMPATIBLE[_QUANTITIES[name]])
                raise ValueError(f"units.{name}: {unit} is not one of {known}; counts have no entry in units")
        for name in {*kinds} & {*_VECTORS}:
            if len(set(getattr(self, name))) < len(getattr(self, name)):
                raise ValueError(f"{name}: a column is named twice, {', '.join(getattr(self, name))}")
        if self.axes and not {*kinds} <= {*_VECTORS}:
            raise ValueError("axes go with gyro, accel or field")
        return self

    @property
    def names(self) -> list[str]:
        """Names of the table's columns that the topic needs."""
        return [*self._stamps, *self.where, *(name for found in self._given.values() for name in found)]

    def to_series(
        self,
        topic: str,
        form: TableHead,
        columns: Mapping[str, NDArray[np.str_]],
        logged: Stamps | None = None,
    ) -> tuple[series.Topic, Stamps | None, list[str]]:
        """Return a topic's series in SI units from the rows of a table, its log times (Unix ns) or None, and notes.

        Rows without a number in any of its columns are left out. Raises InputError.

        Args:
            columns: texts of the table's columns, `names` at least.
            logged: of a table of messages the log times, Unix ns.
        """
        path, given, notes = form.path, self._given, list[str]()
        columns = {name: columns[name] for name in self.names}
        rows = self._rows(path, columns)
        columns = {name: column[rows] for name, column in columns.items()}
        values = {name: numbers(path, columns, found) for name, found in given.items()}
        filled = np.any(
            [np.isfinite(one).any(axis=1) for one in values.values()] or [np.ones(rows.sum(), bool)], axis=0
        )
        if self.time is None:
            t_ns, unit = of_rate(len(filled), self.rate or 1.0)[filled], "s"
        else:
            for name in self._stamps:
                filled &= numbers_or_times(columns[name])
            unit = self._time_unit(form, notes)
            t_ns = self._times(path, [columns[name][filled] for name in self._stamps], unit)
        values = {name: one[filled] for name, one in values.items()}
        log_ns = None if logged is None else logged[rows][filled]
        if log_ns is None:
            t_ns, values = _without_erased(path, t_ns, values, notes)
        is_slow = any(getattr(self, name) is not None for name in _SLOW)
        if not is_slow and isinstance(self.time, str):
            check_steps(path, topic, t_ns, unit, SLOWEST_GYRO_S if self.gyro else SLOWEST_S)
        scales = {name: self._scale(name, form, notes) for name in values}
        values = {
            name: (along(self.axes, one) if name in _VECTORS else one) * scales[name] for name, one in values.items()
        }
        if self.vector is not None:
            measured = np.full((len(t_ns), 3), np.nan)
            measured[:, [column is not None for column in self.vector]] = values["vector"]
            values["vector"] = measured
        if self.yaw_pitch_roll is not None:
            values["wxyz"] = of_yaw_pitch_roll(values["yaw_pitch_roll"])
        if self.rotation_vector is not None:
            values["wxyz"] = so3.exp(values["rotation_vector"])
        if self.video is not None:
            pictures = VideoFile(path.with_name(Path(self.video).name), len(t_ns))
            return series.ImageSeries(t_ns, pictures, "netpbm"), log_ns, notes
        if self.joints is not None:
            return series.JointSeries(t_ns, values["joints"], tuple(self.joints)), log_ns, notes
        kind = next(kind for name, kind in _KINDS.items() if name in values)
        shaped: dict[str, Any] = {
            name: one.reshape(len(t_ns), *kind.COLUMNS[name].shape)
            for name, one in values.items()
            if name in kind.COLUMNS
        }
        if kind is series.ImuSeries:
            for name in {"gyro", "accel"} - values.keys():  # with covariance -1, ROS's convention
                shaped |= {name: np.full(3, 0.0 if name == "gyro" else np.nan), f"{name}_cov": series.ABSENT}
        return kind(t_ns, **shaped), log_ns, notes

    @property
    def _stamps(self) -> list[str]:
        """Names of the columns that hold the rows' stamps; empty for rows at a constant rate."""
        return [self.time] if isinstance(self.time, str) else [*(self.time or ())]

    @property
    def _given(self) -> dict[str, list[str]]:
        """Quantity -> names of its columns."""
        return {name: self._columns(name) for name in (*_NUMBERS, "joints") if getattr(self, name) is not None}

    def _rows(self, path: Path, columns: Mapping[str, NDArray[np.str_]]) -> NDArray[np.bool_]:
        """Mask of the rows that have the values of `where`. Raises InputError where no row has them."""
        rows = np.ones(len(next(iter(columns.values()))), dtype=bool)
        for name, value in self.where.items():
            rows &= np.array([_is_value(text, value) for text in columns[name].tolist()], dtype=bool)
            if not rows.any():
                there = ", ".join(dict.fromkeys(columns[name].tolist()[:1000]))
                raise InputError(f"{path}: where: no row has {name} {value}; its values: {there[:200]}")
        return rows

    def _columns(self, name: str) -> list[str]:
        value = getattr(self, name)
        each = [value] if isinstance(value, str) else value.values() if isinstance(value, dict) else value
        return [column for column in each if column is not None]

    def _times(self, path: Path, texts: Sequence[NDArray[np.str_]], unit: str) -> Stamps:
        """Return stamps (n,), ns, from the texts of the columns of time. Raises InputError at one that is none."""
        t_ns = nanoseconds(path, texts[0], unit)
        for more in texts[1:]:
            ns = nanoseconds(path, more, "ns")
            if (t_ns % 1_000_000_000).any() or ((ns < 0) | (ns >= 1_000_000_000)).any():
                raise InputError(f"{path}: {' and '.join(self._stamps)} are no whole seconds and nanoseconds of these")
            t_ns = t_ns + ns
        return t_ns

    def _time_unit(self, form: TableHead, notes: list[str]) -> str:
        """Unit of time by the config, else by the header, else s."""
        stated = form.units[form.index(self.time)] if isinstance(self.time, str) else ""
        if self.unit is not None or stated not in TIME_UNITS:
            return self.unit or "s"
        if stated != "s":
            notes.append(f"{form.path.name}: {self.time} is in {stated} by its header")
        return stated

    def _scale(self, name: str, form: TableHead, notes: list[str]) -> float:
        """Return the factor to SI of a quantity's unit: by the config, else by the header of its columns, else 1."""
        if name in self.units:
            return UNITS[self.units[name]]
        stated = {unit_of(name, form.units[form.index(column)]) for column in self._columns(name)}
        (unit,) = stated if len(stated) == 1 else ("",)
        if unit not in UNITS or not measures(name, unit) or UNITS[unit] == 1.0:
            return 1.0
        notes.append(f"{form.path.name}: {name} is in {unit} by its header")
        return UNITS[unit]


def of_yaw_pitch_roll(angles: Array) -> Array:
    """Quaternions (n, 4) of turns (n, 3) about z, the new y and the new x, rad."""
    return so3.compose(*(so3.exp(angles[:, [i]] * axis) for i, axis in enumerate(np.eye(3)[::-1])))


def measures(name: str, unit: str) -> bool:
    """Whether a unit is one that the quantity `name` can have."""
    return name in _QUANTITIES and unit in COMPATIBLE[_QUANTITIES[name]]


def _is_value(text: str, value: str | float | int) -> bool:
    """Whether a cell has a value, compared as text or as a number."""
    if text == str(value):
        return True
    try:
        return float(text) == float(value)
    except ValueError:
        return False


def _without_erased(
    path: Path, t_ns: NDArray[np.int64], values: dict[str, NDArray[np.float64]], notes: list[str]
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
    """Remove last rows that all repeat one time and its numbers, as erased flash memory reads."""
    if len(t_ns) < 3 or t_ns[-1] != t_ns[-2]:
        return t_ns, values
    alike = t_ns == t_ns[-1]
    for one in values.values():
        alike &= ((one == one[-1]) | (np.isnan(one) & np.isnan(one[-1]))).all(axis=1)
    kept = len(t_ns) - int(np.argmin(alike[::-1])) if not alike.all() else 0
    notes.append(f"{path.name}: the last {len(t_ns) - kept} rows are all the same, as erased memory: left out")
    return t_ns[:kept], {name: one[:kept] for name, one in values.items()}


def described(container: Container, columns: Mapping[str, TableTopic]) -> Container:
    """Return a container with its tables, and its messages, read as the config describes.

    Raises InputError for a missing table, or a topic that is recorded under the same name.
    """
    files = tables_of(container)
    tables: Mapping[str, Table] = {**message_tables(container), **files}
    recorded = {channel.topic for channel in container.channels.values()}
    by_table: dict[str, dict[str, TableTopic]] = {}
    for topic, table in columns.items():
        if (table.file is None and len(files) != 1) or (table.file is not None and table.file not in tables):
            there = ", ".join(tables) or "none"
            wanted = (
                f"no table {table.file}{nearest(table.file, list(tables))}" if table.file else "which table is meant?"
            )
            raise InputError(f"{container.path}: columns.{topic}.file: {wanted}; tables there: {there}")
        if topic in recorded:
            raise InputError(
                f"{container.path}: columns.{topic}: a topic of that name was recorded; choose another, and name it "
                "under `topics:`"
            )
        by_table.setdefault(table.file or next(iter(files)), {})[topic] = table
    of: dict[str, dict[str, series.Topic]] = {}
    logged: dict[str, Stamps] = {}
    notes: list[str] = []
    for name, topics in by_table.items():
        form = tables[name].form
        needed = [column for table in topics.values() for column in table.names]
        texts, left_out, recorded_ns = tables[name].read(list(dict.fromkeys(needed)))
        notes += left_out
        of[name] = {}
        for topic, table in topics.items():
            of[name][topic], log_ns, concluded = table.to_series(topic, form, texts, recorded_ns)
            logged |= {} if log_ns is None else {topic: log_ns}
            notes += concluded
    whole = _with_topics(container, of)
    if logged:
        of_messages = {topic: made for topics in of.values() for topic, made in topics.items() if topic in logged}
        whole = WithTables(whole, ArrayContainer(container.path, of_messages, log_ns=logged))
    whole.assumptions = tuple(dict.fromkeys([*whole.assumptions, *notes]))
    return whole


class WithTables(MultiPartContainer):
    """Recording that has, beside its own topics, those that the config describes as tables of its messages."""

    def __init__(self, recorded: Container, made: Container) -> None:
        parts = recorded.parts if isinstance(recorded, MultiPartContainer) else [recorded]
        super().__init__(recorded.path, [*parts, made])
        self._recorded = recorded
        self.assumptions, self.incomplete = recorded.assumptions, recorded.incomplete

    def sha256(self) -> str:
        """SHA-256 of the recording, hexadecimal."""
        return self._recorded.sha256()


def tables_of(container: Container) -> dict[str, CsvFile]:
    """The CSV files in a container, by name."""
    if isinstance(container, CsvFile):
        return {container.name: container}
    parts = container.parts if isinstance(container, MultiPartContainer) else ()
    return {name: table for part in parts for name, table in tables_of(part).items()}


def _with_topics(container: Container, of: Mapping[str, Mapping[str, series.Topic]]) -> Container:
    if isinstance(container, CsvFile) and of.get(container.path.name):
        topics = of[container.path.name]
        videos = [video.path for video in _videos(topics)]
        files = [container.path, *videos] if videos else ()
        made = ArrayContainer(container.path, topics, data=container.data, files=files)
        made.temporary, made.incomplete = container.temporary, container.incomplete
        return made
    if isinstance(container, MultiPartContainer):
        used = {video.path.resolve() for topics in of.values() for video in _videos(topics)}
        there = [part for part in container.parts if part.path.resolve() not in used]
        whole = MultiPartContainer(container.path, [_with_topics(part, of) for part in there])
        whole.temporary, whole.incomplete = container.temporary, container.incomplete
        return whole
    return container


def _videos(topics: Mapping[str, series.Topic]) -> list[VideoFile]:
    pictures = [topic.data for topic in topics.values() if isinstance(topic, series.ImageSeries)]
    return [video for video in pictures if isinstance(video, VideoFile)]
