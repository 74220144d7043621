"""Files that belong together, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from alidade.pipelines.errors import InputError


def write_whole(out_dir: Path, names: Sequence[str], make: Callable[[Path], None]) -> tuple[Path, ...]:
    """Files as `make` writes them into the folder it is given; returns their paths in out_dir.

    They are made in a folder of their own and moved at the end. Files of earlier ones are replaced, or removed when
    none of that name was made; others in out_dir stay.

    Args:
        out_dir: where they go.
        names: in the order in which they take their places; the last, gone first and back last, says that the others
            are its own, and is always made.
        make: writes the files.

    Raises:
        InputError: out_dir is a file, or cannot be written to.
    """
    new = not out_dir.exists()
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=".alidade.", dir=out_dir))
    except OSError as error:
        raise InputError(f"{out_dir}: no folder to write results to ({error.strerror})") from error
    try:
        make(part)
        return _move(part, out_dir, names)
    except OSError as error:
        raise InputError(f"{out_dir}: the results cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if new and not (out_dir / names[-1]).exists():
            shutil.rmtree(out_dir, ignore_errors=True)


def require_room(out_dir: Path | None) -> None:
    """Tell before the work that results could not be written after it. Raises InputError."""
    if out_dir is None:
        return
    there = next(folder for folder in (out_dir, *out_dir.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise InputError(f"{out_dir}: no folder to write results to ({there} is no folder)")
    if not os.access(there, os.W_OK):
        raise InputError(f"{out_dir}: no folder to write results to ({there} may not be written to)")


def write_page(out_dir: Path, name: str, text: str) -> Path:
    """One page of text; returns its path. Raises InputError when it cannot be written."""
    (path,) = write_whole(out_dir, [name], lambda folder: _write(folder / name, text))
    return path


def write_file(path: Path, content: str | bytes) -> None:
    """A file that belongs to nothing else. Raises InputError when it cannot be written."""
    try:
        _write(path, content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def _write(path: Path, content: str | bytes) -> None:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _move(part: Path, out_dir: Path, names: Sequence[str]) -> tuple[Path, ...]:
    (out_dir / names[-1]).unlink(missing_ok=True)
    written = []
    for name in names:
        if (part / name).exists():
            os.replace(part / name, out_dir / name)
            written.append(out_dir / name)
        else:
            (out_dir / name).unlink(missing_ok=True)
    return tuple(written)
