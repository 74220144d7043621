"""Facts about a recording, and which method it is for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications.session import missing_for, resolve_method, session_facts
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method, names
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.topics import Setting, Topic

T0 = 1_800_000_000_000_000_000
NONE = load_config(None)


def imu(t_ms: list[int] | np.ndarray[tuple[int], np.dtype[np.int64]]) -> series.ImuSeries:
    return series.ImuSeries(T0 + 1_000_000 * np.asarray(t_ms, dtype=np.int64), np.zeros((len(t_ms), 3)))


def test_rates_gaps_duplicates_and_order(tmp_path: Path) -> None:
    t_ms = [*range(0, 1000, 10), 1000, 1000, 1020, 1010, *range(1500, 2000, 10)]
    write_session(tmp_path / "s.mcap", {"/imu": imu(t_ms), "/one": imu([5])}, {"alidade.yaml": b""})
    facts = session_facts(open_recording(tmp_path / "s.mcap"), NONE)
    assert facts.epoch_ns == T0
    assert facts.attachments == ("alidade.yaml",)
    many, one = facts.topics
    assert (many.name, many.type, many.count) == ("/imu", "sensor_msgs/msg/Imu", len(t_ms))
    assert many.rate_hz == pytest.approx(100.0)
    assert (many.start_s, many.duration_s) == (0.0, 1.99)
    assert (many.largest_gap_s, many.largest_gap_at_s) == (0.48, 1.02)
    assert (many.duplicates, many.out_of_order) == (1, 1)
    assert (one.count, one.start_s, one.rate_hz, one.largest_gap_s) == (1, 0.005, None, None)


def test_which_methods_a_recording_serves(shared_data: Path) -> None:
    for path in (shared_data / "contract").glob("*.mcap"):
        recording = open_recording(path)
        config = load_config(recording.attachment("alidade.yaml"))
        facts = session_facts(recording, config)
        # What makes do with a magnetometer yields to all others.
        assert [name for name in facts.methods if not method(name).fallback] == [config.method]
        assert resolve_method(None, recording, NONE) == config.method
        assert all(topic.duplicates == topic.out_of_order == 0 for topic in facts.topics)


def test_what_is_missing_is_named_and_renames_are_honoured(tmp_path: Path) -> None:
    t = T0 + np.arange(0, 10**9, 10**7)
    write_session(
        tmp_path / "s.mcap",
        {
            "/xsens": series.ImuSeries(t, np.zeros((100, 3))),
            "/indexer/joint_states": series.JointSeries(t, np.zeros((100, 2)), ("outer_x", "inner_z")),
            "/mag": series.VectorSeries(t, np.zeros((100, 3))),
        },
    )
    recording = open_recording(tmp_path / "s.mcap")
    assert missing_for("indexer", recording, NONE) == (
        "/imu (sensor_msgs/msg/Imu)",
        "/fix (sensor_msgs/msg/NavSatFix), or latitude_deg in the config",
    )
    config = load_config(b"topics: {imu: /xsens}\nlatitude_deg: 40")
    assert missing_for("indexer", recording, config) == ()
    (cube,) = missing_for("cube", recording, config)
    assert cube.startswith("/tag_detections (apriltag_msgs/msg/AprilTagDetectionArray) and /camera/camera_info")
    assert cube.endswith("cube.tags in the config, or `method: cube` in the config")
    assert missing_for("cube", recording, load_config(b"topics: {imu: /xsens}\nmethod: cube")) == ()
    los = missing_for("los", recording, load_config(b"topics: {imu: /xsens, gimbal: /mag}"))
    assert "/mag as sensor_msgs/msg/JointState, not geometry_msgs/msg/Vector3Stamped" in los
    head = missing_for("head", recording, config)
    assert head[0] == "/head/imu (sensor_msgs/msg/Imu)"
    assert head[1].endswith("/camera/camera_info (sensor_msgs/msg/CameraInfo) and head.board in the config")
    assert resolve_method(None, recording, config) == "indexer"
    with pytest.raises(InputError, match=r"no usable topics for any method; topics there: .*/xsens"):
        resolve_method(None, recording, NONE)


def test_the_option_wins_over_the_config_over_the_topics(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", {"/imu": imu([0, 1])})
    recording = open_recording(tmp_path / "s.mcap")
    assert resolve_method("cube", recording, load_config(b"method: los")) == "cube"
    assert resolve_method(None, recording, load_config(b"method: los")) == "los"
    with pytest.raises(InputError, match="no method 'sextant'; there are los, indexer, head"):
        resolve_method("sextant", recording, NONE)


def test_several_methods_served_is_an_error_that_names_them(tmp_path: Path) -> None:
    t = T0 + np.arange(0, 10**9, 10**7)
    gyro, zeros = series.ImuSeries(t, np.zeros((100, 3))), np.zeros((100, 2))
    write_session(
        tmp_path / "s.mcap",
        {
            "/imu": gyro,
            "/head/imu": gyro,
            "/indexer/joint_states": series.JointSeries(t, zeros, ("outer_x", "inner_z")),
            "/fix": series.FixSeries(t, zeros[:, 0], zeros[:, 0]),
            "/vision/attitude": series.QuaternionSeries(t, np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))),
        },
    )
    with pytest.raises(InputError, match="serve indexer and head; choose with --method"):
        resolve_method(None, open_recording(tmp_path / "s.mcap"), NONE)


def test_needs_are_made_of_known_keys() -> None:
    topics = {topic for name in names() for topic in method(name).topics}
    needed = {one for name in names() for need in method(name).requirements for group in need for one in group}
    settings = {one.phrase.split(" in the config")[0] for one in needed if isinstance(one, Setting)}
    assert {one for one in needed if isinstance(one, Topic)} <= topics
    assert settings <= {"latitude_deg", "head.board", "cube.tags", "`method: cube`", "`method: tumble`"}
    assert {topic.name for topic in topics} >= {"/imu", "/los/error", "/platform/imu"}
    assert len({topic.key for topic in topics}) == len(topics)


@pytest.mark.parametrize("name", ["compressed", "ros2_talker", "ros2_only_topics", "ros2_service_events"])
def test_files_of_others_serve_no_method(name: str, shared_data: Path) -> None:
    recording = open_recording(shared_data / "mcap_files" / f"{name}.mcap")
    facts = session_facts(recording, NONE)
    assert facts.methods == ()
    assert [topic.count for topic in facts.topics] == [topic.count for topic in recording.topics.values()]
    with pytest.raises(InputError, match="no usable topics") as caught:
        resolve_method(None, recording, NONE)
    assert ("a ROS 1 recording" in str(caught.value)) == (name == "compressed")
