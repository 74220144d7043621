"""Messages of one channel into columns, all at once where they are laid out alike, and one by one where they are not.

Messages in ROS' own encodings are decoded as they are; protobuf, JSON and Foxglove's types are translated into CDR of
the ROS 2 type first, so that there is one decoder. The time of a message is its header stamp. Log times stand in where
a topic has none; where only few messages lack one (sent before a clock was there) they are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array, Stamps
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.container import Channel, Container, MessageBlock, Schema, byte_windows
from alidade.pipelines.recording.messages import Definition, Language, Layout, Leaf, MessageError, Wire, at
from alidade.pipelines.recording.translation import Translation, cells, is_foxglove, is_known, parser, ros_type

# Stamps and log times (N,), Unix ns, in the file's order.
Times = tuple[NDArray[np.int64], NDArray[np.int64]]
# Message and schema encoding as ROS 2 records.
ENCODING = "cdr/ros2msg"
# Encoding of the messages and of their definitions -> byte layout, and language of the definitions.
_ROS: dict[str, tuple[Wire, Language]] = {
    ENCODING: ("cdr", "msg"),
    "cdr/ros2idl": ("cdr", "idl"),
    "ros1/ros1msg": ("ros1", "msg"),
}
_TRANSLATED = ("protobuf/protobuf", "json/jsonschema")
READABLE = (*_ROS, *_TRANSLATED)
# Of a table of messages the column of the times at which these were recorded, unless they have a field of that name.
LOG_TIME = "log_time"
# Messages that show what a topic holds: its fields, of which the first may lack some, and whether it is a ROS type.
FIRST_MESSAGES = 100
# Encoding that is not read -> how to get one that is.
_CONVERSIONS = {
    "flatbuffer/flatbuffer": "record with Foxglove's protobuf schemas, whose fields are the same, or write "
    "the messages as JSON, which `flatc --json --raw-binary` makes of each with its .fbs, into another MCAP file",
}
# Largest share of messages without a stamp that are left out; where there are more, all messages of the topic get their
# log times: stamps of two clocks make no series.
MAX_UNSTAMPED_SHARE = 0.5
# Layouts of a topic's messages (they differ in frame names, say) that are decoded at once; others one by one.
_MAX_LAYOUTS = 8
# Largest message of numbers, bytes; usual ones have some hundred.
MAX_NUMERIC_BYTES = 1 << 20
# What a message with a header begins with: CDR encapsulation, in ROS 1 a sequence number; then the stamp.
_STAMP = {
    order: np.dtype([("kind", "u1", 2), ("options", "u1", 2), ("sec", f"{order}i4"), ("nanosec", f"{order}u4")])
    for order in "<>"
}
_COLUMNS: Mapping[str, Mapping[str, series.Column]] = {
    name: columns
    for kind in (
        series.ImuSeries,
        series.MagneticSeries,
        series.VectorSeries,
        series.QuaternionSeries,
        series.PoseSeries,
        series.FixSeries,
        series.TemperatureSeries,
    )
    for name, columns in ({kind.TYPE: kind.COLUMNS} | kind.OTHERS).items()
}
# Message types that become columns.
NUMERIC_TYPES = {*_COLUMNS, messages.JOINT_STATE}


class DecodedMessage(NamedTuple):
    """One message: its time, Unix ns, whether that is its log time, its content, the definition of its type.

    `left_out`: it is of no use but to decode others of its video by, for want of a stamp.
    """

    t_ns: int
    from_log_time: bool
    content: Any
    definition: Definition
    left_out: bool = False


class _Plan(NamedTuple):
    """Positions of a table's numbers in messages of one layout, in column order; no layout: decode one by one."""

    layout: Layout | None
    fields: dict[str, tuple[Leaf, Any]]
    frame: str = ""


class ColumnTable:
    """Columns of a topic, filled block by block. A column whose values never change takes no memory.

    Args:
        kind: message type, one of NUMERIC_TYPES.
        count: largest number of messages.
        joints: of a sensor_msgs/JointState those whose positions are read.

    Attributes:
        fields: column -> path of the field in a message.
        joint_names: names of joints met in the messages.
        filled: (count,) rows that have values.
        count: rows added: rows beyond them are messages of damaged chunks.
        plans: channel -> layouts of its messages met so far.
    """

    def __init__(self, kind: str, count: int, joints: Sequence[str] = ()) -> None:
        self.joint_names: dict[str, None] = {}
        self._joints = joints if kind == messages.JOINT_STATE else None
        columns = _COLUMNS.get(kind, {"position": series.Column("position", (len(joints),))})
        self._shapes = {name: column.shape for name, column in columns.items()}
        self._orders = {name: column.order or slice(None) for name, column in columns.items()}
        self.fields = {name: column.path for name, column in columns.items()}
        self.filled = np.zeros(count, dtype=bool)
        self.count = 0
        self.plans: dict[int, list[_Plan]] = {}
        self._t_ns = np.zeros(count, dtype=np.int64)
        self._log_ns = np.zeros(count, dtype=np.int64)
        self._frame = np.zeros(count, dtype=np.int32)
        self._frames: dict[str, int] = {}
        self._constant: dict[str, Array] = {}
        self._varying: dict[str, Array] = {}

    def orders(self, message: Any) -> Mapping[str, Any] | None:
        """Map each column to the indexes of its numbers in the field; None for a message that lacks a joint."""
        if self._joints is None:
            return self._orders
        self.joint_names.update(dict.fromkeys(map(str, message.name)))
        if not set(self._joints) <= set(message.name) or len(message.position) != len(message.name):
            return None
        return {"position": [message.name.index(name) for name in self._joints]}

    def add_rows(self, log_ns: Stamps, t_ns: Stamps) -> NDArray[np.int64]:
        """Add messages with these log times and stamps (0: none), Unix ns. Returns their row numbers."""
        new = slice(self.count, self.count + len(log_ns))
        self.count = new.stop
        self._log_ns[new], self._t_ns[new] = log_ns, t_ns
        return np.arange(new.start, new.stop)

    def fill(self, rows: NDArray[np.int64], values: Mapping[str, NDArray[Any]], frame: str = "") -> None:
        """Write messages of one frame into increasing rows, column -> (rows, width). KeyError at another width."""
        # Rows that follow each other are written in half the time.
        first, last = int(rows[0]), int(rows[-1])
        where = slice(first, last + 1) if last - first == len(rows) - 1 else rows
        for name, column in values.items():
            self._fill_column(name, where, column)
        self.filled[where] = True
        self._frame[where] = self._frames.setdefault(frame, len(self._frames))

    def frames(self) -> dict[str, NDArray[np.bool_]]:
        """Map each frame name to the mask of the filled rows whose messages have that frame."""
        found = {name: self.filled & (self._frame == i) for name, i in self._frames.items()}
        return {name: rows for name, rows in found.items() if rows.any()}

    def drop_unstamped(self) -> int:
        """Drop filled rows whose messages have no stamp, if most others have one; return how many."""
        rows = np.flatnonzero(self.filled)
        few = rows[~one_clock(self._t_ns[rows], self._log_ns[rows])[0]]
        self.filled[few] = False
        return len(few)

    def times(self, filled: bool = True) -> Times:
        """Return stamps (log times where most are missing) and log times of the filled rows, or of all, Unix ns."""
        rows: Any = self.filled if filled and not self.filled.all() else slice(self.count)
        return with_log_times(self._t_ns[rows], self._log_ns[rows])

    def sorted(self) -> tuple[Stamps, int, dict[str, Any]]:
        """Return stamps, how many are missing (then all are log times), and columns of the filled rows, by log time."""
        absent = is_unstamped(self._t_ns, self._log_ns) & self.filled
        t_ns = self._log_ns if absent.any() else self._t_ns
        rows: Any = slice(None)
        if not self.filled.all() or (np.diff(self._log_ns) < 0).any():
            rows = np.argsort(self._log_ns, kind="stable")
            rows = rows[self.filled[rows]]
        t_ns = t_ns[rows]
        columns = {
            name: self._varying[name][rows]
            if name in self._varying
            else np.broadcast_to(constant, (len(t_ns), len(constant)))
            for name, constant in self._constant.items()
        }
        shaped = {name: column.reshape(len(t_ns), *self._shapes[name]) for name, column in columns.items()}
        return t_ns, int(np.count_nonzero(absent)), shaped

    def _fill_column(self, name: str, rows: slice | NDArray[np.int64], values: NDArray[Any]) -> None:
        width = int(np.prod(self._shapes[name], dtype=int))
        if values.shape[1] != width:
            raise KeyError(f"{name}: {values.shape[1]} numbers instead of {width}")
        constant = self._constant.setdefault(name, values[0].astype(float))
        if name not in self._varying:
            if (values == constant).all():
                return
            self._varying[name] = np.empty((len(self.filled), width))
            self._varying[name][:] = constant
        self._varying[name][rows] = values


class MessageFormat:
    """Encoding and type of a channel's messages.

    Attributes:
        type: name of the ROS 2 type, of translated messages that of the translation; as recorded where there is none.
        encoding: of the messages and of their definitions, `cdr/ros2msg` in ROS 2.
        is_readable: whether messages of this encoding and type are read.
    """

    def __init__(self, channel: Channel, schema: Schema | None) -> None:
        self._schema = schema
        self.encoding = f"{channel.message_encoding}/{schema.encoding if schema else ''}"
        self._recorded_type = schema.name if schema else ""
        self._wire: Wire | None
        self._language: Language
        self._wire, self._language = _ROS.get(self.encoding, (None, "msg"))
        if self._wire == "ros1":
            self._recorded_type = _ros2_name(self._recorded_type)
        is_ros = self.encoding not in _TRANSLATED and not (self._wire and is_foxglove(self._recorded_type))
        translated = None if is_ros else ros_type(self._recorded_type)
        self._is_translated = translated is not None
        self.type = translated or self._recorded_type
        self.is_readable = self._wire is not None or self._is_translated
        self._has_log_time: bool | None = None  # whether messages have a field of that name; unknown before the first

    @property
    def is_doubtful(self) -> bool:
        """Whether the message type is named like one of ROS, in a package that is not known: it may be another type."""
        return self._is_translated and not is_known(self._recorded_type)

    def check_fit(self, block: MessageBlock) -> None:
        """Take the type for what it was recorded as where none of a block's first messages is one of ROS's."""
        with suppress(MessageError):  # of a definition that cannot be read, which reading will name
            is_other = False
            for i in range(min(len(block.start), FIRST_MESSAGES)):
                fits = self._translation.fits(block.message(i))
                if fits:
                    return
                is_other |= fits is False
            if is_other:
                self._is_translated, self.type, self.is_readable = False, self._recorded_type, False

    @property
    def advice(self) -> str:
        """End of a sentence: how to convert this encoding into one that is read; may be empty."""
        return f": {_CONVERSIONS[self.encoding]}" if self.encoding in _CONVERSIONS else ""

    @cached_property
    def definition(self) -> Definition:
        """Definition of the channel's ROS 2 message type. Raises MessageError where it cannot be used."""
        return messages.known(self.type) if self._is_translated else self._recorded

    def stamps(self, block: MessageBlock) -> Stamps:
        """Return a block's header stamps, Unix ns, 0 where there is none; log times where messages cannot be read."""
        if not self.is_readable:
            return block.log_ns
        try:
            wire = "cdr" if self._is_translated else self._wire or "cdr"
            return header_stamps(self._has_header, self._translated(block), wire)
        except MessageError:
            return block.log_ns

    def append(self, block: MessageBlock, table: ColumnTable) -> None:
        """Append a block's messages to a table; the rows of messages that lack one of its joints stay unfilled.

        Raises KeyError or AttributeError at a field that the messages do not have, and MessageError.
        """
        if not len(block.start):
            return
        block = self._translated(block)
        largest = int(np.argmax(block.size))
        if block.size[largest] > MAX_NUMERIC_BYTES:
            with at_log_time(int(block.log_ns[largest])):
                raise MessageError(f"a message of {block.size[largest]} bytes, which is no {self.definition.name}")
        rows = table.add_rows(block.log_ns, header_stamps(self.definition.has_header, block, self.definition.wire))
        plans = table.plans.setdefault(block.channel, [])
        left = np.arange(len(rows))
        for plan in plans:
            left = left[~_append_alike(plan, block, left, table, rows)]
        while len(left) and len(plans) < _MAX_LAYOUTS:
            with at_log_time(int(block.log_ns[left[0]])):
                plans.append(self._plan(block.message(left[0]), table))
            left = left[~_append_alike(plans[-1], block, left, table, rows)]
        for i in left.tolist():
            with at_log_time(int(block.log_ns[i])):
                message = self.definition.decode(block.message(i))
                orders = table.orders(message)
                if orders is None:
                    continue
                found = {name: self.definition.numbers(at(message, path)) for name, path in table.fields.items()}
            table.fill(rows[i : i + 1], {name: found[name][None, orders[name]] for name in found}, _frame(message))

    def decode(self, block: MessageBlock) -> Iterator[DecodedMessage]:
        """Decode the messages of a block one by one. Raises MessageError."""
        definition, block = self.definition, self._translated(block)
        stamps = header_stamps(definition.has_header, block, definition.wire)
        absent = is_unstamped(stamps, block.log_ns)
        t_ns = np.where(absent, block.log_ns, stamps)
        for i, (stamp, log_ns) in enumerate(zip(t_ns.tolist(), block.log_ns.tolist(), strict=True)):
            with at_log_time(log_ns):
                content = definition.decode(block.message(i))
            yield DecodedMessage(stamp, bool(absent[i]), content, definition)

    def cells(self, block: MessageBlock) -> Iterator[dict[str, Any]]:
        """Yield a mapping from field path to number or word for each message of a block, whatever the type.

        LOG_TIME is the time at which a message was recorded, Unix ns, or its own field where the first one has it.
        Raises MessageError.
        """
        assert self._schema is not None
        parse = parser(self._recorded if self._wire else self._schema)
        for i, log_ns in enumerate(block.log_ns.tolist()):
            with at_log_time(log_ns):
                try:
                    found = dict(cells(parse(block.message(i))))
                except (ValueError, TypeError, AttributeError, OverflowError, RecursionError, MemoryError) as error:
                    raise MessageError(f"a message of {block.size[i]} bytes cannot be read ({error})") from error
            if self._has_log_time is None:
                self._has_log_time = LOG_TIME in found
            if not self._has_log_time:
                found[LOG_TIME] = log_ns
            yield found

    def texts(self, block: MessageBlock, names: Sequence[str]) -> list[NDArray[np.str_]]:
        """Return some of the `cells` of a block's messages as texts (N,) by name, empty where a message lacks one.

        Messages of ROS that are laid out alike are read at once, fifty times as fast. Raises MessageError.
        """
        if self._wire and len(block.start):
            data = block.message(0)
            layout = self._recorded.layout(data)
            if layout is not None and (block.size == len(data)).all():
                rows = byte_windows(block.buffer, len(data))[block.start].view(np.uint8).reshape(-1, len(data))
                if layout.agrees(rows).all():  # in words as well
                    first = next(self.cells(block))
                    words = {name: first.get(name, "") for name in names}
                    columns: dict[str, NDArray[Any]] = {LOG_TIME: block.log_ns}
                    columns |= {name: np.full(len(rows), word) for name, word in words.items() if isinstance(word, str)}
                    columns |= layout.numbers(names, rows)
                    if columns.keys() >= set(names):
                        return [columns[name].astype(str) for name in names]
        each = [[cells.get(name, "") for name in names] for cells in self.cells(block)]
        return [np.array(list(map(str, column)), dtype=np.str_) for column in zip(*each, strict=True)]

    @property
    def is_parsed(self) -> bool:
        """Whether messages of this encoding can be read, whatever their type."""
        return self._schema is not None and (self._wire is not None or self.encoding in _TRANSLATED)

    @cached_property
    def _recorded(self) -> Definition:
        """Definition that the recording has of a ROS type; the standard one where the recording has none."""
        assert self._schema is not None
        assert self._wire is not None
        text = self._schema.data.decode(errors="replace") or messages.definition_text(self._recorded_type)
        language = self._language if self._schema.data else "msg"
        found = messages.definition(self._recorded_type, text, self._wire, language)
        found.check()
        return found

    @cached_property
    def _has_header(self) -> bool:
        """Whether messages begin with a header, by the recorded text, which need not be a valid definition, if any."""
        if not self._is_translated and self._language == "msg" and self._schema is not None and self._schema.data:
            return messages.has_header(self._schema.data.decode(errors="replace"))
        return self.definition.has_header

    @cached_property
    def _translation(self) -> Translation:
        assert self._schema is not None
        return Translation(self._schema if self._wire is None else self._recorded, self.definition)

    def _translated(self, block: MessageBlock) -> MessageBlock:
        """Return the messages translated to `definition`. Raises MessageError at one that cannot be translated."""
        if not self._is_translated:
            return block
        translated = []
        for i, log_ns in enumerate(block.log_ns.tolist()):
            with at_log_time(log_ns):
                translated.append(self._translation(block.message(i)))
        return MessageBlock.pack(block.channel, translated, block.log_ns)

    def _plan(self, data: bytes, table: ColumnTable) -> _Plan:
        """Return the layout of a message and the positions of the table's numbers in that layout."""
        layout = self.definition.layout(data)
        if layout is None:
            return _Plan(None, {})
        message = self.definition.decode(data)
        orders = table.orders(message)
        if orders is None:
            return _Plan(None, {})
        runs = {name: (layout.run(path), orders[name]) for name, path in table.fields.items()}
        return _Plan(layout, runs, _frame(message))


def formats_of(container: Container) -> dict[int, MessageFormat]:
    """Return the format of each channel; a doubtful type is one of ROS if one of its first messages is."""
    found = {
        number: MessageFormat(channel, container.schemas.get(channel.schema_id))
        for number, channel in container.channels.items()
    }
    doubtful = [number for number, each in found.items() if each.is_doubtful]
    for number, block in container.first_blocks(doubtful).items():
        found[number].check_fit(block)
    return found


@contextmanager
def at_log_time(log_ns: int) -> Iterator[None]:
    """Context manager that adds a message's log time, Unix ns, to a MessageError about that message."""
    try:
        yield
    except MessageError as error:
        error.log_ns = log_ns
        raise


def is_unstamped(stamps: Stamps, log_ns: Stamps) -> NDArray[np.bool_]:
    """Mask (N,) of messages without a stamp: stamp zero, log time not (a table's rows may begin at zero)."""
    return np.asarray((stamps == 0) & (log_ns != 0))


def one_clock(stamps: Stamps, log_ns: Stamps) -> tuple[NDArray[np.bool_], int]:
    """Choose a topic's clock: mask (N,) of messages kept, and how many of these lack a stamp; if any: log time."""
    without = is_unstamped(stamps, log_ns)
    count = int(np.count_nonzero(without))
    return (~without, 0) if count <= MAX_UNSTAMPED_SHARE * len(without) else (np.ones_like(without), count)


def with_log_times(stamps: Stamps, log_ns: Stamps) -> Times:
    """Return stamps and log times; few messages without a stamp are left out, with many all get their log times."""
    kept, absent = one_clock(stamps, log_ns)
    if not kept.all():
        stamps, log_ns = stamps[kept], log_ns[kept]
    return (log_ns if absent else stamps), log_ns


def header_stamps(has_header: bool, block: MessageBlock, wire: Wire) -> Stamps:
    """Header stamps of messages, Unix ns; 0 where the stamp is zero or the messages have no header."""
    stamps = np.zeros(len(block.start), dtype=np.int64)
    long = block.size >= _STAMP["<"].itemsize
    if has_header and long.any():
        heads = byte_windows(block.buffer, _STAMP["<"].itemsize)[block.start[long]]
        little, big = heads.view(_STAMP["<"]), heads.view(_STAMP[">"])
        is_little = (little["kind"][:, 1] == 1) | (wire == "ros1")
        stamps[long] = little["sec"].astype(np.int64) * 1_000_000_000 + little["nanosec"]
        if not is_little.all():
            other = big["sec"].astype(np.int64) * 1_000_000_000 + big["nanosec"]
            stamps[long] = np.where(is_little, stamps[long], other)
    return stamps


def _append_alike(
    plan: _Plan, block: MessageBlock, left: NDArray[np.int64], table: ColumnTable, rows: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Append at once those of the messages `left` that have the plan's layout; return the mask of the appended ones."""
    if plan.layout is None:
        return np.zeros(len(left), dtype=bool)
    size = len(plan.layout.first)
    alike = block.size[left] == size
    if not alike.any():
        return alike
    data = byte_windows(block.buffer, size)[block.start[left[alike]]].view(np.uint8).reshape(-1, size)
    agrees = plan.layout.agrees(data)
    alike[alike] = agrees
    data = data if agrees.all() else data[agrees]
    if len(data):
        values = {name: run.of(data)[:, order] for name, (run, order) in plan.fields.items()}
        table.fill(rows[left[alike]], values, plan.frame)
    return alike


def _frame(message: Any) -> str:
    """Return the frame_id in a message's header, empty where there is none."""
    return str(getattr(getattr(message, "header", None), "frame_id", "")).lstrip("/")


def _ros2_name(name: str) -> str:
    package, _, kind = name.partition("/")
    return name if kind.startswith("msg/") else f"{package}/msg/{kind}"
