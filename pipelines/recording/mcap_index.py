"""The index of an MCAP file: what lies where, from one walk from record head to record head.

The walk needs neither a summary nor a chunk index. Where bytes are damaged it goes on at the next record that can be
told, at worst the next chunk; what is left out is noted. The summary behind the data is believed if its checksum holds:
it repeats the definitions and says how many messages there should be.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import mcap_records as records
from alidade.pipelines.recording.container import Channel, Schema
from alidade.pipelines.recording.data_loss import DataLoss
from alidade.pipelines.recording.mcap_records import HEAD, MAGIC, MESSAGE_HEAD, DamagedError, Fields

_RAW_BLOCK = 1 << 20
_FOOTER = struct.Struct("<BQQQI")
# A definition is text that a person wrote; a recorder of thousands of topics is not one of sensors.
_LONGEST_DEFINITION = 1 << 20
_MOST_CHANNELS, _MOST_TEXT = 10_000, 1 << 26
_LARGEST_SUMMARY = 1 << 28
# All chunks together may unpack to so many times the file, beyond so many bytes.
_LARGEST_RATIO, _SMALL_FILE = 100, 1 << 28
_IN_DATA = {
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
_PRIVATE = 0x80  # from here on opcodes are free for everybody's use


@dataclass
class Block:
    """A chunk, or a run of message records outside chunks: bytes [start, end) of the file."""

    start: int
    end: int
    is_chunk: bool
    span: tuple[int, int] | None = None  # log times, ns, as the chunk or the messages state them
    counts: dict[int, int] = field(default_factory=dict)  # channel -> messages
    index_at: dict[int, int] = field(default_factory=dict)  # channel -> byte where its index entries start
    is_lost: bool = False  # found damaged within


class McapIndex:
    """The walk over a file, whole or as far as it has grown.

    Raises InputError when the file is hostile: more definitions than any recording has, or a decompression bomb.

    Attributes:
        size: of the file, bytes.
        profile: the recorder's.
        schemas, channels: definitions outside chunks, by id.
        blocks: where messages are.
        attachments: name -> byte of the record.
        stated: channel -> messages, as the summary says; None without a summary to be believed.
        losses: what cannot be used.
    """

    def __init__(self, name: str) -> None:
        self.size = 0
        self.profile = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.attachments: dict[str, int] = {}
        self.stated: dict[int, int] | None = None
        self.losses: list[DataLoss] = []
        self._name, self._text, self._unpacked = name, 0, 0
        self._chunk: Block | None = None
        self._data_end: tuple[int, int] | None = None  # byte and checksum
        self._walked = len(MAGIC)  # up to this byte

    def read(self, stream: BinaryIO) -> None:
        """The whole file."""
        self.size = stream.seek(0, 2)
        end = self._footer(stream)
        self._walk(stream, self.size if end is None else end)
        self._finish(stream, closed=end is not None)

    def grow(self, stream: BinaryIO) -> None:
        """What has come since the last time, up to the last whole record."""
        self.size = stream.seek(0, 2)
        self._walk(stream, self.size, grows=True)

    def define(self, opcode: int, record: bytes) -> None:
        """Take the definition in a schema or channel record, if it is the first of its id; of other records nothing.

        Raises DamagedError.
        """
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        if len(record) > _LONGEST_DEFINITION:
            raise DamagedError(f"a definition of {len(record)} bytes")
        if opcode == Opcode.SCHEMA:
            schema = records.schema(record)
            self._text += len(record) if schema.id not in self.schemas else 0
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = records.channel(record)
            self.channels.setdefault(channel.id, channel)
        if len(self.channels) > _MOST_CHANNELS or self._text > _MOST_TEXT:
            raise InputError(
                f"{self._name}: more than {_MOST_CHANNELS} channels or {_MOST_TEXT >> 20} MiB of definitions, which no "
                "recording of sensors has; is it one?"
            )

    def _footer(self, stream: BinaryIO) -> int | None:
        """Where the footer begins, None if there is none; takes what the summary says, if it can be believed."""
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
            if not len(MAGIC) <= start <= at or at - start > _LARGEST_SUMMARY:
                raise DamagedError("it is not where the footer says")
            stream.seek(start)
            summary = stream.read(at - start)
            if crc not in (0, zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(summary))):
                raise DamagedError("its checksum is another")
            for opcode, first, last in records.records(memoryview(summary)):
                self._take_summary(opcode, summary[first + HEAD.size : last])
        except DamagedError as damaged:
            self.stated = None
            self.losses.append(DataLoss("summary", start, max(0, at - start), reason=str(damaged)))
        return at

    def _take_summary(self, opcode: int, record: bytes) -> None:
        if opcode == Opcode.STATISTICS:
            fields = Fields(record)
            fields.numbers("QHIIIIQQ")
            counts = Fields(fields.block())
            self.stated = {}
            while (entry := counts.more("HQ")) is not None:
                self.stated[entry[0]] = entry[1]
        elif opcode == Opcode.ATTACHMENT_INDEX:
            fields = Fields(record)
            at, *_ = fields.numbers("QQQQQ")
            if at > self.size:
                raise DamagedError("it says that an attachment lies behind the end of the file")
            self.attachments[fields.text()] = at
        else:
            self.define(opcode, record)

    def _walk(self, stream: BinaryIO, stop: int, grows: bool = False) -> None:
        position = self._walked
        while position < stop and self._data_end is None:
            stream.seek(position)
            head = stream.read(MESSAGE_HEAD.itemsize)
            opcode, length = HEAD.unpack_from(head) if len(head) >= HEAD.size else (0, stop)
            end = position + HEAD.size + length
            if grows and end > stop:
                break
            try:
                if end > stop:
                    raise DamagedError("a record is not whole")
                self._take(stream, opcode, head, position, end)
            except DamagedError as damaged:
                end = self._lose(stream, position, end, stop, str(damaged))
            position = end
        self._walked = position

    def _lose(self, stream: BinaryIO, position: int, end: int, stop: int, reason: str) -> int:
        """Note what is lost at the position; returns where to go on."""
        span = None
        if not _is_record(stream, end, stop):
            end = records.find_chunk(stream, position + 1, stop)
        stream.seek(position)
        head = stream.read(HEAD.size + 16)
        if head[:1] == bytes([Opcode.CHUNK]) and len(head) == HEAD.size + 16:
            first, last = struct.unpack_from("<QQ", head, HEAD.size)
            span = (first, last)
        self._chunk = None
        cut = end == stop == self.size
        self.losses.append(
            DataLoss("cut" if cut else "damage", position, end - position, int(span is not None), span, reason)
        )
        return end

    def _take(self, stream: BinaryIO, opcode: int, head: bytes, position: int, end: int) -> None:
        """Note what the record at [position, end) says. Raises DamagedError."""
        body = position + HEAD.size
        stream.seek(body)
        if opcode == Opcode.MESSAGE:
            self._take_message(np.frombuffer(head.ljust(MESSAGE_HEAD.itemsize, b"\0"), MESSAGE_HEAD)[0], position, end)
        elif opcode == Opcode.CHUNK:
            self._take_chunk(records.chunk_head(stream.read(64), end - body), position, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._take_index(stream.read(6), body, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.define(opcode, stream.read(min(end - body, _LONGEST_DEFINITION + 1)))
        elif opcode == Opcode.HEADER:
            self.profile = Fields(stream.read(min(end - body, 1 << 10))).text()
        elif opcode == Opcode.ATTACHMENT:
            fields = Fields(stream.read(min(end - body, 1 << 16)))
            fields.numbers("QQ")
            self.attachments[fields.text()] = position
        elif opcode == Opcode.METADATA:
            Fields(stream.read(min(end - body, 1 << 16))).text()
        elif opcode == Opcode.DATA_END:
            (crc,) = Fields(stream.read(4)).numbers("I")
            self._data_end = position, crc
        elif opcode < _PRIVATE:
            raise DamagedError(f"a record of unknown kind {opcode}")

    def _take_chunk(self, head: records.ChunkHead, position: int, end: int) -> None:
        self._unpacked += head.size
        if self._unpacked > _SMALL_FILE + _LARGEST_RATIO * self.size:
            raise InputError(
                f"{self._name}: its chunks say that they unpack to over {self._unpacked >> 20} MiB, "
                f"{_LARGEST_RATIO} times the file; no recording of sensors does, it may be made to exhaust the memory"
            )
        self._chunk = Block(position, end, is_chunk=True, span=(head.first_ns, head.last_ns) if head.size else None)
        self.blocks.append(self._chunk)

    def _take_index(self, start: bytes, body: int, end: int) -> None:
        channel, length = Fields(start).numbers("HI")
        if body + 6 + length != end or length % 16:
            raise DamagedError("a message index of another size")
        if self._chunk is None or not length:
            return
        if channel in self._chunk.index_at:
            raise DamagedError("two message indexes of one channel")
        self._chunk.counts[channel] = length // 16
        self._chunk.index_at[channel] = body + 6

    def _take_message(self, message: np.void, position: int, end: int) -> None:
        """Put a message outside chunks into the last block, if it joins on and has room, else into a new one."""
        if message["length"] < records.AFTER_LENGTH:
            raise DamagedError("a message without its head")
        self._chunk = None
        block = self.blocks[-1] if self.blocks else None
        if block is None or block.is_chunk or block.end != position or position - block.start > _RAW_BLOCK:
            block = Block(position, position, is_chunk=False)
            self.blocks.append(block)
        block.end = end
        log_ns = int(message["log_ns"])
        first, last = block.span or (log_ns, log_ns)
        block.span = (min(first, log_ns), max(last, log_ns))
        channel = int(message["channel"])
        block.counts[channel] = block.counts.get(channel, 0) + 1

    def _finish(self, stream: BinaryIO, closed: bool) -> None:
        """Judge the end of the file, and the messages that have no checksum but the one over all data."""
        if closed:
            pass
        elif self._data_end is None and not any(loss.kind == "cut" for loss in self.losses):
            self.losses.append(DataLoss("cut", self.size, 0))
        elif self._data_end is not None:
            at = self._data_end[0] + HEAD.size + 4
            self.losses.append(
                DataLoss("summary", at, self.size - at, reason="the file ends in it or its footer is damaged")
            )
        raw = [block for block in self.blocks if not block.is_chunk]
        if not raw:
            return
        damaged = any(loss.kind == "damage" for loss in self.losses)
        if self._data_end is not None and self._data_end[1]:
            damaged = _crc(stream, self._data_end[0]) != self._data_end[1]
        if damaged:
            self.blocks = [block for block in self.blocks if block.is_chunk]
            size = sum(block.end - block.start for block in raw)
            reason = "messages outside chunks, whose only checksum is another"
            self.losses.append(DataLoss("damage", raw[0].start, size, reason=reason))


def _is_record(stream: BinaryIO, position: int, stop: int) -> bool:
    """Whether a record of the data section may begin there, or the section end."""
    if position >= stop:
        return position == stop
    stream.seek(position)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return False
    opcode, length = HEAD.unpack(head)
    return opcode in _IN_DATA and position + HEAD.size + length <= stop


def _crc(stream: BinaryIO, stop: int) -> int:
    """CRC-32 of the file up to a byte."""
    crc, left = 0, stop
    stream.seek(0)
    while left and (piece := stream.read(min(left, 1 << 20))):
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    return crc
