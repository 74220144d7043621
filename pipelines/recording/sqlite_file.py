"""rosbag2's SQLite files (.db3).

SQLite has no checksum of what it stores: a file that is cut or whose structure is damaged is read up to there, and
that is noted; a byte that is damaged within a message is not found.

A file of SQLite can hold programs: views, virtual tables, columns that are computed. None of them is read, and a query
that works without coming to a row is ended.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Channel, Container, DataLoss, MessageBlock, Schema

# No message, definition or number of topics of a recording comes near these.
_LARGEST, _MOST_TOPICS = 1 << 28, 10_000
# Instructions of SQLite's machine without a row, of which a table of messages takes a dozen; looked at so often.
_MOST_IDLE, _GLANCE = 10_000_000, 100_000
# So many bytes or messages are read at a time.
_BLOCK, _MOST = 1 << 22, 8192


class SqliteFile(Container):
    """A SQLite file as rosbag2 writes it; opened again for every read.

    Raises InputError when it cannot be opened or is no recording.
    """

    def __init__(self, path: Path, data: Path | None = None) -> None:
        super().__init__(path, data)
        self._keep_whole_pages()
        self._idle = 0  # instructions since the last row
        try:
            with self._open() as database:
                self._check_tables(database)
                self.channels, self.schemas = self._definitions(database)
                self._count(database)
        except (sqlite3.Error, ValueError, OverflowError, MemoryError) as error:
            raise InputError(f"{path}: not a recording, or damaged: SQLite says: {error}") from error
        if not self.counts and not self.channels and not self.losses:
            raise InputError(f"{path}: nothing in it can be read")

    def _read_blocks(self, channels: set[int]) -> Iterator[MessageBlock]:
        """Yield the messages of these channels in the order of recording."""
        left = {number: self.counts.get(number, 0) for number in channels}
        reason = ""
        with self._open() as database:
            found: dict[int, tuple[list[bytes], list[int]]] = {}
            size = taken = 0
            cursor = iter(database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"))
            while True:
                try:
                    row = next(cursor, None) if any(left.values()) else None
                except (sqlite3.Error, OverflowError, MemoryError) as error:
                    row, reason = None, str(error)
                if row is not None:
                    self._idle = 0
                    number, log_ns, data = row
                    if number not in left or not left[number]:
                        continue
                    if not isinstance(data, bytes) or not isinstance(log_ns, int):
                        reason = "a message that is none"
                        continue
                    messages, times = found.setdefault(number, ([], []))
                    messages.append(data)
                    times.append(log_ns)
                    left[number] -= 1
                    size, taken = size + len(data), taken + 1
                if row is None or size > _BLOCK or taken > _MOST:
                    for number, (messages, times) in sorted(found.items()):
                        yield MessageBlock.pack(number, messages, times)
                    found, size, taken = {}, 0, 0
                if row is None:
                    break
        if reason or any(left.values()):
            self.lost_messages |= left
            self.losses.append(DataLoss("damage", 0, 0, reason=reason or "fewer messages than it says"))

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        # A file beside which a log of writes lies cannot be opened for reading where the folder cannot be written.
        last = None
        for mode in ("mode=ro", "mode=ro&immutable=1"):
            try:
                database = sqlite3.connect(f"file:{quote(str(self.data.resolve()))}?{mode}", uri=True)
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST)
                database.text_factory = lambda text: text.decode(errors="replace")
                self._idle = 0
                database.set_progress_handler(self._works_too_long, _GLANCE)
                database.execute("PRAGMA trusted_schema=OFF")
                database.execute("SELECT name FROM sqlite_master LIMIT 1").fetchone()
            except sqlite3.Error as error:
                last = error
                continue
            with closing(database):
                yield database
            return
        raise InputError(f"{self.path}: cannot be opened (SQLite says: {last})")

    def _works_too_long(self) -> bool:
        """Progress handler of SQLite: true ends a query that has yielded no row for _MOST_IDLE instructions."""
        self._idle += _GLANCE
        return self._idle > _MOST_IDLE

    def _keep_whole_pages(self) -> None:
        """Replace a truncated file by a copy of its whole pages, with their number in the header.

        As it is, SQLite would refuse it, or take what is missing of the last page for zeros.
        """
        self.size = size = self.data.stat().st_size
        with self.data.open("rb") as stream:
            head = stream.read(100)
        page = int.from_bytes(head[16:18], "big")
        page = 1 << 16 if page == 1 else page
        whole, stated = size // page if page >= 512 else 0, int.from_bytes(head[28:32], "big")
        if self.data.with_name(f"{self.data.name}-wal").exists():  # SQLite puts the two together
            return
        if not whole or (size % page == 0 and stated <= whole):
            return
        copy = tempfile.NamedTemporaryFile(prefix="alidade-", suffix=".whole-pages")  # noqa: SIM115
        with self.data.open("rb") as stream:
            for _ in range(whole):
                copy.write(stream.read(page))
        copy.seek(28)
        copy.write(whole.to_bytes(4, "big"))
        copy.flush()
        self.data, self.temporary = Path(copy.name), copy
        self.losses.append(DataLoss("cut", whole * page, size - whole * page, reason="it is cut short"))

    def _check_tables(self, database: sqlite3.Connection) -> None:
        """Raise InputError unless the tables are real ones of stored columns; computed ones could run for ever."""
        found: list[Any] = database.execute("SELECT name, type, rootpage FROM sqlite_master LIMIT 100").fetchall()
        tables = {str(name) for name, kind, page in found if kind == "table" and isinstance(page, int) and page > 0}
        if not {"topics", "messages"} <= tables:
            raise InputError(
                f"{self.path}: a SQLite file that is no rosbag2 recording; its tables: {', '.join(sorted(tables))}"
            )
        self._has_definitions = "message_definitions" in tables
        for table in tables & {"topics", "messages", "message_definitions"}:
            if any(row[6] > 1 for row in database.execute(f"PRAGMA table_xinfo({table})")):
                raise InputError(f"{self.path}: table {table} has computed columns, which no recorder writes")

    def _definitions(self, database: sqlite3.Connection) -> tuple[dict[int, Channel], dict[int, Schema]]:
        texts: dict[str, tuple[str, bytes]] = {}
        if self._has_definitions:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
            for kind, encoding, text in database.execute(query, (_MOST_TOPICS,)):
                texts[str(kind)] = str(encoding), str(text).encode()
        channels, schemas = {}, {}
        found: list[Any] = database.execute(
            "SELECT id, name, type, serialization_format FROM topics LIMIT ?", (_MOST_TOPICS + 1,)
        ).fetchall()
        if len(found) > _MOST_TOPICS:
            raise InputError(f"{self.path}: more than {_MOST_TOPICS} topics, which no recording of sensors has")
        for i, (number, topic, kind, form) in enumerate(found):
            if not isinstance(number, int):
                raise InputError(f"{self.path}: a topic whose id is no number")
            encoding, text = texts.get(str(kind), ("ros2msg", b""))
            schemas[i] = Schema(i, str(kind), encoding, text)
            channels[number] = Channel(number, str(topic), str(form), i)
        return channels, schemas

    def _count(self, database: sqlite3.Connection) -> None:
        """Count the messages of each channel; of a damaged file those that SQLite can reach."""
        counts = Counter[int]()
        try:
            for (number,) in database.execute("SELECT topic_id FROM messages ORDER BY rowid"):
                self._idle = 0
                counts[number] += 1
        except sqlite3.Error as error:
            self.losses.append(DataLoss("damage", 0, 0, reason=f"SQLite says: {error}"))
        self.set_counts(counts)
