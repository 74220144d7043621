"""Series as messages: the CDR bytes of all messages of a topic at once where they differ in numbers alone."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.mcap_records import MESSAGE_HEAD
from alidade.pipelines.recording.messages import Array, Definition, known

_PICTURE = 1 << 16  # expected size of a message of no fixed size; only chunk sizes depend on it
_SEC_NS = 1_000_000_000


class Source(ABC):
    """A topic as message records of MCAP, head and CDR bytes, taken in order."""

    varies: bool

    def __init__(self, channel: int, definition: Definition, t_ns: NDArray[np.int64], size: int) -> None:
        self.channel, self.definition, self.size = channel, definition, size
        self.t_ns = t_ns
        # A message stamped before its predecessor is still logged after it.
        self.log_ns = np.maximum.accumulate(t_ns)
        self._done = 0

    def take(self, count: int) -> Any:
        """The next records: rows of bytes (count, width), or a list of bytes if their sizes vary."""
        which = slice(self._done, self._done + count)
        self._done = which.stop
        return self._records(which)

    @abstractmethod
    def _records(self, which: slice) -> Any: ...

    def _head(self, which: slice, size: int) -> NDArray[np.void]:
        head = np.zeros(which.stop - which.start, MESSAGE_HEAD)
        head["opcode"], head["channel"] = Opcode.MESSAGE, self.channel
        head["length"] = MESSAGE_HEAD.itemsize - 9 + size
        head["sequence"] = np.arange(which.start, which.stop)
        head["log_ns"] = head["publish_ns"] = self.log_ns[which]
        return head


class _AlikeSource(Source):
    """Messages that differ in nothing but numbers: one is encoded by rosbags, its layout takes the arrays."""

    varies = False

    def __init__(
        self, channel: int, definition: Definition, t_ns: NDArray[np.int64], first: object, columns: dict[str, Array]
    ) -> None:
        data = definition.encode(first)
        layout = definition.layout(data)
        assert layout is not None
        super().__init__(channel, definition, t_ns, len(data))
        self._first = np.frombuffer(data, np.uint8)
        self._columns = [(layout.run(path), values) for path, values in columns.items()]
        self._sec, self._nanosec = layout.run("header.stamp.sec"), layout.run("header.stamp.nanosec")

    def _records(self, which: slice) -> NDArray[np.uint8]:
        head = MESSAGE_HEAD.itemsize
        rows = np.empty((which.stop - which.start, head + self.size), np.uint8)
        rows[:, :head] = self._head(which, self.size).view(np.uint8).reshape(-1, head)
        rows[:, head:] = self._first
        self._sec.of(rows, head)[:, 0], self._nanosec.of(rows, head)[:, 0] = np.divmod(self.t_ns[which], _SEC_NS)
        for run, values in self._columns:
            run.of(rows, head)[:] = values[which]
        return rows


class _VariedSource(Source):
    """Messages of any size, encoded one by one by rosbags."""

    varies = True

    def __init__(
        self, channel: int, definition: Definition, t_ns: NDArray[np.int64], encoded: Iterator[bytes], size: int
    ) -> None:
        super().__init__(channel, definition, t_ns, size)
        self._encoded = encoded

    def _records(self, which: slice) -> list[bytes]:
        records = []
        for i in range(which.start, which.stop):
            data = next(self._encoded)
            records.append(self._head(slice(i, i + 1), len(data)).tobytes() + data)
        return records


def message_source(channel: int, topic: series.Topic) -> Source:
    """The messages of a topic, under the id of a channel."""
    if isinstance(topic, series.Series):
        definition = known(topic.TYPE)
        columns = {}
        for name, column in topic.COLUMNS.items():
            values = getattr(topic, name).reshape(len(topic), math.prod(column.shape))
            back = np.argsort(column.order) if column.order else slice(None)
            columns[column.path] = values[:, back]
        first = definition.new(topic.TYPE, header=_header(definition, 0, topic.frame_id))
        return _AlikeSource(channel, definition, topic.t_ns, first, columns)
    if isinstance(topic, series.JointSeries):
        definition = known(messages.JOINT_STATE)
        header = _header(definition, 0, topic.frame_id)
        zeros = np.zeros(len(topic.names))
        first = definition.new(messages.JOINT_STATE, header=header, name=list(topic.names), position=zeros)
        return _AlikeSource(channel, definition, topic.t_ns, first, {"position": topic.position})
    if isinstance(topic, series.CameraInfo):
        definition = known(messages.CAMERA_INFO)
        t_ns = np.array([topic.t_ns], dtype=np.int64)
        return _VariedSource(channel, definition, t_ns, iter([_camera_info(definition, topic)]), _PICTURE)
    if isinstance(topic, series.ImageSeries):
        definition = known(messages.COMPRESSED_IMAGE)
        return _VariedSource(channel, definition, topic.t_ns, _images(definition, topic), _PICTURE)
    definition = known(messages.TAG_DETECTIONS)
    return _VariedSource(channel, definition, topic.t_ns, _detections(definition, topic), 1024)


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
                    hamming=int(found.hamming[k]),
                    decision_margin=float(found.decision_margin[k]),
                    corners=corners,
                )
            )
        header = _header(definition, t_ns, found.frame_id)
        yield definition.encode(definition.new(messages.TAG_DETECTIONS, header=header, detections=tags))
