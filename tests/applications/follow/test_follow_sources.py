"""Where `follow` gets recordings from: files, folders, Foxglove bridges, standard input; and the server of its own."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.network import SUBPROTOCOLS, websockets
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.follow.sources import Replay, Source, StandardInput, source_of
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers import incremental
from tests.support import forms
from tests.support.builders import BRISK, IDEAL
from tests.support.live import Bridge, messages, write
from tests.support.solved import calibrate

connect = websockets().sync.client.connect
SCENARIO = LosScenario(
    duration_s=8.0,
    carrier=BRISK,
    image_rate_hz=5.0,
    gyro_rate_hz=50.0,
    gimbal_rate_hz=50.0,
    sensors=IDEAL,
)


@pytest.fixture(scope="module", autouse=True)
def _few_batch_solutions() -> Iterator[None]:
    """In the initialisation phase: they are most of what is computed, and no source's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(incremental, "SOLVE_GROWTH", 1.6)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    method("los").write(path, simulate_los(SCENARIO, 2))
    return path


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a stream has no attachment for."""
    path = tmp_path_factory.mktemp("config") / "c.yaml"
    path.write_text(los_config(SCENARIO))
    return path


@pytest.fixture(scope="module")
def batch(whole: Path) -> Calibration:
    return calibrate(whole, ["incremental"])[0]


def follow(
    source: Source, settings: Settings, stopped: Callable[[], bool] = lambda: False
) -> tuple[Calibration, list[View], list[str]]:
    views: list[View] = []
    said: list[str] = []
    with source:
        return Follower(source, settings, views.append, said.append, stopped).follow(), views, said


def agree(calibration: Calibration, batch: Calibration, sigmas: float = 0.05) -> None:
    difference = np.abs(calibration.estimate.values - batch.estimate.values)
    assert (difference <= sigmas * batch.estimate.sigmas).all(), difference / batch.estimate.sigmas


def test_a_folder_in_which_splits_appear(whole: Path, config: Path, batch: Calibration, tmp_path: Path) -> None:
    folder, sent = tmp_path / "bag", messages(whole)
    source = Source(folder)
    assert source.size == 0
    assert not source.is_finished
    views: list[View] = []

    def record() -> Iterator[None]:
        folder.mkdir()
        for i in range(3):
            with (folder / f"bag_{i}.mcap").open("wb") as out:
                write(sent[i * len(sent) // 3 : (i + 1) * len(sent) // 3], out)
            yield
        names = "".join(f"\n    - bag_{i}.mcap" for i in range(3))
        (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:{names}\n")

    parts = record()
    next(parts)

    def show(view: View) -> None:
        views.append(view)
        next(parts, None)

    settings = Settings(config=config, patience=30.0)
    calibration = Follower(source, settings, show, lambda _: None, lambda: False).follow()
    assert next(parts, None) is None
    agree(calibration, batch)
    assert calibration.recording == "bag"
    assert len({round(view.time) for view in views}) > 2


def test_a_folder_of_several_recordings_is_one_line(tmp_path: Path) -> None:
    for name in ("one.mcap", "other.mcap"):
        (tmp_path / name).write_bytes(bytes(100))
    with pytest.raises(InputError, match=r"a folder of several recordings \(one.mcap, other.mcap\)"):
        follow(Source(tmp_path), Settings())


def test_standard_input(whole: Path, batch: Calibration, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    calibration, _, _ = follow(StandardInput(kept, io.BytesIO(whole.read_bytes())), Settings())
    agree(calibration, batch, 1e-9)
    assert [p.read_bytes() for p in kept.iterdir()] == [whole.read_bytes()]
    assert calibration.recording == "live_0000.mcap"
    with StandardInput(None, io.BytesIO(b"what comes"), lambda _: None) as source:
        assert source._ended.wait(5.0)
    assert not source.path.exists()


def test_a_stream_never_overwrites_an_earlier_one(tmp_path: Path) -> None:
    """Its file has the number after the largest, not that of how many there are."""
    (tmp_path / "live_0001.mcap").write_bytes(b"an earlier recording")
    with StandardInput(tmp_path, io.BytesIO(b"what comes"), lambda _: None) as source:
        assert source._ended.wait(5.0)
    assert (tmp_path / "live_0001.mcap").read_bytes() == b"an earlier recording"
    assert (tmp_path / "live_0002.mcap").read_bytes() == b"what comes"


def test_a_pipe_that_ends_early_gives_what_came(whole: Path) -> None:
    write(messages(whole), pipe := io.BytesIO(), 4096)
    half = io.BytesIO(pipe.getvalue()[: len(pipe.getvalue()) // 2])
    calibration, _, _ = follow(StandardInput(None, half), Settings(method="los"))
    assert 2.0 < calibration.facts.duration_s < 6.0
    assert any("truncated" in note for note in calibration.facts.notes)
    assert calibration.recording == "standard input"


def test_only_web_sockets_are_followed_of_addresses() -> None:
    with pytest.raises(InputError, match=r"^http://robot:8765: only ws:// and wss:// addresses are followed$"):
        source_of("http://robot:8765")


def test_a_file_is_not_recorded_anew(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"s.mcap is kept as it is; what arrives by ws:// or - is recorded$"):
        source_of(str(tmp_path / "s.mcap"), tmp_path / "kept")


def test_a_pipe_of_something_else_is_one_line() -> None:
    with pytest.raises(InputError, match=r"^standard input: not an MCAP file"):
        follow(StandardInput(None, io.BytesIO(b"%PDF-1.7" + bytes(100))), Settings())
    with pytest.raises(InputError, match=r"standard input: nothing there, or nothing in it$"):
        follow(StandardInput(None, io.BytesIO(b"")), Settings())


class _KilledError(Exception):
    """As a process is that is killed: nothing is done any more."""


@pytest.mark.slow
def test_a_ros_1_bag_is_followed_killed_and_resumed_when_it_is_closed(tmp_path: Path) -> None:
    """What tells a bag from others is not its head, which is written anew when the bag is closed."""
    scenario = SCENARIO.model_copy(update={"duration_s": 75.0, "image_rate_hz": 3.0, "gyro_rate_hz": 25.0})
    whole, config = tmp_path / "whole.mcap", tmp_path / "c.yaml"
    method("los").write(whole, simulate_los(scenario, 2))
    config.write_text(los_config(scenario))
    closed = forms.rosbag1(whole, tmp_path / "closed.bag", chunk=8_000).read_bytes()
    path, settings = tmp_path / "s.bag", Settings(config=config, checkpoint=tmp_path / "s.checkpoint")
    # Before it is closed, the head does not say where the index is.
    open_ = re.sub(rb"index_pos=.{8}", b"index_pos=" + bytes(8), closed, count=1, flags=re.DOTALL)
    path.write_bytes(open_[: round(0.85 * len(open_))])
    assert not Source(path).is_finished

    def kill(view: View) -> None:
        if view.time > 60.0:
            raise _KilledError

    with pytest.raises(_KilledError):
        Follower(Source(path), settings, kill, lambda _: None, lambda: False).follow()
    path.write_bytes(closed)
    assert Source(path).is_finished
    resumed, _, said = follow(Source(path), settings)
    assert any(sentence.startswith("resumed at ") for sentence in said)
    at_once = calibrate(path, ["incremental"], None, config)[0]
    agree(resumed, at_once, 0.1)


def test_a_bridge_that_hangs_up_and_comes_back(whole: Path, config: Path, tmp_path: Path) -> None:
    said: list[str] = []
    with Bridge(messages(whole), 8.0, drop_at=[0.5]) as bridge:
        kept = tmp_path / "kept"
        calibration, views, _ = follow(
            source_of(bridge.url, kept, said.append), Settings(config=config), lambda: bridge.is_over
        )
    truth = {"delta_px", "delta_gx", "delta_gy"}
    assert truth <= set(calibration.parameters)
    again = calibrate(next(kept.glob("*.mcap")), ["incremental"], None, config)[0]
    agree(calibration, again)
    assert calibration.facts.duration_s > 7.0
    assert [sentence.rpartition(": ")[2].partition(" ")[0] for sentence in said] in (
        [["connected", "no", "connected"], ["connected", "no", "connected", "no"], ["connected"]]
    ), said
    assert views[-1].time > 7.0


def test_a_bridge_is_asked_for_sensors_alone(whole: Path) -> None:
    sent = messages(whole)
    schema, channel, log_ns, _ = sent[0]
    text = replace(schema, name="std_msgs/msg/String", data=b"string data")
    other = text, replace(channel, topic="/chatter"), log_ns, b"\0\1\0\0\2\0\0\0a\0"
    with Bridge([other, *sent], 40.0, also=("/chatter",)) as bridge, source_of(bridge.url, None, lambda _: None):
        until = time.monotonic() + 30.0
        while not bridge.is_over and time.monotonic() < until:
            time.sleep(0.02)
        assert bridge.is_over
        assert bridge.subscribed == {"/imu", "/gimbal/joint_states", "/los/error"}


def test_a_bridge_that_is_not_there_is_waited_for() -> None:
    said: list[str] = []
    with pytest.raises(InputError, match=r"ws://127.0.0.1:9: nothing there.* after 0.7 s of waiting"):
        follow(source_of("ws://127.0.0.1:9", None, said.append), Settings(patience=0.7))
    assert len(said) == 1
    assert "no connection" in said[0]


def _view(quantities: int) -> View:
    names = tuple(Quantity(f"p{i}", "rad", 0.1, 0.1, 1e-3) for i in range(quantities))
    return View(3.0, 7, names, np.arange(float(quantities)), np.eye(quantities) * 1e-8, ())


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_who_subscribes_the_instant_a_channel_is_told_gets_every_channel(protocol: str) -> None:
    """Long before there are data, and while there are."""
    with LiveServer(0) as server, connect(server.url, subprotocols=[protocol]) as client:
        assert json.loads(client.recv(5.0))["op"] == "serverInfo"
        topics: dict[int, str] = {}
        got: dict[str, list[dict[str, object]]] = {}
        show = threading.Thread(target=server.show, args=[_view(40)])
        while len(got) < 41:
            data = client.recv(5.0)
            if isinstance(data, bytes):
                number, at = struct.unpack_from("<IQ", data, 1)
                assert at == 3_000_000_007
                got.setdefault(topics[number], []).append(json.loads(data[13:]))
                continue
            told = json.loads(data)
            assert told["op"] == "advertise", told
            new = {channel["id"]: channel["topic"] for channel in told["channels"]}
            topics |= new
            wanted = [{"id": number, "channelId": number} for number in new]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            if not show.is_alive() and not show.ident:
                assert new == {1: "/status"}
                show.start()
        show.join()
    assert got["/estimate/p39"][0]["value"] == 39.0


def test_the_server_serves_many_and_outlives_who_goes() -> None:
    with LiveServer(0) as server, ExitStack() as stack:
        clients = [stack.enter_context(connect(server.url, subprotocols=SUBPROTOCOLS)) for _ in range(3)]
        clients[0].close()
        clients[1].send("no JSON")
        clients[1].send(os.urandom(64))
        clients[1].send(json.dumps({"op": "subscribe", "subscriptions": [{"id": "x"}]}))
        server.show(_view(2))
        for client in clients[1:]:
            client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 9, "channelId": 1}]}))
            status = next(data for data in client if isinstance(data, bytes))
            assert struct.unpack_from("<BI", status) == (1, 9)
            assert json.loads(status[13:])["time_s"] == 3.0
        with pytest.raises(InputError, match="no server can be started there"):
            LiveServer(int(server.url.rpartition(":")[2]))


def test_a_finished_recording_is_replayed_as_if_it_were_made_now(whole: Path, tmp_path: Path) -> None:
    """Written anew at the pace at which it was recorded; the result is that of the file."""
    seen: list[float] = []
    started = time.monotonic()
    with Replay(whole, 8.0, tmp_path / "kept", lambda _: None) as source:
        settings = Settings(patience=10.0)
        calibration = Follower(source, settings, lambda view: seen.append(view.time), print, lambda: False).follow()
    assert 8.0 / 8.0 <= time.monotonic() - started < 30.0
    (kept,) = (tmp_path / "kept").iterdir()
    assert kept.read_bytes() == whole.read_bytes()
    (once,) = calibrate(whole, ["incremental"])
    np.testing.assert_allclose(calibration.estimate.values, once.estimate.values, atol=1e-3)
    assert len(seen) > 2


def test_what_cannot_be_replayed_is_refused_in_one_line(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t,x\n0,1\n1,2\n")
    for path, speed, message in ((whole, 0.0, "--speed 0"), (tmp_path / "none.mcap", 1.0, "none.mcap")):
        with pytest.raises(InputError, match=message):
            Replay(path, speed, None, print)
