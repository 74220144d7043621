"""What holds messages: a file, or several. Whatever the form, messages come as bytes, channel by channel.

A container knows no message type; alidade.pipelines.recording.message_reader makes numbers of the bytes.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.pipelines.recording.data_loss import DataLoss


class Schema(NamedTuple):
    """How messages are defined."""

    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic and how its messages are encoded."""

    id: int
    topic: str
    message_encoding: str
    schema_id: int


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


def rows_of(channel: int, messages: Sequence[bytes], log_ns: ArrayLike) -> Rows:
    """Messages side by side in one buffer."""
    size = np.array([len(message) for message in messages], dtype=np.int64)
    buffer = np.frombuffer(b"".join(messages), np.uint8)
    return Rows(channel, buffer, np.cumsum(size) - size, size, np.asarray(log_ns, dtype=np.int64))


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_together(digests: Iterable[str]) -> str:
    """SHA-256 of several digests (their 32 bytes each), in order, hexadecimal."""
    whole = hashlib.sha256()
    for digest in digests:
        whole.update(bytes.fromhex(digest))
    return whole.hexdigest()


class Container(ABC):
    """Messages by channel, and what is known to be lost of them.

    Attributes:
        path: of the file or folder, as it was named.
        data: the file that is read: another one where `path` is compressed.
        profile: the recorder's, `ros2` for ROS 2.
        channels, schemas: definitions, by id.
        counts: channel -> messages that can be read, as far as is known.
        losses: what cannot be used; complete when everything has been read.
        remarks: sentences about what was assumed, or is not there beside what was named.
    """

    path: Path
    data: Path
    profile: str
    channels: Mapping[int, Channel]
    schemas: Mapping[int, Schema]
    counts: Mapping[int, int]
    losses: Sequence[DataLoss]
    remarks: Sequence[str] = ()
    unpacked: object = None  # a temporary file that lives as long as its container

    @abstractmethod
    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages of these channels, block by block in the order of the file."""

    @abstractmethod
    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Sentences about what is lost, and when in a session that starts at start_ns, Unix ns."""

    @property
    def first_log_ns(self) -> int:
        """Log time of the first messages, Unix ns; 0 if there are none."""
        for rows in self.rows(set(self.channels)):
            return int(rows.log_ns.min())
        return 0

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost."""
        return {}

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return ()

    def attachment(self, name: str, needed: bool = True) -> bytes | None:  # noqa: ARG002
        """The attachment of that name, None if there is none. One that is damaged and needed raises InputError."""
        return None

    def sha256(self) -> str:
        """SHA-256 of the file, hexadecimal; of several files that of their own digests, in order."""
        return sha256_of(self.path)
