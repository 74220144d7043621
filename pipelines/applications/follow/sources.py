"""Sources of a recording that is being made: a file or folder that another process writes, or a stream.

Streams are written down as they come (`Spool`), so that all sources look alike: files that grow.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import BinaryIO

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import require_regular
from alidade.pipelines.recording.mcap_records import MAGIC
from alidade.pipelines.recording.opening import Where, is_closed, parts_in
from alidade.pipelines.recording.recording import open_recording

_PIECE = 1 << 16
# A replay writes so often, s, and no less than so many bytes.
_REPLAY_PERIOD_S, _REPLAY_PIECE = 0.05, 1 << 10
# Names of the files in which a stream is written down.
_PART = re.compile(r"live_(\d+)\.mcap")


class Source(AbstractContextManager["Source"]):
    """Recording that may still be written: a file, or a folder of its parts, which may not exist yet.

    Attributes:
        path: of the file or the folder.
        name: what it is called in sentences.
        is_kept: whether its files stay: results name the file, else the source.
    """

    is_kept = True

    def __init__(self, path: Path, name: str | None = None) -> None:
        self.path, self.name = path, name or str(path)

    @property
    def parts(self) -> list[Path]:
        """Files of the recording so far, in order, without empty ones. Raises InputError for several recordings."""
        if not self.path.is_dir():
            return [self.path] if _size(self.path) else []
        return [p for p in parts_in(self.path) if _size(p)]

    @property
    def where(self) -> Where:
        """Files or folder to pass to `open_recording`."""
        return self.path if self.is_finished or not self.path.is_dir() else self.parts

    @property
    def size(self) -> int:
        """Size of all parts, bytes; 0 when there is nothing yet."""
        return sum(map(_size, self.parts))

    @property
    def is_finished(self) -> bool:
        """Whether the recording is closed: its last file has the closing mark, a folder also its metadata.yaml."""
        parts = self.parts
        try:
            closed = bool(parts) and is_closed(parts[-1])
        except OSError:  # gone since, or no more files may be opened: no way to know
            return False
        return closed and (not self.path.is_dir() or (self.path / "metadata.yaml").is_file())

    def named(self, sentence: str) -> str:
        """Return a sentence with the source's name in place of those of its temporary files."""
        for file in () if self.is_kept else self.parts:
            sentence = sentence.replace(str(file), self.name)
        return sentence

    def __exit__(self, *_: object) -> None:
        """Do nothing: another process writes the recording."""


class Stream(Source):
    """Source of messages that arrive as a stream, stored in a folder: a file for each run, so that later runs go on.

    Args:
        name: what it is called.
        folder: where to; None: a temporary one.
        say: called with what goes wrong.

    Raises InputError when the folder cannot be made.
    """

    def __init__(self, name: str, folder: Path | None, say: Callable[[str], None]) -> None:
        self._stack, self._say = ExitStack(), say
        self._ended = threading.Event()
        self.is_kept = folder is not None
        try:
            if folder is None:
                folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="alidade-")))
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder or 'TMPDIR'}: {name} cannot be written down there ({error.strerror}); give another --record"
            ) from error
        super().__init__(folder, name)
        numbers = (int(found[1]) for file in folder.iterdir() if (found := _PART.fullmatch(file.name)))
        self._file = folder / f"live_{max(numbers, default=-1) + 1:04d}.mcap"
        self._over = threading.Event()

    @property
    def is_finished(self) -> bool:
        """Whether the stream has ended."""
        return self._ended.is_set()

    @property
    def where(self) -> Where:
        """Files that the stream has been written to."""
        return self.parts

    def __enter__(self) -> Stream:
        threading.Thread(target=self._run, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._ended.wait(2.0)
        self._stack.close()

    def _run(self) -> None:
        spool = Spool(self._file, self._say)
        try:
            self._write(spool)
        except Exception as error:  # nobody else would say it
            self._say(f"{self.name}: no more is read ({type(error).__name__}: {' '.join(str(error).split())})")
        finally:
            spool.close()
            self._ended.set()

    def _write(self, out: Spool) -> None:
        """Write arriving messages to a spool until the stream ends or `_over` is set."""
        raise NotImplementedError


class StandardInput(Stream):
    """Source of an MCAP file on standard input."""

    def __init__(self, folder: Path | None, stream: BinaryIO | None = None, say: Callable[[str], None] = print) -> None:
        super().__init__("standard input", folder, say)
        self._stream = stream or sys.stdin.buffer

    def _write(self, out: Spool) -> None:
        read = getattr(self._stream, "read1", self._stream.read)
        while not self._over.is_set() and (piece := read(_PIECE)):
            out.write(piece)
            out.flush()
            while out.is_full and not self._over.is_set():  # whoever writes into the pipe waits
                time.sleep(RETRY_PERIOD_S)
                out.flush()


class Replay(Stream):
    """Source that copies a finished MCAP file as fast as it was recorded, so that the copy grows as a live one does.

    Args:
        path: of the file.
        speed: how many times as fast.
        folder: where it is written; None: a temporary one.
        say: called with what goes wrong.

    Raises:
        InputError: it is no MCAP file, or the speed is not above zero.
    """

    def __init__(self, path: Path, speed: float, folder: Path | None, say: Callable[[str], None]) -> None:
        if not speed > 0.0:
            raise InputError(f"--speed {speed:g}: has to be above 0")
        self._seconds = open_recording(path).duration_s / speed
        self._content = path.read_bytes() if path.is_file() else b""
        if not self._content.startswith(MAGIC):
            raise InputError(f"--replay {path}: is no MCAP file; `follow` takes folders while they are being written")
        super().__init__(path.name, folder, say)

    def _write(self, out: Spool) -> None:
        start, content = time.monotonic(), memoryview(self._content)
        pieces = max(1, min(-(-len(content) // _REPLAY_PIECE), round(self._seconds / _REPLAY_PERIOD_S)))
        size = -(-len(content) // pieces)
        for i in range(pieces):
            due = start + self._seconds * (i + 1) / pieces
            if self._over.wait(max(0.0, due - time.monotonic())):
                return
            out.write(content[i * size : (i + 1) * size])
            out.flush()


def source_of(what: str, folder: Path | None = None, say: Callable[[str], None] = print) -> Source:
    """Return the source of a name: a path, `-` for standard input, ws:// of a Foxglove WebSocket bridge.

    Args:
        what: its name.
        folder: where streams are kept; None: nowhere.
        say: called with connections and their failures.

    Raises:
        InputError: a folder cannot be written, a library is not installed, or what is there is a device or a pipe.
    """
    if what == "-":
        return StandardInput(folder, say=say)
    if what.startswith(("ws://", "wss://")):
        from alidade.pipelines.applications.follow.bridge import Bridge

        return Bridge(what, folder, say)
    if "://" in what:
        raise InputError(f"{what}: only ws:// and wss:// addresses are followed")
    if folder is not None:
        raise InputError(f"--record {folder}: {what} is kept as it is; what arrives by ws:// or - is recorded")
    path = Path(what)
    if path.exists() and not path.is_dir():
        require_regular(path)
    return Source(path)


def _size(path: Path) -> int:
    """Return the size of a file, bytes; 0 if there is none yet, or one shorter than its opening mark."""
    try:
        size = path.stat().st_size
    except OSError:
        return 0
    return size if size >= len(MAGIC) else 0


# What may wait for room, bytes: an hour of numbers at 1 kHz.
MAX_WAITING_BYTES = 1 << 28
# A disk without room is tried again after this, s.
RETRY_PERIOD_S = 0.5


class Spool:
    """File for a stream, buffered in memory while the disk is full; created with the first bytes.

        spool.write(record)        # kept in memory
        spool.flush()              # on the disk, whole, or still in memory

    What does not fit waits in memory and is tried again: readers of the file find whole pieces, in order, and at the
    end everything if there is room by then. A disk that is full costs nothing but time until MAX_WAITING_BYTES wait.

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
        self.dropped = 0  # records lost for want of room

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
