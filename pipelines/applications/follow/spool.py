"""File for a stream, buffered in memory while the disk is full.

    spool = Spool(path, say)
    spool.write(record)        # kept in memory
    spool.flush()              # on the disk, whole, or still in memory

What does not fit waits in memory and is tried again: readers of the file find whole pieces, in order, and at the end
everything if there is room by then. A disk that is full costs nothing but time until MAX_WAITING_BYTES wait.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

# What may wait for room, bytes: an hour of numbers at 1 kHz.
MAX_WAITING_BYTES = 1 << 28
# A disk without room is tried again after this, s.
RETRY_PERIOD_S = 0.5


class Spool:
    """File that grows by bytes in memory whenever its disk has room; created with the first bytes.

    Args:
        path: of the file.
        say: called when there is no room, and when there is again.
    """

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self._path, self._say = path, say
        self._file: int | None = None
        self._waiting = bytearray()
        self._end = 0  # of what is on the disk
        self._due: float | None = None  # when to try again, while there is no room
        self.dropped = 0

    @property
    def is_full(self) -> bool:
        """Whether the buffer in memory is full."""
        return len(self._waiting) > MAX_WAITING_BYTES

    def write(self, data: bytes | memoryview) -> int:
        """Buffer a part of a record; the next `flush` may write it to the disk."""
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        """Return the position: bytes written so far, on the disk or in the buffer."""
        return self._end + len(self._waiting)

    def drop(self) -> None:
        """Count a record that is lost for want of room."""
        self.dropped += 1

    def flush(self, at_once: bool = False) -> None:
        """Write the buffer to the disk if there is room; call between records, to write whole ones alone."""
        if not self._waiting or (self._due is not None and time.monotonic() < self._due and not at_once):
            return
        try:
            self._append()
        except OSError as error:
            self._fail(error)
            return
        if self._due is not None:
            self._due = None
            lost = f"{self.dropped} messages are lost" if self.dropped else "nothing is lost"
            self._say(f"{self._path}: written again, {lost}")

    def close(self) -> None:
        """Flush to the disk as far as there is room, and close the file."""
        self.flush(at_once=True)
        if self._waiting:
            self._say(f"{self._path}: the last {len(self._waiting)} bytes are lost, there is no room for them")
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _append(self) -> None:
        if self._file is None:
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        at, left = self._end, memoryview(bytes(self._waiting))
        while left:
            written = os.pwrite(self._file, left, at)
            at, left = at + written, left[written:]
        self._end = at
        self._waiting.clear()

    def _fail(self, error: OSError) -> None:
        """Remove what was written in part, so that the file ends with a whole record; try again later."""
        if self._file is not None:
            os.ftruncate(self._file, self._end)
        if self._due is None:
            self._say(f"{self._path}: cannot be written ({error.strerror}): what comes waits in memory, trying again")
        self._due = time.monotonic() + RETRY_PERIOD_S
