"""The records of an MCAP file as bytes: their fields, chunks unpacked within bounds, where the next chunk begins.

Nothing here believes a length that the file states: every one is held against the bytes that are there.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from alidade.pipelines.recording.container import Channel, Schema

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")

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
AFTER_LENGTH = MESSAGE_HEAD.itemsize - HEAD.size

# Times, size, checksum and length of the compression's name: what stands before that name in a chunk.
_CHUNK_HEAD = struct.Struct("<QQQII")
_PACKED_SIZE = struct.Struct("<Q")
# No recorder makes larger chunks, and nothing it records packs that well; a few constant images may.
_LARGEST_CHUNK = 1 << 28
_LARGEST_RATIO, _SMALL_CHUNK = 2000, 1 << 16
# Definitions in one chunk; more are an attack.
_MOST_DEFINITIONS = 1 << 16
# How much of the file is searched at a time.
_PIECE = 1 << 20


class DamagedError(Exception):
    """Bytes that are not what they should be; the message says why, as a part of a sentence."""


class ChunkHead(NamedTuple):
    """What a chunk says about itself; times in Unix ns by log time, sizes in bytes. `packed` is where its data are."""

    first_ns: int
    last_ns: int
    size: int
    crc: int
    compression: str
    packed: slice


class Fields:
    """The fields of a record, taken one after the other. Raises DamagedError where the record is too short."""

    def __init__(self, record: bytes) -> None:
        self._record, self._at = record, 0

    def numbers(self, form: str) -> tuple[int, ...]:
        """Numbers by their struct format, little endian."""
        return struct.unpack(f"<{form}", self._take(struct.calcsize(f"<{form}")))

    def more(self, form: str) -> tuple[int, ...] | None:
        """The next numbers, None at the end of the record."""
        return self.numbers(form) if self._at < len(self._record) else None

    def block(self, length: str = "I") -> bytes:
        """Bytes after their length."""
        return self._take(*self.numbers(length))

    def text(self) -> str:
        """UTF-8 text after its length."""
        try:
            return self.block().decode()
        except UnicodeDecodeError as error:
            raise DamagedError("a name in it is no text") from error

    def _take(self, size: int) -> bytes:
        start, self._at = self._at, self._at + size
        if self._at > len(self._record):
            raise DamagedError("it is shorter than its fields")
        return self._record[start : self._at]


def schema(record: bytes) -> Schema:
    """The fields of a schema record."""
    fields = Fields(record)
    (number,) = fields.numbers("H")
    return Schema(number, fields.text(), fields.text(), fields.block())


def channel(record: bytes) -> Channel:
    """The fields of a channel record, without its metadata."""
    fields = Fields(record)
    number, schema_id = fields.numbers("HH")
    return Channel(number, fields.text(), fields.text(), schema_id)


def chunk_head(start: bytes, length: int) -> ChunkHead:
    """What a chunk of so many bytes says about itself in its first 64 bytes. Raises DamagedError at what cannot be."""
    if len(start) < _CHUNK_HEAD.size:
        raise DamagedError("it is shorter than its fields")
    first, last, size, crc, name = _CHUNK_HEAD.unpack_from(start)
    at = _CHUNK_HEAD.size + name
    compression = start[_CHUNK_HEAD.size : at].decode(errors="replace")
    if compression not in ("", "zstd", "lz4"):
        raise DamagedError(f"unknown compression {compression!r}")
    if at + _PACKED_SIZE.size > len(start):
        raise DamagedError("it is shorter than its fields")
    (packed,) = _PACKED_SIZE.unpack_from(start, at)
    at += _PACKED_SIZE.size
    if at + packed > length:
        raise DamagedError("it is shorter than its data")
    if size > (packed if not compression else min(_LARGEST_CHUNK, _SMALL_CHUNK + _LARGEST_RATIO * packed)):
        raise DamagedError(f"it says that {packed} bytes hold {size}")
    return ChunkHead(first, last, size, crc, compression, slice(at, at + packed))


def unpack(chunk: bytes) -> NDArray[np.uint8]:
    """The records in a chunk, decompressed and checked. Raises DamagedError."""
    head = chunk_head(chunk[:64], len(chunk))
    packed = memoryview(chunk)[head.packed]
    try:
        data = _decompress(head, packed)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise DamagedError("it cannot be decompressed") from error
    if len(data) != head.size:
        raise DamagedError(f"{len(data)} bytes instead of {head.size}")
    if head.crc not in (0, zlib.crc32(data)):
        raise DamagedError("its checksum is another")
    return np.frombuffer(data, np.uint8)


def records(data: memoryview, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end) of the records side by side in [start, stop). Raises DamagedError if they do not fill it."""
    stop = len(data) if stop is None else stop
    while start < stop:
        opcode, length = HEAD.unpack_from(data, start) if start + HEAD.size <= stop else (0, stop)
        end = start + HEAD.size + length
        if end > stop or not opcode or (opcode == Opcode.MESSAGE and length < AFTER_LENGTH):
            raise DamagedError("a record in it is not whole")
        yield opcode, start, end
        start = end


def walk(buffer: NDArray[np.uint8]) -> tuple[dict[int, NDArray[np.int64]], list[tuple[int, bytes]]]:
    """Where the messages of each channel begin in these records, and the other records: (opcode, content)."""
    found: dict[int, list[int]] = {}
    others: list[tuple[int, bytes]] = []
    for opcode, start, end in records(buffer.data):
        if opcode == Opcode.MESSAGE:
            number = int.from_bytes(buffer.data[start + 9 : start + 11], "little")
            found.setdefault(number, []).append(start)
        elif len(others) == _MOST_DEFINITIONS:
            raise DamagedError(f"it has more than {_MOST_DEFINITIONS} definitions")
        else:
            others.append((opcode, bytes(buffer.data[start + HEAD.size : end])))
    return {number: np.array(offsets, dtype=np.int64) for number, offsets in found.items()}, others


def is_whole_index(buffer: NDArray[np.uint8], index: dict[int, NDArray[np.int64]]) -> bool:
    """Whether the index, channel -> where its messages begin, names every message in the records, and nothing else."""
    offsets = np.concatenate([*index.values(), np.empty(0, np.int64)])
    numbers = np.repeat(list(index), [len(one) for one in index.values()])
    if len(offsets) and not (offsets.min() >= 0 and offsets.max() + MESSAGE_HEAD.itemsize <= len(buffer)):
        return False
    heads = windows(buffer, MESSAGE_HEAD.itemsize)[offsets].view(MESSAGE_HEAD)
    length = heads["length"]
    if not ((heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == numbers) & (length >= AFTER_LENGTH)).all():
        return False
    if (length > len(buffer)).any():
        return False
    order = np.argsort(offsets, kind="stable")
    starts = np.append(offsets[order], len(buffer))
    ends = np.concatenate([[0], (offsets + length.astype(np.int64) + HEAD.size)[order]])
    if (ends > starts).any():
        return False
    try:
        for i in np.flatnonzero(ends < starts).tolist():
            if any(opcode == Opcode.MESSAGE for opcode, *_ in records(buffer.data, int(ends[i]), int(starts[i]))):
                return False
    except DamagedError:
        return False
    return True


def find_chunk(stream: BinaryIO, start: int, stop: int) -> int:
    """Where from `start` on the next chunk begins that ends by `stop`; `stop` if there is none."""
    while start + HEAD.size <= stop:
        stream.seek(start)
        piece = np.frombuffer(stream.read(min(_PIECE, stop - start)), np.uint8)
        heads = windows(piece, HEAD.size).view([("opcode", "u1"), ("length", "<u8")])
        likely = (heads["opcode"] == Opcode.CHUNK) & (heads["length"] <= stop - start)
        for i in np.flatnonzero(likely).tolist():
            length = int(heads["length"][i])
            stream.seek(start + i + HEAD.size)
            try:
                # Written without slack: its data end where the record does.
                if chunk_head(stream.read(64), length).packed.stop == length <= stop - start - i - HEAD.size:
                    return start + i
            except DamagedError:
                continue
        start += len(heads)
    return stop


def windows(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """Every stretch of `width` bytes of the buffer, as one overlapping array without a copy."""
    shape = (max(0, len(buffer) - width + 1),)
    return np.ndarray(shape, dtype=f"V{width}", buffer=buffer, strides=(1,))


def _decompress(head: ChunkHead, packed: memoryview) -> bytes | memoryview:
    """At most one byte more than the chunk says it holds."""
    if head.compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=head.size + 1)
    if head.compression == "zstd":
        # What the frame itself says of its size would be allocated before a byte is decompressed.
        if zstandard.frame_content_size(packed[:32]) not in (-1, head.size):
            raise ValueError("another size")
        return zstandard.decompress(packed, max_output_size=head.size + 1) if head.size else b""
    return packed
