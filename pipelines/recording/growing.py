"""Recordings that another process still writes: what is new in them, without reading again what was there before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import open_binary
from alidade.pipelines.recording.container import Container, MessageBlock, MultiPartContainer, byte_windows, total
from alidade.pipelines.recording.mcap_file import Block, McapFile
from alidade.pipelines.recording.mcap_records import MAGIC
from alidade.pipelines.recording.opening import open_container

# Longer messages, bytes, are not kept from one refresh to the next; those of numbers are shorter.
MAX_KEPT_BYTES = 1 << 14


class GrowingMcap(McapFile):
    """MCAP file that is still being written; `refresh` selects the blocks at its end that are read.

    Raises InputError when it is no MCAP, or hostile.
    """

    def __init__(self, path: Path) -> None:
        self._view: list[Block] = []  # the blocks that are read
        self._checked = 0  # blocks
        # Start of a block -> its end when it was read, and its messages by channel.
        self._kept: dict[int, tuple[int, dict[int, MessageBlock]]] = {}
        super().__init__(path)

    def _read_index(self, stream: BinaryIO) -> None:
        """Read no index on opening; `refresh` walks the file."""

    def refresh(self, since_ns: int | None) -> None:
        """Walk the new records; select the blocks logged since a time, Unix ns, or a little before (None: all)."""
        with open_binary(self.data, self.path) as stream:
            self._walk_new(stream)
            # The last block's message index may not have been written yet.
            self._verify_unindexed(stream, self._blocks[max(0, self._checked - 1) :])
            self._checked = len(self._blocks)
        # Blocks overlap little: those after the last one that ends before.
        first = len(self._blocks)
        while first and not _ends_before(self._blocks[first - 1], since_ns):
            first -= 1
        self._view = self._blocks[first:]
        self._kept = {block.start: self._kept[block.start] for block in self._view if block.start in self._kept}
        self.counts = {
            number: n for number, n in total(block.counts for block in self._view).items() if self.is_defined(number)
        }

    def last_log_ns(self) -> int | None:
        """Return the log time of the last message written so far, Unix ns, as its block states it; None without one."""
        with open_binary(self.data, self.path) as stream:
            self._walk_new(stream)
        return next((block.log_span_ns[1] for block in reversed(self._blocks) if block.log_span_ns is not None), None)

    @property
    def first_log_ns(self) -> int:
        """Log time of the first message that is read, as its block states it, Unix ns."""
        return next((block.log_span_ns[0] for block in self._view if block.log_span_ns is not None), 0)

    def _walk_new(self, stream: BinaryIO) -> None:
        self.size = stream.seek(0, 2)
        self._walk(stream, self.size, is_growing=True)

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of each channel in one block, however small the recorder's chunks are.

        From its first large message on those of a channel come chunk by chunk, in their order.
        """
        found: dict[int, list[MessageBlock]] = {}
        large: set[int] = set()
        with open_binary(self.data, self.path) as stream:
            for block in self._view:
                wanted = channels & block.counts.keys()
                end, kept = self._kept.get(block.start, (block.end, {}))
                if end != block.end:
                    kept = {}
                for messages in self._messages(stream, block, wanted - kept.keys()):
                    if messages.size.max(initial=0) > MAX_KEPT_BYTES:
                        large.add(messages.channel)
                        yield from _joined(found.pop(messages.channel, []))
                        yield messages
                    else:
                        kept[messages.channel] = _compact(messages)
                self._kept[block.start] = block.end, kept
                for number in wanted & kept.keys():
                    if number in large:
                        yield kept[number]
                    else:
                        found.setdefault(number, []).append(kept[number])
        for parts in found.values():
            yield from _joined(parts)


def _joined(parts: Sequence[MessageBlock]) -> Iterator[MessageBlock]:
    """Yield compact blocks of one channel joined into one block; no block for none."""
    if parts:
        size, log_ns = (np.concatenate(each) for each in zip(*((p.size, p.log_ns) for p in parts), strict=True))
        buffer = np.concatenate([part.buffer for part in parts])
        yield MessageBlock(parts[0].channel, buffer, np.cumsum(size) - size, size, log_ns)


class GrowingFiles:
    """Files of a recording that is still being written; those that are not MCAP are read anew on each refresh."""

    def __init__(self) -> None:
        self._files: dict[Path, GrowingMcap] = {}

    @property
    def attachments(self) -> list[str]:
        """Names of the attachments of all files read so far."""
        return [name for file in self._files.values() for name in file.attachments]

    def last_log_ns(self, paths: Sequence[Path]) -> int | None:
        """Return the log time of the last message written so far, Unix ns, from record heads alone; None if unknown."""
        last = self._files.get(paths[-1]) if paths else None
        return None if last is None else last.last_log_ns()

    def refresh(self, paths: Sequence[Path], since_ns: int | None) -> Container:
        """Return the recording so far: all of it, or what was logged since a time, Unix ns. Raises InputError."""
        files: list[Container] = []
        for path in paths:
            with path.open("rb") as stream:
                is_mcap = stream.read(len(MAGIC)) == MAGIC
            if not is_mcap:
                files.append(open_container(path))
                continue
            if path not in self._files:
                self._files[path] = GrowingMcap(path)
            file = self._files[path]
            file.refresh(since_ns)
            if file.counts:
                files.append(file)
        if not files:
            raise InputError(f"{paths[0]}: no messages yet")
        return files[0] if len(files) == 1 else MultiPartContainer(paths[0], files)


def _ends_before(block: Block, since_ns: int | None) -> bool:
    return since_ns is not None and block.log_span_ns is not None and block.log_span_ns[1] < since_ns


def _compact(block: MessageBlock) -> MessageBlock:
    """Return a block with its messages side by side, without the bytes between them."""
    size = int(block.size[0]) if len(block.size) else 0
    if size and (block.size == size).all():
        data = byte_windows(block.buffer, size)[block.start].view(np.uint8)
        return block._replace(buffer=data, start=size * np.arange(len(block.size)))
    return MessageBlock.pack(block.channel, [block.message(i) for i in range(len(block.size))], block.log_ns)
