"""What the columns of a table are, as the config says it under `columns:`, by the topic they make.

columns:
  /imu: {file: imu.csv, time: t, unit: s, gyro: [wx, wy, wz], accel: [ax, ay, az], units: {gyro: deg/s}}
  /vision/attitude: {file: vision.csv, time: t_ns, unit: ns, wxyz: [qw, qx, qy, qz]}
  /gimbal/joint_states: {time: t, joints: {azimuth: az, elevation: el}, units: {joints: deg}}
  /camera/image: {file: stamps.csv, time: t_ns, unit: ns, video: camera.mp4}
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.recording import series
from alidade.pipelines.recording.arrays import ArrayContainer
from alidade.pipelines.recording.container import Container, sha256_of, sha256_together
from alidade.pipelines.recording.parts import Parts
from alidade.pipelines.recording.tables import CsvFile, nanoseconds, numbers, read_columns
from alidade.pipelines.recording.video import VideoFile

_Three = Annotated[tuple[str, str, str], Field(strict=False)]
_Four = Annotated[tuple[str, str, str, str], Field(strict=False)]

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
_KINDS: dict[str, type[series.Series]] = {
    "gyro": series.ImuSeries,
    "wxyz": series.PoseSeries,
    "field": series.MagneticSeries,
    "vector": series.VectorSeries,
    "latitude_deg": series.FixSeries,
    "celsius": series.TemperatureSeries,
}


class TableTopic(BaseModel):
    """A topic made of columns of a CSV file: where its time and its numbers are.

    Attributes:
        file: name of the file; needed where there are several tables.
        time: column of the stamps.
        unit: what they count.
        gyro, accel: columns of an IMU's rates and accelerations.
        wxyz, position: columns of a pose.
        field: columns of a magnetometer.
        vector: columns of a LOS error.
        latitude_deg, longitude_deg, height: columns of a fix.
        celsius: column of a temperature.
        joints: name of a joint and its column.
        video: name of a video beside the table, whose rows are the stamps of its pictures.
        units: of one of these, where it is not SI.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    file: str | None = None
    time: str
    unit: Literal["s", "ms", "us", "ns"] = "s"
    gyro: _Three | None = None
    accel: _Three | None = None
    wxyz: _Four | None = None
    position: _Three | None = None
    field: _Three | None = None
    vector: _Three | None = None
    latitude_deg: str | None = None
    longitude_deg: str | None = None
    height: str | None = None
    celsius: str | None = None
    joints: dict[str, str] | None = None
    video: str | None = None
    units: dict[str, str] = {}

    @model_validator(mode="after")
    def _complete(self) -> TableTopic:
        kinds = [name for name in (*_KINDS, "joints", "video") if getattr(self, name) is not None]
        if len(kinds) != 1:
            found = " and ".join(kinds) or "none"
            raise ValueError(f"exactly one of {', '.join(_KINDS)}, joints, video is needed, not {found}")
        for name, unit in self.units.items():
            if name not in TableTopic.model_fields or unit not in UNITS:
                raise ValueError(f"units.{name}: {unit} is not one of {', '.join(UNITS)}")
        return self

    def read(self, path: Path, data: Path) -> series.Topic:
        """The topic. Rows without a number in any of its columns are left out. Raises InputError."""
        if self.video is not None:
            t_ns = nanoseconds(path, read_columns(path, data, [self.time])[self.time], self.unit)
            pictures = VideoFile(path.with_name(Path(self.video).name), len(t_ns))
            return series.ImageSeries(t_ns, pictures, "netpbm")
        given = {name: self._columns(name) for name in (*_NUMBERS, "joints") if getattr(self, name) is not None}
        columns = read_columns(path, data, list(dict.fromkeys([self.time, *(c for cs in given.values() for c in cs)])))
        values = {name: self._scale(name) * numbers(path, columns, names) for name, names in given.items()}
        filled = np.any([np.isfinite(one).any(axis=1) for one in values.values()], axis=0) & (columns[self.time] != "")
        t_ns = nanoseconds(path, columns[self.time][filled], self.unit)
        values = {name: one[filled] for name, one in values.items()}
        if self.joints is not None:
            return series.JointSeries(t_ns, values["joints"], tuple(self.joints))
        kind = next(kind for name, kind in _KINDS.items() if name in values)
        if kind is series.ImuSeries and "accel" not in values:
            values["accel"] = np.full((len(t_ns), 3), np.nan)
        shaped: dict[str, Any] = {
            name: one.reshape(len(t_ns), *kind.COLUMNS[name].shape)
            for name, one in values.items()
            if name in kind.COLUMNS
        }
        return kind(t_ns, **shaped)

    def _columns(self, name: str) -> list[str]:
        value = getattr(self, name)
        return [value] if isinstance(value, str) else list(value.values() if isinstance(value, dict) else value)

    def _scale(self, name: str) -> float:
        return UNITS[self.units[name]] if name in self.units else 1.0


_NUMBERS = (
    *("gyro", "accel", "wxyz", "position", "field", "vector", "latitude_deg", "longitude_deg", "height", "celsius"),
)


def described(container: Container, columns: Mapping[str, TableTopic]) -> Container:
    """A container with its tables read as the config describes them. Raises InputError at a table that is not there."""
    tables = _tables(container)
    of: dict[str, dict[str, series.Topic]] = {name: {} for name in tables}
    for topic, table in columns.items():
        if (table.file is None and len(tables) != 1) or (table.file is not None and table.file not in tables):
            there = ", ".join(tables) or "none"
            wanted = (
                f"no table {table.file}{nearest(table.file, list(tables))}" if table.file else "which table is meant?"
            )
            raise InputError(f"{container.path}: columns.{topic}.file: {wanted}; tables there: {there}")
        name = table.file or next(iter(tables))
        of[name][topic] = table.read(tables[name].path, tables[name].data)
    return _with_topics(container, of)


def _tables(container: Container) -> dict[str, CsvFile]:
    """The CSV files in a container, by name."""
    if isinstance(container, CsvFile):
        return {container.path.name: container}
    parts = container.parts if isinstance(container, Parts) else ()
    return {name: table for part in parts for name, table in _tables(part).items()}


def _with_topics(container: Container, of: Mapping[str, Mapping[str, series.Topic]]) -> Container:
    if isinstance(container, CsvFile) and of.get(container.path.name):
        return _Described(container, of[container.path.name])
    if isinstance(container, Parts):
        used = {video.path.resolve() for topics in of.values() for video in _videos(topics)}
        there = [part for part in container.parts if part.path.resolve() not in used]
        whole = Parts(container.path, [_with_topics(part, of) for part in there])
        whole.unpacked = container.unpacked
        return whole
    return container


class _Described(ArrayContainer):
    """A table whose columns are known, with the videos that it has the stamps of."""

    def __init__(self, table: CsvFile, topics: Mapping[str, series.Topic]) -> None:
        super().__init__(table.path, topics)
        self.data, self._video_paths = table.data, [video.path for video in _videos(topics)]

    def sha256(self) -> str:
        """SHA-256 of the table; with videos, of its digest and theirs, in order."""
        digest = super().sha256()
        return sha256_together([digest, *map(sha256_of, self._video_paths)]) if self._video_paths else digest


def _videos(topics: Mapping[str, series.Topic]) -> list[VideoFile]:
    pictures = [topic.data for topic in topics.values() if isinstance(topic, series.ImageSeries)]
    return [video for video in pictures if isinstance(video, VideoFile)]
