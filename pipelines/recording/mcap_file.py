"""MCAP files: the messages in them, as far as they are sound.

A damaged or unfinished file is read as far as checksums hold, and what is lost is noted; only positions stay in memory.
The message index after a chunk tells which topics the chunk holds and where. It is outside every checksum, so it is
believed only where it names every message of the chunk; else the chunk is walked.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import mcap_records as records
from alidade.pipelines.recording.container import Container, Rows
from alidade.pipelines.recording.data_loss import DataLoss, described
from alidade.pipelines.recording.mcap_index import Block, McapIndex
from alidade.pipelines.recording.mcap_records import (
    AFTER_LENGTH,
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    DamagedError,
    Fields,
    windows,
)

_LARGEST_ATTACHMENT = 1 << 26


class McapFile(Container):
    """An MCAP file, walked once; the file is opened again for every read.

    Raises InputError when there is no such file, when it is no MCAP, when it is hostile, and when nothing in it can be
    read; with `strict` also at the first loss.

    Attributes:
        profile: the recorder's.
        channels, schemas: definitions, by id.
        counts: channel -> messages in blocks not known to be damaged.
        losses: what cannot be used, as far as is known. A chunk that is damaged within is found when it is first read.
    """

    def __init__(self, path: Path, strict: bool = False, data: Path | None = None) -> None:
        self.path, self.data = path, data or path
        self._strict = strict
        self.counts: dict[int, int] = {}
        self._lost: dict[int, int] = {}
        with self._open() as stream:
            self._check_magic(stream)
            self._index = index = McapIndex(str(path))
            index.read(stream)
            self.profile, self.channels, self.schemas = index.profile, index.channels, index.schemas
            self.losses: list[DataLoss] = index.losses
            self._blocks = index.blocks
            for block in self._blocks:
                if block.is_chunk and not (block.index_at and block.index_at.keys() <= self.channels.keys()):
                    self._verify(stream, block)
            if self.losses or self._counted() != index.stated:
                for block in self._blocks:
                    if not block.is_lost:
                        self._verify(stream, block)
        undefined = {number: n for number, n in self._counted().items() if not self._defined(number)}
        if undefined:
            self.losses.append(DataLoss("definition", 0, sum(undefined.values())))
        self.counts = {number: n for number, n in self._counted().items() if number not in undefined}
        if strict or not self.counts:
            self._refuse()

    @property
    def size(self) -> int:
        """Of the file, bytes."""
        return self._index.size

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost, by the summary, or without one by the indexes of the damaged chunks."""
        lost = self._lost
        if self._index.stated is not None:
            lost = {number: n - self.counts.get(number, 0) for number, n in self._index.stated.items()}
        missing: dict[str, int] = {}
        for number, n in lost.items():
            if n > 0 and self._defined(number):
                missing[self.channels[number].topic] = missing.get(self.channels[number].topic, 0) + n
        return missing

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages of these channels, block by block in file order, every chunk checked against its CRC.

        Chunks that are damaged are left out and noted. Raises InputError at one when strict.
        """
        with self._open() as stream:
            for block in self._blocks:
                yield from self._block_rows(stream, block, channels & block.counts.keys())

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._index.attachments)

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """Content of the attachment of that name (the last one, if there are several), or None.

        One that is damaged raises InputError; if it is not needed, it is noted as a loss.
        """
        at = self._index.attachments.get(name)
        if at is None:
            return None
        with self._open() as stream:
            stream.seek(at)
            opcode, length = HEAD.unpack(stream.read(HEAD.size).ljust(HEAD.size, b"\0"))
            record = stream.read(min(length, _LARGEST_ATTACHMENT))
        try:
            if opcode != Opcode.ATTACHMENT or len(record) != length:
                raise DamagedError("it is no attachment, or too large to be one of alidade's")
            if int.from_bytes(record[-4:], "little") not in (0, zlib.crc32(record[:-4])):
                raise DamagedError("checksum")
            fields = Fields(record)
            fields.numbers("QQ")
            fields.text(), fields.text()
            return fields.block("Q")
        except DamagedError as damaged:
            if needed or self._strict:
                raise InputError(
                    f"{self.path}: the attachment {name} is damaged ({damaged}); a config can be given with --config"
                ) from damaged
            self.losses.append(DataLoss("attachment", at, length, reason=name))
            return None

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Sentences about what is lost, and when in a session that starts at start_ns, Unix ns."""
        return described(self.losses, self.missing, self.size, start_ns, duration_s)

    def _open(self) -> BinaryIO:
        try:
            return self.data.open("rb")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be opened ({error.strerror})") from error

    def _check_magic(self, stream: BinaryIO) -> None:
        start = stream.read(len(MAGIC))
        if not start:
            raise InputError(f"{self.path}: the file is empty; an MCAP recording is needed")
        if start != MAGIC:
            raise InputError(f"{self.path}: not an MCAP file, nor any other recording that is known")

    def _defined(self, number: int) -> bool:
        return number in self.channels and self.channels[number].schema_id in {0, *self.schemas}

    def _counted(self) -> dict[int, int]:
        """Channel -> messages in all blocks."""
        counts: dict[int, int] = {}
        for block in self._blocks:
            for number, n in block.counts.items():
                counts[number] = counts.get(number, 0) + n
        return counts

    def _refuse(self) -> None:
        """Raise InputError if anything is lost."""
        if self.losses or self.missing:
            raise InputError(
                f"{self.path}: {'; '.join(self.notes(None))}; "
                + ("--strict reads nothing that is damaged" if self.counts else "nothing in it can be read")
                + ": record again"
            )

    def _load(self, stream: BinaryIO, block: Block) -> NDArray[np.uint8]:
        """The records of a block: decompressed and checked, if it is a chunk. Raises DamagedError."""
        stream.seek(block.start + HEAD.size if block.is_chunk else block.start)
        data = stream.read(block.end - stream.tell())
        return records.unpack(data) if block.is_chunk else np.frombuffer(data, np.uint8)

    def _locate(
        self, stream: BinaryIO, block: Block, buffer: NDArray[np.uint8]
    ) -> tuple[dict[int, NDArray[np.int64]], list[tuple[int, bytes]]]:
        """Channel -> where its messages begin in the buffer; with the records.walk that there may have to be."""
        index = {}
        for number, at in block.index_at.items():
            stream.seek(at)
            entries = np.frombuffer(stream.read(16 * block.counts[number]), "<u8")
            index[number] = np.sort(entries[1::2].astype(np.int64), kind="stable")
        return (index, []) if index and records.is_whole_index(buffer, index) else records.walk(buffer)

    def _verify(self, stream: BinaryIO, block: Block) -> None:
        """Read a block: count its messages, take the definitions in it if need be."""
        try:
            offsets, others = self._locate(stream, block, self._load(stream, block))
            if block.index_at and not block.index_at.keys() <= self.channels.keys():
                _, others = records.walk(self._load(stream, block))
            for opcode, record in others:
                self._index.define(opcode, record)
        except DamagedError as damaged:
            self._lose(block, damaged)
            return
        counts = {number: len(found) for number, found in offsets.items()}
        if counts != block.counts:
            block.counts, block.index_at = counts, {}

    def _block_rows(self, stream: BinaryIO, block: Block, wanted: set[int]) -> list[Rows]:
        """The messages of these channels in a block; none if it is damaged."""
        if not wanted:
            return []
        try:
            buffer = self._load(stream, block)
            offsets, _ = self._locate(stream, block, buffer)
            if any(len(offsets.get(number, ())) != n for number, n in block.counts.items()):
                raise DamagedError("its message index is wrong")
        except DamagedError as damaged:
            self._lose(block, damaged)
            return []
        return [_rows(number, buffer, offsets[number]) for number in sorted(wanted)]

    def _lose(self, block: Block, damaged: DamagedError) -> None:
        """Leave out a block from now on."""
        for number, n in block.counts.items():
            self._lost[number] = self._lost.get(number, 0) + n
            if number in self.counts:
                self.counts[number] -= n
        block.counts, block.index_at, block.is_lost = {}, {}, True
        self.losses.append(DataLoss("damage", block.start, block.end - block.start, 1, block.span, str(damaged)))
        if self._strict:
            self._refuse()


def _rows(number: int, buffer: NDArray[np.uint8], offsets: NDArray[np.int64]) -> Rows:
    heads = windows(buffer, MESSAGE_HEAD.itemsize)[offsets].view(MESSAGE_HEAD)
    size = heads["length"].astype(np.int64) - AFTER_LENGTH
    return Rows(number, buffer, offsets + MESSAGE_HEAD.itemsize, size, heads["log_ns"].astype(np.int64))
