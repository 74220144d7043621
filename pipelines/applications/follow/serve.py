"""The state of a recording being followed, live over Foxglove's WebSocket.

One topic per parameter, `/estimate/<parameter>`, with the fields of estimates.mcap (value, sigma, lower, upper) so that
one layout shows both, and what is required; `/status` says the rest in words. JSON messages with a schema. Whoever
comes late, or reads slowly, gets the last message of each topic. Pages of other sites are refused by their Origin.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pydantic_core import to_json

from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.network import (
    HANDSHAKE_TIME_S,
    MESSAGE_DATA,
    MESSAGE_HEAD,
    SUBPROTOCOLS,
    Gate,
    RefusedError,
    read_id,
    read_message,
    websockets,
)
from alidade.pipelines.errors import InputError

# Others on the network have no business with a calibration bench.
HOST = "127.0.0.1"
PORT = 8765  # Foxglove's own
# Pages that may read the estimates: Foxglove's. Programs that are no browser send no Origin.
ORIGINS = ("https://app.foxglove.dev", "https://studio.foxglove.dev")
# Every connection has two threads; one client subscribes to each topic once, of which there are some hundred at most.
MAX_CLIENTS, MAX_SUBSCRIPTIONS = 32, 4096
# A subscription to thousands of channels in one message, bytes.
MAX_MESSAGE_BYTES = 1 << 18

# Whoever calls and says no WebSocket is no news for the person recording.
_SILENT = logging.Logger("alidade.serve", logging.CRITICAL + 1)

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_ESTIMATE = {
    "title": "alidade.Estimate",
    "type": "object",
    "properties": {**dict.fromkeys(("value", "sigma", "lower", "upper", "require"), _NUMBER), "verdict": _TEXT},
}
_STATUS = {
    "title": "alidade.Status",
    "type": "object",
    "properties": {
        "time_s": _NUMBER,
        "status": _TEXT,
        "headline": _TEXT,
        "missing": {"type": "array", "items": _TEXT},
        "collected": {"type": "array", "items": {"type": "object", "properties": {"what": _TEXT, "have": _TEXT}}},
    },
}


class LiveServer:
    """Context manager that serves a calibration on the loopback interface.

    Raises InputError when websockets is not installed or the port is taken.

    Args:
        port: 0: any that is free.
        origins: pages of other sites that may read it, beside Foxglove's: `https://example.org`.
    """

    def __init__(self, port: int = PORT, origins: Sequence[str] = ()) -> None:
        serve = websockets().sync.server.serve
        self._changed = threading.Condition()
        self._channels: dict[str, dict[str, Any]] = {}  # topic -> how it is advertised
        self._last: dict[int, _Last] = {}  # by channel
        self._over = False
        try:
            self._server = serve(
                self._client,
                HOST,
                port,
                subprotocols=SUBPROTOCOLS,
                origins=[None, *ORIGINS, *origins],
                open_timeout=HANDSHAKE_TIME_S,
                max_size=MAX_MESSAGE_BYTES,
                logger=_SILENT,
            )
        except (OSError, OverflowError) as error:
            raise InputError(f"--port {port}: no server can be started there ({error}); give another") from error
        self._gate, self._handle = Gate(MAX_CLIENTS, MAX_CLIENTS), self._server.handler
        self._server.handler = self._bounded
        self._advertise("/status", _STATUS, {})

    @property
    def url(self) -> str:
        """Address of the server, for Foxglove."""
        return f"ws://{HOST}:{self._server.socket.getsockname()[1]}"

    def __enter__(self) -> LiveServer:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._over = True
            self._changed.notify_all()
        self._server.shutdown()

    def show(self, view: View) -> None:
        """Send a view to all clients, with the recording's time as log time."""
        at = view.epoch_ns + round(view.time * 1e9)
        if view.values is not None and view.sigmas is not None:
            for q, value, sigma in zip(view.quantities, view.values.tolist(), view.sigmas.tolist(), strict=True):
                message = {"value": value, "sigma": sigma, "lower": value - sigma, "upper": value + sigma}
                if q.judged:
                    message |= {"require": q.require, "verdict": view.verdicts[q.name]}
                self._log(f"/estimate/{q.name}", _ESTIMATE, {"unit": q.unit}, message, at)
        self._log("/status", _STATUS, {}, view.summary, at)

    def _advertise(self, topic: str, schema: dict[str, Any], metadata: dict[str, str]) -> int:
        """Return the number of a topic's channel; announce a new channel to all clients."""
        with self._changed:
            if topic not in self._channels:
                self._channels[topic] = {
                    "id": len(self._channels) + 1,
                    "topic": topic,
                    "encoding": "json",
                    "schemaName": schema["title"],
                    "schemaEncoding": "jsonschema",
                    "schema": json.dumps(schema),
                    "metadata": metadata,
                }
                self._changed.notify_all()
            return int(self._channels[topic]["id"])

    def _log(
        self, topic: str, schema: dict[str, Any], metadata: dict[str, str], message: dict[str, Any], at: int
    ) -> None:
        number = self._advertise(topic, schema, metadata)
        with self._changed:
            before = self._last[number].number if number in self._last else 0
            self._last[number] = _Last(before + 1, at, to_json(message, inf_nan_mode="null"))
            self._changed.notify_all()

    # -- one client: this thread listens, another one sends

    def _bounded(self, connected: socket.socket, address: tuple[Any, ...]) -> None:
        """Serve a connection as long as the gate has room for it."""
        self._gate.admit(connected, str(address[0]), lambda: _hang_up(connected))
        try:
            self._handle(connected, address)
        finally:
            self._gate.release(connected)

    def _client(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed as Closed

        self._gate.trust(connection.socket)
        client = _Client()
        sender = threading.Thread(target=self._send, args=(connection, client), daemon=True)
        sender.start()
        with suppress(Closed):
            for text in connection:
                with self._changed:
                    client.take(text)
                    self._changed.notify_all()
        with self._changed:
            client.gone = True
            self._changed.notify_all()
        sender.join()

    def _send(self, connection: Any, client: _Client) -> None:
        """Send all channels, and each last message of the wanted ones once, until the client is gone."""
        from websockets.exceptions import ConnectionClosed as Closed

        info = {"op": "serverInfo", "name": "alidade", "capabilities": [], "supportedEncodings": [], "metadata": {}}
        try:
            connection.send(json.dumps(info))
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._news(client))
                    if self._over or client.gone:
                        return
                    channels = list(self._channels.values())[client.channels :]
                    client.channels += len(channels)
                    due = self._due(client)
                    client.sent |= {subscription: last.number for subscription, last in due.items()}
                if channels:
                    connection.send(json.dumps({"op": "advertise", "channels": channels}))
                for subscription, last in due.items():
                    connection.send(MESSAGE_HEAD.pack(MESSAGE_DATA, subscription, last.at_ns) + last.data)
        except Closed:
            return

    def _news(self, client: _Client) -> bool:
        return self._over or client.gone or len(self._channels) > client.channels or bool(self._due(client))

    def _due(self, client: _Client) -> dict[int, _Last]:
        """Return subscription -> last message, for messages that the client has not received."""
        wanted = {subscription: self._last.get(channel) for subscription, channel in client.wanted.items()}
        return {s: last for s, last in wanted.items() if last is not None and last.number > client.sent.get(s, 0)}


class _Last(NamedTuple):
    """Last message of a channel: its running number, time, ns, and bytes."""

    number: int
    at_ns: int
    data: bytes


@dataclass
class _Client:
    """State of a client: the channels it wants, by subscription, and the last message sent to each."""

    wanted: dict[int, int] = field(default_factory=dict)
    sent: dict[int, int] = field(default_factory=dict)  # subscription -> number of the last message
    channels: int = 0  # announced
    gone: bool = False

    def take(self, text: str | bytes) -> None:
        """Apply a client's subscriptions, up to MAX_SUBSCRIPTIONS; ignore all other messages."""
        if isinstance(text, bytes):
            return
        try:
            message = read_message(text)
            subscribed = {read_id(one["id"]): read_id(one["channelId"]) for one in message.get("subscriptions", [])}
            unsubscribed = [read_id(number) for number in message.get("subscriptionIds", [])]
        except (RefusedError, KeyError, TypeError):
            return
        for number in (*subscribed, *unsubscribed):
            self.wanted.pop(number, None)
            self.sent.pop(number, None)
        if message.get("op") == "subscribe":
            room = MAX_SUBSCRIPTIONS - len(self.wanted)
            self.wanted |= dict(list(subscribed.items())[:room])


def _hang_up(connected: socket.socket) -> None:
    """Shut down a connection from any thread; the thread that reads or writes then finds it closed."""
    with suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)
