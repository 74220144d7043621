"""Sessions into MCAP files, from arrays.

The mcap package's own writer takes messages one at a time. Here the CDR bytes of all messages of a topic are one array,
and whole chunks are put together from them; the records around the chunks are the package's.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from pipelines import progress
from pipelines.config import ATTACHMENT, TRUTH
from pipelines.recording import messages, series
from pipelines.recording.mcap_records import MAGIC, MESSAGE_HEAD, windows
from pipelines.recording.messages import Array, Definition, known

_CHUNK = 1 << 20
_LEVEL = 1  # noise does not compress better at higher ones
_MEDIA = {".yaml": "application/yaml", ".json": "application/json"}

_PICTURE = 1 << 16  # expected size of a message of no fixed size; only chunk sizes depend on it
_SEC_NS = 1_000_000_000


def attached(truth: Mapping[str, float] | None, config_yaml: str | None) -> dict[str, bytes]:
    """A session's attachments: its config and the true values of its parameters, as far as there are any."""
    attachments = {}
    if config_yaml is not None:
        attachments[ATTACHMENT] = config_yaml.encode()
    if truth is not None:
        attachments[TRUTH] = json.dumps(dict(truth), indent=1).encode()
    return attachments


def write_session(
    path: Path | str, topics: Mapping[str, series.Topic], attachments: Mapping[str, bytes] | None = None
) -> None:
    """Write topics, name -> series, and attachments, name -> content, as a ROS 2 recording.

    Messages are logged at their stamps and written in that order. The file appears under its name when it is whole, or
    not at all.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            _File(stream).write(topics, attachments or {})
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


class _File:
    """An MCAP file being written: header, attachments, definitions, chunks with their message indexes, summary."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []

    def write(self, topics: Mapping[str, series.Topic], attachments: Mapping[str, bytes]) -> None:
        sources = [_source(i, topic) for i, topic in enumerate(topics.values(), start=1)]
        texts = {source.definition.name: messages.definition_text(source.definition.name) for source in sources}
        schemas = [Schema(i, text.encode(), "ros2msg", name) for i, (name, text) in enumerate(texts.items(), start=1)]
        ids = {schema.name: schema.id for schema in schemas}
        channels = [
            Channel(source.channel, name, "cdr", {}, ids[source.definition.name])
            for name, source in zip(topics, sources, strict=True)
        ]
        start = min((int(source.log_ns[0]) for source in sources if len(source.log_ns)), default=0)
        end = max((int(source.log_ns[-1]) for source in sources if len(source.log_ns)), default=0)

        self._stream.write(MAGIC)
        self._put(Header("ros2", "alidade"))
        for name, data in attachments.items():
            self._attach(name, data, start)
        self._put(*schemas, *channels)
        self._write_chunks(sources)
        self._put(DataEnd(0))
        counts = {source.channel: len(source.log_ns) for source in sources}
        statistics = Statistics(
            attachment_count=len(attachments),
            channel_count=len(channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=sum(counts.values()),
            message_end_time=end,
            message_start_time=start,
            metadata_count=0,
            schema_count=len(schemas),
        )
        self._finish(*schemas, *channels, statistics, *self._chunks, *self._attachments)

    def _put(self, *records: McapRecord) -> int:
        """Write records; returns their size."""
        return self._stream.write(_bytes(*records))

    def _attach(self, name: str, data: bytes, time_ns: int) -> None:
        media = _MEDIA.get(Path(name).suffix, "application/octet-stream")
        offset = self._stream.tell()
        length = self._put(Attachment(time_ns, time_ns, name, media, data))
        self._attachments.append(AttachmentIndex(offset, length, time_ns, time_ns, len(data), name, media))

    def _write_chunks(self, sources: list[_Source]) -> None:
        """Cut the messages of all topics, in time order, into chunks of about the same size."""
        log_ns = np.concatenate([np.empty(0, np.int64), *(source.log_ns for source in sources)])
        owner = np.repeat(np.arange(len(sources)), [len(source.log_ns) for source in sources])
        order = np.argsort(log_ns, kind="stable")
        log_ns, owner = log_ns[order], owner[order]
        widths = np.array([MESSAGE_HEAD.itemsize + source.size for source in sources], dtype=np.int64)
        filled = np.cumsum(widths[owner])
        cuts = np.flatnonzero(np.diff(filled // _CHUNK)) + 1
        pieces = list(zip([0, *cuts], [*cuts, len(order)], strict=True))
        # Pictures are drawn as they are written.
        for start, end in progress.track(pieces, "writing", len(pieces)):
            if end > start:
                self._write_chunk(sources, owner[start:end], log_ns[start:end])

    def _write_chunk(self, sources: list[_Source], owner: NDArray[np.int64], log_ns: NDArray[np.int64]) -> None:
        counts = np.bincount(owner, minlength=len(sources))
        size = np.empty(len(owner), dtype=np.int64)
        parts = {}
        for i in np.flatnonzero(counts):
            mine = np.flatnonzero(owner == i)
            parts[i] = mine, sources[i].take(int(counts[i]))
            size[mine] = [len(message) for message in parts[i][1]] if sources[i].varies else parts[i][1].shape[1]
        end = np.cumsum(size)
        offset = end - size
        records = np.empty(end[-1], np.uint8)
        for mine, rows in parts.values():
            if isinstance(rows, list):
                for at, message in zip(offset[mine], rows, strict=True):
                    records[at : at + len(message)] = np.frombuffer(message, np.uint8)
            else:
                windows(records, rows.shape[1])[offset[mine]] = rows.view(f"V{rows.shape[1]}")[:, 0]
        index = {sources[i].channel: np.stack([log_ns[mine], offset[mine]], axis=1) for i, (mine, _) in parts.items()}
        self._put_chunk(records.tobytes(), int(log_ns[0]), int(log_ns[-1]), index)

    def _put_chunk(self, records: bytes, start_ns: int, end_ns: int, index: dict[int, NDArray[np.int64]]) -> None:
        packed = zstandard.compress(records, _LEVEL)
        at = self._stream.tell()
        length = self._put(Chunk("zstd", packed, end_ns, start_ns, zlib.crc32(records), len(records)))
        offsets = {}
        for channel, entries in index.items():
            offsets[channel] = self._stream.tell()
            body = struct.pack("<HI", channel, entries.nbytes) + entries.astype("<u8").tobytes()
            self._stream.write(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(body)) + body)
        after = self._stream.tell() - at - length
        self._chunks.append(ChunkIndex(length, at, "zstd", len(packed), end_ns, after, offsets, start_ns, len(records)))

    def _finish(self, *summary: McapRecord) -> None:
        start = self._stream.tell()
        records = _bytes(*summary)
        # The checksum takes in the footer up to itself.
        crc = zlib.crc32(records + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0))
        self._stream.write(records)
        self._put(Footer(start, 0, crc))
        self._stream.write(MAGIC)


class _Source(ABC):
    """A topic on its way into the file: message records, head and CDR bytes, taken in order."""

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


class _AlikeSource(_Source):
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


class _VariedSource(_Source):
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


def _source(channel: int, topic: series.Topic) -> _Source:
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


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
