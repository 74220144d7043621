"""Many messages of one topic into columns, all at once where they are alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording.container import MessageBlock, byte_windows
from alidade.pipelines.recording.messages import Array, Definition, Layout, Leaf, MessageError, Wire, at

# Which numbers of a field, as indexes, given the message; None if the message has not got them.
Order = Callable[[Any], Sequence[int] | None]

# Stamps and log times, ns, in the file's order.
Times = tuple[NDArray[np.int64], NDArray[np.int64]]

Stamps = NDArray[np.int64]

# Up to so many messages of a topic without a stamp are left out; of more the log times are taken.
_FEW_UNSTAMPED = 0.1
# What every message with a header starts with: CDR encapsulation, in ROS 1 a sequence number; then the stamp.
_STAMP = {
    order: np.dtype([("kind", "u1", 2), ("options", "u1", 2), ("sec", f"{order}i4"), ("nanosec", f"{order}u4")])
    for order in "<>"
}

# A topic with more kinds of messages than this (frame names, say) has its further ones decoded one by one.
_MAX_LAYOUTS = 8
# Bytes; messages of numbers have some hundred.
_LARGEST = 1 << 20


class Table:
    """Columns filled from the messages of a topic, step by step. One whose values never change takes no memory."""

    def __init__(self, rows: int, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.filled = np.zeros(rows, dtype=bool)
        self._t_ns = np.zeros(rows, dtype=np.int64)
        self._log_ns = np.zeros(rows, dtype=np.int64)
        self._shapes = shapes
        self._frame = np.zeros(rows, dtype=np.int32)
        self._frames: dict[str, int] = {}
        self._constant: dict[str, Array] = {}
        self._full: dict[str, Array] = {}
        self._next = 0

    def advance(self, log_ns: NDArray[np.int64], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Take up the next messages: their log times, and their stamps (0: none). Returns their row numbers."""
        new = slice(self._next, self._next + len(log_ns))
        self._next = new.stop
        self._log_ns[new], self._t_ns[new] = log_ns, t_ns
        if not self._shapes:
            self.filled[new] = True
        return np.arange(new.start, new.stop)

    def put(self, rows: NDArray[np.int64], values: Mapping[str, NDArray[Any]], frame: str = "") -> None:
        """Fill these rows, in order: (rows, numbers) for every column, all of one frame. KeyError at another width."""
        # Rows that follow each other are written in half the time.
        first, last = int(rows[0]), int(rows[-1])
        where = slice(first, last + 1) if last - first == len(rows) - 1 else rows
        for name, column in values.items():
            self._put(name, where, column)
        self.filled[where] = True
        self._frame[where] = self._frames.setdefault(frame, len(self._frames))

    def frames(self) -> dict[str, NDArray[np.bool_]]:
        """Frames of the messages and the rows, of those filled, that have them; where they are mixed, more than one."""
        found = {name: self.filled & (self._frame == i) for name, i in self._frames.items()}
        return {name: rows for name, rows in found.items() if rows.any()}

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Let go of all other rows."""
        self.filled &= rows

    @property
    def taken(self) -> int:
        """Messages taken up so far: rows beyond them are those of damaged chunks."""
        return self._next

    def drop_unstamped(self) -> int:
        """Let go of the rows without a stamp where they are few; returns how many they are."""
        few = few_unstamped(self._t_ns[: self._next], self._log_ns[: self._next])
        self.filled[: self._next] &= ~few
        return int(np.count_nonzero(few))

    def times(self, filled: bool = True) -> Times:
        """Stamps, log times where there are none, and log times of the rows that were filled, or of all taken up."""
        rows: Any = self.filled if filled and not self.filled.all() else slice(self._next)
        return with_log_times(self._t_ns[rows], self._log_ns[rows])

    def sorted(self) -> tuple[NDArray[np.int64], int, dict[str, Any]]:
        """Stamps, how many of them are log times, and the columns, of the rows that were filled, by log time."""
        by_log = is_unstamped(self._t_ns, self._log_ns) & self.filled
        t_ns = np.where(by_log, self._log_ns, self._t_ns)
        keep: Any = slice(None)
        if not self.filled.all() or (np.diff(self._log_ns) < 0).any():
            keep = np.argsort(self._log_ns, kind="stable")
            keep = keep[self.filled[keep]]
        t_ns = t_ns[keep]
        columns = {
            name: self._full[name][keep]
            if name in self._full
            else np.broadcast_to(constant, (len(t_ns), len(constant)))
            for name, constant in self._constant.items()
        }
        shaped = {name: column.reshape(len(t_ns), *self._shapes[name]) for name, column in columns.items()}
        return t_ns, int(np.count_nonzero(by_log)), shaped

    def _put(self, name: str, rows: slice | NDArray[np.int64], values: NDArray[Any]) -> None:
        width = int(np.prod(self._shapes[name], dtype=int))
        if values.shape[1] != width:
            raise KeyError(f"{name}: {values.shape[1]} numbers instead of {width}")
        constant = self._constant.setdefault(name, values[0].astype(float))
        if name not in self._full:
            if (values == constant).all():
                return
            self._full[name] = np.empty((len(self.filled), width))
            self._full[name][:] = constant
        self._full[name][rows] = values


class _Plan(NamedTuple):
    """Where the fields are in messages of a layout: a run of numbers, and their order. No layout: nowhere."""

    layout: Layout | None
    fields: dict[str, tuple[Leaf, Any]]
    frame: str = ""


class Decoder:
    """Takes fields, name -> (path in the message, order of its numbers or None), out of the messages of one channel.

    A field the messages do not have is a KeyError or an AttributeError, a message that cannot be read a MessageError.
    """

    def __init__(self, definition: Definition, fields: Mapping[str, tuple[str, Order | None]]) -> None:
        self._definition = definition
        self._fields = fields
        self._plans: list[_Plan] = []

    def append(self, rows: MessageBlock, table: Table) -> None:
        """Append the messages to the table; those for which an order is None stay unfilled."""
        if not len(rows.start):
            return
        largest = int(np.argmax(rows.size))
        if rows.size[largest] > _LARGEST:
            with logged_at(int(rows.log_ns[largest])):
                raise MessageError(f"a message of {rows.size[largest]} bytes, which is no {self._definition.name}")
        into = table.advance(rows.log_ns, header_stamps(self._definition.has_header, rows, self._definition.wire))
        left = np.arange(len(into) if self._fields else 0)
        for plan in self._plans:
            left = left[~self._append_alike(plan, rows, left, table, into)]
        while len(left) and len(self._plans) < _MAX_LAYOUTS:
            with logged_at(int(rows.log_ns[left[0]])):
                self._plans.append(self._plan(rows.message(left[0])))
            left = left[~self._append_alike(self._plans[-1], rows, left, table, into)]
        for i in left.tolist():
            with logged_at(int(rows.log_ns[i])):
                message = self._definition.decode(rows.message(i))
                values = self._one(message)
            if values is not None:
                table.put(into[i : i + 1], values, _frame_of(message))

    def _plan(self, data: bytes) -> _Plan:
        """Work out the layout of a message and where in it the fields are."""
        layout = self._definition.layout(data)
        if layout is None:
            return _Plan(None, {})
        message = self._definition.decode(data)
        orders = {name: order(message) if order else slice(None) for name, (_, order) in self._fields.items()}
        if None in orders.values():
            return _Plan(None, {})
        runs = {name: (layout.run(path), orders[name]) for name, (path, _) in self._fields.items()}
        return _Plan(layout, runs, _frame_of(message))

    def _append_alike(
        self, plan: _Plan, rows: MessageBlock, left: NDArray[np.int64], table: Table, into: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Append those of the messages `left` that have the layout, all at once. Returns which ones those are."""
        if plan.layout is None or not len(left):
            return np.zeros(len(left), dtype=bool)
        size = len(plan.layout.first)
        alike = rows.size[left] == size
        data = byte_windows(rows.buffer, size)[rows.start[left[alike]]].view(np.uint8).reshape(-1, size)
        agrees = plan.layout.agrees(data)
        alike[alike] = agrees
        data = data if agrees.all() else data[agrees]
        if len(data):
            values = {name: run.of(data)[:, order] for name, (run, order) in plan.fields.items()}
            table.put(into[left[alike]], values, plan.frame)
        return alike

    def _one(self, message: Any) -> dict[str, NDArray[Any]] | None:
        values = {}
        for name, (path, order) in self._fields.items():
            chosen = order(message) if order else slice(None)
            if chosen is None:
                return None
            values[name] = self._definition.numbers(at(message, path))[None, chosen]
        return values


def _frame_of(message: Any) -> str:
    """The frame in a message's header, empty where it has none."""
    return str(getattr(getattr(message, "header", None), "frame_id", "")).lstrip("/")


@contextmanager
def logged_at(log_ns: int) -> Iterator[None]:
    """Notes the log time of the message that cannot be read in the error that says so."""
    try:
        yield
    except MessageError as error:
        error.log_ns = log_ns
        raise


def is_unstamped(stamps: Stamps, log_ns: Stamps) -> NDArray[np.bool_]:
    """Which messages have no stamp: zero, but for those that were logged at zero, too, as rows of a table are."""
    return np.asarray((stamps == 0) & (log_ns != 0))


def few_unstamped(stamps: Stamps, log_ns: Stamps) -> NDArray[np.bool_]:
    """The messages without a stamp where they are few among others: sent before a clock was there. Otherwise none."""
    without = is_unstamped(stamps, log_ns)
    return without & (np.count_nonzero(without) <= _FEW_UNSTAMPED * len(without))


def with_log_times(stamps: Stamps, log_ns: Stamps) -> Times:
    """Stamps and log times: these stand in for stamps that are not there; where those are few they are left out."""
    kept: Any = ~few if (few := few_unstamped(stamps, log_ns)).any() else slice(None)
    stamps, log_ns = stamps[kept], log_ns[kept]
    return (stamps if stamps.all() else np.where(stamps == 0, log_ns, stamps)), log_ns


def header_stamps(has_header: bool, rows: MessageBlock, wire: Wire) -> NDArray[np.int64]:
    """Header stamps of messages, ns; 0 where the stamp is zero or the messages have no header."""
    stamps = np.zeros(len(rows.start), dtype=np.int64)
    long = rows.size >= _STAMP["<"].itemsize
    if has_header and long.any():
        heads = byte_windows(rows.buffer, _STAMP["<"].itemsize)[rows.start[long]]
        little, big = heads.view(_STAMP["<"]), heads.view(_STAMP[">"])
        is_little = (little["kind"][:, 1] == 1) | (wire == "ros1")
        stamps[long] = little["sec"].astype(np.int64) * 1_000_000_000 + little["nanosec"]
        if not is_little.all():
            other = big["sec"].astype(np.int64) * 1_000_000_000 + big["nanosec"]
            stamps[long] = np.where(is_little, stamps[long], other)
    return stamps
