"""ROS messages as bytes: definitions, the layout of CDR and of ROS 1, many messages at once.

Neither has a field table: a string or a sequence moves everything after it. Messages of one topic, though, hardly ever
differ in their strings and lengths. So the layout is worked out once, by walking a message along its definition, and
serves every message with the same size, strings and lengths; the others are decoded one by one with rosbags.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from alidade.factors.array import Array

# How ROS 2 and ROS 1 lay a message out: ROS 1 without encapsulation and without alignment.
Wire = Literal["cdr", "ros1"]
# What a definition is written in: ROS' own lines, or OMG's IDL.
Language = Literal["msg", "idl"]

IMU = "sensor_msgs/msg/Imu"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
JOINT_STATE = "sensor_msgs/msg/JointState"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PLAIN_POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistStamped"
ACCEL = "geometry_msgs/msg/AccelStamped"
TF = "tf2_msgs/msg/TFMessage"
TEMPERATURE = "sensor_msgs/msg/Temperature"
TAG_DETECTIONS = "apriltag_msgs/msg/AprilTagDetectionArray"

# What an attitude is taken from; of an Imu its orientation. A TFMessage besides needs the pair of frames.
ATTITUDES = (POSE, PLAIN_POSE, QUATERNION, TRANSFORM, ODOMETRY, IMU)
# Angular rates and accelerations in one message.
IMUS = (IMU,)
# What angular rates are taken from where no acceleration is needed.
RATES = (*IMUS, VECTOR, TWIST)
# Pictures, as files and raw.
PICTURES = (COMPRESSED_IMAGE, IMAGE)

# All types that anything is taken from.
SENSORS = (
    *(*IMUS, MAGNETIC_FIELD, JOINT_STATE, NAV_SAT_FIX, CAMERA_INFO, *PICTURES, VECTOR, QUATERNION, POSE),
    *(PLAIN_POSE, TRANSFORM, ODOMETRY, TWIST, ACCEL, TF, TAG_DETECTIONS, TEMPERATURE),
)

# Definitions of types that rosbags does not bring along.
_DEFINITIONS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n"
    ),
    TAG_DETECTIONS: "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n",
}

_HEADER = "std_msgs/msg/Header"
_CODES = {"bool": "u1", "byte": "u1", "char": "u1"}

# The primitive types `time` and `duration` of ROS 1.
_ROS1_TIMES = {
    name: fields
    for name, fields in get_typestore(Stores.EMPTY).fielddefs.items()
    if name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
}

# No message of sensors comes near any of these. The parser of IDL takes a tenth of a second for a thousand letters.
_LONGEST_TEXT, _LONGEST_IDL, _MOST_FIELDS, _DEEPEST = 1 << 18, 1 << 15, 10_000, 32


@dataclass(frozen=True)
class Leaf:
    """Run of numbers of one type in a message: field path, byte offset, numpy type, count."""

    path: str
    offset: int
    dtype: np.dtype[Any]
    count: int

    def of(self, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """Return the run's numbers in messages, rows of bytes (n, size), as a view (n, count)."""
        strides = (rows.shape[1], self.dtype.itemsize)
        return np.ndarray((len(rows), self.count), self.dtype, rows, self.offset, strides)


@dataclass(frozen=True)
class Layout:
    """Positions of the numbers in messages that agree with the first one in size, strings and lengths."""

    first: bytes
    leaves: tuple[Leaf, ...]
    fixed: tuple[tuple[int, int], ...]  # [start, end) of what has to be equal

    def run(self, path: str) -> Leaf:
        """Return the run of all numbers at or below the field at a path.

        Raises KeyError if the message has no such field, or does not hold its numbers side by side.
        """
        found = [leaf for leaf in self.leaves if leaf.path == path or leaf.path.startswith((f"{path}.", f"{path}["))]
        if not found:
            raise KeyError(path)
        end = found[0].offset
        for leaf in found:
            if leaf.offset != end or leaf.dtype != found[0].dtype:
                raise KeyError(path)
            end = leaf.offset + leaf.count * leaf.dtype.itemsize
        return Leaf(path, found[0].offset, found[0].dtype, sum(leaf.count for leaf in found))

    def numbers(self, names: Iterable[str], messages: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Return the numbers (n,) called `gyro_rad[0]`, or `header.stamp` (ns), in messages (n, size), by name."""
        leaves, found = {leaf.path: leaf for leaf in self.leaves}, dict[str, NDArray[Any]]()
        for name in names:
            path, _, at = name.removesuffix("]").rpartition("[") if name.endswith("]") else (name, "", "0")
            if path in leaves and int(at) < leaves[path].count:
                values = leaves[path].of(messages)[:, int(at)]
                found[name] = values.astype(float) if values.dtype.kind == "f" else values
            elif f"{name}.nanosec" in leaves:
                sec, nanosec = (leaves[f"{name}.{part}"].of(messages)[:, 0] for part in ("sec", "nanosec"))
                found[name] = 1_000_000_000 * sec.astype(np.int64) + nanosec
        return found

    def agrees(self, messages: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Mask (n,) of the messages (n, size) that have this layout."""
        first = np.frombuffer(self.first, np.uint8)
        same = np.ones(len(messages), dtype=bool)
        for start, end in self.fixed:
            equal = messages[:, start:end] == first[start:end]
            # Nearly always all are, which is seen in less time than which.
            if not equal.all():
                same &= equal.all(axis=1)
        return same


class MessageError(Exception):
    """Raised for a message or definition that cannot be read; the caller adds the topic and the file.

    log_ns is the log time of the message, Unix ns, where it is one.
    """

    log_ns: int | None = None


class Definition:
    """A message type by the definition text in the recording, which may differ from the standard one.

    The text is foreign input, and rosbags generates code from it: its size is checked first.
    """

    def __init__(self, name: str, text: str, wire: Wire = "cdr", language: Language = "msg") -> None:
        self.name, self.wire = name, wire
        if len(text) > (_LONGEST_TEXT if language == "msg" else _LONGEST_IDL):
            raise MessageError(f"the definition of message type {name} has {len(text)} letters")
        try:
            self._types = get_types_from_msg(text, name) if language == "msg" else _types_of_idl(text)
        except Exception as error:  # a parser on a text that may be anything
            raise self._unreadable(error) from error
        if wire == "ros1":  # where CameraInfo has K, ROS 2 has k
            self._types = {
                kind: (constants, [(field.lower(), what) for field, what in fields])
                for kind, (constants, fields) in (_ROS1_TIMES | self._types).items()
            }
        _, fields = self._types.get(name, ((), ()))
        begins_so = next((what for _, what in fields), None) == (Nodetype.NAME, _HEADER)
        self.has_header = has_header(text) if language == "msg" else begins_so

    def check(self) -> None:
        """Raise MessageError if no messages can be read with the definition."""
        _ = self._store

    def decode(self, data: bytes) -> Any:
        """One message, decoded by rosbags. Raises MessageError."""
        store = self._store
        try:
            return (store.deserialize_cdr if self.wire == "cdr" else store.deserialize_ros1)(data, self.name)
        except (SerdeError, IndexError, TypeError, OverflowError, MemoryError) as error:
            reason = " ".join(str(error).split())
            raise MessageError(
                f"a message of {len(data)} bytes does not agree with the definition of {self.name} ({reason})"
            ) from error

    def numbers(self, value: Any) -> Array:
        """Return the numbers in a field of a decoded message as a flat array, in the order of the definition."""
        if isinstance(value, list):
            return np.concatenate([self.numbers(item) for item in value]) if value else np.empty(0)
        if hasattr(value, "__msgtype__"):
            members = self._store.get_msgdef(value.__msgtype__).fields
            return np.concatenate([self.numbers(getattr(value, name)) for name, _ in members])
        return np.atleast_1d(np.asarray(value, dtype=float))

    def encode(self, message: object) -> bytes:
        """Encode one message as CDR, little endian."""
        return bytes(self._store.serialize_cdr(message, self.name, little_endian=True))

    def fields(self, kind: str) -> Any:
        """Fields of this type or of a nested one as (name, rosbags' description)."""
        return self._store.fielddefs[kind][1]

    def new(self, kind: str, /, **given: Any) -> Any:
        """Create a message of this type or of a nested one; fields not given are zero, empty, or new messages."""
        values = {
            name: given[name] if name in given else self._zero(what) for name, what in self._store.fielddefs[kind][1]
        }
        return self._store.types[kind](**values)

    def layout(self, data: bytes) -> Layout | None:
        """Return the layout of a message; None if it is neither plain CDR, little or big endian, nor ROS 1."""
        if self.wire == "cdr" and data[:2] not in (b"\x00\x00", b"\x00\x01"):
            return None
        walk = _Walk(self._store.fielddefs, data, self.wire)
        try:
            walk.struct(self.name, "")
        except (IndexError, KeyError):
            return None
        # Up to three bytes of padding may follow in CDR.
        if not 0 <= len(data) - walk.end <= (3 if self.wire == "cdr" else 0):
            return None
        return Layout(data, tuple(walk.leaves), (*([(0, 2)] if self.wire == "cdr" else []), *walk.fixed))

    @cached_property
    def _store(self) -> Any:
        store = get_typestore(Stores.EMPTY)
        fields = _fields(self._types, self.name, {})
        if fields > _MOST_FIELDS:
            raise MessageError(f"the definition of message type {self.name} has {fields} fields")
        try:
            store.register(self._types)
            store.get_msgdef(self.name)
        except (TypesysError, KeyError, SyntaxError) as error:
            raise self._unreadable(error) from error
        return store

    def _unreadable(self, error: Exception) -> MessageError:
        reason = " ".join(str(error).split())
        return MessageError(f"the definition of message type {self.name} cannot be read ({reason})")

    def _zero(self, kind: Any) -> Any:
        node, what = kind
        if node == Nodetype.NAME:
            return self.new(what)
        if node == Nodetype.BASE:
            return "" if what[0] == "string" else 0
        (inner, name), count = what
        count = count if node == Nodetype.ARRAY else 0
        if inner == Nodetype.NAME:
            return [self.new(name) for _ in range(count)]
        return [""] * count if name[0] == "string" else np.zeros(count, _CODES.get(name[0], name[0]))


# Definitions by the texts of recordings, made once.
definition = lru_cache(maxsize=64)(Definition)


def _types_of_idl(text: str) -> Any:
    """Parse the IDL of one type, or of several types each under a line with its name, into definitions by name."""
    types: dict[str, Any] = {}
    for part in text.split(f"{'=' * 80}\n"):
        types |= (
            get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL: ") else part) if part.strip() else {}
        )
    return types


def has_header(text: str) -> bool:
    """Whether messages with this definition text begin with a std_msgs/Header."""
    lines = (line.partition("#")[0].split() for line in text.split("\n"))
    first = next((words for words in lines if words and not any("=" in word for word in words)), [""])
    return first[0] in ("Header", "std_msgs/Header", "std_msgs/msg/Header")


@lru_cache(maxsize=64)
def definition_text(name: str) -> str:
    """Return the definition text that a recording carries for a type, including all nested types.

    Raises MessageError for a type that is neither one of ROS 2 Humble's nor in _DEFINITIONS.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    for own, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, own))
    if name not in store.types:
        raise MessageError(f"the message type {name} is not known, and the recording does not define it")
    return store.generate_msgdef(name, ros_version=2)[0]


def known(name: str) -> Definition:
    """Return the definition of a known type, parsed from its `definition_text`. Raises MessageError."""
    return definition(name, definition_text(name))


def at(message: Any, path: str) -> Any:
    """Return the field of a decoded message at a dotted path. Raises AttributeError."""
    return reduce(getattr, path.split("."), message)


def _fields(types: Any, name: str, known: dict[str, int], depth: int = 0) -> int:
    """Count the numbers and strings in a message of a type, fixed-size arrays included. Raises MessageError."""
    if depth > _DEEPEST or name not in types:
        what = "is nested too deep" if name in types else f"lacks the type {name}"
        raise MessageError(f"the definition of a message type {what}")
    if name not in known:
        total = 0
        for _, (node, what) in types[name][1]:
            count = 1
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                count = what[1] if node == Nodetype.ARRAY else 1
                node, what = what[0]
            total += count * (_fields(types, what, known, depth + 1) if node == Nodetype.NAME else 1)
        known[name] = total
    return known[name]


class _Walk:
    """Walks one message along its definition; records the runs of numbers and the bytes that fix the layout.

    Raises IndexError when the message is too short and KeyError at something CDR has no numbers for.
    """

    def __init__(self, fielddefs: Any, data: bytes, wire: Wire) -> None:
        self.fielddefs, self.data = fielddefs, data
        self.aligned = wire == "cdr"
        self.end = 4 if self.aligned else 0  # behind the encapsulation; alignment counts from here
        self.leaves: list[Leaf] = []
        self.fixed: list[tuple[int, int]] = []
        self.order: Literal["<", ">"] = ">" if self.aligned and not data[1] else "<"

    def struct(self, name: str, path: str) -> None:
        members = self.fielddefs[name][1]
        if not members:
            raise KeyError(name)
        for member, kind in members:
            self.value(kind, f"{path}.{member}" if path else member)

    def value(self, kind: Any, path: str) -> None:
        node, what = kind
        if node == Nodetype.NAME:
            self.struct(what, path)
        elif node == Nodetype.BASE:
            self.base(what[0], path, 1)
        else:
            inner, count = what
            self.items(inner, path, count if node == Nodetype.ARRAY else self.length())

    def items(self, kind: Any, path: str, count: int) -> None:
        node, what = kind
        if node == Nodetype.BASE and what[0] != "string":
            self.base(what[0], path, count)
        else:
            for i in range(count):
                self.value(kind, f"{path}[{i}]")

    def base(self, name: str, path: str, count: int) -> None:
        if name == "string":
            self.take(1, self.length(), fixed=True)
        elif count:
            dtype = np.dtype(_CODES.get(name, name)).newbyteorder(self.order)
            start = self.take(dtype.itemsize, dtype.itemsize * count)
            self.leaves.append(Leaf(path, start, dtype, count))

    def length(self) -> int:
        start = self.take(4, 4, fixed=True)
        return int(np.frombuffer(self.data, f"{self.order}u4", 1, start)[0])

    def take(self, align: int, size: int, fixed: bool = False) -> int:
        start = 4 + -(-(self.end - 4) // align) * align if self.aligned else self.end
        self.end = start + size
        if self.end > len(self.data):
            raise IndexError(self.end)
        if fixed:
            self.fixed.append((start, self.end))
        return start
