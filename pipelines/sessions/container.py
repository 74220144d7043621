"""MCAP files: where the messages lie, and the bytes of them.

The whole file is walked once from record head to record head, so a file needs neither a summary nor a chunk index, and
a cut file is known for what it is. The message index after a chunk tells which topics the chunk holds and where; a
chunk without one is walked. Nothing but positions stays in memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Schema
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from pipelines.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_COMPRESSIONS = ("", "zstd", "lz4")
# What the mcap package, the compressors and the reading of numbers raise on damaged bytes. A failed checksum and text
# that is no UTF-8 are ValueErrors, lz4's own error is a RuntimeError.
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, OverflowError, MemoryError)
_RAW_BLOCK = 1 << 20
_OTHER_FORMATS = {
    b"#ROSBAG": "a ROS 1 bag; convert it to ROS 2 and MCAP first",
    b"SQLite ": "a rosbag2 SQLite file; convert it, or record with `ros2 bag record -s mcap`",
}

# What stands before the CDR bytes of a message record. `length` counts what follows it.
MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<i8"),
        ("publish_ns", "<i8"),
    ]
)
_AFTER_LENGTH = MESSAGE_HEAD.itemsize - _HEAD.size


class Rows(NamedTuple):
    """The messages of one channel in one block: message i is buffer[start[i]:start[i] + size[i]]."""

    channel: int
    buffer: NDArray[np.uint8]
    start: NDArray[np.int64]
    size: NDArray[np.int64]
    log_ns: NDArray[np.int64]

    def message(self, i: int) -> bytes:
        """The bytes of message i."""
        return self.buffer[self.start[i] : self.start[i] + self.size[i]].tobytes()


@dataclass
class _Block:
    """A chunk, or a run of message records outside chunks: bytes [start, end) of the file."""

    start: int
    end: int
    is_chunk: bool
    counts: dict[int, int] = field(default_factory=dict)  # channel -> messages
    index_at: dict[int, int] = field(default_factory=dict)  # channel -> byte where its index entries start


def windows(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """Every stretch of `width` bytes of the buffer, as one overlapping array without a copy."""
    shape = (max(0, len(buffer) - width + 1),)
    return np.ndarray(shape, dtype=f"V{width}", buffer=buffer, strides=(1,))


class McapFile:
    """An MCAP file, walked once; the file is opened again for every read.

    Raises InputError when there is no such file, when it is no MCAP, cut or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.profile = ""
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.counts: dict[int, int] = {}
        self.first_ns, self.last_ns = 0, 0
        self._stated: int | None = None
        self._blocks: list[_Block] = []
        self._attachments: dict[str, int] = {}
        with self._open() as stream:
            self._check_magic(stream)
            self._walk(stream)
            for block in self._blocks:
                if block.is_chunk and not (block.index_at and block.index_at.keys() <= self.channels.keys()):
                    self._walk_block(stream, block)
        for block in self._blocks:
            for channel, count in block.counts.items():
                if channel not in self.channels or self.channels[channel].schema_id not in {0, *self.schemas}:
                    raise InputError(f"{path}: damaged, it has messages of channel {channel} but does not define it")
                self.counts[channel] = self.counts.get(channel, 0) + count
        if self._stated not in (None, sum(self.counts.values())):
            raise InputError(
                f"{path}: damaged, {sum(self.counts.values())} messages where it should have {self._stated}"
            )

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages of these channels, block by block in file order, every chunk checked against its CRC.

        Raises InputError when a chunk is damaged.
        """
        with self._open() as stream:
            for block in self._blocks:
                wanted = channels & block.counts.keys()
                if not wanted:
                    continue
                buffer = self._load(stream, block)
                for channel in sorted(wanted):
                    yield self._locate(stream, block, channel, buffer)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachments)

    def attachment(self, name: str) -> bytes | None:
        """Content of the attachment of that name (the last one, if there are several), or None."""
        if name not in self._attachments:
            return None
        with self._open() as stream:
            stream.seek(self._attachments[name])
            _, length = _HEAD.unpack(stream.read(_HEAD.size))
            record = stream.read(length)
        (crc,) = struct.unpack("<I", record[-4:])
        if crc not in (0, zlib.crc32(record[:-4])):
            raise InputError(f"{self.path}: the attachment {name} is damaged (checksum)")
        return Attachment.read(_stream(record)).data

    def _open(self) -> BinaryIO:
        if self.path.is_dir():
            raise InputError(f"{self.path}: a folder; give the .mcap file in it")
        try:
            return self.path.open("rb")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be opened ({error.strerror})") from error

    def _check_magic(self, stream: BinaryIO) -> None:
        start = stream.read(len(MAGIC))
        if not start:
            raise InputError(f"{self.path}: the file is empty; an MCAP recording is needed")
        if start != MAGIC:
            what = next((text for head, text in _OTHER_FORMATS.items() if start.startswith(head)), "")
            raise InputError(f"{self.path}: not an MCAP file{f', but {what}' if what else ''}")

    def _walk(self, stream: BinaryIO) -> None:
        size = stream.seek(0, 2)
        position, opcode = len(MAGIC), 0
        while opcode != Opcode.FOOTER:
            stream.seek(position)
            head = stream.read(MESSAGE_HEAD.itemsize)
            opcode, length = _HEAD.unpack(head[: _HEAD.size]) if len(head) >= _HEAD.size else (0, size)
            end = position + _HEAD.size + length
            if end > size:
                raise InputError(
                    f"{self.path}: truncated or damaged, the record at byte {position} of {size} is not whole; "
                    "record again, or save what is there with `mcap recover`"
                )
            try:
                self._take(stream, opcode, head, position, end)
            except _BROKEN as error:
                raise InputError(f"{self.path}: damaged, the record at byte {position} cannot be read") from error
            position = end
        stream.seek(position)
        if stream.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{self.path}: truncated, the file ends without its closing mark")

    def _take(self, stream: BinaryIO, opcode: int, head: bytes, position: int, end: int) -> None:
        """Note what the record at [position, end) says."""
        body = position + _HEAD.size
        stream.seek(body)
        if opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, stream.read(end - body))
        elif opcode == Opcode.CHUNK:
            self._blocks.append(_Block(position, end, is_chunk=True))
            first, last, size = struct.unpack("<QQQ", stream.read(24))
            if size:
                self._extend(first, last)
        elif opcode == Opcode.MESSAGE_INDEX:
            channel, length = struct.unpack("<HI", stream.read(6))
            if body + 6 + length != end or not self._blocks:
                raise ValueError("message index of another size, or of no chunk")
            block = self._blocks[-1]
            if length:
                block.counts[channel] = length // 16
                block.index_at[channel] = body + 6
        elif opcode == Opcode.MESSAGE:
            block = self._raw_block(position)
            block.end = end
            message = np.frombuffer(head, MESSAGE_HEAD)[0]
            channel = int(message["channel"])
            block.counts[channel] = block.counts.get(channel, 0) + 1
            self._extend(int(message["log_ns"]), int(message["log_ns"]))
        elif opcode == Opcode.STATISTICS:
            (self._stated,) = struct.unpack("<Q", stream.read(8))
        elif opcode == Opcode.ATTACHMENT:
            _, _, length = struct.unpack("<QQI", stream.read(20))
            self._attachments[stream.read(length).decode()] = position

    def _define(self, opcode: int, record: bytes) -> None:
        if opcode == Opcode.HEADER:
            self.profile = Header.read(_stream(record)).profile
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(record))
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(record))
            self.channels[channel.id] = channel

    def _extend(self, first: int, last: int) -> None:
        self.first_ns = min(self.first_ns, first) if self.last_ns else first
        self.last_ns = max(self.last_ns, last)

    def _raw_block(self, position: int) -> _Block:
        """The block a message record at this position belongs to: the last one, if it joins on and has room."""
        last = self._blocks[-1] if self._blocks else None
        if last is None or last.is_chunk or last.end != position or position - last.start > _RAW_BLOCK:
            last = _Block(position, position, is_chunk=False)
            self._blocks.append(last)
        return last

    def _load(self, stream: BinaryIO, block: _Block) -> NDArray[np.uint8]:
        """The records of a block: decompressed and checked, if it is a chunk."""
        if not block.is_chunk:
            stream.seek(block.start)
            return np.frombuffer(stream.read(block.end - block.start), np.uint8)
        stream.seek(block.start + _HEAD.size)
        try:
            chunk = Chunk.read(ReadDataStream(stream))
            if chunk.compression not in _COMPRESSIONS:
                raise ValueError(f"unknown compression {chunk.compression!r}")
            records, size = get_chunk_data_stream(chunk, validate_crc=True)
            if size != chunk.uncompressed_size:
                raise ValueError(f"{size} bytes instead of {chunk.uncompressed_size}")
            return np.frombuffer(records.read(size), np.uint8)
        except _BROKEN as error:
            raise InputError(
                f"{self.path}: the chunk at byte {block.start} is damaged ({error}); record again, or save the rest "
                "with `mcap recover`"
            ) from error

    def _walk_block(self, stream: BinaryIO, block: _Block) -> None:
        """Count the messages of a block without an index; take the definitions in it."""
        buffer = self._load(stream, block)
        block.counts = {}
        block.index_at = {}
        for opcode, start, end in self._records(block, buffer):
            if opcode == Opcode.MESSAGE:
                channel = int.from_bytes(buffer[start + 9 : start + 11].tobytes(), "little")
                block.counts[channel] = block.counts.get(channel, 0) + 1
            else:
                self._define(opcode, buffer[start + _HEAD.size : end].tobytes())

    def _records(self, block: _Block, buffer: NDArray[np.uint8]) -> Iterator[tuple[int, int, int]]:
        """(opcode, start, end) of the records in a block."""
        start, data = 0, buffer.data
        while start < len(data):
            opcode, length = _HEAD.unpack_from(data, start) if start + _HEAD.size <= len(data) else (0, len(data))
            end = start + _HEAD.size + length
            if end > len(data) or (opcode == Opcode.MESSAGE and length < _AFTER_LENGTH):
                raise InputError(f"{self.path}: damaged, a record in the block at byte {block.start} is not whole")
            yield opcode, start, end
            start = end

    def _locate(self, stream: BinaryIO, block: _Block, channel: int, buffer: NDArray[np.uint8]) -> Rows:
        if channel in block.index_at:
            stream.seek(block.index_at[channel])
            entries = np.frombuffer(stream.read(16 * block.counts[channel]), "<u8")
            offsets = np.sort(entries[1::2]).astype(np.int64)
        else:
            messages = (start for opcode, start, _ in self._records(block, buffer) if opcode == Opcode.MESSAGE)
            offsets = np.fromiter(messages, np.int64)
            ids = windows(buffer[9:], 2)[offsets].view("<u2")
            offsets = offsets[ids == channel]
        # The index is outside the checksum: believe it only where it points at messages of this channel.
        width = MESSAGE_HEAD.itemsize
        inside = len(offsets) == 0 or (offsets[0] >= 0 and offsets[-1] + width <= len(buffer))
        heads = windows(buffer, width)[offsets if inside else offsets[:0]].view(MESSAGE_HEAD)
        size = heads["length"].astype(np.int64) - _AFTER_LENGTH
        start = offsets[: len(heads)] + width
        sound = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == channel)
        sound &= (size >= 0) & (start + size <= len(buffer))
        if not (inside and sound.all()):
            raise InputError(f"{self.path}: damaged, the message index of the chunk at byte {block.start} is wrong")
        return Rows(channel, buffer, start, size, heads["log_ns"].astype(np.int64))


def _stream(record: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(record))
