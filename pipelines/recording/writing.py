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
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.mcap_records import MAGIC, MESSAGE_HEAD, windows
from alidade.pipelines.recording.message_source import Source, message_source
from alidade.pipelines.settings import ATTACHMENT, TRUTH

_CHUNK = 1 << 20
_LEVEL = 1  # noise does not compress better at higher ones
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

    def write(self, topics: Mapping[str, series.Topic], attachments: Mapping[str, bytes]) -> None:
        sources = [message_source(i, topic) for i, topic in enumerate(topics.values(), start=1)]
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

    def _write_chunks(self, sources: list[Source]) -> None:
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

    def _write_chunk(self, sources: list[Source], owner: NDArray[np.int64], log_ns: NDArray[np.int64]) -> None:
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


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
