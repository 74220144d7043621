"""A Foxglove WebSocket bridge as a source: its sensors' messages, written down as MCAP.

The bridge is asked for what a method can read and nothing else. Whenever it drops the connection it is called again.
"""

from __future__ import annotations

import base64
import binascii
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import Writer

from alidade.pipelines.applications.follow.protocol import MESSAGE_DATA, MESSAGE_HEAD, SUBPROTOCOLS, websockets
from alidade.pipelines.applications.follow.sources import Stream
from alidade.pipelines.recording.channel_format import ChannelFormat
from alidade.pipelines.recording.container import Channel, Schema
from alidade.pipelines.recording.messages import SENSORS

# Encoding of messages -> that of their schema, where a bridge does not say it.
_SCHEMAS = {
    "cdr": "ros2msg",
    "ros1": "ros1msg",
    "protobuf": "protobuf",
    "json": "jsonschema",
    "flatbuffer": "flatbuffer",
}
# Schemas that are bytes go as base64 through JSON.
_BYTES = ("protobuf", "flatbuffer")
# Between two calls of a bridge that does not answer, and for one that does, s.
_PAUSE, _PATIENCE = 0.5, 5.0
# A waiting client looks so often whether it is still wanted, and what has come is shown to readers so often, s.
_GLANCE, _FLUSH = 0.1, 0.01
# No message of a sensor is larger.
_LARGEST = 1 << 26


class Bridge(Stream):
    """The messages of a bridge. Raises InputError when websockets is not installed.

    Args:
        url: ws://host:port or wss://.
        folder: where they are kept; None: nowhere.
        say: is told when the bridge answers and when it does not.
    """

    def __init__(self, url: str, folder: Path | None, say: Callable[[str], None]) -> None:
        self._connect = websockets().sync.client.connect
        super().__init__(url, folder)
        self._url, self._say, self._told = url, say, ""

    def _write(self, out: BinaryIO) -> None:
        from websockets.exceptions import InvalidURI, WebSocketException

        record = _Record(out)
        while not self._over.is_set():
            try:
                with self._connect(
                    self._url,
                    subprotocols=SUBPROTOCOLS,
                    max_size=_LARGEST,
                    open_timeout=_PATIENCE,
                    close_timeout=_PAUSE,
                ) as connection:
                    self._tell(f"{self._url}: connected")
                    self._listen(connection, record)
            except InvalidURI as error:
                self._tell(f"{self._url}: no address of a bridge ({error})")
                break
            except (OSError, WebSocketException) as error:
                self._tell(f"{self._url}: no connection ({' '.join(str(error).split())}); trying again")
            time.sleep(_PAUSE)
        record.close()

    def _tell(self, sentence: str) -> None:
        """Say it, but not twice in a row."""
        if sentence != self._told:
            self._told = sentence
            self._say(sentence)

    def _listen(self, connection: Any, record: _Record) -> None:
        """Take what one connection brings, until it closes."""
        wanted: dict[int, dict[str, Any]] = {}  # by subscription, which are numbered as the bridge's channels
        while not self._over.is_set():
            try:
                data = connection.recv(_GLANCE)
            except TimeoutError:
                record.flush()
                continue
            if isinstance(data, bytes):
                if len(data) >= MESSAGE_HEAD.size and data[0] == MESSAGE_DATA:
                    _, subscription, log_ns = MESSAGE_HEAD.unpack_from(data)
                    if subscription in wanted:
                        record.add(wanted[subscription], log_ns, data[MESSAGE_HEAD.size :])
                continue
            new = {number: one for number, one in _advertised(data).items() if number not in wanted}
            if new:
                wanted |= new
                subscriptions = [{"id": number, "channelId": number} for number in new]
                connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


class _Record:
    """An MCAP file of what comes, readable up to the last message at any time."""

    def __init__(self, out: BinaryIO) -> None:
        self._out, self._writer = out, Writer(out, use_chunking=False)
        self._channels: dict[tuple[str, ...], int] = {}
        self._flushed = time.monotonic()

    def add(self, channel: dict[str, Any], log_ns: int, data: bytes) -> None:
        """A message of a channel as the bridge describes it."""
        key = tuple(str(channel[name]) for name in ("topic", "encoding", "schemaName", "schema"))
        if not self._channels:
            self._writer.start("", "alidade")
        if key not in self._channels:
            schema = self._writer.register_schema(channel["schemaName"], channel["schemaEncoding"], _schema(channel))
            self._channels[key] = self._writer.register_channel(channel["topic"], channel["encoding"], schema)
        self._writer.add_message(self._channels[key], log_ns, data, log_ns)
        if time.monotonic() - self._flushed > _FLUSH:
            self.flush()

    def flush(self) -> None:
        """Let readers see it."""
        self._flushed = time.monotonic()
        self._out.flush()

    def close(self) -> None:
        """With what a closed file ends with, if anything has come."""
        if self._channels:
            self._writer.finish()  # type: ignore[no-untyped-call]
        self._out.flush()


def _advertised(text: str) -> dict[int, dict[str, Any]]:
    """The channels that a bridge tells of in a message and that are of use, by its numbers."""
    try:
        told = json.loads(text)
        channels = told["channels"] if told["op"] == "advertise" else []
        found = {}
        for channel in channels:
            encoding = channel["encoding"]
            given = {name: value for name, value in channel.items() if value}
            whole = {"schema": "", "schemaName": "", "schemaEncoding": _SCHEMAS.get(encoding, encoding), **given}
            if _is_of_use(whole):
                found[int(whole["id"])] = whole
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
    return found


def _schema(channel: dict[str, Any]) -> bytes:
    text = str(channel["schema"])
    return base64.b64decode(text, validate=True) if channel["schemaEncoding"] in _BYTES else text.encode()


def _is_of_use(channel: dict[str, Any]) -> bool:
    """Whether the messages are a sensor's, and can be read."""
    try:
        schema = Schema(1, str(channel["schemaName"]), channel["schemaEncoding"], _schema(channel))
    except binascii.Error:
        return False
    form = ChannelFormat(Channel(1, str(channel["topic"]), channel["encoding"], 1), schema)
    return form.is_readable and form.type in SENSORS
