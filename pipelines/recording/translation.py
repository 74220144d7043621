"""Messages of protobuf and JSON, and of Foxglove's types in ROS, as ROS 2 messages.

Translated are messages whose fields have the names that they have in ROS, and Foxglove's own types, which differ from
them in little: `timestamp` and `frame_id` instead of a header, a transform without a level of its own. What a message
does not say is NaN; a covariance is zero, unknown.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.container import Schema
from alidade.pipelines.recording.messages import Definition, MessageError

# Raised by parsing, translating or encoding a message that is not what its definition says.
_BROKEN = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, MemoryError)
_HEADER, _TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
# Last part of a type's name -> ROS 2 type; packages in which such a type is that of ROS, whatever its fields.
_ROS = {name.rpartition("/")[2]: name for name in messages.SENSORS}
_PACKAGES = {"ros", *(name.partition("/")[0] for name in messages.SENSORS)}
_FOXGLOVE = {
    "CompressedImage": messages.COMPRESSED_IMAGE,
    "CompressedVideo": messages.COMPRESSED_IMAGE,
    "PoseInFrame": messages.PLAIN_POSE,
    "FrameTransform": messages.TRANSFORM,
    "FrameTransforms": messages.TF,
    "CameraCalibration": messages.CAMERA_INFO,
    "RawImage": messages.IMAGE,
    "LocationFix": messages.NAV_SAT_FIX,
}
# What a message of ROS 2 has that has nothing.
_NO_MEMBER = "structure_needs_at_least_one_member"
# Numbers of a list that are columns of a table at most: a covariance has 36.
_LONGEST = 64
# Names of the two parts of a time.
_SECONDS, _NANOSECONDS = ("sec", "seconds", "secs"), ("nanosec", "nsec", "nanos", "nsecs")


def ros_type(name: str) -> str | None:
    """The ROS 2 type that messages of a type are translated into, None if there is none."""
    kind = name.replace(".", "/").rpartition("/")[2]
    return (_FOXGLOVE if is_foxglove(name) else _ROS).get(kind)


def is_known(name: str) -> bool:
    """Whether a type is of a package of ROS or Foxglove; another one may have fields of its own."""
    return is_foxglove(name) or not _PACKAGES.isdisjoint(name.replace(".", "/").split("/"))


def is_foxglove(name: str) -> bool:
    """Whether a type is one of Foxglove's: foxglove.X, in ROS foxglove_msgs/msg/X."""
    return name.startswith("foxglove")


class Translation:
    """Converter of recorded messages, as of protobuf, JSON or ROS 1, to the CDR bytes of a ROS 2 message type.

    Raises MessageError.
    """

    def __init__(self, recorded: Schema | Definition, definition: Definition) -> None:
        self._definition = definition
        self._parse = parser(recorded)

    def __call__(self, data: bytes) -> bytes:
        """Translate one message into the bytes of a CDR message."""
        try:
            return self._encoded(self._parse(data))
        except _BROKEN as error:
            reason = " ".join(str(error).split())[:200]
            name = self._definition.name
            raise MessageError(f"a message of {len(data)} bytes does not translate into {name} ({reason})") from error

    def fits(self, data: bytes) -> bool | None:
        """Whether a message translates and has one of the ROS 2 type's fields, a header apart; None if it is broken."""
        try:
            tree = self._parse(data)
        except _BROKEN:
            return None
        own = {
            name for name, what in self._definition.fields(self._definition.name) if what != (Nodetype.NAME, _HEADER)
        }
        try:
            self._encoded(tree)
            return not own.isdisjoint(name.lower() for name, _ in _fields(tree))
        except _BROKEN:
            return False

    def _encoded(self, tree: Any) -> bytes:
        """Encode a parsed message as CDR."""
        return self._definition.encode(self._message(self._definition.name, tree))

    def _message(self, kind: str, tree: Any) -> Any:
        if kind == _TIME:
            return self._definition.new(kind, sec=int(_any(tree, _SECONDS)), nanosec=int(_any(tree, _NANOSECONDS)))
        values = {}
        for name, what in self._definition.fields(kind):
            found = _get(tree, name)
            if what == (Nodetype.NAME, _HEADER) and found is None:
                found = {
                    "stamp": _get(tree, "timestamp"),
                    "frame_id": _get(tree, "frame_id") or _get(tree, "parent_frame_id"),
                }
            elif kind == messages.TRANSFORM and name == "transform" and found is None:
                found = tree
            values[name] = self._value(what, found, name)
        return self._definition.new(kind, **values)

    def _value(self, kind: Any, found: Any, name: str) -> Any:
        node, what = kind
        if node == Nodetype.NAME:
            return self._message(what, {} if found is None else found)
        if node == Nodetype.BASE:
            return _scalar(what[0], found)
        (inner, element), count = what
        count = count if node == Nodetype.ARRAY else 0
        if inner == Nodetype.NAME:
            return [self._message(element, one) for one in found or ()]
        if element[0] == "string":
            return [str(one) for one in found or ()]
        dtype = "u1" if element[0] in ("bool", "byte", "char") else element[0]
        if found is None or (count and not len(found)):
            return np.full(count, 0.0 if "covariance" in name or dtype[0] != "f" else np.nan, dtype)
        if isinstance(found, (str, bytes)):
            return np.frombuffer(base64.b64decode(found, validate=True) if isinstance(found, str) else found, dtype)
        values = np.array(found, float if dtype[0] == "f" else None).astype(dtype)
        if values.ndim != 1 or count not in (0, len(values)):
            raise ValueError(f"{name}: shape {values.shape} instead of {count or 'a list'}")
        return values


def parser(recorded: Schema | Definition) -> Callable[[bytes], Any]:
    """Return the function from a message's bytes to its fields: an object of ROS or protobuf, or JSON's mapping.

    Raises MessageError for a definition that cannot be read; the function MessageError or ValueError.
    """
    if isinstance(recorded, Definition):
        return recorded.decode
    return _protobuf(recorded) if recorded.encoding == "protobuf" else _json


def cells(tree: Any, name: str = "") -> Iterator[tuple[str, int | float | str]]:
    """Yield the numbers and words in a message's fields by path, `header.stamp`, `gyro_rad[0]`; true and false as 1, 0.

    A time of seconds and nanoseconds is one number, ns. Lists of more than `_LONGEST` numbers are left out, as pictures
    are.
    """
    if isinstance(tree, np.generic):
        tree = tree.item()
    if isinstance(tree, (bool, int, float, str)):
        yield name, int(tree) if isinstance(tree, bool) else tree
    elif hasattr(tree, "__len__") and not isinstance(tree, (bytes, Mapping)):
        for i, each in enumerate(tree if len(tree) <= _LONGEST else ()):
            yield from cells(each, f"{name}[{i}]")
    elif not isinstance(tree, (bytes, type(None))):
        fields = _fields(tree)
        if [each for each, _ in fields] == ["sec", "nanosec"] and all(isinstance(one, int) for _, one in fields):
            yield name, fields[0][1] * 1_000_000_000 + fields[1][1]
            return
        for field, value in fields:
            yield from cells(value, f"{name}.{field}" if name else field)


def _fields(tree: Any) -> list[tuple[str, Any]]:
    """Return the name and value of each top-level field of a ROS, protobuf or JSON message, in order."""
    if isinstance(tree, Mapping):
        return [(str(key), value) for key, value in tree.items()]
    if hasattr(tree, "__msgtype__"):
        names = [each.name for each in dataclasses.fields(tree) if each.name not in ("__msgtype__", _NO_MEMBER)]
        return [(name, getattr(tree, name)) for name in names]
    return [(each.name, _get(tree, each.name)) for each in tree.DESCRIPTOR.fields]


def _scalar(kind: str, found: Any) -> Any:
    if kind == "string":
        return "" if found is None else str(found)
    if kind.startswith("float"):
        return float("nan") if found is None else float(found)
    return 0 if found is None else int(found)


def _get(tree: Any, name: str) -> Any:
    """Return a field by its ROS name, in lower or upper case; None if there is none."""
    if isinstance(tree, Mapping):
        found = tree.get(name)
        return tree.get(name.upper()) if found is None else found
    if hasattr(tree, "__msgtype__"):
        return getattr(tree, name, None)
    fields = tree.DESCRIPTOR.fields_by_name
    field = fields.get(name) or fields.get(name.upper())
    if field is None or (field.has_presence and not tree.HasField(field.name)):
        return None
    return getattr(tree, field.name)


def _any(tree: Any, names: tuple[str, ...]) -> Any:
    """Return the first of several fields that a message has, else 0."""
    return next((found for name in names if (found := _get(tree, name)) is not None), 0)


def _json(data: bytes) -> Any:
    tree = json.loads(data)
    if not isinstance(tree, dict):
        raise ValueError("it is no JSON object")
    return tree


def _protobuf(schema: Schema) -> Callable[[bytes], Any]:
    """Return a parser of messages of the type that a FileDescriptorSet defines."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

    try:
        pool = descriptor_pool.DescriptorPool()
        message_factory.GetMessages(descriptor_pb2.FileDescriptorSet.FromString(schema.data).file, pool)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (message.Error, KeyError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise MessageError(f"the definition of message type {schema.name} cannot be read ({reason})") from error

    def parse(data: bytes) -> Any:
        try:
            return kind.FromString(data)
        except message.DecodeError as error:
            raise ValueError(str(error)) from error

    return parse
