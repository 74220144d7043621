"""Files that belong together, written whole or not at all.

Processes that write into one folder wait for each other: the files there are those of one of them, never of two. A
command that finds the results of another that ended first leaves them with a message. A process that is killed leaves
those of before, or none.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import replacing

# Of a file: its text or bytes, a function that writes it to a path, or None where there is none.
Content = str | bytes | Callable[[Path], None] | None

# Others are waited for so long, s: pages and tables are made in a few seconds. Looked at so often, s.
_PATIENCE_S, _GLANCE_S = 60.0, 0.02
_PART = ".alidade."
# Folder -> when a command of this process claimed it, or wrote there last, Unix ns.
_claimed: dict[Path, int] = {}


def write_whole(out_dir: Path, contents: Mapping[str, Content]) -> tuple[Path, ...]:
    """Write files that belong together; returns the paths of those that have a content.

    They are made in a folder of their own and moved at the end. Files of earlier ones are replaced, or removed where
    there is no content now; others in out_dir stay.

    Args:
        out_dir: where they go.
        contents: by name, in the order in which they take their places; the last, gone first and back last, says that
            the others are its own, and always has a content.

    Raises:
        InputError: out_dir is a file, cannot be written to, another process does not come to an end there, or has
            written there since this one claimed the folder (`require_room`).
    """
    new, names = not out_dir.exists(), list(contents)
    try:
        with _alone(out_dir):
            for left in out_dir.glob(f"{_PART}*"):  # of processes that were killed: nobody else is here
                shutil.rmtree(left, ignore_errors=True)
            part = Path(tempfile.mkdtemp(prefix=_PART, dir=out_dir))
            try:
                for name, content in contents.items():
                    _write(part / name, content)
                return _move(part, out_dir, names)
            finally:
                shutil.rmtree(part, ignore_errors=True)
                if new and not (out_dir / names[-1]).exists():
                    shutil.rmtree(out_dir, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{out_dir}: the results cannot be written ({error.strerror})") from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a folder, made if need be, for this process, with which the lock ends. Raises InputError."""
    patience = time.monotonic() + _PATIENCE_S
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise InputError(f"{folder}: no folder to write results to ({error.strerror})") from error
        try:
            if _locked(lock, patience, folder):
                yield
                return
        finally:
            os.close(lock)


def _locked(lock: int, patience: float, folder: Path) -> bool:
    """Whether the lock is acquired, and the locked folder is still the one with this name."""
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > patience:
                raise InputError(f"{folder}: another process is writing its results there; give another") from error
            time.sleep(_GLANCE_S)
            continue
        except OSError:  # a file system without locks
            return True
        return folder.exists() and os.path.samestat(os.fstat(lock), folder.stat())


def require_room(out_dir: Path | None) -> None:
    """Claim a folder before the work whose results are written there. Raises InputError if it is not writable."""
    if out_dir is None:
        return
    _claimed[out_dir.absolute()] = time.time_ns()
    there = next(folder for folder in (out_dir, *out_dir.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise InputError(f"{out_dir}: no folder to write results to ({there} is no folder)")
    if not os.access(there, os.W_OK):
        raise InputError(f"{out_dir}: no folder to write results to ({there} may not be written to)")


def write_file(path: Path, content: str | bytes) -> None:
    """Write a single file, whole or not at all. Raises InputError when it cannot be written."""
    data = content if isinstance(content, bytes) else content.encode()
    if path.exists() and not path.is_file():  # a pipe, a terminal
        try:
            path.write_bytes(data)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
        return
    with replacing(path) as stream:
        stream.write(data)


def _write(path: Path, content: Content) -> None:
    if callable(content):
        content(path)
    elif content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _move(part: Path, out_dir: Path, names: Sequence[str]) -> tuple[Path, ...]:
    last, claimed = out_dir / names[-1], _claimed.get(out_dir.absolute())
    if claimed is not None and last.exists() and last.stat().st_mtime_ns > claimed:
        raise InputError(
            f"{out_dir}: another process has written its results there since this one began; those of this one are "
            "not written: give another folder"
        )
    for name in reversed(names):  # all of them, the last first: at no time do files of two writers stand together
        (out_dir / name).unlink(missing_ok=True)
    made = [name for name in names if (part / name).exists()]
    for name in made:
        os.replace(part / name, out_dir / name)
    if claimed is not None:
        _claimed[out_dir.absolute()] = last.stat().st_mtime_ns
    return tuple(out_dir / name for name in made)
