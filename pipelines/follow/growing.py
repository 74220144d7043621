"""MCAP files that another process is still writing."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from pipelines.errors import InputError
from pipelines.sessions.container import MAGIC, McapFile
from pipelines.sessions.reading import Recording

_HEAD = 9  # bytes of opcode and length before a record


class GrowingRecording(Recording):
    """What there is of a recording that is still being written: whole records, without a summary."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = _GrowingFile(path)
        self.topics = self._list_topics()


class _GrowingFile(McapFile):
    def _walk(self, stream: BinaryIO) -> None:
        """As far as there are whole records."""
        try:
            super()._walk(stream)
        except InputError:
            if self._whole(stream):
                raise

    def _whole(self, stream: BinaryIO) -> bool:
        """Whether the damage is not at the end, where a record may still be being written."""
        size = stream.seek(0, 2)
        position = len(MAGIC)
        while position + _HEAD <= size:
            stream.seek(position)
            head = stream.read(_HEAD)
            position += _HEAD + int.from_bytes(head[1:], "little")
            if head[0] == Opcode.FOOTER:
                return position + len(MAGIC) <= size
        return False


def is_finished(path: Path) -> bool:
    """Whether the file has its closing mark."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        if size < 2 * len(MAGIC):
            return False
        stream.seek(size - len(MAGIC))
        return stream.read() == MAGIC


def size_of(path: Path) -> int:
    """In bytes; 0 when there is no such file yet."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
