"""ROS 1 bags, version 2.0.

A bag has no checksums but those of its compression. It is walked from record to record, so that one that was never
closed is read as well; where a record is not whole the walk ends, and what is behind is noted as lost.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Channel, Container, DataLoss, MessageBlock, Schema, total
from alidade.pipelines.recording.mcap_records import MAX_CHUNK_BYTES, DamagedError, decompress, most_unpacked

MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _INDEX, _CHUNK, _CHUNK_INFO, _BAG, _CONNECTION = 2, 4, 5, 6, 3, 7
# No header, definition or number of topics of a recording comes near these.
_LONGEST_HEADER, _LONGEST_TEXT, _MOST_CONNECTIONS = 1 << 16, 1 << 20, 10_000
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")


@dataclass
class _Chunk:
    """Chunk of a bag: byte range of its data, compression, and number of messages of each connection."""

    start: int
    end: int
    compression: str
    size: int
    counts: dict[int, int] = field(default_factory=dict)


class Ros1Bag(Container):
    """ROS 1 bag as a container; the file is opened again for every read. Raises InputError when it is hostile."""

    def __init__(self, path: Path, data: Path | None = None) -> None:
        super().__init__(path, data)
        self._chunks: list[_Chunk] = []
        self.size = self.data.stat().st_size
        with self.data.open("rb") as stream:
            self._walk(stream)
            for chunk in self._chunks:
                if not chunk.counts or not chunk.counts.keys() <= self.channels.keys():
                    self._verify(stream, chunk)
        self.set_counts(total(chunk.counts for chunk in self._chunks))

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of these connections, chunk by chunk."""
        with self.data.open("rb") as stream:
            for chunk in self._chunks:
                if not channels & chunk.counts.keys():
                    continue
                try:
                    found = self._messages(stream, chunk)
                    if {number: len(block.start) for number, block in found.items()} != chunk.counts:
                        raise DamagedError("its index is wrong")
                except DamagedError as damaged:
                    self._lose(chunk, str(damaged))
                    continue
                for number in sorted(channels & found.keys()):
                    yield found[number]

    def _walk(self, stream: BinaryIO) -> None:
        """Index the bag's chunks and connections; record a loss if the file ends too early."""
        position, unpacked, indexed = len(MAGIC), 0, 0
        try:
            for op, header, start, end in _records(stream, position, self.size, "a record"):
                if op == _BAG:
                    indexed = int.from_bytes(header.get(b"index_pos", b""), "little")
                elif op == _CHUNK:
                    size = int.from_bytes(header.get(b"size", b""), "little")
                    compression = header.get(b"compression", b"").decode(errors="replace")
                    unpacked += size
                    if unpacked > MAX_CHUNK_BYTES + 100 * self.size:
                        raise InputError(
                            f"{self.path}: its chunks say that they unpack to over {unpacked >> 20} MiB, 100 times "
                            "the file; it may be made to exhaust the memory"
                        )
                    self._chunks.append(_Chunk(start, end, compression, size))
                elif op == _INDEX and self._chunks:
                    number = int.from_bytes(header.get(b"conn", b""), "little")
                    counts = self._chunks[-1].counts
                    count = int.from_bytes(header.get(b"count", b""), "little")
                    if 12 * count != end - start:
                        raise DamagedError("an index of another size")
                    counts[number] = counts.get(number, 0) + count
                elif op == _CONNECTION:
                    stream.seek(start)
                    self._connect(header, stream.read(min(end - start, _LONGEST_TEXT + 1)))
                elif op not in (_INDEX, _CHUNK_INFO):
                    raise DamagedError(f"a record of unknown kind {op}")
                position = end
        except DamagedError as damaged:
            kind, reason = ("damage", str(damaged)) if indexed else ("cut", "")
            self.losses.append(DataLoss(kind, position, self.size - position, reason=reason))  # type: ignore[arg-type]
            return
        if not indexed:
            self.losses.append(DataLoss("cut", self.size, 0))

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        if len(data) > _LONGEST_TEXT:
            raise DamagedError("a definition that is too long")
        fields = _fields(data)
        number = int.from_bytes(header.get(b"conn", b""), "little")
        if number in self.channels:
            return
        if len(self.channels) >= _MOST_CONNECTIONS:
            raise InputError(f"{self.path}: more than {_MOST_CONNECTIONS} connections, which no recording has")
        topic, kind = (text.decode(errors="replace") for text in (header.get(b"topic", b""), fields.get(b"type", b"")))
        self.schemas[number] = Schema(number, kind, "ros1msg", fields.get(b"message_definition", b""))
        self.channels[number] = Channel(number, topic, "ros1", number)

    def _messages(self, stream: BinaryIO, chunk: _Chunk) -> dict[int, MessageBlock]:
        """Return the messages in a chunk, a block for each connection. Raises DamagedError."""
        if chunk.compression not in ("none", "bz2", "lz4"):
            raise DamagedError(f"unknown compression {chunk.compression!r}")
        stream.seek(chunk.start)
        packed = stream.read(chunk.end - chunk.start)
        if chunk.size > most_unpacked(len(packed)):
            raise DamagedError(f"it says that {len(packed)} bytes hold {chunk.size}")
        data = bytes(decompress(packed, chunk.compression, chunk.size))
        found: dict[int, tuple[list[int], list[int], list[int]]] = {}
        for op, header, start, end in _records(BytesIO(data), 0, len(data), "a record in it"):
            if op == _CONNECTION:
                self._connect(header, data[start:end])
            elif op == _MESSAGE:
                try:
                    number = _LENGTH.unpack(header[b"conn"])[0]
                    sec, nanosec = _TIME.unpack(header[b"time"])
                except (KeyError, struct.error) as error:
                    raise DamagedError("a message without its head") from error
                starts, sizes, times = found.setdefault(number, ([], [], []))
                starts.append(start)
                sizes.append(end - start)
                times.append(sec * 1_000_000_000 + nanosec)
        buffer = np.frombuffer(data, np.uint8)
        return {number: MessageBlock(number, buffer, *map(np.array, parts)) for number, parts in found.items()}

    def _verify(self, stream: BinaryIO, chunk: _Chunk) -> None:
        """Count the messages of a chunk whose index is missing."""
        try:
            chunk.counts = {number: len(block.start) for number, block in self._messages(stream, chunk).items()}
        except DamagedError as damaged:
            self._lose(chunk, str(damaged))

    def _lose(self, chunk: _Chunk, reason: str) -> None:
        for number, n in chunk.counts.items():
            self.lost_messages[number] = self.lost_messages.get(number, 0) + n
        chunk.counts = {}
        self.losses.append(DataLoss("damage", chunk.start, chunk.end - chunk.start, 1, reason=reason))


def is_closed(stream: BinaryIO) -> bool:
    """Whether a bag has been closed: its header then states the position of the index."""
    size = stream.seek(0, 2)
    try:
        _, header, _, _ = next(_records(stream, len(MAGIC), size, "a record"))
    except (DamagedError, StopIteration):
        return False
    return 0 < int.from_bytes(header.get(b"index_pos", b""), "little") < size


def _records(
    stream: BinaryIO, position: int, stop: int, what: str
) -> Iterator[tuple[int, dict[bytes, bytes], int, int]]:
    """Yield kind, header, begin and end of data of each record in [position, stop); errors call a record `what`."""
    while position < stop:
        stream.seek(position)
        head = stream.read(4)
        length = _LENGTH.unpack(head)[0] if len(head) == 4 else stop
        if length > _LONGEST_HEADER or position + length + 8 > stop:
            raise DamagedError(f"{what} is not whole")
        header = stream.read(length + 4)
        start = position + length + 8
        position = start + _LENGTH.unpack(header[length:])[0]
        if position > stop:
            raise DamagedError(f"{what} is not whole")
        fields = _fields(header[:length])
        yield (fields.get(b"op") or b"\0")[0], fields, start, position


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the ROS 1 header fields of a record as a mapping of name to bytes. Raises DamagedError."""
    fields, at = {}, 0
    while at < len(header):
        length = int.from_bytes(header[at : at + 4], "little")
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(header):
            raise DamagedError("a header is not whole")
        fields[name] = value
    return fields
