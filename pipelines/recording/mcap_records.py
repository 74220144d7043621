"""Records of an MCAP file as bytes: parsed, chunks decompressed within bounds, the next chunk behind damaged bytes.

No length that the file states is trusted: each is compared with the bytes that are there. Functions are pure; bytes
that are not what they should be raise DamagedError.
"""

from __future__ import annotations

import bz2
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from alidade.pipelines.recording.container import byte_windows

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
_COMPRESSED_SIZE = struct.Struct("<Q")
# Bounds of a chunk, bytes, and of its compression ratio beyond a small size: no recorder exceeds them.
MAX_CHUNK_BYTES = 1 << 28
MAX_CHUNK_RATIO, _SMALL_CHUNK = 2000, 1 << 16
# Definitions in one chunk; more are an attack.
MAX_CHUNK_DEFINITIONS = 1 << 16
# Bytes of the file that are searched at a time.
_SEARCHED = 1 << 20


class DamagedError(Exception):
    """Raised at damaged bytes, with the reason as a part of a sentence."""


class ChunkHead(NamedTuple):
    """Head of a chunk: log times, Unix ns; sizes, bytes; `packed`: position of its data."""

    first_ns: int
    last_ns: int
    size: int
    crc: int
    compression: str
    packed: slice


_Record = TypeVar("_Record")


class _WholeFields(ReadDataStream):
    """Reader of a record's fields that raises DamagedError at a field that is cut short."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise DamagedError("it is shorter than its fields")
        return data


def parse(read: Callable[[ReadDataStream], _Record], record: bytes) -> _Record:
    """Parse the bytes of a record by the `read` of one of the kinds in mcap.records. Raises DamagedError."""
    try:
        return read(_WholeFields(BytesIO(record)))
    except EndOfFile as error:
        raise DamagedError("it is shorter than its fields") from error
    except UnicodeDecodeError as error:
        raise DamagedError("a name in it is no text") from error


def chunk_head(start: bytes, length: int) -> ChunkHead:
    """Head of a chunk from its first 64 bytes. Raises DamagedError where it is invalid."""
    if len(start) < _CHUNK_HEAD.size:
        raise DamagedError("it is shorter than its fields")
    first, last, size, crc, name = _CHUNK_HEAD.unpack_from(start)
    at = _CHUNK_HEAD.size + name
    compression = start[_CHUNK_HEAD.size : at].decode(errors="replace")
    if compression not in ("", "zstd", "lz4"):
        raise DamagedError(f"unknown compression {compression!r}")
    if at + _COMPRESSED_SIZE.size > len(start):
        raise DamagedError("it is shorter than its fields")
    (packed,) = _COMPRESSED_SIZE.unpack_from(start, at)
    at += _COMPRESSED_SIZE.size
    if at + packed > length:
        raise DamagedError("it is shorter than its data")
    if size > (most_unpacked(packed) if compression else packed):
        raise DamagedError(f"it says that {packed} bytes hold {size}")
    return ChunkHead(first, last, size, crc, compression, slice(at, at + packed))


def most_unpacked(packed: int) -> int:
    """Return the bytes that a chunk of so many compressed ones may hold."""
    return min(MAX_CHUNK_BYTES, _SMALL_CHUNK + MAX_CHUNK_RATIO * packed)


def decompress_chunk(chunk: bytes) -> NDArray[np.uint8]:
    """Return the records in a chunk, decompressed, with their checksum verified. Raises DamagedError."""
    head = chunk_head(chunk[:64], len(chunk))
    data = decompress(memoryview(chunk)[head.packed], head.compression, head.size)
    if head.crc not in (0, zlib.crc32(data)):
        raise DamagedError("its checksum is another")
    return np.frombuffer(data, np.uint8)


def decompress(packed: bytes | memoryview, compression: str, size: int) -> bytes | memoryview:
    """Decompress data that unpack to `size` bytes, into one byte more at most. Raises DamagedError."""
    try:
        if compression == "lz4":
            packed = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        elif compression == "bz2":
            packed = bz2.BZ2Decompressor().decompress(packed, size + 1)
        elif compression == "zstd":
            # What the frame itself says of its size would be allocated before a byte is decompressed.
            if zstandard.frame_content_size(packed[:32]) not in (-1, size):
                raise ValueError("another size")
            packed = zstandard.decompress(packed, max_output_size=size + 1) if size else b""
    except (zstandard.ZstdError, OSError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise DamagedError("it cannot be decompressed") from error
    if len(packed) != size:
        raise DamagedError(f"{len(packed)} bytes instead of {size}")
    return packed


def iter_records(data: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield the records of MCAP data as (opcode, start, end), in bytes. Raises DamagedError if they do not fill it."""
    start, stop = 0, len(data)
    while start < stop:
        opcode, length = HEAD.unpack_from(data, start) if start + HEAD.size <= stop else (0, stop)
        end = start + HEAD.size + length
        if end > stop or not opcode or (opcode == Opcode.MESSAGE and length < AFTER_LENGTH):
            raise DamagedError("a record in it is not whole")
        yield opcode, start, end
        start = end


def locate_messages(
    buffer: NDArray[np.uint8],
) -> tuple[dict[int, NDArray[np.int64]], list[tuple[int, bytes]]]:
    """Channel -> offsets of its messages in these records, and the other records as (opcode, content)."""
    found: dict[int, list[int]] = {}
    others: list[tuple[int, bytes]] = []
    for opcode, start, end in iter_records(buffer.data):
        if opcode == Opcode.MESSAGE:
            number = int.from_bytes(buffer.data[start + 9 : start + 11], "little")
            found.setdefault(number, []).append(start)
        elif len(others) == MAX_CHUNK_DEFINITIONS:
            raise DamagedError(f"it has more than {MAX_CHUNK_DEFINITIONS} definitions")
        else:
            others.append((opcode, bytes(buffer.data[start + HEAD.size : end])))
    return {number: np.array(offsets, dtype=np.int64) for number, offsets in found.items()}, others


def index_is_complete(buffer: NDArray[np.uint8], index: Mapping[int, NDArray[np.int64]]) -> bool:
    """Whether an index, channel -> offsets of its messages, names every record, and all records are such messages.

    The message index is outside every checksum; the records it is compared with are inside.
    """
    offsets = np.concatenate(list(index.values()))
    if not len(offsets) or offsets.min() != 0 or offsets.max() > len(buffer) - MESSAGE_HEAD.itemsize:
        return False
    heads = byte_windows(buffer, MESSAGE_HEAD.itemsize)[offsets].view(MESSAGE_HEAD)
    numbers = np.repeat(list(index), [len(one) for one in index.values()])
    length = heads["length"]
    sound = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == numbers)
    if not (sound & (length >= AFTER_LENGTH) & (length <= len(buffer))).all():
        return False
    order = np.argsort(offsets)
    ends = (offsets + length.astype(np.int64) + HEAD.size)[order]
    return np.array_equal(ends, np.append(offsets[order][1:], len(buffer)))


def find_next_chunk(stream: BinaryIO, start: int, stop: int) -> int:
    """Return the byte from `start` on at which the next chunk begins that ends by `stop`; `stop` if there is none."""
    while start + HEAD.size <= stop:
        stream.seek(start)
        piece = np.frombuffer(stream.read(min(_SEARCHED, stop - start)), np.uint8)
        heads = byte_windows(piece, HEAD.size).view([("opcode", "u1"), ("length", "<u8")])
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
