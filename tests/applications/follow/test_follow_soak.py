"""`follow` while a recording is made, under clients that misbehave, a bridge that drops and a disk that fills."""

from __future__ import annotations

import os
import random
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest

from alidade.pipelines.applications.follow import follow as following
from alidade.pipelines.applications.follow.follower import Settings
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.protocol import SUBPROTOCOLS, websockets
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.session import calibrate
from alidade.pipelines.methods import simulate
from alidade.pipelines.recording.recording import open_recording
from tests.support.live import Bridge, messages

connect: Any = websockets().sync.client.connect
Attack = Callable[[random.Random, int, int], None]


def _idle(rng: random.Random, page: int, _: int) -> None:
    with socket.create_connection(("127.0.0.1", page), timeout=5.0) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: loc"[: rng.randrange(26)])
        time.sleep(rng.uniform(0.0, 8.0))


def _garbage(rng: random.Random, page: int, served: int) -> None:
    with socket.create_connection(("127.0.0.1", rng.choice([page, served])), timeout=5.0) as client:
        client.sendall(rng.randbytes(rng.randrange(1, 100_000)))


def _stream(rng: random.Random, page: int, _: int) -> None:
    """Asks for the events, and reads a little or nothing of them."""
    with socket.create_connection(("127.0.0.1", page), timeout=5.0) as client:
        client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        client.recv(rng.choice([1, 1000]))
        time.sleep(rng.uniform(0.0, 8.0))


def _stranger(rng: random.Random, page: int, _: int) -> None:
    with socket.create_connection(("127.0.0.1", page), timeout=5.0) as client:
        client.sendall(f"GET /?token={rng.random()} HTTP/1.1\r\nHost: evil.example\r\n\r\n".encode())
        assert b" 403 " in client.recv(4096)


def _subscriber(rng: random.Random, _: int, served: int) -> None:
    with connect(f"ws://127.0.0.1:{served}", subprotocols=SUBPROTOCOLS, open_timeout=5.0) as client:
        for _ in range(rng.randrange(20)):
            numbers = (rng.choice([rng.randrange(100), -1, 1 << 40]) for _ in range(rng.randrange(500)))
            wanted = ", ".join(f'{{"id": {number}, "channelId": {rng.randrange(30)}}}' for number in numbers)
            client.send(f'{{"op": "subscribe", "subscriptions": [{wanted}]}}')
            client.send("[" * rng.randrange(100_000))
            time.sleep(rng.uniform(0.0, 0.5))


ATTACKS: list[Attack] = [_idle, _garbage, _stream, _stranger, _subscriber]


class Attackers:
    """Many who attack a page and a server, again and again; a context."""

    def __init__(self, many: int, page: int, served: int) -> None:
        self.made, self._over = 0, threading.Event()
        self._threads = [threading.Thread(target=self._attack, args=(i, page, served)) for i in range(many)]

    def __enter__(self) -> Attackers:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(30.0)

    def _attack(self, seed: int, page: int, served: int) -> None:
        rng = random.Random(seed)
        while not self._over.is_set():
            with suppress(Exception):  # whatever becomes of the attacker
                rng.choice(ATTACKS)(rng, page, served)
            self.made += 1
            time.sleep(rng.uniform(0.0, 1.0))


@pytest.mark.slow
def test_nothing_is_lost_and_memory_stays_under_attack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute and a half; the bridge drops once, the disk is full for 3 s of every 10 s, 60 clients misbehave."""
    scenario, whole, config = tmp_path / "s.yaml", tmp_path / "whole.mcap", tmp_path / "c.yaml"
    scenario.write_text("{duration_s: 90, gyro_rate_hz: 50, gimbal_rate_hz: 50, image_rate_hz: 5}")
    simulate("los", str(scenario), 0, whole, False)
    config.write_bytes(open_recording(whole).attachment("alidade.yaml") or b"")
    began, write, full, failed = time.monotonic(), os.pwrite, [0], list[Any]()

    def limited(file: int, data: memoryview, at: int) -> int:
        if (time.monotonic() - began) % 10.0 < 3.0:
            full[0] += 1
            raise OSError(28, "No space left on device")
        return write(file, data, at)

    monkeypatch.setattr(os, "pwrite", limited)
    monkeypatch.setattr(threading, "excepthook", failed.append)
    servers: dict[str, int] = {}
    for kind in (LivePage, LiveServer):
        _remember_port(monkeypatch, kind, servers)
    memory: list[tuple[float, int]] = []
    started, over = threading.Event(), threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            memory.append((time.monotonic() - began, psutil.Process().memory_info().rss))

    def attack() -> None:
        while len(servers) < 2:
            time.sleep(0.05)
        started.set()
        with Attackers(60, servers["LivePage"], servers["LiveServer"]) as attackers:
            over.wait(200.0)
        servers["made"] = attackers.made

    threads = [threading.Thread(target=each) for each in (watch, attack)]
    for thread in threads:
        thread.start()
    kept = tmp_path / "kept"
    try:
        with Bridge(messages(whole), 1.0, drop_at=0.5) as bridge:
            settings = Settings(config=config, patience=8.0)
            live = following.follow(bridge.url, settings, 0, kept, True, ("127.0.0.1", 0))
    finally:
        over.set()
        for thread in threads:
            thread.join(60.0)
    assert failed == []
    assert full[0] > 3, "the disk was full"
    assert servers["made"] > 500
    again = calibrate(next(kept.glob("*.mcap")), ["incremental"], None, config)[0]
    assert live.facts.duration_s == again.facts.duration_s > 85.0
    sent = {name: topic.count for name, topic in open_recording(whole).topics.items()}
    came = {name: topic.count for name, topic in open_recording(next(kept.glob("*.mcap"))).topics.items()}
    # What a bridge plays while nobody is connected is not sent again.
    assert all(came[name] >= 0.97 * sent[name] for name in came), (sent, came)
    settled = [rss for at, rss in memory if 40.0 < at < 50.0]
    late = [rss for at, rss in memory if at > 80.0]
    print(f"{servers['made']} attacks, full {full[0]} times, {min(settled) >> 20} to {max(late) >> 20} MiB")
    assert max(late) < 1.25 * max(settled)


def _remember_port(monkeypatch: pytest.MonkeyPatch, kind: Any, servers: dict[str, int]) -> None:
    enter = kind.__enter__

    def entered(server: Any) -> Any:
        servers[kind.__name__] = int(urlsplit(server.url).port or 0)
        return enter(server)

    monkeypatch.setattr(kind, "__enter__", entered)
