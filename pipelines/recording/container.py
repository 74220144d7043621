"""Containers of raw messages, for every file format: bytes block by block, and losses.

A container knows no message type: `decoding.py` makes numbers of the bytes. A part of a file that cannot be used is a
`DataLoss`, not an error; `require_complete` makes one of it.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import zstandard
from numpy.typing import ArrayLike, NDArray

from alidade.pipelines.errors import InputError

# Bound of a message that was compressed by itself, bytes: no message of a sensor is larger.
MAX_MESSAGE_BYTES = 1 << 26
# Times that damaged bytes state are plausible within this of the recording, s.
MAX_TIME_OUTSIDE_S = 3600.0
# Channel and schema ids of part i of a recording are offset by i times this.
_ID_RANGE = 1 << 32

_Key = TypeVar("_Key", int, str)
LossKind = Literal["cut", "damage", "summary", "definition", "attachment"]


class Schema(NamedTuple):
    """Definition of a message type."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic and the encoding of its messages."""

    id: int
    topic: str
    message_encoding: str
    schema_id: int


class MessageBlock(NamedTuple):
    """Messages of one channel: message i is buffer[start[i]:start[i] + size[i]], logged at log_ns[i] (Unix ns)."""

    channel: int
    buffer: NDArray[np.uint8]
    start: NDArray[np.int64]
    size: NDArray[np.int64]
    log_ns: NDArray[np.int64]

    @classmethod
    def pack(cls, channel: int, messages: Sequence[bytes], log_ns: ArrayLike) -> MessageBlock:
        """Return a block of messages of one channel, copied side by side into one buffer."""
        size = np.array([len(message) for message in messages], dtype=np.int64)
        buffer = np.frombuffer(b"".join(messages), np.uint8)
        return cls(channel, buffer, np.cumsum(size) - size, size, np.asarray(log_ns, dtype=np.int64))

    def message(self, i: int) -> bytes:
        """Bytes of message i."""
        return self.buffer[self.start[i] : self.start[i] + self.size[i]].tobytes()


def byte_windows(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """All windows of `width` bytes of a buffer, as an overlapping array (n,) without a copy."""
    shape = (max(0, len(buffer) - width + 1),)
    return np.ndarray(shape, dtype=f"V{width}", buffer=buffer, strides=(1,))


@dataclass(frozen=True)
class DataLoss:
    """A part of a file that cannot be used.

    Attributes:
        kind: cut: the file ends too early; damage: damaged bytes; summary: the summary after the data is missing or
            damaged, which loses no message; definition: messages of undefined channels; attachment: a damaged one.
        at: first byte.
        size: bytes; of `definition` messages.
        chunks: number of chunks known to be in it.
        span: log times of the first and the last message, Unix ns, as the file states them; None: unknown.
        reason: cause, as a part of a sentence; of `attachment` its name.
    """

    kind: LossKind
    at: int
    size: int
    chunks: int = 0
    span: tuple[int, int] | None = None
    reason: str = ""


class Container(ABC):
    """Base of the recordings' files: messages by channel.

    Attributes:
        path: file or folder as the user named it.
        data: file that is read: another one where `path` is compressed.
        size: bytes of `data`.
        channels, schemas: definitions, by id.
        counts: channel -> number of readable messages, as far as is known.
        losses: parts that cannot be used; complete when all blocks have been read.
        assumptions: sentences about what was assumed.
        incomplete: sentences about parts that are not there at all.
        message_compression: whether each message is a zstd frame (rosbag2's `compression_mode: message`).
        temporary: temporary files that live as long as the container.
    """

    size = 0
    assumptions: Sequence[str] = ()
    incomplete: Sequence[str] = ()
    message_compression = False
    temporary: object = None

    def __init__(self, path: Path, data: Path | None = None) -> None:
        self.path, self.data = path, data or path
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.counts: dict[int, int] = {}
        self.losses: list[DataLoss] = []
        self.lost_messages: dict[int, int] = {}  # channel -> messages known to be lost

    @abstractmethod
    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Messages of these channels as they are stored, in file order."""

    def blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Messages of these channels, block by block in file order.

        Raises InputError at a damaged message where each is compressed by itself.
        """
        found = self._read_blocks(channels)
        return map(self._decompressed, found) if self.message_compression else found

    def first_blocks(self, channels: Iterable[int]) -> dict[int, MessageBlock]:
        """The first block of each of the channels that have messages."""
        found = {number: next(self.blocks({number}), None) for number in channels if self.counts.get(number)}
        return {number: block for number, block in found.items() if block is not None}

    @property
    def first_log_ns(self) -> int:
        """Least log time of the first blocks of all channels, Unix ns; 0 without messages."""
        return min((int(block.log_ns.min()) for block in self.first_blocks(self.channels).values()), default=0)

    def is_defined(self, channel: int) -> bool:
        """Whether the file defines a channel, and its schema if the channel refers to one."""
        return channel in self.channels and self.channels[channel].schema_id in {0, *self.schemas}

    def set_counts(self, counts: Mapping[int, int]) -> None:
        """Count the messages of defined channels as readable, those of others as lost."""
        self.counts = {number: n for number, n in counts.items() if self.is_defined(number)}
        undefined = sum(counts.values()) - sum(self.counts.values())
        if undefined:
            self.losses.append(DataLoss("definition", 0, undefined))

    @property
    def missing(self) -> dict[str, int]:
        """Number of messages known to be lost, by topic."""
        lost = ((number, n) for number, n in self.lost_messages.items() if n > 0 and self.is_defined(number))
        return total({self.channels[number].topic: n} for number, n in lost)

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Return a sentence about each kind of loss, with its time in a session that starts at start_ns, Unix ns.

        A start of None leaves out when the losses are; `duration_s` is the length of the session.
        """
        missing = self.missing
        messages = f"; messages lost: {', '.join(f'{n} of {topic}' for topic, n in missing.items())}" if missing else ""
        notes = []
        damaged = [loss for loss in self.losses if loss.kind == "damage"]
        if damaged:
            size, chunks = sum(loss.size for loss in damaged), sum(loss.chunks for loss in damaged)
            what = f"{chunks} {'chunk' if chunks == 1 else 'chunks'}, " if chunks else ""
            where = f": {what}{size} of {self.size} bytes from byte {damaged[0].at} on cannot be used" if size else ""
            reason = damaged[0].reason if size else ", ".join(dict.fromkeys(loss.reason for loss in damaged))
            notes.append(f"the recording is damaged{where} ({reason}){_when(damaged, start_ns, duration_s)}{messages}")
            messages = ""
        for loss in self.losses:
            if loss.kind == "cut":
                lost = f", the last {loss.size} of {self.size} bytes cannot be used" if loss.size else ""
                when = _when([loss], start_ns, duration_s)
                notes.append(f"the recording is truncated: it ends without its closing records{lost}{when}{messages}")
                messages = ""
            elif loss.kind == "summary":
                notes.append(
                    f"the recording's summary at byte {loss.at} cannot be used ({loss.reason}); no message is in it"
                )
            elif loss.kind == "attachment":
                notes.append(f"the attachment {loss.reason} is damaged and not used")
        undefined = sum(loss.size for loss in self.losses if loss.kind == "definition")
        if undefined:
            notes.append(
                f"the recording is damaged: {undefined} messages cannot be read, it does not define their channel"
            )
        if messages:
            notes.append(f"the recording has fewer messages than it says{messages}")
        return tuple(notes)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return ()

    def attachment(self, name: str, needed: bool = True) -> bytes | None:  # noqa: ARG002
        """Content of an attachment, None if there is none.

        A damaged one raises InputError if it is needed; otherwise it is noted as a loss.
        """
        return None

    def sha256(self) -> str:
        """SHA-256 of the file, hexadecimal; of several files that of their own digests, in order."""
        return file_sha256(self.path)

    def require_readable(self) -> None:
        """Raise InputError if parts of the file are lost and no readable message is left."""
        if not self.counts and (self.losses or self.missing):
            raise InputError(f"{self.path}: {'; '.join(self.notes(None))}; nothing in it can be read: record again")

    def require_complete(self) -> None:
        """Read the whole file once; raise InputError if any part or message of the file is lost."""
        for _ in self.blocks(set(self.channels)):
            pass
        for name in self.attachments:
            self.attachment(name)
        lost = [*self.incomplete, *(self.notes(None) if self.losses or self.missing else ())]
        if lost:
            raise InputError(f"{self.path}: {'; '.join(lost)}; --strict reads nothing that is damaged: record again")

    def _decompressed(self, block: MessageBlock) -> MessageBlock:
        decompressor, messages = zstandard.ZstdDecompressor(), []
        try:
            for message in map(block.message, range(len(block.start))):
                if (size := zstandard.frame_content_size(message)) > MAX_MESSAGE_BYTES:
                    raise ValueError(f"it says that it holds {size} bytes")
                messages.append(decompressor.decompress(message, max_output_size=MAX_MESSAGE_BYTES))
        except (zstandard.ZstdError, MemoryError, ValueError) as error:
            topic = self.channels[block.channel].topic
            raise InputError(f"{self.path}: topic {topic}: a compressed message is damaged ({error})") from error
        return MessageBlock.pack(block.channel, messages, block.log_ns)


class MultiPartContainer(Container):
    """Several files as one recording: parts of a bag that was split, or files recorded side by side.

    The parts are read in the order of their first messages; `path` is their folder, or the first of them.
    """

    def __init__(self, path: Path, parts: Sequence[Container]) -> None:  # counts and losses are those of the parts
        self.path = self.data = path
        self.parts = sorted(parts, key=lambda part: part.first_log_ns)
        self.assumptions = self._named("assumptions")
        self.incomplete = self._named("incomplete")
        self.channels, self.schemas = {}, {}
        for i, part in enumerate(self.parts):
            at = i * _ID_RANGE
            for number, channel in part.channels.items():
                self.channels[at + number] = channel._replace(id=at + number, schema_id=at + channel.schema_id)
            self.schemas |= {at + number: schema for number, schema in part.schemas.items()}

    @property
    def counts(self) -> dict[int, int]:  # type: ignore[override]
        """Number of readable messages of each channel, as far as it is known."""
        return {i * _ID_RANGE + number: n for i, part in enumerate(self.parts) for number, n in part.counts.items()}

    @property
    def losses(self) -> list[DataLoss]:  # type: ignore[override]
        """Losses of all parts."""
        return [loss for part in self.parts for loss in part.losses]

    @property
    def missing(self) -> dict[str, int]:
        """Number of messages known to be lost, by topic."""
        return total(part.missing for part in self.parts)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.attachments))

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """Return the content of the attachment of that name, from the first part that has one."""
        for part in self.parts:
            if name in part.attachments:
                return part.attachment(name, needed)
        return None

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        for i, part in enumerate(self.parts):
            own = {number - i * _ID_RANGE for number in channels if number // _ID_RANGE == i}
            for block in part.blocks(own) if own else ():
                yield block._replace(channel=i * _ID_RANGE + block.channel)

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Return the sentences about losses of all parts, each after the name of its part."""
        notes = (f"{part.path.name}: {note}" for part in self.parts for note in part.notes(start_ns, duration_s))
        return tuple(notes)

    def sha256(self) -> str:
        """SHA-256 of the parts' own digests (their 32 bytes each), in the order of the parts."""
        return combined_sha256(part.sha256() for part in self.parts)

    def _named(self, attribute: str) -> tuple[str, ...]:
        return tuple(f"{part.path.name}: {sentence}" for part in self.parts for sentence in getattr(part, attribute))


def total(counts: Iterable[Mapping[_Key, int]]) -> dict[_Key, int]:
    """Return the sum, key by key, of several mappings of counts."""
    found = Counter[_Key]()
    for each in counts:
        found.update(each)
    return dict(found)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def combined_sha256(digests: Iterable[str]) -> str:
    """SHA-256 of several digests (their 32 bytes each), in order, hexadecimal."""
    return hashlib.sha256(b"".join(map(bytes.fromhex, digests))).hexdigest()


def require_distinct(recordings: Iterable[tuple[str, str]]) -> None:
    """Raise InputError if two recordings, each a name and a SHA-256, are the same."""
    seen: set[str] = set()
    for name, sha256 in recordings:
        if sha256 in seen:
            raise InputError(f"{name}: the same recording is named twice; it would count twice")
        seen.add(sha256)


def _when(losses: Sequence[DataLoss], start_ns: int | None, duration_s: float) -> str:
    """Return a phrase with the time span of losses, s from the session's start; empty if unknown or implausible."""
    if start_ns is None:
        return ""
    spans = [loss.span for loss in losses if loss.span is not None]
    times = [((a - start_ns) * 1e-9, (b - start_ns) * 1e-9) for a, b in spans if a <= b]
    near = [(a, b) for a, b in times if a > -MAX_TIME_OUTSIDE_S and b < duration_s + MAX_TIME_OUTSIDE_S]
    if not near:
        return ""
    return f", between {min(a for a, _ in near):.3f} and {max(b for _, b in near):.3f} s"
