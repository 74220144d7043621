"""alidade follow: a recording calibrated while another process writes it, killed, resumed, and shown live."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from tornado.websocket import websocket_connect

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.follow.sources import Source
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import ClockSheet
from alidade.pipelines.solvers import incremental
from benchmarks.initialisation import nees
from tests.support.builders import BRISK, IDEAL
from tests.support.command import Command
from tests.support.solved import calibrate

ROOT = Path(__file__).resolve().parents[3]
SCENARIO = LosScenario(
    duration_s=11.0, carrier=BRISK, image_rate_hz=3.0, gyro_rate_hz=50.0, gimbal_rate_hz=50.0, sensors=IDEAL
)
# The initialisation phase has fewer solutions and may end with fewer steps; the past is marginalised out more often
# than every 20 s.
EARLY = {"MIN_STEPS": 15, "MARGINALIZE_EVERY": 3.0, "SOLVE_GROWTH": 1.6}
COMMAND = f"""
from alidade.pipelines.applications.cli import main
from alidade.pipelines.solvers import incremental
vars(incremental).update({EARLY})
main()
"""

# Another process that records: what is in one file, into another, in pieces; from some time on it waits for a file.
RECORDER = """
import sys, time
from pathlib import Path
from mcap.reader import make_reader
from mcap.writer import Writer

source, target, chunks, hold, go = sys.argv[1], sys.argv[2], sys.argv[3] == "chunks", float(sys.argv[4]), sys.argv[5]
with open(source, "rb") as stream, open(target, "wb") as out:
    reader = make_reader(stream)
    writer = Writer(out, chunk_size=4096, use_chunking=chunks)
    writer.start("ros2", "recorder")
    for a in reader.iter_attachments():
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
    schemas, channels, first, second = {}, {}, None, 0
    for schema, channel, message in reader.iter_messages():
        first = message.log_time if first is None else first
        t = (message.log_time - first) / 1e9
        if t > second:
            second += 1
            out.flush()
            time.sleep(0.02)
        while t > hold and not Path(go).exists():
            time.sleep(0.02)
        if schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            coding = channel.message_encoding
            channels[channel.id] = writer.register_channel(channel.topic, coding, schemas[schema.id])
        writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
    writer.finish()
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished recording, which the tests have recorded anew."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    data, truth = simulate_los(SCENARIO, 2)
    method("los").write_data(path, data, truth, los_config(SCENARIO))
    return path


def _recorder(
    source: Path, target: Path, hold: float = 1e9, go: Path | None = None, chunks: bool = True
) -> subprocess.Popen[bytes]:
    how = "chunks" if chunks else "raw"
    return subprocess.Popen([sys.executable, "-c", RECORDER, str(source), str(target), how, str(hold), str(go)])


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in EARLY.items():
        monkeypatch.setattr(incremental, name, value)


def _alidade(*arguments: str) -> list[str]:
    return [sys.executable, "-c", COMMAND, *arguments]


async def _received(url: str, topic: str, seconds: float) -> dict[str, Any]:
    """The first message on a topic of a Foxglove server, as any client gets it."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            found = await asyncio.wait_for(_first(url, topic), 3.0)
        except (OSError, TimeoutError):
            found = None
        if found is not None:
            return found
        # No server yet, one too busy to keep this client, or one that does not know yet the channel it has told of.
        await asyncio.sleep(0.1)
    raise AssertionError(f"nothing on {topic}")


async def _first(url: str, topic: str) -> dict[str, Any] | None:
    """The first message on a topic; None when the server hangs up."""
    connection = await websocket_connect(url, subprotocols=["foxglove.sdk.v1", "foxglove.websocket.v1"])
    try:
        while (message := await connection.read_message()) is not None:
            if isinstance(message, bytes):
                if message[0] == 1:  # message data: subscription, time, payload
                    struct.unpack_from("<BIQ", message)
                    return dict(json.loads(message[13:]))
                continue
            told = json.loads(message)
            for channel in told.get("channels", []) if told["op"] == "advertise" else []:
                if channel["topic"] == topic:
                    wanted = [{"id": 7, "channelId": channel["id"]}]
                    await connection.write_message(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        return None
    finally:
        connection.close()


@pytest.mark.usefixtures("early")
def test_live_killed_and_resumed_it_ends_as_batch_on_the_finished_file(whole: Path, tmp_path: Path) -> None:
    session, checkpoint, out = tmp_path / "s.mcap", tmp_path / "s.checkpoint", tmp_path / "out"
    recorder = _recorder(whole, session, 10.0, tmp_path / "go")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    common = ["follow", str(session), "--checkpoint", str(checkpoint), "--out", str(out)]
    first = subprocess.Popen(
        _alidade(*common, "--serve", "--port", str(port)), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        estimate = asyncio.run(_received(f"ws://127.0.0.1:{port}", "/estimate/delta_gx", 60.0))
    except AssertionError:
        first.kill()
        recorder.kill()
        raise AssertionError(first.communicate()[0].decode()) from None
    assert estimate["lower"] < estimate["value"] < estimate["upper"]
    until = time.monotonic() + 60.0
    while not checkpoint.exists() and first.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    text = first.communicate()[0].decode()
    assert checkpoint.exists(), text
    assert not out.exists()
    assert recorder.poll() is None, "it was to be killed while recording"
    (tmp_path / "go").touch()

    done = subprocess.run(_alidade(*common), cwd=ROOT, capture_output=True, text=True, check=False)
    assert recorder.wait() == 0
    assert done.returncode == 0, done.stdout + done.stderr
    assert "resumed at " in done.stdout
    result = json.loads((out / "result.json").read_text())
    batch, again = calibrate(session, ["batch", "incremental"])
    assert result["session"]["sha256"] == batch.sha256
    found = {p["name"]: p["value"] for p in result["parameters"]}
    for finished, tolerance in ((batch, 1e-6), (again, 0.1)):
        for p in finished.parameters.values():
            assert found[p.name] == pytest.approx(p.value, abs=tolerance * p.sigma), p.name
    assert {p.name for p in (out).iterdir()} >= {"result.json", "report.html", "calibration.yaml", "estimates.mcap"}


def _follow(
    path: Path, settings: Settings, go: Path | None = None, until: float = 0.0
) -> tuple[Calibration, list[View], list[str]]:
    """Followed to the end; whoever waits for `go` may go on when there is an estimate `until` then, s."""
    views: list[View] = []
    said: list[str] = []

    def show(view: View) -> None:
        views.append(view)
        if go is not None and view.values is not None and view.time > until:
            go.touch()

    return Follower(Source(path), settings, show, said.append, lambda: False).follow(), views, said


def _unfinished(whole: Path, target: Path, share: float) -> Path:
    content = whole.read_bytes()
    target.write_bytes(content[: int(share * len(content))])
    return target


def test_a_recording_that_stops_growing_unfinished_gives_what_is_there(whole: Path, tmp_path: Path) -> None:
    raw = tmp_path / "raw.mcap"
    assert _recorder(whole, raw, chunks=False).wait() == 0
    session = _unfinished(raw, tmp_path / "s.mcap", 0.4)
    calibration, views, said = _follow(session, Settings(patience=0.5))
    assert said[-1] == "nothing new for 0.5 s: the recording is not finished, the result is that of what is there"
    assert 3.0 < calibration.facts.duration_s < 6.0
    assert views[-1].values is not None
    assert views[-1].time > views[0].time


def test_what_is_missing_is_said_until_the_accuracy_is_reached(whole: Path, tmp_path: Path) -> None:
    session = tmp_path / "s.mcap"
    recorder = _recorder(whole, session, 5.0, tmp_path / "go")
    calibration, views, _ = _follow(session, Settings(patience=30.0), tmp_path / "go")
    assert recorder.wait() == 0
    assert calibration.status == "calibrated"
    last = views[-1]
    assert last.done
    assert last.headline == "the accuracy wanted is reached: recording may end"
    early = [view for view in views if not view.done]
    assert early, "it was to be seen before enough was there"
    assert all(view.missing or view.covariance is None for view in early)
    assert {c.what for c in last.checklist} >= {"target", "sway about x", "sway about y", "sway about z"}


@pytest.mark.slow
def test_a_clock_that_drifts_far_is_told_and_the_recording_solved_anew(tmp_path: Path) -> None:
    """0.1 s in 49 s; los carries motion 0.02 s far."""
    sensors = IDEAL.model_copy(update={"clock": ClockSheet(skew=2e-3)})
    changed = {"duration_s": 49.0, "sensors": sensors, "effects": {"clock_skew": 2e-3}}
    scenario = SCENARIO.model_copy(update=changed)
    data, truth = simulate_los(scenario, 2)
    whole, session = tmp_path / "whole.mcap", tmp_path / "s.mcap"
    method("los").write_data(whole, data, truth, los_config(scenario))
    recorder = _recorder(whole, session, 45.0, tmp_path / "go")
    calibration, views, said = _follow(session, Settings(), tmp_path / "go", until=40.0)
    assert recorder.wait() == 0
    told = "by now pictures are taken farther from their stamps than motion around these can be carried"
    assert [sentence.removeprefix(told) for sentence in said if sentence.startswith(told)] == [
        "; what is shown may be off by that, and is solved anew when the recording ends",
        ": solved anew, with keyframes where they were",
    ]
    estimate = calibration.estimate
    (again,) = calibrate(session, ["incremental"])
    np.testing.assert_allclose(estimate.values, again.estimate.values, rtol=1e-9)
    np.testing.assert_array_equal(views[-1].values, estimate.values)
    true = np.array([truth[name] for name in estimate.names])
    size, numbers = nees(estimate.values, estimate.covariance, true)
    assert size < chi2.ppf(0.999, numbers)


@pytest.mark.slow
def test_json_is_all_that_is_printed(whole: Path, tmp_path: Path, alidade: Command) -> None:
    done = alidade("follow", whole, "--json", "--no-check", "--out", tmp_path / "out")
    assert json.loads(done.out) == json.loads((tmp_path / "out" / "result.json").read_text())


@pytest.mark.usefixtures("early")
def test_follow_uses_the_topics_that_its_message_proposes(whole: Path, tmp_path: Path, alidade: Command) -> None:
    """It once recommended --auto-topics, an option that follow lacked."""
    renamed = tmp_path / "renamed.mcap"
    renamed.write_bytes(whole.read_bytes().replace(b"/imu", b"/omu"))
    refused = alidade("follow", renamed, "--out", tmp_path / "out")
    assert (refused.code, refused.err.count("\n"), "--auto-topics" in refused.err) == (2, 1, True)
    done = alidade("follow", renamed, "--auto-topics", "--no-check", "--out", tmp_path / "out")
    assert "topics chosen automatically (los): /omu" in done.out, done.err


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"s\.mcap: nothing there, or nothing in it, after 0\.3 s of waiting"):
        _follow(tmp_path / "s.mcap", Settings(patience=0.3))


def test_no_mcap(tmp_path: Path) -> None:
    (tmp_path / "s.mcap").write_bytes(b"%PDF-1.7" + bytes(100))
    with pytest.raises(InputError, match="not an MCAP file"):
        _follow(tmp_path / "s.mcap", Settings(patience=60.0))


def test_too_little_to_calibrate_is_the_readers_own_line(whole: Path, tmp_path: Path) -> None:
    session = _unfinished(whole, tmp_path / "s.mcap", 0.002)
    with pytest.raises(InputError, match=re.escape(str(session))):
        _follow(session, Settings(patience=0.3))


@pytest.mark.usefixtures("early")
def test_a_checkpoint_of_another_config_is_refused(whole: Path, tmp_path: Path) -> None:
    checkpoint, config = tmp_path / "c", tmp_path / "c.yaml"
    _follow(whole, Settings(checkpoint=checkpoint))
    assert checkpoint.exists()
    config.write_text("require: {delta_px: 0.5}\n")
    with pytest.raises(InputError, match=r"checkpoint is of another config, \{.*\}, not \{.*delta_px"):
        _follow(whole, Settings(config=config, checkpoint=checkpoint))
    _, _, said = _follow(whole, Settings(checkpoint=checkpoint))
    assert said[0].startswith("resumed at ")
    # A parameter that the motion until then fixed: its variance in what was saved is 0.
    with np.load(checkpoint) as stored:
        arrays = {name: stored[name] for name in stored.files}
    head = json.loads(str(arrays["head"]))
    arrays["head"] = np.array(json.dumps({**head, "estimated": head["estimated"][1:]}))
    with checkpoint.open("wb") as stream:
        np.savez(stream, **arrays)
    _, _, said = _follow(whole, Settings(checkpoint=checkpoint))
    assert said[0].endswith("of a run that estimated other parameters: beginning anew")


def test_without_websockets_serving_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.sync.client", None)
    with pytest.raises(InputError, match=r"--serve need websockets.*alidade\[live\]"):
        LiveServer()


def test_ctrl_c_ends_with_what_is_there(whole: Path, tmp_path: Path) -> None:
    session = _unfinished(whole, tmp_path / "s.mcap", 0.9)
    command = _alidade("follow", str(session), "--patience", "60", "--out", str(tmp_path / "out"))
    follower = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    assert follower.stdout is not None
    assert follower.stdout.readline()
    follower.send_signal(signal.SIGINT)
    text = follower.communicate(timeout=60)[0]
    assert follower.returncode in (0, 3), text
    assert "stopped: the recording is not finished" in text
    assert (tmp_path / "out" / "result.json").exists()
