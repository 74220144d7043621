"""How the messages of a channel are read: as ROS lays them out, or translated from protobuf, JSON, Foxglove's types."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.container import Channel, MessageBlock, Schema
from alidade.pipelines.recording.decoding import header_stamps, logged_at
from alidade.pipelines.recording.messages import Definition, Language, MessageError, Wire
from alidade.pipelines.recording.translation import Translation, is_foxglove, ros_type

# Encoding of the messages and of what defines them -> layout, and what the definition is written in.
_ROS: dict[str, tuple[Wire, Language]] = {
    "cdr/ros2msg": ("cdr", "msg"),
    "cdr/ros2idl": ("cdr", "idl"),
    "ros1/ros1msg": ("ros1", "msg"),
}
_TRANSLATED = ("protobuf/protobuf", "json/jsonschema")
READABLE = (*_ROS, *_TRANSLATED)
# Encoding that is not read -> how to get one that is.
_CONVERTED = {
    "flatbuffer/flatbuffer": "record with Foxglove's protobuf schemas, whose fields are the same, or write "
    "the messages as JSON, which `flatc --json --raw-binary` makes of each with its .fbs, into another MCAP file",
}


def converted(encoding: str) -> str:
    """How to get an encoding that is read in place of one that is not, as the end of a sentence; may be empty."""
    return f": {_CONVERTED[encoding]}" if encoding in _CONVERTED else ""


class ChannelFormat:
    """What the messages of a channel are.

    Attributes:
        type: the ROS 2 name of their type, or of the one they are translated into; as recorded where there is none.
        encoding: of the messages and of what defines them, `cdr/ros2msg` in ROS 2.
        is_readable: whether messages of this encoding and type can be read.
    """

    def __init__(self, channel: Channel, schema: Schema | None) -> None:
        self._schema = schema
        self.encoding = f"{channel.message_encoding}/{schema.encoding if schema else ''}"
        self.type = schema.name if schema else ""
        self._wire: Wire | None
        self._language: Language
        self._wire, self._language = _ROS.get(self.encoding, (None, "msg"))
        self.is_readable = self._wire is not None
        if self._wire == "ros1":
            self.type = _ros2_name(self.type)
        self._recorded_type = self.type
        is_ros = self.encoding not in _TRANSLATED and not (self.is_readable and is_foxglove(self.type))
        known = None if is_ros else ros_type(self.type)
        self._is_translated = known is not None
        self.type = known or self.type
        self.is_readable |= self._is_translated

    @cached_property
    def definition(self) -> Definition:
        """Of the type. Raises MessageError where it cannot be used."""
        return messages.known(self.type) if self._is_translated else self._recorded

    @cached_property
    def _recorded(self) -> Definition:
        """As the recording has it, in ROS."""
        assert self._schema is not None
        assert self._wire is not None
        text = self._schema.data.decode(errors="replace") or messages.definition_text(self._recorded_type)
        language = self._language if self._schema.data else "msg"
        found = messages.definition(self._recorded_type, text, self._wire, language)
        found.check()
        return found

    def rows(self, rows: MessageBlock) -> MessageBlock:
        """The messages as `definition` tells them. Raises MessageError at one that cannot be translated."""
        if not self._is_translated:
            return rows
        translated = []
        for i, log_ns in enumerate(rows.log_ns.tolist()):
            with logged_at(log_ns):
                translated.append(self._translation(rows.message(i)))
        return MessageBlock.pack(rows.channel, translated, rows.log_ns)

    def stamps(self, rows: MessageBlock) -> NDArray[np.int64]:
        """Header stamps of messages as the container has them, ns: 0 where there is none, log times if none is read."""
        stamps = rows.log_ns
        if self._wire and not self._is_translated and self._schema is not None and self._language == "msg":
            has_header = messages.has_header(self._schema.data.decode(errors="replace"))
            stamps = header_stamps(has_header, rows, self._wire)
        elif self.is_readable:
            try:
                stamps = header_stamps(self.definition.has_header, self.rows(rows), self.definition.wire)
            except MessageError:
                return rows.log_ns
        return stamps

    @cached_property
    def _translation(self) -> Translation:
        assert self._schema is not None
        return Translation(self._schema if self._wire is None else self._recorded, self.definition)


def _ros2_name(name: str) -> str:
    package, _, kind = name.partition("/")
    return name if kind.startswith("msg/") else f"{package}/msg/{kind}"
