"""Recordings played anew: over a Foxglove bridge, into files, into a pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import foxglove
from mcap.reader import make_reader
from mcap.writer import Writer

# Schema and channel as mcap's reader gives them, log time in ns, the message.
Message = tuple[Any, Any, int, bytes]


def messages(path: Path) -> list[Message]:
    """The messages of an MCAP file."""
    with path.open("rb") as stream:
        return [(schema, channel, m.log_time, m.data) for schema, channel, m in make_reader(stream).iter_messages()]


def paced(whole: list[Message], speed: float, wait: threading.Event | None = None) -> Iterator[Message]:
    """The messages when they are due, so many times as fast as they were recorded."""
    if wait is not None:
        assert wait.wait(30.0), "nobody subscribed"
    start, first = time.monotonic(), whole[0][2]
    for message in whole:
        ahead = (message[2] - first) * 1e-9 / speed - (time.monotonic() - start)
        if ahead > 0.0:
            time.sleep(ahead)
        yield message


class Bridge:
    """A bridge that plays messages once somebody has subscribed to all of its topics; a context.

    Args:
        whole: what it plays.
        speed: how fast.
        drop_at: shares of the messages after which it hangs up, and comes back.
        also: topics that nobody is expected to ask for.
    """

    def __init__(
        self, whole: list[Message], speed: float, drop_at: Sequence[float] = (), also: tuple[str, ...] = ()
    ) -> None:
        self._whole, self._speed, self._also = whole, speed, also
        self._drops = {int(share * len(whole)) for share in drop_at}
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        for schema, channel, _, _ in whole:
            if channel.topic not in self._channels:
                self._channels[channel.topic] = foxglove.Channel(
                    channel.topic,
                    message_encoding=channel.message_encoding,
                    schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                    context=self._context,
                )
        self.subscribed: set[str] = set()
        self._played: float | None = None
        self.came: dict[int, float] = {}  # log time -> when it was played
        self._ready, self._over = threading.Event(), threading.Event()
        self._server = self._serve(0)
        self.port = self._server.port
        self.url = f"ws://127.0.0.1:{self.port}"

    def __enter__(self) -> Bridge:
        threading.Thread(target=self._play, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._server.stop()

    @property
    def is_over(self) -> bool:
        """Whether all has been played, and had time to come."""
        return self._played is not None and time.monotonic() - self._played > 0.5

    def on_subscribe(self, _: object, channel: Any) -> None:
        self.subscribed.add(channel.topic)
        if self.subscribed >= self._channels.keys() - set(self._also):
            self._ready.set()

    def on_unsubscribe(self, _: object, __: object) -> None: ...

    def _serve(self, port: int) -> Any:
        """On a port that may take a moment to be free again."""
        end = time.monotonic() + 20.0
        while True:
            try:
                return foxglove.start_server(
                    name="bridge", host="127.0.0.1", port=port, context=self._context, server_listener=self
                )
            except RuntimeError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)

    def _play(self) -> None:
        for i, (_, channel, log_ns, data) in enumerate(paced(self._whole, self._speed, self._ready)):
            if self._over.is_set():
                return
            if i in self._drops:
                self._server.stop()
                self._ready.clear()
                self.subscribed.clear()
                self._server = self._serve(self.port)
                assert self._ready.wait(30.0), "nobody came back"
            self._channels[channel.topic].log(data, log_time=log_ns)
            self.came[log_ns] = time.monotonic()
        self._played = time.monotonic()


def write(whole: Iterator[Message] | list[Message], out: BinaryIO, chunk_size: int = 20_000) -> None:
    """As an MCAP file, a chunk at a time."""
    writer = Writer(out, chunk_size=chunk_size)
    writer.start("ros2")
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for schema, channel, log_ns, data in whole:
        if schema.name not in schemas:
            schemas[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.topic not in channels:
            coding = channel.message_encoding
            channels[channel.topic] = writer.register_channel(channel.topic, coding, schemas[schema.name])
        writer.add_message(channels[channel.topic], log_ns, data, log_ns)
        out.flush()
    writer.finish()  # type: ignore[no-untyped-call]
    out.flush()
