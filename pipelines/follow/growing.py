"""Files that another process may still be writing."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import MCAP0_MAGIC as MAGIC


def size_of(path: Path) -> int:
    """In bytes; 0 when there is no such file yet, or not even the mark it begins with."""
    try:
        size = path.stat().st_size
    except OSError:
        return 0
    return size if size >= len(MAGIC) else 0


def is_finished(path: Path) -> bool:
    """Whether an MCAP file has its closing mark."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        if size < 2 * len(MAGIC):
            return False
        stream.seek(size - len(MAGIC))
        return stream.read() == MAGIC
