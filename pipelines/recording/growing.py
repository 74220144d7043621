"""Recordings that another process still writes: what is new in them, without reading again what was there before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Container, Rows, rows_of
from alidade.pipelines.recording.data_loss import DataLoss
from alidade.pipelines.recording.mcap_file import McapFile
from alidade.pipelines.recording.mcap_index import Block, McapIndex
from alidade.pipelines.recording.mcap_records import MAGIC, windows
from alidade.pipelines.recording.opening import open_container
from alidade.pipelines.recording.parts import Parts

# Messages of numbers are shorter, bytes; longer ones are not kept from look to look.
_LARGE = 1 << 14


class GrowingMcap(McapFile):
    """An MCAP file as far as it has been written, and of that the end alone, if it is asked for so.

    Raises InputError when it is no MCAP, or hostile.
    """

    def __init__(self, path: Path) -> None:
        self.path = self.data = path
        self._strict = False
        self._lost: dict[int, int] = {}
        self._index = index = McapIndex(str(path))
        self.profile, self.channels, self.schemas = "", index.channels, index.schemas
        self.counts: dict[int, int] = {}
        self.losses: list[DataLoss] = index.losses
        self._checked = 0  # blocks
        self._blocks: list[Block] = []
        self._kept: dict[int, tuple[int, dict[int, Rows]]] = {}  # start of a block -> its end when read, its messages
        with self._open() as stream:
            self._check_magic(stream)

    def look(self, since_ns: int | None) -> None:
        """Take what has come, and have in view what was logged since a time, Unix ns, a little before included."""
        with self._open() as stream:
            self._index.grow(stream)
            blocks = self._index.blocks
            # Of the last one the index may not have been written yet.
            for block in blocks[max(0, self._checked - 1) :]:
                indexed = block.index_at and block.index_at.keys() <= self.channels.keys()
                if block.is_chunk and not block.is_lost and not indexed:
                    self._verify(stream, block)
            self._checked = len(blocks)
        # Blocks overlap little: those after the last one that is over by then.
        first = len(blocks)
        while first and not _is_over(blocks[first - 1], since_ns):
            first -= 1
        self._blocks = blocks[first:]
        self._kept = {block.start: self._kept[block.start] for block in self._blocks if block.start in self._kept}
        self.profile = self._index.profile
        self.counts = {number: n for number, n in self._counted().items() if self._defined(number)}

    def last_log_ns(self) -> int | None:
        """Log time of the last messages there are by now, in view or not, as their block states it; None: of none."""
        with self._open() as stream:
            self._index.grow(stream)
        return next((block.span[1] for block in reversed(self._index.blocks) if block.span is not None), None)

    @property
    def first_log_ns(self) -> int:
        """As the first block in view states it."""
        return next((block.span[0] for block in self._blocks if block.span is not None), 0)

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages in view: each channel's at once, however small the recorder's chunks are, but for large ones."""
        found: dict[int, list[Rows]] = {}
        with self._open() as stream:
            for block in self._blocks:
                wanted = channels & block.counts.keys()
                end, kept = self._kept.get(block.start, (block.end, {}))
                if end != block.end:
                    kept = {}
                for rows in self._block_rows(stream, block, wanted - kept.keys()):
                    if rows.size.max(initial=0) > _LARGE:
                        yield rows
                    else:
                        kept[rows.channel] = _compact(rows)
                self._kept[block.start] = block.end, kept
                for number in wanted & kept.keys():
                    found.setdefault(number, []).append(kept[number])
        for number, pieces in found.items():
            size, log_ns = (np.concatenate(parts) for parts in zip(*((p.size, p.log_ns) for p in pieces), strict=True))
            yield Rows(number, np.concatenate([p.buffer for p in pieces]), np.cumsum(size) - size, size, log_ns)


class Growing:
    """The files of a recording, by and by. Those that are not MCAP are read anew every time."""

    def __init__(self) -> None:
        self._files: dict[Path, GrowingMcap] = {}

    @property
    def attachments(self) -> list[str]:
        """Names of all attachments met."""
        return [name for file in self._files.values() for name in file.attachments]

    def last_log_ns(self, where: Sequence[Path]) -> int | None:
        """Log time of the last messages there are by now, without reading them; None where that cannot be told."""
        last = self._files.get(where[-1]) if where else None
        return None if last is None else last.last_log_ns()

    def look(self, where: Sequence[Path], since_ns: int | None) -> Container:
        """What the files hold by now: all, or what was logged since a time, Unix ns. Raises InputError."""
        files: list[Container] = []
        for path in where:
            if not _is_mcap(path):
                files.append(open_container(path))
                continue
            if path not in self._files:
                self._files[path] = GrowingMcap(path)
            file = self._files[path]
            file.look(since_ns)
            if file.counts:
                files.append(file)
        if not files:
            raise InputError(f"{where[0]}: no messages yet")
        return files[0] if len(files) == 1 else Parts(where[0], files)


def _is_over(block: Block, since_ns: int | None) -> bool:
    """Whether all of its messages were logged before."""
    return since_ns is not None and block.span is not None and block.span[1] < since_ns


def _compact(rows: Rows) -> Rows:
    """The messages side by side, without what stands between them."""
    size = int(rows.size[0]) if len(rows.size) else 0
    if size and (rows.size == size).all():
        data = windows(rows.buffer, size)[rows.start].view(np.uint8)
        return rows._replace(buffer=data, start=size * np.arange(len(rows.size)))
    return rows_of(rows.channel, [rows.message(i) for i in range(len(rows.size))], rows.log_ns)


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC
