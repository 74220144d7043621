"""A Foxglove WebSocket bridge as a source: its sensors' messages as MCAP.

The bridge is asked for what a method can read and nothing else. Whenever it drops the connection it is called again.
Messages that are none are refused and counted, and cost nothing else.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import Writer

from alidade.pipelines.applications.follow.network import (
    MESSAGE_DATA,
    MESSAGE_HEAD,
    SUBPROTOCOLS,
    RefusedError,
    read_id,
    read_message,
    websockets,
)
from alidade.pipelines.applications.follow.sources import Spool, Stream
from alidade.pipelines.errors import printable
from alidade.pipelines.recording.container import Channel, Schema
from alidade.pipelines.recording.decoding import MessageFormat
from alidade.pipelines.recording.messages import SENSORS

# Encoding of messages -> that of their schema, where a bridge does not say it and it is another.
_SCHEMAS = {"cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema"}
# Schemas that are bytes go as base64 through JSON.
_BYTES = ("protobuf", "flatbuffer")
# Between two calls of a bridge that does not answer, and for one that does, s.
_PAUSE, _PATIENCE = 0.5, 5.0
# A waiting client looks so often whether it is still wanted, and what has come is shown to readers so often, s.
_GLANCE, _FLUSH = 0.1, 0.01
# No message of a sensor is larger.
_LARGEST = 1 << 26
# Channels that are written down: more than any device has sensors.
MAX_CHANNELS = 1000


class _Topic(NamedTuple):
    """Description of a bridge's channel without its number."""

    name: str
    encoding: str
    schema: Schema


class Bridge(Stream):
    """Source of the messages of a Foxglove WebSocket bridge. Raises InputError when websockets is not installed.

    Args:
        url: ws://host:port or wss://.
        folder: where they are kept; None: nowhere.
        say: called when the bridge answers and when it does not.
    """

    def __init__(self, url: str, folder: Path | None, say: Callable[[str], None]) -> None:
        self._connect = websockets().sync.client.connect
        super().__init__(url, folder, say)
        self._url, self._sentence = url, ""
        self.refused = 0

    def _write(self, out: Spool) -> None:
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
                    self._say_once(f"{self._url}: connected")
                    self._listen(connection, record)
            except InvalidURI as error:
                self._say_once(f"{self._url}: no address of a bridge ({error})")
                break
            except (OSError, WebSocketException) as error:
                self._say_once(f"{self._url}: no connection ({' '.join(str(error).split())}); trying again")
            self._over.wait(_PAUSE)
        record.close()
        if self.refused > 1:
            self._say(f"{self._url}: {self.refused} messages refused")

    def _say_once(self, sentence: str) -> None:
        """Pass a sentence to `say` unless the sentence before was the same."""
        if sentence != self._sentence:
            self._sentence = sentence
            self._say(sentence)

    def _listen(self, connection: Any, record: _Record) -> None:
        """Record the messages of one connection until the connection closes."""
        wanted: dict[int, _Topic] = {}  # by subscription, which are numbered as the bridge's channels
        while not self._over.is_set():
            try:
                data = connection.recv(_GLANCE)
            except TimeoutError:
                record.flush()
                continue
            if isinstance(data, bytes):
                self._take(data, wanted, record)
                continue
            new = self._announced(data, wanted)
            if new and len(wanted) + len(new) <= MAX_CHANNELS:
                wanted |= new
                subscriptions = [{"id": number, "channelId": number} for number in new]
                connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
            elif new:
                self._refuse(f"more than {MAX_CHANNELS} channels")

    def _take(self, data: bytes, wanted: dict[int, _Topic], record: _Record) -> None:
        if len(data) < MESSAGE_HEAD.size or data[0] != MESSAGE_DATA:
            return
        _, subscription, log_ns = MESSAGE_HEAD.unpack_from(data)
        if subscription not in wanted:
            return
        try:
            record.add(wanted[subscription], log_ns, data[MESSAGE_HEAD.size :])
        except RefusedError as error:
            self._refuse(str(error))

    def _announced(self, text: str, wanted: dict[int, _Topic]) -> dict[int, _Topic]:
        """Return the usable channels that a message advertises; remove those it withdraws, whose ids are reused."""
        found: dict[int, _Topic] = {}
        try:
            message = read_message(text)
            channels = message.get("channels") if message.get("op") == "advertise" else []
            withdrawn = message.get("channelIds") if message.get("op") == "unadvertise" else []
            if not isinstance(channels, list) or not isinstance(withdrawn, list):
                raise RefusedError("channels that are no list")
            for number in map(read_id, withdrawn):
                wanted.pop(number, None)
        except RefusedError as error:
            self._refuse(str(error))
            return found
        for channel in channels:
            try:
                number, topic = _described(channel)
            except RefusedError as error:
                self._refuse(str(error))
                continue
            if number not in wanted and _is_of_use(topic):
                found[number] = topic
        return found

    def _refuse(self, why: str) -> None:
        self.refused += 1
        if self.refused == 1:
            self._say(f"{self._url}: a message refused ({why}); more are counted")


class _Record:
    """MCAP file of received messages, readable at any time up to the last flush."""

    def __init__(self, out: Spool) -> None:
        self._out, self._writer = out, Writer(out, use_chunking=False)  # type: ignore[arg-type]
        self._channels: dict[_Topic, int] = {}
        self._types: dict[str, tuple[str, ...]] = {}  # by topic: a recording in which they change is of no use
        self._flushed = time.monotonic()

    def add(self, topic: _Topic, log_ns: int, data: bytes) -> None:
        """Write a message of a topic. Raises RefusedError when the topic had another type before."""
        if self._out.is_full:
            self.flush()
        if self._out.is_full:
            self._out.dropped += 1
            return
        if not self._channels:
            self._writer.start("", "alidade")
        if topic not in self._channels:
            schema = topic.schema
            kind = topic.encoding, schema.encoding, schema.name
            if self._types.setdefault(topic.name, kind) != kind or len(self._channels) >= MAX_CHANNELS:
                raise RefusedError(f"topic {printable(topic.name)} with messages of another type")
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[topic] = self._writer.register_channel(topic.name, topic.encoding, number)
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns)
        if time.monotonic() - self._flushed > _FLUSH:
            self.flush()

    def flush(self) -> None:
        """Flush buffered messages to the file, where readers see them."""
        self._flushed = time.monotonic()
        self._out.flush()

    def close(self) -> None:
        """Write the end of the MCAP file, if it has any message, and flush the file."""
        if self._channels:
            self._writer.finish()  # type: ignore[no-untyped-call]
        self._out.flush()


def _described(channel: Any) -> tuple[int, _Topic]:
    """Return a channel's number and description, completed where a bridge may leave parts out. Raises RefusedError."""
    if not isinstance(channel, dict):
        raise RefusedError("a channel that is no object")
    given = [channel.get(name) or "" for name in ("topic", "encoding", "schemaName", "schemaEncoding", "schema")]
    if not all(isinstance(value, str) for value in given) or not (given[0] and given[1]):
        raise RefusedError("a channel without topic or encoding, or whose description is no text")
    topic, encoding, name, language, text = given
    language = language or _SCHEMAS.get(encoding, encoding)
    try:
        data = base64.b64decode(text, validate=True) if language in _BYTES else text.encode()
    except ValueError as error:
        raise RefusedError("a schema that is no base64") from error
    return read_id(channel.get("id")), _Topic(topic, encoding, Schema(1, name, language, data))


def _is_of_use(topic: _Topic) -> bool:
    """Whether a channel has messages of a sensor's type that can be decoded."""
    form = MessageFormat(Channel(1, topic.name, topic.encoding, 1), topic.schema)
    return form.is_readable and form.type in SENSORS
