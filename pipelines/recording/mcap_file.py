"""MCAP files, closed, cut, damaged or growing: one walk from record head to record head, then blocks on demand.

The walk needs neither a summary nor a chunk index. Where bytes are damaged it continues at the next record, at worst
the next chunk, and notes a `DataLoss`; only positions stay in memory. The summary behind the data is used if its
checksum holds: it repeats the definitions and states the number of messages.

The message index after a chunk states which channels the chunk holds and where. It is outside every checksum, so it is
used only where it names every record of the chunk; otherwise the chunk is searched.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import mcap.records
import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError, NotARecordingError
from alidade.pipelines.files import open_binary
from alidade.pipelines.recording import mcap_records as records
from alidade.pipelines.recording.container import (
    Channel,
    Container,
    DataLoss,
    LossKind,
    MessageBlock,
    Schema,
    byte_windows,
    total,
)
from alidade.pipelines.recording.mcap_records import AFTER_LENGTH, HEAD, MAGIC, MESSAGE_HEAD, DamagedError

_FOOTER = struct.Struct("<BQQQI")
# Messages outside chunks form blocks of about this size, bytes.
_RAW_BLOCK = 1 << 20
# Bounds of what a recording of sensors holds: a definition is text that a person wrote.
MAX_DEFINITION_BYTES, MAX_ALL_DEFINITION_BYTES, MAX_CHANNELS = 1 << 20, 1 << 26, 10_000
MAX_SUMMARY_BYTES, MAX_ATTACHMENT_BYTES = 1 << 28, 1 << 26
# All chunks together may decompress to so many times the file, beyond so many bytes.
MAX_FILE_RATIO, _SMALL_FILE = 100, 1 << 28
_OPCODES_OF_DATA = {
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
}
_PRIVATE_OPCODES = 0x80  # from here on, free for everybody's use


@dataclass
class Block:
    """A chunk, or a run of message records outside chunks: bytes [start, end) of the file.

    Attributes:
        log_span_ns: log times of the first and the last message as the chunk or its messages state them, Unix ns.
        counts: channel -> messages.
        index_offsets: channel -> byte at which its message index entries start.
        is_damaged: whether it is left out.
    """

    start: int
    end: int
    is_chunk: bool
    log_span_ns: tuple[int, int] | None = None
    counts: dict[int, int] = field(default_factory=dict)
    index_offsets: dict[int, int] = field(default_factory=dict)
    is_damaged: bool = False


def _attachment_name(stream: ReadDataStream) -> str:
    stream.read(16)  # times
    return stream.read_prefixed_string()


class McapFile(Container):
    """An MCAP file, walked once; it is opened again for every read.

    A chunk that is damaged within is found when it is first decompressed; until then it counts as readable.

    Raises InputError when there is no such file, when it is no MCAP, and when it is hostile: more definitions than any
    recording has, or a decompression bomb.
    """

    def __init__(self, path: Path, data: Path | None = None) -> None:
        super().__init__(path, data)
        self._blocks: list[Block] = []
        self._attachment_offsets: dict[str, int] = {}
        self._stated: dict[int, int] | None = None  # channel -> messages, by a summary whose checksum holds
        self._definition_bytes = self._decompressed_bytes = 0
        self._chunk: Block | None = None  # whose message indexes come next
        self._data_end: tuple[int, int] | None = None  # byte and checksum
        self._walked = len(MAGIC)  # up to this byte
        with open_binary(self.data, self.path) as stream:
            start = stream.read(len(MAGIC))
            if not start:
                raise InputError(f"{self.path}: the file is empty: nothing was recorded")
            if start != MAGIC:
                raise NotARecordingError.of(self.path)
            self._read_index(stream)

    def _read_index(self, stream: BinaryIO) -> None:
        """Index the file's records; read the chunks whose content no index lists."""
        self.size = stream.seek(0, 2)
        end = self._read_summary(stream)
        self._walk(stream, self.size if end is None else end)
        self._check_end(stream, is_closed=end is not None)
        self._verify_unindexed(stream, self._blocks)
        if self.losses or total(block.counts for block in self._blocks) != self._stated:
            for block in self._blocks:
                if not block.is_damaged:
                    self._verify(stream, block)
        self.set_counts(total(block.counts for block in self._blocks))

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost, by the summary, or without one by the indexes of the damaged chunks."""
        if self._stated is not None:
            self.lost_messages = {number: n - self.counts.get(number, 0) for number, n in self._stated.items()}
        return super().missing

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Messages of these channels in file order, checksums verified; damaged chunks are left out and noted."""
        with open_binary(self.data, self.path) as stream:
            for block in self._blocks:
                yield from self._messages(stream, block, channels & block.counts.keys())

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachment_offsets)

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """Content of the attachment of that name (the last one, if there are several), or None.

        A damaged one raises InputError if it is needed; otherwise it is noted as a loss.
        """
        at = self._attachment_offsets.get(name)
        if at is None:
            return None
        with open_binary(self.data, self.path) as stream:
            stream.seek(at)
            opcode, length = HEAD.unpack(stream.read(HEAD.size).ljust(HEAD.size, b"\0"))
            record = stream.read(min(length, MAX_ATTACHMENT_BYTES))
        try:
            if opcode != Opcode.ATTACHMENT or len(record) != length:
                raise DamagedError("it is no attachment, or too large to be one of alidade's")
            if int.from_bytes(record[-4:], "little") not in (0, zlib.crc32(record[:-4])):
                raise DamagedError("checksum")
            return records.parse(mcap.records.Attachment.read, record).data
        except DamagedError as damaged:
            if needed:
                raise InputError(
                    f"{self.path}: the attachment {name} is damaged ({damaged}); a config can be given with --config"
                ) from damaged
            loss = DataLoss("attachment", at, length, reason=name)
            if loss not in self.losses:
                self.losses.append(loss)
            return None

    # -- the messages of a block

    def _load(self, stream: BinaryIO, block: Block) -> NDArray[np.uint8]:
        """Return the bytes of a block's records; a chunk is decompressed and verified. Raises DamagedError."""
        stream.seek(block.start + HEAD.size if block.is_chunk else block.start)
        data = stream.read(block.end - stream.tell())
        return records.decompress_chunk(data) if block.is_chunk else np.frombuffer(data, np.uint8)

    def _locate(
        self, stream: BinaryIO, block: Block, buffer: NDArray[np.uint8]
    ) -> tuple[dict[int, NDArray[np.int64]], list[tuple[int, bytes]]]:
        """Return channel -> offsets of its messages in the buffer, and the other records."""
        index = {}
        for number, at in block.index_offsets.items():
            stream.seek(at)
            entries = np.frombuffer(stream.read(16 * block.counts[number]), "<u8")
            index[number] = np.sort(entries[1::2].astype(np.int64), kind="stable")
        return (index, []) if index and records.index_is_complete(buffer, index) else records.locate_messages(buffer)

    def _verify_unindexed(self, stream: BinaryIO, blocks: Iterable[Block]) -> None:
        """Verify chunks without a message index, or with messages of channels that are defined nowhere before."""
        for block in blocks:
            is_indexed = block.index_offsets and block.index_offsets.keys() <= self.channels.keys()
            if block.is_chunk and not block.is_damaged and not is_indexed:
                self._verify(stream, block)

    def _verify(self, stream: BinaryIO, block: Block) -> None:
        """Read a block to verify the counts of its messages, and any definitions that are not known yet."""
        try:
            buffer = self._load(stream, block)
            offsets, others = self._locate(stream, block, buffer)
            for opcode, record in others:
                self._define(opcode, record)
        except DamagedError as damaged:
            self._leave_out(block, damaged)
            return
        counts = {number: len(found) for number, found in offsets.items()}
        if counts != block.counts:
            block.counts, block.index_offsets = counts, {}

    def _messages(self, stream: BinaryIO, block: Block, channels: set[int]) -> list[MessageBlock]:
        """Messages of these channels in a block; none if it is damaged."""
        if not channels:
            return []
        try:
            buffer = self._load(stream, block)
            offsets, _ = self._locate(stream, block, buffer)
            if any(len(offsets.get(number, ())) != n for number, n in block.counts.items()):
                raise DamagedError("its message index is wrong")
        except DamagedError as damaged:
            self._leave_out(block, damaged)
            return []
        return [_message_block(number, buffer, offsets[number]) for number in sorted(channels)]

    def _leave_out(self, block: Block, damaged: DamagedError) -> None:
        for number, n in block.counts.items():
            self.lost_messages[number] = self.lost_messages.get(number, 0) + n
            if number in self.counts:
                self.counts[number] -= n
        block.counts, block.index_offsets, block.is_damaged = {}, {}, True
        self.losses.append(DataLoss("damage", block.start, block.end - block.start, 1, block.log_span_ns, str(damaged)))

    # -- the walk

    def _walk(self, stream: BinaryIO, stop: int, is_growing: bool = False) -> None:
        """Read record heads up to byte `stop`; of a growing file up to its last whole record."""
        position = self._walked
        while position < stop and self._data_end is None:
            stream.seek(position)
            head = stream.read(MESSAGE_HEAD.itemsize)
            opcode, length = HEAD.unpack_from(head) if len(head) >= HEAD.size else (0, stop)
            end = position + HEAD.size + length
            if is_growing and end > stop:
                break
            try:
                if end > stop:
                    raise DamagedError("a record is not whole")
                self._read_record(stream, opcode, head, position, end)
            except DamagedError as damaged:
                end = self._skip_damage(stream, position, end, stop, str(damaged))
            position = end
        self._walked = position

    def _skip_damage(self, stream: BinaryIO, position: int, end: int, stop: int, reason: str) -> int:
        """Record a data loss at a byte position; return the byte at which reading continues."""
        span = None
        if not _may_be_record(stream, end, stop):
            end = records.find_next_chunk(stream, position + 1, stop)
        stream.seek(position)
        head = stream.read(HEAD.size + 16)
        if head[:1] == bytes([Opcode.CHUNK]) and len(head) == HEAD.size + 16:
            first, last = struct.unpack_from("<QQ", head, HEAD.size)
            span = (first, last)
        self._chunk = None
        kind: LossKind = "cut" if end == stop == self.size else "damage"
        self.losses.append(DataLoss(kind, position, end - position, int(span is not None), span, reason))
        return end

    def _read_record(self, stream: BinaryIO, opcode: int, head: bytes, position: int, end: int) -> None:
        """Read the record at bytes [position, end) into the file's index. Raises DamagedError."""
        body = position + HEAD.size
        stream.seek(body)
        if opcode == Opcode.MESSAGE:
            message = np.frombuffer(head.ljust(MESSAGE_HEAD.itemsize, b"\0"), MESSAGE_HEAD)[0]
            self._add_message(message, position, end)
        elif opcode == Opcode.CHUNK:
            self._add_chunk(records.chunk_head(stream.read(64), end - body), position, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._add_message_index(stream.read(6), body, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, stream.read(min(end - body, MAX_DEFINITION_BYTES + 1)))
        elif opcode == Opcode.ATTACHMENT:
            self._attachment_offsets[records.parse(_attachment_name, stream.read(min(end - body, 1 << 16)))] = position
        elif opcode == Opcode.DATA_END:
            self._data_end = position, records.parse(mcap.records.DataEnd.read, stream.read(4)).data_section_crc
        elif opcode < _PRIVATE_OPCODES and opcode not in (Opcode.HEADER, Opcode.METADATA):
            raise DamagedError(f"a record of unknown kind {opcode}")

    def _define(self, opcode: int, record: bytes) -> None:
        """Keep a schema or channel, if it is the first of its id; other records are ignored. Raises DamagedError."""
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        if len(record) > MAX_DEFINITION_BYTES:
            raise DamagedError(f"a definition of {len(record)} bytes")
        if opcode == Opcode.SCHEMA:
            schema = records.parse(mcap.records.Schema.read, record)
            self._definition_bytes += len(record) if schema.id not in self.schemas else 0
            self.schemas.setdefault(schema.id, Schema(schema.id, schema.name, schema.encoding, schema.data))
        else:
            found = records.parse(mcap.records.Channel.read, record)
            channel = Channel(found.id, found.topic, found.message_encoding, found.schema_id)
            self.channels.setdefault(found.id, channel)
        if len(self.channels) > MAX_CHANNELS or self._definition_bytes > MAX_ALL_DEFINITION_BYTES:
            raise InputError(
                f"{self.path}: more than {MAX_CHANNELS} channels or {MAX_ALL_DEFINITION_BYTES >> 20} MiB of "
                "definitions, which no recording of sensors has; is it one?"
            )

    def _add_chunk(self, head: records.ChunkHead, position: int, end: int) -> None:
        self._decompressed_bytes += head.size
        if self._decompressed_bytes > _SMALL_FILE + MAX_FILE_RATIO * self.size:
            raise InputError(
                f"{self.path}: its chunks say that they unpack to over {self._decompressed_bytes >> 20} MiB, "
                f"{MAX_FILE_RATIO} times the file; no recording of sensors does, it may be made to exhaust the memory"
            )
        span = (head.first_ns, head.last_ns) if head.size else None
        self._chunk = Block(position, end, is_chunk=True, log_span_ns=span)
        self._blocks.append(self._chunk)

    def _add_message_index(self, start: bytes, body: int, end: int) -> None:
        if len(start) < 6:
            raise DamagedError("it is shorter than its fields")
        channel, length = struct.unpack("<HI", start)
        if body + 6 + length != end or length % 16:
            raise DamagedError("a message index of another size")
        if self._chunk is None or not length:
            return
        if channel in self._chunk.index_offsets:
            raise DamagedError("two message indexes of one channel")
        self._chunk.counts[channel] = length // 16
        self._chunk.index_offsets[channel] = body + 6

    def _add_message(self, message: np.void, position: int, end: int) -> None:
        """Put a message outside chunks into the last block if it follows and there is room, else into a new one."""
        if message["length"] < AFTER_LENGTH:
            raise DamagedError("a message without its head")
        self._chunk = None
        block = self._blocks[-1] if self._blocks else None
        if block is None or block.is_chunk or block.end != position or position - block.start > _RAW_BLOCK:
            block = Block(position, position, is_chunk=False)
            self._blocks.append(block)
        block.end = end
        log_ns = int(message["log_ns"])
        first, last = block.log_span_ns or (log_ns, log_ns)
        block.log_span_ns = (min(first, log_ns), max(last, log_ns))
        channel = int(message["channel"])
        block.counts[channel] = block.counts.get(channel, 0) + 1

    # -- the end of the file

    def _read_summary(self, stream: BinaryIO) -> int | None:
        """Read the summary if its checksum is right; return the byte of the footer, None without a footer."""
        at = self.size - len(MAGIC) - _FOOTER.size
        if at < len(MAGIC):
            return None
        stream.seek(at)
        tail = stream.read()
        opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
        if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - HEAD.size) or tail[_FOOTER.size :] != MAGIC:
            return None
        if start == 0:
            return at
        try:
            if not len(MAGIC) <= start <= at or at - start > MAX_SUMMARY_BYTES:
                raise DamagedError("it is not where the footer says")
            stream.seek(start)
            summary = stream.read(at - start)
            if crc not in (0, zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(summary))):
                raise DamagedError("its checksum is another")
            for opcode, first, last in records.iter_records(memoryview(summary)):
                self._read_summary_record(opcode, summary[first + HEAD.size : last])
        except DamagedError as damaged:
            self._stated = None
            self.losses.append(DataLoss("summary", start, max(0, at - start), reason=str(damaged)))
        return at

    def _read_summary_record(self, opcode: int, record: bytes) -> None:
        if opcode == Opcode.STATISTICS:
            self._stated = records.parse(mcap.records.Statistics.read, record).channel_message_counts
        elif opcode == Opcode.ATTACHMENT_INDEX:
            index = records.parse(mcap.records.AttachmentIndex.read, record)
            if index.offset > self.size:
                raise DamagedError("it says that an attachment lies behind the end of the file")
            self._attachment_offsets[index.name] = index.offset
        else:
            self._define(opcode, record)

    def _check_end(self, stream: BinaryIO, is_closed: bool) -> None:
        """Record a loss if the file has no proper end; verify messages outside chunks by the checksum of all data."""
        if is_closed:
            pass
        elif self._data_end is None and not any(loss.kind == "cut" for loss in self.losses):
            self.losses.append(DataLoss("cut", self.size, 0))
        elif self._data_end is not None:
            at = self._data_end[0] + HEAD.size + 4
            reason = "the file ends in it or its footer is damaged"
            self.losses.append(DataLoss("summary", at, self.size - at, reason=reason))
        raw = [block for block in self._blocks if not block.is_chunk]
        if not raw:
            return
        is_damaged = any(loss.kind == "damage" for loss in self.losses)
        if self._data_end is not None and self._data_end[1]:
            is_damaged = _crc(stream, self._data_end[0]) != self._data_end[1]
        if is_damaged:
            self._blocks = [block for block in self._blocks if block.is_chunk]
            size = sum(block.end - block.start for block in raw)
            reason = "messages outside chunks, whose only checksum is another"
            self.losses.append(DataLoss("damage", raw[0].start, size, reason=reason))


def _message_block(number: int, buffer: NDArray[np.uint8], offsets: NDArray[np.int64]) -> MessageBlock:
    heads = byte_windows(buffer, MESSAGE_HEAD.itemsize)[offsets].view(MESSAGE_HEAD)
    size = heads["length"].astype(np.int64) - AFTER_LENGTH
    return MessageBlock(number, buffer, offsets + MESSAGE_HEAD.itemsize, size, heads["log_ns"].astype(np.int64))


def _may_be_record(stream: BinaryIO, position: int, stop: int) -> bool:
    """Whether a record of the data section, or the section's end, may begin at this position."""
    if position >= stop:
        return position == stop
    stream.seek(position)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return False
    opcode, length = HEAD.unpack(head)
    return opcode in _OPCODES_OF_DATA and position + HEAD.size + length <= stop


def _crc(stream: BinaryIO, stop: int) -> int:
    """Return the CRC-32 of the first `stop` bytes of the file."""
    crc, left = 0, stop
    stream.seek(0)
    while left and (piece := stream.read(min(left, 1 << 20))):
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    return crc
