"""`follow` while a recording is made, under clients that misbehave, a bridge that drops and a disk that fills.

    python -m tests.support.soak --minutes 30 --clients 200

The bridge and the clients are processes of their own; follow, its page and its server are this one, whose memory is
looked at. While it plays the disk is full for 3 s of every 10 s: the system's call that writes refuses.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil

from alidade.pipelines.applications.follow import follow as following
from alidade.pipelines.applications.follow.follower import Settings
from alidade.pipelines.applications.follow.network import SUBPROTOCOLS, websockets
from alidade.pipelines.methods import simulate
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.result import Calibration
from tests.support.live import Bridge, messages

Attack = Callable[[random.Random, int, int], None]
_SPAWN = multiprocessing.get_context("spawn")
# The disk is full for the first part of every period, s; the bridge hangs up this often.
_PERIOD_S, _FULL_S, _DROP_EVERY_S = 10.0, 3.0, 60.0
# What a bridge has sent but the client not received when it hangs up is lost: messages about then, s.
_IN_FLIGHT_S = 1.0


@dataclass(frozen=True)
class Soak:
    """What became of a run.

    Attributes:
        calibration: of the run.
        kept: its recording.
        attacks, refused: connections of the clients, and of those how many ended in an error on their side.
        full: writes that found the disk full.
        sent, lost: messages of the bridge, and those missing in the recording.
        astray: of the lost those that the bridge did not send about when it hung up.
        failed: threads that ended with an exception.
        memory: (n, 2) s and MiB of this process while the bridge plays.
    """

    calibration: Calibration
    kept: Path
    attacks: int
    refused: int
    full: int
    sent: int
    lost: int
    astray: int
    failed: list[Any]
    memory: np.ndarray[Any, np.dtype[np.float64]]

    def peak(self, first: float, last: float) -> float:
        """Largest memory between two shares of the time, MiB."""
        time, used = self.memory.T
        return float(used[(time >= first * time[-1]) & (time <= last * time[-1])].max())


def soak(folder: Path, seconds: float, clients: int) -> Soak:
    """Follow a simulated recording of so many seconds under attack."""
    whole, config, kept = folder / "whole.mcap", folder / "c.yaml", folder / "kept"
    (folder / "s.yaml").write_text(f"{{duration_s: {seconds}, gyro_rate_hz: 50, gimbal_rate_hz: 50, image_rate_hz: 5}}")
    simulate("los", str(folder / "s.yaml"), 0, whole, False)
    config.write_bytes(open_recording(whole).attachment("alidade.yaml") or b"")
    drops = (np.arange(0.5 * min(_DROP_EVERY_S, seconds), seconds, _DROP_EVERY_S) / seconds).tolist()
    page, served, failed = _free_port(), _free_port(), list[Any]()
    memory: list[tuple[float, float]] = []
    with (
        mock.patch.object(threading, "excepthook", failed.append),
        _apart(_play, whole, drops) as bridge,
        _apart(_attack, clients, page, served) as attackers,
        _sampled(memory),
        _filling_disk(seconds) as full,
    ):
        settings = Settings(config=config, patience=min(8.0, 0.3 * seconds))
        live = following.follow(bridge.recv(), settings, served, kept, True, ("127.0.0.1", page))
        attackers.send(None)
        attacks, refused = attackers.recv()
    (recording,) = kept.glob("*.mcap")
    sent, came = (sorted((m[2], m[1].topic) for m in messages(path)) for path in (whole, recording))
    lost = np.array([log_ns for log_ns, _ in set(sent) - set(came)], dtype=np.int64)
    dropped = np.array([sent[int(share * len(sent))][0] for share in drops])
    apart = np.abs(lost[:, None] - dropped).min(axis=1, initial=np.iinfo(np.int64).max)
    astray = int((apart > _IN_FLIGHT_S * 1e9).sum())
    used = np.array([each for each in memory if each[0] < seconds])
    return Soak(live, recording, attacks, refused, full[0], len(sent), len(lost), astray, failed, used)


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def _apart(work: Callable[..., None], *arguments: Any) -> Iterator[Connection]:
    """A process that works with one end of a pipe and ends with the block; the other end."""
    here, there = _SPAWN.Pipe()
    process = _SPAWN.Process(target=work, args=(there, *arguments), daemon=True)
    process.start()
    try:
        yield here
    finally:
        process.kill()
        process.join()


def _play(pipe: Connection, whole: Path, drops: list[float]) -> None:
    with Bridge(messages(whole), 1.0, drop_at=drops) as bridge:
        pipe.send(bridge.url)
        threading.Event().wait()


@contextmanager
def _sampled(memory: list[tuple[float, float]]) -> Iterator[None]:
    began, over = time.monotonic(), threading.Event()

    def sample() -> None:
        while not over.wait(1.0):
            memory.append((time.monotonic() - began, psutil.Process().memory_info().rss / (1 << 20)))

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def _filling_disk(seconds: float) -> Iterator[list[int]]:
    """How many writes found the disk full, which it is for so many seconds at most: in the end there is room."""
    began, write, full = time.monotonic(), os.pwrite, [0]

    def limited(file: int, data: memoryview, at: int) -> int:
        since = time.monotonic() - began
        if since < seconds and since % _PERIOD_S < _FULL_S:
            full[0] += 1
            raise OSError(28, "No space left on device")
        return write(file, data, at)

    with mock.patch.object(os, "pwrite", limited):
        yield full


# -- the clients


def _attack(pipe: Connection, clients: int, page: int, served: int) -> None:
    over, counts, lock = threading.Event(), [0, 0], threading.Lock()

    def one(seed: int) -> None:
        rng = random.Random(seed)
        while not over.is_set():
            refused = True
            with suppress(Exception):  # whatever becomes of the attacker
                rng.choice(ATTACKS)(rng, page, served)
                refused = False
            with lock:
                counts[0] += 1
                counts[1] += refused
            over.wait(rng.uniform(0.0, 1.0))

    threads = [threading.Thread(target=one, args=(i,), daemon=True) for i in range(clients)]
    for thread in threads:
        thread.start()
    pipe.recv()
    over.set()
    pipe.send(tuple(counts))


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
    url = f"ws://127.0.0.1:{served}"
    with websockets().sync.client.connect(url, subprotocols=SUBPROTOCOLS, open_timeout=5.0) as client:
        for _ in range(rng.randrange(20)):
            numbers = (rng.choice([rng.randrange(100), -1, 1 << 40]) for _ in range(rng.randrange(500)))
            wanted = ", ".join(f'{{"id": {number}, "channelId": {rng.randrange(30)}}}' for number in numbers)
            client.send(f'{{"op": "subscribe", "subscriptions": [{wanted}]}}')
            client.send("[" * rng.randrange(100_000))
            time.sleep(rng.uniform(0.0, 0.5))


ATTACKS: list[Attack] = [_idle, _garbage, _stream, _stranger, _subscriber]


def main() -> None:
    """Run a soak and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--clients", type=int, default=200)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = soak(Path(folder), 60.0 * given.minutes, given.clients)
    print(
        f"{given.minutes:g} min, {given.clients} clients: {found.attacks} attacks ({found.refused} refused), disk full "
        f"at {found.full} writes; {found.lost} of {found.sent} messages lost, {found.astray} of them not in flight "
        f"when the bridge hung up; {len(found.failed)} threads failed; {found.calibration.status}; memory by tenths of "
        f"the time, MiB: {', '.join(f'{found.peak(0.1 * i, 0.1 * i + 0.1):.0f}' for i in range(10))}"
    )


if __name__ == "__main__":
    main()
