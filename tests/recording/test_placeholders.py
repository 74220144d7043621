"""What drivers write in place of a measurement, and messages in an order or number that they were not sent in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import clean, tracked
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.plausibility import (
    GRAVITY_REMOVED,
    density,
    implausible,
    is_there,
    measured_once,
    plausible_covariance,
)
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.streams import StreamReader
from alidade.pipelines.recording.topics import TopicSource
from tests.support import forms

RNG = np.random.default_rng(3)
T_NS = 10_000_000 * np.arange(1000)
T_S = np.asarray(1e-9 * T_NS, dtype=np.float64)
RATES = RNG.normal(0.0, 0.3, (1000, 3))
NOTHING = np.zeros((1000, 3, 3))
AB: dict[str, Any] = {"frames": ("a", "b")}


@pytest.mark.parametrize("variance", [1e6, 99999.0, np.finfo(float).max, 1.0, -1.0, 1e-15])
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 1)])
def test_a_covariance_that_no_gyro_has_says_nothing(variance: float, axes: tuple[int, ...]) -> None:
    covariance = np.zeros((1000, 3, 3))
    covariance[:, axes, axes] = variance
    dropped: dict[str, int] = {}
    assert density("/imu", "gyro", T_S, covariance, 2e-7, dropped) is None
    assert list(dropped.values()) == [1000]


def test_a_covariance_in_some_rows_alone_is_that_of_all() -> None:
    covariance = np.zeros((1000, 3, 3))
    covariance[0] = 1e-4 * np.eye(3)
    assert density("/imu", "gyro", T_S, covariance, 2e-7, {}) == pytest.approx(1e-3)


def test_an_attitude_known_to_a_radian_is_not_known() -> None:
    assert not plausible_covariance("/pose", "attitude", np.tile(np.eye(3), (5, 1, 1)), 1e-11, {}).any()
    known = np.asarray(plausible_covariance("/pose", "attitude", np.tile(1e-4 * np.eye(3), (5, 1, 1)), 1e-11, {}))
    assert known[..., np.arange(3), np.arange(3)].all()


def test_minus_one_is_believed_of_what_no_sensor_reads() -> None:
    absent = NOTHING - np.diag([1.0, 0.0, 0.0])
    force = np.array([0.1, -0.2, 9.8]) + 0.02 * RNG.normal(size=(1000, 3))
    assert is_there("accel", force, absent), "a driver wrote -1 over real accelerations"
    assert is_there("accel", force, NOTHING)
    for filled_in in (np.zeros((1000, 3)), np.full((1000, 3), np.nan), np.tile([0.0, 0.0, 9.8], (1000, 1))):
        assert not is_there("accel", filled_in, absent)


def test_a_held_reading_is_used_once() -> None:
    own = RNG.normal(size=(125, 3))
    dropped: dict[str, int] = {}
    kept = measured_once("/mag", np.repeat(own, 8, axis=0), dropped)
    np.testing.assert_array_equal(kept, 8 * np.arange(125))
    assert dropped == {"/mag: repeats the reading before, used once": 875}
    assert len(measured_once("/mag", RNG.normal(size=(1000, 3)), {})) == 1000
    coarse = np.round(0.4 * RNG.normal(size=(1000, 3)))
    assert len(measured_once("/mag", np.ones((1000, 3)), {})) == 1000, "a coarse sensor at rest has one value"
    assert len(measured_once("/mag", coarse, {})) == 1000, "a coarse sensor repeats itself, but not each value alike"


def test_a_held_reading_is_not_one_at_the_end_of_the_range(tmp_path: Path) -> None:
    turn = np.linspace(0.0, 20.0, 125)[:, None] + [0.0, 1.0, 2.0]
    held = np.repeat(3e-5 * np.sin(turn) + 1e-7 * RNG.normal(size=(125, 3)), 8, axis=0)
    imu = series.ImuSeries(T_NS, 1e4 * held, np.full(3, np.nan))
    write_session(tmp_path / "s.mcap", {"/mag": series.MagneticSeries(T_NS, held), "/imu": imu}, {})
    reader = StreamReader(open_recording(tmp_path / "s.mcap"), {})
    np.testing.assert_array_equal(reader.magnetic_field("/mag").series.field, held[::8])
    np.testing.assert_array_equal(reader.gyro("/imu").series.gyro, 1e4 * held[::8])
    assert reader.dropped == {f"/{topic}: repeats the reading before, used once": 875 for topic in ("mag", "imu")}


def test_quaternions_of_zeros_are_a_body_that_was_not_seen() -> None:
    wxyz, dropped = np.tile([1.0, 0.0, 0.0, 0.0], (10, 1)), dict[str, int]()
    wxyz[3:5] = 0.0
    assert np.flatnonzero(np.isnan(tracked("/pose", wxyz, dropped)).any(axis=1)).tolist() == [3, 4]
    assert list(dropped.values()) == [2]


def test_gravity_that_was_taken_off_is_named() -> None:
    moving = 0.05 * RNG.normal(size=(2000, 3)) * (1.0 + 5.0 * (np.arange(2000) % 400 > 300))[:, None]
    assert GRAVITY_REMOVED in implausible("accel", moving)
    directions = RNG.normal(size=(2000, 3))
    gravity = directions / np.linalg.norm(directions, axis=1)[:, None]
    assert implausible("accel", 9.8 * gravity + 2.0 * RNG.normal(size=(2000, 3))) == ""
    assert implausible("accel", gravity + 0.3 * RNG.normal(size=(2000, 3))).endswith("is it in g?")


def test_messages_recorded_twice_are_dropped_and_counted() -> None:
    dropped: dict[str, int] = {}
    _, keep = clean("/imu", np.repeat(T_NS, 2), 0, np.repeat(RATES, 2, axis=0), dropped)
    np.testing.assert_array_equal(keep, 2 * np.arange(1000))
    assert dropped == {"/imu: the same message once more, left out": 1000}
    other = np.repeat(RATES, 2, axis=0) + np.arange(2000)[:, None] % 2
    with pytest.raises(InputError, match=r"1000 of 2000 stamps are duplicate .*are two devices on one topic"):
        clean("/imu", np.repeat(T_NS, 2), 0, other, {})


def test_messages_that_overtook_each_other_are_sorted_and_a_clock_that_jumps_is_not() -> None:
    late = T_NS + 35_000_000 * (RNG.random(1000) < 0.05)
    order = np.argsort(late, kind="stable")
    dropped: dict[str, int] = {}
    t, keep = clean("/imu", T_NS[order], 0, RATES[order], dropped)
    np.testing.assert_array_equal(t, T_NS / 1e9)
    np.testing.assert_array_equal(order[keep], np.arange(1000))
    assert dropped["/imu: stamp out of order (sorted, kept)"] > 10
    with pytest.raises(InputError, match="out of order"):
        clean("/imu", RNG.permutation(T_NS), 0, RATES, {})


def test_readings_of_two_devices_in_turn_are_refused() -> None:
    with pytest.raises(InputError, match=r"axis y alternates between two levels .*two devices"):
        drop_faults("/imu", T_S, RATES * 0.01 + np.array([0.0, 0.2, 0.0]) * (np.arange(1000) % 2)[:, None], {}, "")
    assert len(drop_faults("/imu", T_S, RATES, {}, "rad/s")) == 1000


def test_readings_of_two_devices_in_turn_are_refused_when_only_their_mounts_differ() -> None:
    """By 2 deg, the motion and the noise as of a head; nothing that shakes, nor stamps 9 and 11 ms apart."""
    rng, n = np.random.default_rng(5), 4000
    t = 0.01 * np.arange(n) + 0.001 * (np.arange(n) % 2)
    swings = rng.uniform(0.1, 1.0, 9).reshape(3, 3)[:, None] * t[:, None]
    rates = np.sin(2.0 * np.pi * swings + rng.uniform(0.0, 6.0, (3, 1, 3))).sum(axis=0)
    noisy = rates + np.where(t % 20.0 < 2.0, 0.5, 0.01)[:, None] * rng.standard_normal((n, 3))
    assert len(drop_faults("/imu", t, noisy, {}, "rad/s")) == n
    # Motors at nearly half the sampling rate, from 0 to 3 Hz beside it.
    phase = np.pi * np.arange(n) + 2.0 * np.pi * np.cumsum(0.01 * (1.5 + 1.5 * np.sin(0.4 * t)))
    shaken = noisy + 0.3 * np.sin(phase[:, None] + [0.0, 1.0, 2.0])
    assert len(drop_faults("/imu", t, shaken, {}, "rad/s")) == n
    turned = noisy @ so3.matrix(so3.exp(np.deg2rad([[0.0, 2.0, 0.0]])))[0].T
    with pytest.raises(InputError, match=r"alternates between two levels .*two devices"):
        drop_faults("/imu", t, np.where(np.arange(n)[:, None] % 2, turned, noisy), {}, "rad/s")


def _imu_message(stamp_ns: int, frame: str, rate: float) -> object:
    types = forms.ROS2.types
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=9.8)
    return types["sensor_msgs/msg/Imu"](
        header=forms.header(stamp_ns, frame),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=types["geometry_msgs/msg/Vector3"](x=rate, y=0.0, z=0.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=zero,
        linear_acceleration_covariance=np.zeros(9),
    )


def test_of_several_devices_on_one_topic_one_is_chosen_by_its_frame(tmp_path: Path) -> None:
    start = 1_790_000_000_000_000_000
    messages = [
        (start + 5_000_000 * i, _imu_message(start + 5_000_000 * i, f"imu_{('left', 'right')[i % 2]}", float(i)))
        for i in range(60)
    ]
    path = forms.ros2_recording(tmp_path / "two.mcap", {"/imu": messages})
    with pytest.raises(InputError, match=r"several devices, by their frames: imu_left \(30 messages\), imu_right"):
        open_recording(path).imu("/imu")

    recording = open_recording(path)
    source = TopicSource(topic="/imu", frame="imu_right", axes=("-y", "x", "z"))
    recording = recording.with_config([source])
    imu = recording.imu(source.name)
    np.testing.assert_array_equal(imu.gyro[:, 1], np.arange(1.0, 60.0, 2.0))
    assert not imu.gyro[:, 0].any()
    wrong = TopicSource(topic="/imu", frame="imu_top")
    recording = recording.with_config([wrong])
    with pytest.raises(InputError, match="no messages of the frame imu_top; there: imu_left"):
        recording.imu(wrong.name)


def test_a_message_sent_before_there_was_a_clock_is_left_out(tmp_path: Path) -> None:
    """Under simulated time: stamps are seconds, log times are Unix time, the first message has stamp 0."""
    log = 1_790_000_000_000_000_000
    messages = [
        (log + 10_000_000 * i, _imu_message(10_000_000 * (i + 100) * (i > 0), "imu", float(i))) for i in range(50)
    ]
    recording = open_recording(forms.ros2_recording(tmp_path / "sim.mcap", {"/imu": messages}))
    imu = recording.imu("/imu")
    assert (len(imu), imu.stamped_by_log, recording.epoch_ns) == (49, 0, 1_010_000_000)
    assert "topic /imu: 1 messages without a stamp, among others that have one, are left out" in recording.notes


@pytest.mark.parametrize(("stamped_each", "kept", "by_log"), [(2, 25, 0), (3, 50, 50)])
def test_a_topic_has_one_clock(stamped_each: int, kept: int, by_log: int, tmp_path: Path) -> None:
    """Every second or third message has a stamp, of the device's clock; most messages decide for that or the log's."""
    log = 1_790_000_000_000_000_000
    messages = [
        (log + 10_000_000 * i, _imu_message(10_000_000 * (i + 100) * (i % stamped_each == 0), "imu", float(i)))
        for i in range(50)
    ]
    recording = open_recording(forms.ros2_recording(tmp_path / "mixed.mcap", {"/imu": messages}))
    imu = recording.imu("/imu")
    assert (len(imu), imu.stamped_by_log) == (kept, by_log)
    assert np.ptp(np.diff(imu.t_ns)) == 0
    found = [recording.stamps(block) for block in recording.container.blocks(set(recording.container.channels))]
    assert np.isin(imu.t_ns, np.concatenate(found)).all()


def _one_by_one(kind: str, t_ns: int) -> Any:
    """A message of a type that is read one by one, with a stamp."""
    make = forms.ROS2.types
    if kind == "sensor_msgs/msg/CompressedImage":
        return make[kind](forms.header(t_ns), "jpeg", np.zeros(4, np.uint8))
    if kind == "apriltag_msgs/msg/AprilTagDetectionArray":
        return make[kind](forms.header(t_ns), [])
    turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    turn = make["geometry_msgs/msg/Transform"](make["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), turn)
    return make[kind]([make["geometry_msgs/msg/TransformStamped"](forms.header(t_ns, "a"), "b", turn)])


@pytest.mark.parametrize(
    ("stamped", "kept"), [(lambda i: i > 0, 49), (lambda i: i % 2 == 0, 25), (lambda i: i < 9, 50)]
)
@pytest.mark.parametrize(
    ("kind", "read"),
    [
        ("sensor_msgs/msg/CompressedImage", lambda recording, topic: [t for t, _ in recording.images(topic)]),
        ("apriltag_msgs/msg/AprilTagDetectionArray", lambda recording, topic: recording.detections(topic).t_ns),
        ("tf2_msgs/msg/TFMessage", lambda recording, topic: recording.poses_of(TopicSource(topic=topic, **AB)).t_ns),
    ],
)
def test_pictures_tags_and_transforms_have_one_clock(
    kind: str, read: Callable[[Any, str], Any], stamped: Callable[[int], bool], kept: int, tmp_path: Path
) -> None:
    """Stamps are the device's clock, log times Unix time; messages without a stamp are left out, if they are few."""
    log = 1_790_000_000_000_000_000
    messages = [(log + 10_000_000 * i, _one_by_one(kind, 10_000_000 * (i + 100) * bool(stamped(i)))) for i in range(50)]
    recording = open_recording(forms.ros2_recording(tmp_path / "mixed.mcap", {"/x": messages}))
    t_ns = np.asarray(read(recording, "/x"))
    assert len(t_ns) == kept
    assert np.ptp(t_ns) <= 490_000_000
    left_out = f"topic /x: {50 - kept} messages without a stamp, among others that have one, are left out"
    by_log = "messages have no stamp; all get their log times"
    assert any((by_log if kept == 50 else left_out) in note for note in recording.notes)
    np.testing.assert_array_equal(read(recording, "/x"), t_ns)


def test_one_of_two_devices_on_a_topic_has_no_stamps(tmp_path: Path) -> None:
    log = 1_790_000_000_000_000_000
    messages = [
        (log + 10_000_000 * i, _imu_message(10_000_000 * (i + 100) * (i % 2), ("b", "a")[i % 2], float(i)))
        for i in range(50)
    ]
    source = TopicSource(topic="/imu", frame="b")
    recording = open_recording(forms.ros2_recording(tmp_path / "two.mcap", {"/imu": messages})).with_config([source])
    imu = recording.imu(source.name)
    assert (len(imu), imu.stamped_by_log) == (25, 25)


def test_a_gyro_alone_in_a_series_says_so() -> None:
    imu = series.ImuSeries(T_NS, RATES, np.full(3, np.nan))
    assert is_there("gyro", imu.gyro, imu.gyro_cov)
    assert not is_there("accel", imu.accel, imu.accel_cov)
