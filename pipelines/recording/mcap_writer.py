"""Sessions into MCAP files, from arrays.

The mcap package's own writer takes messages one at a time. Here the CDR bytes of all messages of a topic are one array,
and whole chunks are put together from them; the records around the chunks are the package's.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

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

from alidade.pipelines import progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import SeriesEncoder, encode_series
from alidade.pipelines.recording.container import byte_windows
from alidade.pipelines.recording.mcap_records import AFTER_LENGTH, MAGIC, MESSAGE_HEAD
from alidade.pipelines.recording.messages import definition_text
from alidade.pipelines.settings import ATTACHMENT, TRUTH

# Bytes of a chunk before compression.
CHUNK_BYTES = 1 << 20
# Of zstd: noise does not compress better at higher ones.
_LEVEL = 1
_MEDIA = {".yaml": "application/yaml", ".json": "application/json"}


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
    not at all. Raises InputError when it cannot be written.
    """
    path = Path(path)
    if not path.name or (path.exists() and not path.is_file()):
        raise InputError(f"{path}: there is no file to be written, it is something else")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with part.open("wb") as stream:
                _File(stream).write(topics, attachments or {})
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


class _File:
    """An MCAP file being written: header, attachments, definitions, chunks with their message indexes, summary."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._encoders: list[SeriesEncoder] = []

    def write(self, topics: Mapping[str, series.Topic], attachments: Mapping[str, bytes]) -> None:
        self._encoders = encoders = [encode_series(topic) for topic in topics.values()]
        texts = {encoder.definition.name: definition_text(encoder.definition.name) for encoder in encoders}
        schemas = [Schema(i, text.encode(), "ros2msg", name) for i, (name, text) in enumerate(texts.items(), start=1)]
        ids = {schema.name: schema.id for schema in schemas}
        channels = [
            Channel(i, name, "cdr", {}, ids[encoder.definition.name])
            for i, (name, encoder) in enumerate(zip(topics, encoders, strict=True), start=1)
        ]
        start = min((int(encoder.log_ns[0]) for encoder in encoders if len(encoder.log_ns)), default=0)
        end = max((int(encoder.log_ns[-1]) for encoder in encoders if len(encoder.log_ns)), default=0)

        self._stream.write(MAGIC)
        self._put(Header("ros2", "alidade"))
        for name, data in attachments.items():
            self._attach(name, data, start)
        self._put(*schemas, *channels)
        self._write_chunks()
        self._put(DataEnd(0))
        counts = {i: len(encoder.log_ns) for i, encoder in enumerate(encoders, start=1)}
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

    def _write_chunks(self) -> None:
        """Cut the messages of all topics, in time order, into chunks of about the same size."""
        log_ns = np.concatenate([np.empty(0, np.int64), *(encoder.log_ns for encoder in self._encoders)])
        owner = np.repeat(np.arange(len(self._encoders)), [len(encoder.log_ns) for encoder in self._encoders])
        order = np.argsort(log_ns, kind="stable")
        log_ns, owner = log_ns[order], owner[order]
        widths = np.array([MESSAGE_HEAD.itemsize + encoder.size for encoder in self._encoders], dtype=np.int64)
        filled = np.cumsum(widths[owner])
        cuts = np.flatnonzero(np.diff(filled // CHUNK_BYTES)) + 1
        pieces = list(zip([0, *cuts], [*cuts, len(order)], strict=True))
        # Pictures are drawn as they are written.
        for start, end in progress.track(pieces, "writing", len(pieces)):
            if end > start:
                self._write_chunk(owner[start:end], log_ns[start:end])

    def _write_chunk(self, owner: NDArray[np.int64], log_ns: NDArray[np.int64]) -> None:
        """Write the next messages: their topics' numbers and log times, (n,) each."""
        heads = np.zeros(len(owner), MESSAGE_HEAD)
        size = np.empty(len(owner), dtype=np.int64)
        found = {}
        for i in np.unique(owner).tolist():
            encoder, rows = self._encoders[i], np.flatnonzero(owner == i)
            heads["sequence"][rows] = encoder.taken + np.arange(len(rows))
            messages = encoder.take(len(rows))
            size[rows] = [len(message) for message in messages] if encoder.varies else encoder.size
            found[i] = rows, messages
        heads["opcode"], heads["channel"], heads["length"] = Opcode.MESSAGE, owner + 1, AFTER_LENGTH + size
        heads["log_ns"] = heads["publish_ns"] = log_ns
        end = np.cumsum(size + heads.itemsize)
        at = end - size
        records = np.empty(end[-1], np.uint8)
        byte_windows(records, heads.itemsize)[at - heads.itemsize] = heads.view(f"V{heads.itemsize}")
        for rows, messages in found.values():
            if isinstance(messages, list):
                for start, message in zip(at[rows], messages, strict=True):
                    records[start : start + len(message)] = np.frombuffer(message, np.uint8)
            else:
                byte_windows(records, messages.shape[1])[at[rows]] = messages.view(f"V{messages.shape[1]}")[:, 0]
        start = at - heads.itemsize
        index = {i + 1: np.stack([log_ns[rows], start[rows]], axis=1) for i, (rows, _) in found.items()}
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


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
