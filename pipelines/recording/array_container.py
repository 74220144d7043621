"""Series as CDR messages: for the writer, and as a container for what logs, tables and data sets hold.

All messages of a topic that differ in numbers alone are encoded at once: rosbags encodes one, whose layout the arrays
are written into. What is read from a log or a table thus passes the same decoder and checks as a recording's messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array, Stamps
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.container import Channel, Container, MessageBlock, Schema, combined_sha256, file_sha256
from alidade.pipelines.recording.messages import Definition, definition_text, known

# Messages of a block; those of varying size may be pictures.
_UNIFORM_BLOCK, _VARYING_BLOCK = 1 << 14, 4
# Expected size of a message of varying size, bytes; only chunk sizes depend on it.
_PICTURE_BYTES, _DETECTIONS_BYTES = 1 << 16, 1 << 10
_SEC_NS = 1_000_000_000


class SeriesEncoder:
    """Encodes a series as CDR messages, in the order of its stamps.

    Attributes:
        log_ns: log times (N,), Unix ns: the stamps; a message stamped before its predecessor is logged with it.
        size: bytes of a message, expected ones where they vary.
        varies: whether they do.
    """

    def __init__(self, t_ns: NDArray[np.int64], size: int, encode: Callable[[slice], Any], varies: bool) -> None:
        self.log_ns, self.size, self.varies = np.maximum.accumulate(t_ns), size, varies
        self._encode, self._taken = encode, 0

    def take(self, count: int) -> Any:
        """Return the next `count` messages: rows of bytes (count, size), or a list of bytes if their sizes vary."""
        which = slice(self._taken, self._taken + count)
        self._taken = which.stop
        return self._encode(which)

    def block(self, channel: int, count: int) -> MessageBlock:
        """Encode the next `count` messages as one block of a channel."""
        log_ns, rows = self.log_ns[self._taken : self._taken + count], self.take(count)
        if self.varies:
            return MessageBlock.pack(channel, rows, log_ns)
        return MessageBlock(channel, rows.ravel(), self.size * np.arange(count), np.full(count, self.size), log_ns)


def _uniform(
    definition: Definition, t_ns: NDArray[np.int64], first: object, columns: Mapping[str, Array]
) -> SeriesEncoder:
    """Return the encoder of messages that differ in numbers alone, from the first one and columns (N, k) by field."""
    data = definition.encode(first)
    layout = definition.layout(data)
    assert layout is not None
    sec, nanosec = layout.run("header.stamp.sec"), layout.run("header.stamp.nanosec")
    runs = [(layout.run(path), values) for path, values in columns.items()]

    def encode(which: slice) -> NDArray[np.uint8]:
        rows = np.tile(np.frombuffer(data, np.uint8), (which.stop - which.start, 1))
        sec.of(rows)[:, 0], nanosec.of(rows)[:, 0] = np.divmod(t_ns[which], _SEC_NS)
        for run, values in runs:
            run.of(rows)[:] = values[which]
        return rows

    return SeriesEncoder(t_ns, len(data), encode, varies=False)


def _varying(t_ns: NDArray[np.int64], encoded: Iterator[bytes], size: int) -> SeriesEncoder:
    """Return the encoder of messages of any size, each of which rosbags has encoded by itself."""
    return SeriesEncoder(t_ns, size, lambda which: list(islice(encoded, which.stop - which.start)), varies=True)


def encode_series(topic: series.Topic) -> SeriesEncoder:
    """Return the encoder of a series as the CDR messages of a topic."""
    definition = known(topic.TYPE)
    header = _header(definition, 0, topic.frame_id)
    if isinstance(topic, series.Series):
        columns = {}
        for name, column in topic.COLUMNS.items():
            values = getattr(topic, name).reshape(len(topic), math.prod(column.shape))
            recorded_order = np.argsort(column.order) if column.order else slice(None)
            columns[column.path] = values[:, recorded_order]
        return _uniform(definition, topic.t_ns, definition.new(topic.TYPE, header=header), columns)
    if isinstance(topic, series.JointSeries):
        zeros = np.zeros(len(topic.names))
        first = definition.new(topic.TYPE, header=header, name=list(topic.names), position=zeros)
        return _uniform(definition, topic.t_ns, first, {"position": topic.position})
    if isinstance(topic, series.CameraInfo):
        t_ns = np.array([topic.t_ns], dtype=np.int64)
        return _varying(t_ns, iter([_camera_info(definition, topic)]), _PICTURE_BYTES)
    if isinstance(topic, series.ImageSeries):
        return _varying(topic.t_ns, _images(definition, topic), _PICTURE_BYTES)
    return _varying(topic.t_ns, _detections(definition, topic), _DETECTIONS_BYTES)


class ArrayContainer(Container):
    """Container of topics that are series in memory, encoded as CDR messages on reading.

    Args:
        topics: pictures are read from their iterable anew each time.
        files: whose digests make that of the recording; none: `path` alone.
        log_ns: log times, Unix ns, of the topics whose messages were not recorded at their stamps.
    """

    def __init__(
        self,
        path: Path,
        topics: Mapping[str, series.Topic],
        assumptions: Sequence[str] = (),
        data: Path | None = None,
        files: Sequence[Path] = (),
        log_ns: Mapping[str, Stamps] | None = None,
    ) -> None:
        super().__init__(path, data)
        self.assumptions, self._files, self._log_ns = tuple(assumptions), files, log_ns or {}
        self._topics = dict(enumerate(topics.values(), start=1))
        for number, (name, topic) in enumerate(topics.items(), start=1):
            self.schemas[number] = ros2_schema(topic.TYPE)._replace(id=number)
            self.channels[number] = Channel(number, name, "cdr", number)
            self.counts[number] = 1 if isinstance(topic, series.CameraInfo) else len(topic)

    def sha256(self) -> str:
        """Return the SHA-256 of the file, hexadecimal; of several files that of their own digests, in order."""
        return combined_sha256(map(file_sha256, self._files)) if self._files else super().sha256()

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Messages of these channels, one channel after the other."""
        for number in sorted(channels):
            encoder = encode_series(self._topics[number])
            encoder.log_ns = self._log_ns.get(self.channels[number].topic, encoder.log_ns)
            step = _VARYING_BLOCK if encoder.varies else _UNIFORM_BLOCK
            for start in range(0, self.counts[number], step):
                yield encoder.block(number, min(step, self.counts[number] - start))


def ros2_schema(name: str) -> Schema:
    """Return the schema of a ROS 2 message type, with the id 0. Raises MessageError for an unknown type."""
    return Schema(0, name, "ros2msg", definition_text(name).encode())


def _header(definition: Definition, t_ns: int, frame_id: str) -> Any:
    sec, nanosec = divmod(int(t_ns), _SEC_NS)
    stamp = definition.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return definition.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _camera_info(definition: Definition, info: series.CameraInfo) -> bytes:
    return definition.encode(
        definition.new(
            messages.CAMERA_INFO,
            header=_header(definition, info.t_ns, info.frame_id),
            width=info.width,
            height=info.height,
            distortion_model=info.distortion_model,
            d=info.d,
            k=info.k.ravel(),
            r=info.r.ravel(),
            p=info.p.ravel(),
        )
    )


def _images(definition: Definition, images: series.ImageSeries) -> Iterator[bytes]:
    for t_ns, data in zip(images.t_ns, images.data, strict=True):
        header = _header(definition, t_ns, images.frame_id)
        picture = np.frombuffer(data, np.uint8)
        yield definition.encode(
            definition.new(messages.COMPRESSED_IMAGE, header=header, format=images.format, data=picture)
        )


def _detections(definition: Definition, found: series.DetectionSeries) -> Iterator[bytes]:
    point = "apriltag_msgs/msg/Point"
    for i, t_ns in enumerate(found.t_ns):
        tags = []
        for k in np.flatnonzero(found.frame == i):
            corners = [definition.new(point, x=x, y=y) for x, y in found.corners[k].tolist()]
            tags.append(
                definition.new(
                    "apriltag_msgs/msg/AprilTagDetection",
                    family=str(found.family[k]),
                    id=int(found.tag_id[k]),
                    corners=corners,
                )
            )
        header = _header(definition, t_ns, found.frame_id)
        yield definition.encode(definition.new(messages.TAG_DETECTIONS, header=header, detections=tags))
