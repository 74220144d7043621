"""Who is let in, and what others on the wire may do: the page, the server and the client of a bridge under attack."""

from __future__ import annotations

import base64
import http.client
import json
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus

from alidade.pipelines.applications.follow.bridge import Bridge
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.network import (
    MAX_ATTEMPTS,
    MAX_CONNECTIONS,
    MAX_PER_ADDRESS,
    MESSAGE_DATA,
    MESSAGE_HEAD,
    SUBPROTOCOLS,
    Attempts,
    Gate,
    network_of,
    websockets,
)
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.serve import MAX_SUBSCRIPTIONS, LiveServer
from alidade.pipelines.applications.follow.sources import Spool
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.recording.recording import open_recording

connect: Any = websockets().sync.client.connect
serve: Any = websockets().sync.server.serve
IDLE, BURST = 300, 450


def _view() -> View:
    quantities = (Quantity("p0", "rad", 0.1, 0.1, 1e-3),)
    return View(3.0, 7, quantities, np.zeros(1), np.eye(1) * 1e-8, ())


def _get(port: int, path: str = "/", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5.0)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value.encode("utf-8"))
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


def _port(page: LivePage) -> int:
    return int(urlsplit(page.url).port or 0)


def _token(page: LivePage) -> str:
    return page.url.rpartition("=")[2]


def _is_closed(client: socket.socket) -> bool:
    client.setblocking(False)
    with suppress(BlockingIOError):
        try:
            return client.recv(1) == b""
        except ConnectionError:
            return True
    return False


# -- the gate


def test_of_too_many_connections_of_a_kind_the_oldest_goes() -> None:
    gate, closed = Gate(2, 2), list[str]()

    def admit(name: str) -> None:
        gate.admit(name, f"10.0.0.{ord(name)}", lambda: closed.append(name))

    for name in "abc":
        admit(name)
    assert closed == ["a"]
    for name in "bc":
        gate.trust(name)
    for name in "def":
        admit(name)
    assert closed == ["a", "d"], "nobody who may read goes for one that has shown nothing"
    gate.trust("f")
    assert closed == ["a", "d", "b"], "a device that comes back finds room beside what a lost network left"
    gate.close_untrusted("c")
    gate.close_untrusted("e")
    assert closed == ["a", "d", "b", "e"]
    gate.release("c")
    assert len(gate) == 1


def test_an_address_pushes_out_its_own_connections_alone() -> None:
    gate, closed = Gate(10, 2), list[int]()
    gate.admit("other", "10.0.0.1", lambda: closed.append(-1))
    for i in range(4):
        gate.admit(i, "10.0.0.2", partial(closed.append, i))
        gate.trust(i)
    assert closed == [0, 1]


def test_an_ipv6_network_counts_as_one_address() -> None:
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:2") != network_of("2001:db8:0:1::1")
    assert network_of("::ffff:10.0.0.1") == "10.0.0.1"


def test_attempts_come_back_with_time_and_few_addresses_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    attempts = Attempts()
    for _ in range(MAX_ATTEMPTS):
        assert attempts.allowed("10.0.0.1")
        attempts.failed("10.0.0.1")
    assert not attempts.allowed("10.0.0.1")
    assert attempts.allowed("10.0.0.2")
    now[0] += 11.0
    assert attempts.allowed("10.0.0.1")
    for i in range(3000):
        attempts.failed(f"10.1.{i // 250}.{i % 250}")
    assert len(attempts._left) <= 1024


# -- the page


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_idle_connections_keep_nobody_out_and_end(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("alidade.pipelines.applications.follow.page.HANDSHAKE_TIME_S", 1.0)
    with LivePage(lambda _: None, host, 0) as page, ExitStack() as stack:
        port = _port(page)
        idle = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(IDLE)]
        for client in idle[::2]:
            with suppress(OSError):
                client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nX: ")
        time.sleep(0.2)
        assert len(page._gate) <= MAX_PER_ADDRESS
        path = "/" if host == "127.0.0.1" else f"/?token={_token(page)}"
        assert _get(port, path)[0] in (200, 303)
        page.show(_view())
        time.sleep(1.3)
        assert len(page._gate) == 0
        assert all(map(_is_closed, idle))


def test_a_burst_of_connections_leaves_files_to_open(caplog: pytest.LogCaptureFixture) -> None:
    """More wait to be taken in than this process may have files open."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    page = LivePage(lambda _: None, "127.0.0.1", 0)
    page._socket.listen(2 * BURST)
    with ExitStack() as stack:
        for _ in range(BURST):
            stack.enter_context(socket.create_connection(("127.0.0.1", _port(page))))
        used = max(map(int, os.listdir("/proc/self/fd")))
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (used + 5 * MAX_CONNECTIONS, limits[1]))
            with page:
                for _ in range(10):
                    assert _get(_port(page))[0] == 200
                assert len(page._gate) <= MAX_PER_ADDRESS
            assert not caplog.records, "nothing was refused for want of files"
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_a_stream_outlives_idle_connections() -> None:
    with LivePage(lambda _: None, "127.0.0.1", 0) as page, ExitStack() as stack:
        stream = stack.enter_context(socket.create_connection(("127.0.0.1", _port(page))))
        stream.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b"200 OK" in stream.recv(4096)
        for _ in range(3 * MAX_CONNECTIONS):
            stack.enter_context(socket.create_connection(("127.0.0.1", _port(page))))
        time.sleep(0.3)
        page.show(_view())
        stream.settimeout(3.0)
        said = b""
        while b'"estimated"' not in said:
            said += stream.recv(1 << 16)


def test_guesses_are_limited_and_the_token_has_128_bits() -> None:
    with LivePage(lambda _: None, "0.0.0.0", 0) as page:
        token, port = _token(page), _port(page)
        assert len(base64.b32decode(token.upper() + "======")) == 16
        answers = [_get(port, f"/?token={i:026}")[0] for i in range(MAX_ATTEMPTS + 20)]
        assert answers.count(403) <= MAX_ATTEMPTS + 1
        assert answers[-1] == 429
        assert _token(page) == token
        assert _get(port, f"/?token={token}")[0] == 429, "from this address not even the right one, for a while"


@pytest.mark.parametrize(
    "name", ["elsewhere.example", "127.0.0.1.elsewhere.example", "[::1", "", "localhost@evil.example"]
)
def test_a_name_that_leads_here_is_refused_with_the_right_cookie_and_token(name: str) -> None:
    with LivePage(lambda _: None, "0.0.0.0", 0) as page:
        port = _port(page)
        cookie = {"Cookie": f"alidade-{port}={page._key}"}
        assert _get(port, **cookie)[0] == 200
        for path in ("/", "/events", f"/?token={_token(page)}"):
            assert _get(port, path, Host=name, **cookie)[0] in (400, 403), path
        assert _get(port, Host=f"127.0.0.1:{port}", **cookie)[0] == 200


def test_letters_beyond_ascii_are_refused_as_any_other() -> None:
    with LivePage(lambda _: None, "0.0.0.0", 0) as page:
        port = _port(page)
        assert _get(port, "/?token=%C3%A9%ED%A0%80")[0] == 403
        assert _get(port, Cookie=f"alidade-{port}=é\u2028")[0] == 403
        assert _get(port, "/events", Cookie=f"alidade-{port}=é")[0] == 403


def test_connections_that_use_a_port_again_are_told_apart() -> None:
    with LivePage(lambda _: None, "127.0.0.1", 0) as page:
        page._gate.admit(old := object(), "127.0.0.1", lambda: None)
        with socket.create_connection(("127.0.0.1", _port(page))) as client:
            client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert b"200 OK" in client.recv(4096)
            (served,) = set(page._gate._admitted) - {old}
            assert page._gate._admitted[served].trusted
            assert not page._gate._admitted[old].trusted


def test_every_address_of_both_families_is_one_that_answers() -> None:
    if not socket.has_dualstack_ipv6():
        pytest.skip("this machine has no IPv6")
    with LivePage(lambda _: None, "::", 0) as page:
        host, port = str(urlsplit(page.url).hostname), _port(page)
        assert page.is_open
        for address in ("127.0.0.1", "::1", host):
            with socket.create_connection((address, port), timeout=3.0) as client:
                client.sendall(f"GET /?token={_token(page)} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
                assert client.recv(4096).startswith(b"HTTP/1.1 403"), address


def test_numbers_that_are_none_are_null_in_what_is_sent() -> None:
    """JSON knows neither NaN nor Infinity: a browser refuses the whole message."""
    view = replace(_view(), values=np.array([np.nan]), covariance=np.array([[np.inf]]))

    def refuse(name: str) -> None:
        pytest.fail(f"{name} is sent")

    with LiveServer(0) as server, LivePage(lambda _: None, "127.0.0.1", 0) as page:
        server.show(view)
        page.show(view)
        sent = [last.data.decode() for last in server._last.values()]
        for text in (*sent, page._event[1]):
            json.loads(text, parse_constant=refuse)


# -- the server


EVIL = ("https://evil.example", "null", "http://app.foxglove.dev", "https://app.foxglove.dev.evil.example")


def test_pages_of_other_sites_are_refused_by_the_server() -> None:
    with LiveServer(0, ["https://bench.example"]) as server:
        for origin in (None, "https://app.foxglove.dev", "https://bench.example"):
            with connect(server.url, subprotocols=SUBPROTOCOLS, origin=origin) as client:
                assert json.loads(client.recv(5.0))["op"] == "serverInfo"
        for origin in (
            "https://evil.example",
            "null",
            "http://app.foxglove.dev",
            "https://app.foxglove.dev.evil.example",
        ):
            with pytest.raises(InvalidStatus) as refused:
                connect(server.url, subprotocols=SUBPROTOCOLS, origin=origin)
            assert refused.value.response.status_code == 403


NO_IDS: list[Any] = [-1, 1 << 40, 1.5, True, None, "1", []]
NO_LISTS: list[Any] = [1, None, "x", [1], [[]], {"id": 1}]
HOSTILE_REQUESTS: list[dict[str, Any]] = [
    *({"op": "subscribe", "subscriptions": [{"id": one, "channelId": 1}]} for one in NO_IDS),
    *({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": one}]} for one in NO_IDS),
    *({"op": "subscribe", "subscriptions": one} for one in NO_LISTS),
    {"op": "unsubscribe", "subscriptionIds": [[], {}, 1 << 70]},
]


def test_the_server_survives_what_a_client_may_say() -> None:
    failed: list[Any] = []
    before, threading.excepthook = threading.excepthook, failed.append
    try:
        with LiveServer(0) as server, connect(server.url, subprotocols=SUBPROTOCOLS) as client:
            for wrong in HOSTILE_REQUESTS:
                client.send(json.dumps(wrong))
            for text in (
                "[" * 100_000,
                '{"op": Infinity}',
                '{"op":"subscribe","subscriptions":[{"id":Infinity}]}',
                "1",
            ):
                client.send(text)
            server.show(_view())
            client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 1}]}))
            data = next(data for data in client if isinstance(data, bytes))
            assert MESSAGE_HEAD.unpack_from(data)[:2] == (MESSAGE_DATA, 7)
    finally:
        threading.excepthook = before
    assert failed == []


def test_subscriptions_of_a_client_are_bounded() -> None:
    with LiveServer(0) as server, connect(server.url, subprotocols=SUBPROTOCOLS) as client:
        for start in range(0, 40_000, 2000):
            many = [{"id": i, "channelId": 1} for i in range(start, start + 2000)]
            client.send(json.dumps({"op": "subscribe", "subscriptions": many}))
        server.show(_view())
        got = set()
        with suppress(TimeoutError):
            while True:
                data = client.recv(1.0)
                if isinstance(data, bytes):
                    got.add(MESSAGE_HEAD.unpack_from(data)[1])
        assert len(got) == MAX_SUBSCRIPTIONS


def test_the_server_outlives_idle_connections() -> None:
    with LiveServer(0) as server, ExitStack() as stack:
        port = int(server.url.rpartition(":")[2])
        for _ in range(IDLE):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        with connect(server.url, subprotocols=SUBPROTOCOLS) as client:
            assert json.loads(client.recv(5.0))["op"] == "serverInfo"
        assert len(server._gate) <= 33


# -- the client of a bridge

GOOD = {
    "id": 1,
    "topic": "/gyro",
    "encoding": "cdr",
    "schemaName": "geometry_msgs/msg/Vector3Stamped",
    "schema": "std_msgs/Header header\ngeometry_msgs/Vector3 vector\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\n"
    "uint32 nanosec\n" + "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
}
HOSTILE_MESSAGES = {
    "deep": "[" * 200_000,
    "deep object": '{"op":"advertise","channels":' + '{"a":' * 100_000,
    "infinite id": '{"op":"advertise","channels":[{"id":Infinity,"topic":"/x","encoding":"cdr"}]}',
    "huge id": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": 1 << 40}]}),
    "negative id": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": -1}]}),
    "truth as id": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": True}]}),
    "number as topic": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": 5, "topic": 7}]}),
    "list as encoding": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": 5, "encoding": ["cdr"]}]}),
    "lone surrogate": json.dumps({"op": "advertise", "channels": [{**GOOD, "id": 5, "topic": "/\ud800"}]}),
    "bad base64": json.dumps(
        {"op": "advertise", "channels": [{**GOOD, "id": 5, "encoding": "protobuf", "schema": "é!"}]}
    ),
    "no list": '{"op":"advertise","channels":7}',
    "no objects": '{"op":"advertise","channels":[1,null,"x"]}',
    "no JSON": "\x00",
    "many digits": '{"op":' + "9" * 10_000 + "}",
}


@contextmanager
def _bridge(say: Callable[[Any], None]) -> Iterator[str]:
    """A server that says what a function says to whoever connects, and hangs up."""
    with serve(say, "127.0.0.1", 0, subprotocols=SUBPROTOCOLS, max_size=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"


def _message(number: int) -> bytes:
    sec, nanosec = divmod(1_700_000_000_000_000_000 + number * 10_000_000, 1_000_000_000)
    body = np.array([sec, nanosec, 1], "<u4").tobytes() + b"\0" + bytes(7) + np.zeros(3).tobytes()
    return MESSAGE_HEAD.pack(MESSAGE_DATA, 1, sec * 1_000_000_000 + nanosec) + b"\0\1\0\0" + body


def test_a_bridge_that_says_anything_costs_no_message_of_its_sensors(tmp_path: Path) -> None:
    came, failed = threading.Event(), list[Any]()
    connections = []

    def say(connection: Any) -> None:
        connections.append(connection)
        start = 100 * len(connections)
        connection.send(json.dumps({"op": "advertise", "channels": [GOOD]}))
        connection.recv(5.0)
        for i, text in enumerate(HOSTILE_MESSAGES.values()):
            connection.send(_message(start + i))
            connection.send(text)
        other = {**GOOD, "id": 2, "schemaName": "sensor_msgs/msg/Imu", "schema": "float64 x"}
        connection.send(json.dumps({"op": "advertise", "channels": [other]}))
        connection.recv(5.0)
        connection.send(MESSAGE_HEAD.pack(MESSAGE_DATA, 2, 1) + bytes(20))
        connection.send(bytes(3))
        if len(connections) == 2:
            time.sleep(0.3)
            came.set()
            time.sleep(2.0)

    before, threading.excepthook = threading.excepthook, failed.append
    said: list[str] = []
    try:
        with _bridge(say) as url, (bridge := Bridge(url, tmp_path, said.append)):
            assert came.wait(20.0), said
            time.sleep(0.2)
    finally:
        threading.excepthook = before
    assert failed == []
    recording = open_recording(next(tmp_path.glob("*.mcap")))
    assert recording.topics["/gyro"].count == 2 * len(HOSTILE_MESSAGES)
    assert list(recording.topics) == ["/gyro"]
    assert bridge.refused >= 2 * len(HOSTILE_MESSAGES)
    assert f"{url}: {bridge.refused} messages refused" in said


def test_a_channel_that_is_advertised_again_after_it_was_withdrawn_is_subscribed_again(tmp_path: Path) -> None:
    """As when a node behind the bridge is restarted: the bridge gives its channel the same id."""
    came = threading.Event()
    asked = list[Any]()

    def say(connection: Any) -> None:
        for start in (0, 10):
            connection.send(json.dumps({"op": "advertise", "channels": [GOOD]}))
            asked.append(json.loads(connection.recv(5.0)))
            connection.send(_message(start))
            connection.send(json.dumps({"op": "unadvertise", "channelIds": [GOOD["id"]]}))
        time.sleep(0.3)
        came.set()
        time.sleep(1.0)

    said: list[str] = []
    with _bridge(say) as url, Bridge(url, tmp_path, said.append):
        assert came.wait(10.0), said
    assert [message["op"] for message in asked] == ["subscribe", "subscribe"]
    assert open_recording(next(tmp_path.glob("*.mcap"))).topics["/gyro"].count >= 2


# -- a disk without room


def test_what_finds_no_room_waits_and_stands_in_order_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of a record is written before the disk is full: it goes again, so that readers find whole ones."""

    write, room = os.pwrite, [10]

    def limited(file: int, data: memoryview, at: int) -> int:
        if room[0] <= 0:
            raise OSError(28, "No space left on device")
        count = write(file, data[: room[0]], at)
        room[0] -= count
        return count

    monkeypatch.setattr(os, "pwrite", limited)
    monkeypatch.setattr("alidade.pipelines.applications.follow.sources.RETRY_PERIOD_S", 0.0)
    said: list[str] = []
    spool = Spool(tmp_path / "x", said.append)
    spool.write(b"abcdef")
    spool.flush()
    spool.write(b"ghijkl")
    spool.flush()
    spool.write(b"mnopqr")
    spool.flush()
    assert (tmp_path / "x").read_bytes() == b"abcdef"
    room[0] = 100
    spool.flush()
    assert (tmp_path / "x").read_bytes() == b"abcdefghijklmnopqr"
    assert len(said) == 2
    assert "No space left" in said[0]
    assert "nothing is lost" in said[1]
    room[0] = 0
    spool.write(b"end")
    spool.close()
    assert "the last 3 bytes are lost" in said[-1]
