"""MCAP files, from series and from blocks of messages.

The mcap package's own writer takes messages one at a time. Here those of a block are one array, and whole chunks are
put together from blocks; the records around the chunks are the package's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Chunk, ChunkIndex, DataEnd, Footer, Header, McapRecord, Statistics
from numpy.typing import NDArray

from alidade.pipelines import progress
from alidade.pipelines.files import replacing
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import encode_series, ros2_schema
from alidade.pipelines.recording.container import MessageBlock, Schema, byte_windows
from alidade.pipelines.recording.mcap_records import AFTER_LENGTH, MAGIC, MESSAGE_HEAD

# Bytes of a chunk before compression.
CHUNK_BYTES = 1 << 20
# Of zstd: noise does not compress better at higher ones.
_LEVEL = 1
_MEDIA = {".yaml": "application/yaml", ".json": "application/json"}


def write_session(
    path: Path | str, topics: Mapping[str, series.Topic], attachments: Mapping[str, bytes] | None = None
) -> None:
    """Write topics, name -> series, and attachments, name -> content, as a ROS 2 recording.

    Messages are logged at their stamps and written in that order. The file appears under its name when it is whole, or
    not at all. Raises InputError when it cannot be written.
    """
    encoders = {name: encode_series(topic) for name, topic in topics.items()}
    log_ns = np.concatenate([np.empty(0, np.int64), *(encoder.log_ns for encoder in encoders.values())])
    owner = np.repeat(np.arange(len(encoders)), [len(encoder.log_ns) for encoder in encoders.values()])
    order = np.argsort(log_ns, kind="stable")
    owner = owner[order]
    widths = np.array([MESSAGE_HEAD.itemsize + encoder.size for encoder in encoders.values()], dtype=np.int64)
    cuts = np.flatnonzero(np.diff(np.cumsum(widths[owner]) // CHUNK_BYTES)) + 1
    pieces = list(zip([0, *cuts], [*cuts, len(order)], strict=True))
    with replacing(Path(path)) as stream:
        out = McapOutput(stream, attachments or {}, int(log_ns[order[0]]) if len(log_ns) else 0)
        numbers = [out.channel(name, "cdr", ros2_schema(topic.TYPE)) for name, topic in topics.items()]
        # Pictures are drawn as they are written.
        for start, end in progress.track(pieces, "writing", len(pieces)):
            counts = np.bincount(owner[start:end], minlength=len(encoders)).tolist()
            for number, encoder, count in zip(numbers, encoders.values(), counts, strict=True):
                if count:
                    out.put(encoder.block(number, count))
            out.flush()
        out.finish()


class McapOutput:
    """Writer of an MCAP file: header, attachments, definitions, chunks with their message indexes, summary.

    Attachments, name -> content, have the time `time_ns`, Unix ns.
    """

    def __init__(self, stream: BinaryIO, attachments: Mapping[str, bytes], time_ns: int = 0) -> None:
        self._stream = stream
        self._schemas: dict[Schema, records.Schema] = {}
        self._channels: dict[tuple[str, str, int], records.Channel] = {}
        self._counts: dict[int, int] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._waiting: list[MessageBlock] = []
        stream.write(MAGIC)
        self._put(Header("ros2", "alidade"))
        for name, data in attachments.items():
            self._attach(name, data, max(time_ns, 0))

    def channel(self, topic: str, encoding: str, schema: Schema | None) -> int:
        """Return the channel id of a topic with this encoding and schema; write both definitions on their first use."""
        number = 0
        if schema is not None:
            schema = schema._replace(id=0)
            if schema not in self._schemas:
                self._schemas[schema] = records.Schema(
                    len(self._schemas) + 1, schema.data, schema.encoding, schema.name
                )
                self._put(self._schemas[schema])
            number = self._schemas[schema].id
        key = topic, encoding, number
        if key not in self._channels:
            self._channels[key] = records.Channel(len(self._channels) + 1, topic, encoding, {}, number)
            self._counts[self._channels[key].id] = 0
            self._put(self._channels[key])
        return self._channels[key].id

    def put(self, block: MessageBlock) -> None:
        """Add messages of a channel to the pending chunk, which is written once it is full."""
        if len(block.start):
            self._waiting.append(block)
        if sum(int(each.size.sum()) for each in self._waiting) >= CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the pending messages as a chunk, in the order of their log times."""
        if not self._waiting:
            return
        blocks, self._waiting = self._waiting, []
        log_ns = np.maximum(np.concatenate([block.log_ns for block in blocks]), 0)
        size = np.concatenate([block.size for block in blocks])
        heads = np.zeros(len(log_ns), MESSAGE_HEAD)
        heads["opcode"], heads["length"] = Opcode.MESSAGE, AFTER_LENGTH + size
        heads["log_ns"] = heads["publish_ns"] = log_ns
        heads["channel"] = np.repeat([block.channel for block in blocks], [len(block.start) for block in blocks])
        for channel in np.unique(heads["channel"]).tolist():
            rows = np.flatnonzero(heads["channel"] == channel)
            heads["sequence"][rows] = self._counts[channel] + np.arange(len(rows))
            self._counts[channel] += len(rows)
        order = np.argsort(log_ns, kind="stable")
        end = np.empty_like(size)
        end[order] = np.cumsum(size[order] + heads.itemsize)
        at = end - size
        out = np.empty(end.max(), np.uint8)
        byte_windows(out, heads.itemsize)[at - heads.itemsize] = heads.view(f"V{heads.itemsize}")
        first = 0
        for block in blocks:
            _copy(block, out, at[first : first + len(block.start)])
            first += len(block.start)
        entries = np.stack([log_ns, at - heads.itemsize], axis=1)[order]
        owner = heads["channel"][order]
        index = {channel: entries[owner == channel] for channel in np.unique(owner).tolist()}
        self._put_chunk(out.tobytes(), int(log_ns.min()), int(log_ns.max()), index)

    def finish(self) -> None:
        """Write the pending messages and the summary."""
        self.flush()
        self._put(DataEnd(0))
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        start = self._stream.tell()
        summary = _bytes(
            *self._schemas.values(), *self._channels.values(), statistics, *self._chunks, *self._attachments
        )
        # The checksum takes in the footer up to itself.
        crc = zlib.crc32(summary + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0))
        self._stream.write(summary)
        self._put(Footer(start, 0, crc))
        self._stream.write(MAGIC)

    def _put(self, *records: McapRecord) -> int:
        """Write records; returns their size."""
        return self._stream.write(_bytes(*records))

    def _attach(self, name: str, data: bytes, time_ns: int) -> None:
        media = _MEDIA.get(Path(name).suffix, "application/octet-stream")
        offset = self._stream.tell()
        length = self._put(Attachment(time_ns, time_ns, name, media, data))
        self._attachments.append(AttachmentIndex(offset, length, time_ns, time_ns, len(data), name, media))

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


def _copy(block: MessageBlock, out: NDArray[np.uint8], at: NDArray[np.int64]) -> None:
    """Copy a block's messages to the offsets `at` of a buffer, all messages of one size at once."""
    for size in np.unique(block.size).tolist():
        rows = np.flatnonzero(block.size == size)
        byte_windows(out, size)[at[rows]] = byte_windows(block.buffer, size)[block.start[rows]]


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
