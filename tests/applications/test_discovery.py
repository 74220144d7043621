"""Topics found by what they measured: which gyro with which attitude, delays, inverses; what a command makes of it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.applications.discovery import suggestions, unused, with_suggested
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import VISION_ATTITUDE, read_head
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.pairing import pair
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.topics import inverted
from tests.support import forms
from tests.support.command import Command

NONE = load_config(None)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("discovery") / "head.mcap"
    head = method("head")
    head.write(path, head.simulate(head.settings("head_mounts").model_copy(update={"duration_s": 20.0}), 3))
    return path


def renamed(source: Path, path: Path, invert: bool = False, late_ns: int = 0) -> Recording:
    """The recording under a tracker's and drivers' names, without config."""
    whole = open_recording(source)
    poses = whole.poses("/vision/attitude")
    late = series.PoseSeries(poses.t_ns + late_ns, poses.wxyz, poses.position, poses.cov)
    write_session(
        path,
        {
            "/xsens/data": whole.imu("/head/imu"),
            "/tracker/pose": inverted(late) if invert else late,
            "/vehicle/imu": whole.imu("/platform/imu"),
        },
    )
    return open_recording(path)


@pytest.mark.parametrize("invert", [False, True])
def test_the_gyro_that_turns_with_an_attitude_is_found(invert: bool, simulated: Path, tmp_path: Path) -> None:
    recording = renamed(simulated, tmp_path / "s.mcap", invert, 40_000_000)
    poses = recording.poses("/tracker/pose")
    names = ("/xsens/data", "/vehicle/imu")
    gyros = [(imu.t_ns, imu.gyro) for imu in map(recording.imu, names)]
    ours, other = (pair(*gyro, poses.t_ns, poses.wxyz, [carrier]) for gyro, carrier in (gyros, gyros[::-1]))
    assert ours is not None
    assert ours.correlation > 0.85
    assert ours.inverted == invert
    assert other is None or other.correlation < 0.5
    # The scenario's camera is stamped 12 ms late.
    assert ours.offset_s == pytest.approx(-0.04 + 0.012, abs=0.001)
    alone = pair(*gyros[0], poses.t_ns, poses.wxyz)
    assert alone is not None
    # What the platform turns meanwhile passes for a delay where nothing tells it.
    assert alone.offset_s == pytest.approx(ours.offset_s, abs=0.006)


def test_nothing_is_said_of_sensors_at_rest() -> None:
    rng = np.random.default_rng(1)
    t_ns = 10_000_000 * np.arange(3000)
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (3000, 1))
    assert pair(t_ns, 1e-3 * rng.normal(size=(3000, 3)), t_ns, wxyz) is None
    assert pair(t_ns[:5], np.ones((5, 3)), t_ns, wxyz) is None
    assert pair(t_ns[:0], np.ones((0, 3)), t_ns, wxyz) is None


def test_what_is_suggested_reads_as_the_recording_did_under_its_own_names(simulated: Path, tmp_path: Path) -> None:
    recording = renamed(simulated, tmp_path / "s.mcap", invert=True)
    (head,) = (found for found in suggestions(recording, NONE) if found.method == "head")
    assert head.missing == ()
    assert head.yaml.split("\n") == [
        "topics:",
        "  head_imu: /xsens/data",
        "  vision_attitude: {topic: /tracker/pose, invert: true}",
        "  platform_imu: /vehicle/imu",
    ]
    assert head.reasons[0].endswith(", inverted")
    assert unused(recording, NONE) == ("/tracker/pose", "/vehicle/imu", "/xsens/data")
    assert load_config(head.yaml.encode()).topics == head.topics
    recording, config = with_suggested(recording, NONE)
    assert config.method == "head"
    assert recording.notes[0].startswith("topics chosen automatically (head): /tracker/pose matches /xsens/data")
    data, expected = read_head(recording, config), read_head(open_recording(simulated), NONE)
    np.testing.assert_array_equal(data.head_gyro, expected.head_gyro)
    np.testing.assert_allclose(data.vision_wxyz, expected.vision_wxyz, atol=1e-15)
    assert unused(recording, config) == ()


def test_a_topic_that_was_only_looked_at_widens_no_sigma(simulated: Path, tmp_path: Path) -> None:
    """The delay's sigma and the notes are those of the topics that are used, however these were found."""
    whole = renamed(simulated, tmp_path / "s.mcap")
    other = whole.imu("/xsens/data")
    rows = [
        (t, forms.ROS2.deserialize_cdr(data, kind))
        for topic, kind, t, data in forms.raw_messages(tmp_path / "s.mcap")
        if topic == "/vehicle/imu" and t < other.t_ns[500]
    ]
    for _, message in rows:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    unstamped = open_recording(forms.ros2_recording(tmp_path / "u.mcap", {"/other/imu": rows}))
    assert len(unstamped.imu("/other/imu")) == len(rows)
    assert unstamped.stamp_sigma_s > 0.005
    both = open_recording([tmp_path / "s.mcap", tmp_path / "u.mcap"])
    recording, config = with_suggested(both, NONE, "head")
    assert config.topic(VISION_ATTITUDE).startswith("/tracker/pose")
    assert read_head(recording, config).stamp_sigma == 0.0
    assert not any("have no stamp" in note for note in recording.notes)


def test_the_pair_of_frames_that_turns_with_a_gyro_is_found(simulated: Path, tmp_path: Path) -> None:
    """Among others: one at rest, one of something else that turns, told of child before parent."""
    whole = open_recording(simulated)
    poses = whole.poses("/vision/attitude")
    back = inverted(poses)
    noise = np.random.default_rng(1).normal(size=(len(poses), 4))
    other = noise / np.linalg.norm(noise, axis=1, keepdims=True)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(poses), 1))
    frames = [("map", "base", still), ("map", "drone", other), ("helmet", "camera", back.wxyz)]
    types = forms.ROS2.types

    def transform(t_ns: int, parent: str, child: str, w: float, x: float, y: float, z: float) -> Any:
        nowhere = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        turn = types["geometry_msgs/msg/Transform"](nowhere, types["geometry_msgs/msg/Quaternion"](x, y, z, w))
        return types["geometry_msgs/msg/TransformStamped"](forms.header(t_ns, parent), child, turn)

    tf = [
        (t, types["tf2_msgs/msg/TFMessage"]([transform(t, a, b, *wxyz[i].tolist()) for a, b, wxyz in frames]))
        for i, t in enumerate(poses.t_ns[:400].tolist())
    ]
    imu = [
        (t, forms.ROS2.deserialize_cdr(data, kind))
        for topic, kind, t, data in forms.raw_messages(simulated)
        if topic == "/head/imu" and t < poses.t_ns[400]
    ]
    path = forms.ros2_recording(tmp_path / "tf.mcap", {"/tf": tf, "/xsens": imu})
    (head,) = (found for found in suggestions(open_recording(path), NONE) if found.method == "head")
    assert head.missing == ()
    assert head.yaml.split("\n") == [
        "topics:",
        "  head_imu: /xsens",
        "  vision_attitude: {topic: /tf, frames: [helmet, camera], invert: true}",
    ]
    assert "/tf (helmet to camera) matches /xsens" in head.reasons[0]
    config = load_config(head.yaml.encode())
    recording = open_recording(path)
    recording = recording.with_config(config.topics.values(), config.columns)
    data, expected = read_head(recording, config), read_head(open_recording(simulated), NONE)
    np.testing.assert_allclose(data.vision_wxyz, expected.vision_wxyz[: len(data.vision_wxyz)], atol=1e-12)


def test_a_sensor_that_is_there_but_not_used_is_told(simulated: Path, tmp_path: Path) -> None:
    """A second gyro beside the head's, which the platform's could be."""
    whole = open_recording(simulated)
    topics = {"/head/imu": whole.imu("/head/imu"), "/vision/attitude": whole.poses("/vision/attitude")}
    write_session(tmp_path / "s.mcap", {**topics, "/vehicle/imu": whole.imu("/platform/imu")})
    session = Session.read(open_recording(tmp_path / "s.mcap"), "head", None)
    told = "/vehicle/imu (Imu): not used; is it the platform_imu? `topics: {platform_imu: /vehicle/imu}`"
    assert session.facts.notes == (told,)
    config = load_config(b"topics: {platform_imu: /vehicle/imu}")
    assert Session.read(open_recording(tmp_path / "s.mcap"), "head", config).facts.notes == ()
    # What `apply` adds is no other sensor.
    write_session(tmp_path / "t.mcap", {**topics, "/head/imu_calibrated": topics["/head/imu"]})
    assert Session.read(open_recording(tmp_path / "t.mcap"), "head", None).facts.notes == ()


def test_a_topic_without_messages_counts_as_not_recorded(simulated: Path, tmp_path: Path) -> None:
    """A recorder makes a channel of every topic that somebody might send to. A platform's gyro has to be there."""
    whole = open_recording(simulated)
    imus = {name: whole.imu(name) for name in ("/head/imu", "/platform/imu")}
    none = series.QuaternionSeries(np.empty(0, np.int64), np.empty((0, 4)))
    there = {**imus, "/vision/attitude": whole.poses("/vision/attitude"), "/truth/attitude": none}
    write_session(tmp_path / "s.mcap", there)
    recording = open_recording(tmp_path / "s.mcap")
    assert "/truth/attitude" in recording.topics
    session = Session.read(recording, "head", None)
    assert session.data.truth_t is None
    assert "topic /truth/attitude has no messages: it counts as not recorded" in session.facts.notes
    of_none = series.ImuSeries(none.t_ns, *np.empty((2, 0, 3)))
    write_session(tmp_path / "s.mcap", {**there, "/platform/imu": of_none})
    with pytest.raises(InputError, match="topic /platform/imu has no messages"):
        Session.read(open_recording(tmp_path / "s.mcap"), "head", None)


def test_a_recording_that_is_served_is_left_alone(simulated: Path) -> None:
    recording = open_recording(simulated)
    assert with_suggested(recording, NONE) == (recording, NONE)
    assert "head" not in {found.method for found in suggestions(recording, NONE)}


def test_the_commands_suggest_and_say_what_is_nearest(simulated: Path, tmp_path: Path, alidade: Command) -> None:
    path = tmp_path / "s.mcap"
    renamed(simulated, path)
    shown = alidade("info", path, "--quiet").out
    lines = ("head: yes, with these topics", "head_imu: /xsens/data", "los: missing")
    assert sorted(lines, key=shown.index) == list(lines)
    # What is proposed three lines above is not listed as unused.
    assert "not used:" not in shown
    told = json.loads(alidade("info", path, "--json").out)
    assert told["schema"] == "alidade.info/1"
    assert told["methods"]["head"]["suggested"]["platform_imu"] == "/vehicle/imu"
    assert told["methods"]["head"]["still_missing"] == []
    assert not told["methods"]["los"]["served"]
    for options in ([], ["--method", "head"]):
        refused = alidade("calibrate", path, *options)
        assert refused.code == 2
        assert "nearest is for head: /tracker/pose matches /xsens/data" in refused.err
        assert "`topics: {head_imu: /xsens/data, vision_attitude: /tracker/pose" in refused.err


def test_a_recording_without_anything_is_one_line(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", {"/v": series.VectorSeries(np.arange(5), np.zeros((5, 3)))})
    named = r"/v \(Vector3Stamped, 5 messages\) proposed as head_imu.*still missing: /vision"
    with pytest.raises(InputError, match=named):
        with_suggested(open_recording(tmp_path / "s.mcap"), NONE)


def _moving(n: int = 600) -> tuple[Any, Any]:
    rng = np.random.default_rng(4)
    t_ns = 1_790_000_000_000_000_000 + 10_000_000 * np.arange(n)
    return t_ns, rng


def test_a_gyro_and_an_accelerometer_on_two_topics_are_one_imu(tmp_path: Path) -> None:
    t_ns, rng = _moving()
    gyro = series.ImuSeries(t_ns, 0.3 * rng.normal(size=(600, 3)), np.zeros(3))
    accel = series.ImuSeries(t_ns + 3_000_000, np.zeros(3), np.array([0.0, 0.0, 9.8]) + rng.normal(size=(600, 3)))
    write_session(tmp_path / "s.mcap", {"/camera/gyro/sample": gyro, "/camera/accel/sample": accel})
    (found,) = suggestions(open_recording(tmp_path / "s.mcap"), NONE, ["tumble"])
    assert found.topics["imu"].parts == ("/camera/gyro/sample", "/camera/accel/sample")
    assert found.has_to_be_asked_for
    assert not found.missing


def test_of_two_imus_none_is_taken_by_chance(tmp_path: Path) -> None:
    t_ns, rng = _moving()
    imus = [
        series.ImuSeries(t_ns, 0.3 * rng.normal(size=(600, 3)), np.array([0.0, 0.0, 9.8]) + rng.normal(size=(600, 3)))
        for _ in range(2)
    ]
    write_session(tmp_path / "s.mcap", {"/sensors/a": imus[0], "/sensors/b": imus[1]})
    recording = open_recording(tmp_path / "s.mcap")
    (found,) = suggestions(recording, NONE, ["tumble"])
    assert not found.topics
    assert "/sensors/a and /sensors/b could be the imu: choose" in found.reasons[0]
    with pytest.raises(InputError, match="could be the imu: choose"):
        with_suggested(recording, NONE, "tumble")


def test_another_order_of_a_quaternions_components_is_no_inverse(simulated: Path, tmp_path: Path) -> None:
    """(x, y, z, w) read as (w, x, y, z) is exactly an inverse between two constant rotations, with a mount far off."""
    whole = open_recording(simulated)
    poses = whole.poses("/vision/attitude")
    wrong = series.PoseSeries(poses.t_ns, poses.wxyz[:, [1, 2, 3, 0]], poses.position)
    topics = {"/xsens/data": whole.imu("/head/imu"), "/tracker/pose": wrong, "/vehicle/imu": whole.imu("/platform/imu")}
    write_session(tmp_path / "s.mcap", topics)
    recording = open_recording(tmp_path / "s.mcap")
    (found,) = suggestions(recording, NONE, ["head"])
    assert "vision_attitude" not in found.topics
    assert "another order of its components" in found.reasons[0]
    assert found.missing


def twins(simulated: Path, path: Path, poses: bool = False) -> Recording:
    """Two IMUs on one helmet, at rest on its platform, and, if wanted, two trackers that see it."""
    whole, rng = open_recording(simulated), np.random.default_rng(4)
    one, pose = whole.imu("/head/imu"), whole.poses("/vision/attitude")
    other = dataclasses.replace(one, gyro=one.gyro[:, [1, 2, 0]] + 1e-3 * rng.normal(size=one.gyro.shape))
    topics = {"/imu_left": one, "/imu_right": other, "/pose": pose}
    write_session(path, topics | ({"/other/pose": pose} if poses else {}))
    return open_recording(path)


def test_a_topic_that_is_named_for_another_method_serves_as_well(simulated: Path, tmp_path: Path) -> None:
    recording = renamed(simulated, tmp_path / "s.mcap")
    (found,) = suggestions(recording, load_config(b"topics: {imu: /xsens/data}"), ["head"])
    assert found.topics["head_imu"].name == "/xsens/data"


def test_rates_in_another_unit_than_the_attitudes_are_not_taken(simulated: Path, tmp_path: Path) -> None:
    whole = open_recording(simulated)
    poses, imu = whole.poses("/vision/attitude"), whole.imu("/platform/imu")
    gyro = whole.imu("/head/imu")
    fast = {
        "/tracker/pose": dataclasses.replace(poses, t_ns=poses.t_ns // 5),
        "/xsens/data": dataclasses.replace(gyro, t_ns=gyro.t_ns // 5),
        "/vehicle/imu": dataclasses.replace(imu, t_ns=imu.t_ns // 5),
    }
    write_session(tmp_path / "s.mcap", fast)
    (found,) = suggestions(open_recording(tmp_path / "s.mcap"), NONE, ["head"])
    assert "/xsens/data turns with /tracker/pose, but 0.2" in " ".join(found.reasons)
    assert "vision_attitude" not in found.topics


def test_of_two_gyros_on_one_body_people_choose(simulated: Path, tmp_path: Path, alidade: Command) -> None:
    recording = twins(simulated, tmp_path / "s.mcap")
    (head,) = (found for found in suggestions(recording, NONE) if found.method == "head")
    assert "/imu_left and /imu_right could be the head_imu: choose, `topics: {head_imu: /imu_left}`" in head.reasons[0]
    assert set(head.topics) == {"vision_attitude"}
    run = alidade("calibrate", tmp_path / "s.mcap", "--method", "head", "--auto-topics", "--out", tmp_path / "out")
    assert (run.code, run.out) == (2, "")
    assert "/imu_left and /imu_right could be the head_imu" in run.err
    config = load_config(b"topics: {head_imu: /imu_right}")
    (head,) = (found for found in suggestions(recording, config) if found.method == "head")
    assert head.missing == ()
    assert set(head.topics) == {"vision_attitude"}
    assert "/imu_left turns as /imu_right does: not proposed as platform_imu" in head.reasons


def test_of_two_attitudes_of_one_body_people_choose(simulated: Path, tmp_path: Path) -> None:
    recording = twins(simulated, tmp_path / "s.mcap", poses=True)
    config = load_config(b"topics: {head_imu: /imu_right}")
    (head,) = (found for found in suggestions(recording, config) if found.method == "head")
    assert head.topics == {}
    assert "/other/pose and /pose could be the vision_attitude" in head.reasons[0]


@pytest.mark.parametrize("names", [("/mag0", "/mag1"), ("/x", "/y"), ("/left/mag", "/right/mag")])
def test_of_two_magnetometers_people_choose(names: tuple[str, str], tmp_path: Path, alidade: Command) -> None:
    t_ns = 1_700_000_000_000_000_000 + 20_000_000 * np.arange(200)
    field = 5e-5 * np.random.default_rng(2).normal(size=(200, 3))
    write_session(tmp_path / "s.mcap", {name: series.MagneticSeries(t_ns, field) for name in names})
    run = alidade("info", tmp_path / "s.mcap")
    assert f"tumble: {names[0]} and {names[1]} could be the mag: choose" in run.out
    run = alidade("calibrate", tmp_path / "s.mcap", "--method", "tumble", "--auto-topics", "--out", tmp_path / "out")
    assert (run.code, run.out) == (2, "")
    assert "could be the mag: choose" in run.err
