"""Layouts against rosbags' own decoder, and the fast decoding against the slow one."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import alidade
from alidade.pipelines.applications.discovery import suggestions
from alidade.pipelines.applications.session import resolve_method, session_facts
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.decoding import NUMERIC_TYPES
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.series import ImuSeries, PoseSeries, VectorSeries
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.settings import Config
from tests.support.raw_messages import FLAT, OLD_TAGS, POINT_TAGS, STORE, T0, random_message, read_any, write_raw


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("kind", [*FLAT, messages.JOINT_STATE, messages.CAMERA_INFO])
@pytest.mark.parametrize("frame_id", ["", "a", "imu_link", "sensor/é"])
def test_layout_finds_every_number_where_rosbags_finds_it(kind: str, frame_id: str, little: bool) -> None:
    message = random_message(kind, np.random.default_rng(3), T0 + 123, frame_id)
    data = bytes(STORE.serialize_cdr(message, kind, little_endian=little))
    layout = messages.known(kind).layout(data)
    assert layout is not None
    raw = np.frombuffer(data, np.uint8)[None, :]
    found = np.concatenate([leaf.of(raw)[0].astype(float) for leaf in layout.leaves])
    np.testing.assert_array_equal(found, _numbers_without_strings(messages.known(kind), message))


def _numbers_without_strings(definition: messages.Definition, message: Any) -> np.ndarray[Any, Any]:
    if isinstance(message, str) or (isinstance(message, list) and message and isinstance(message[0], str)):
        return np.empty(0)
    if hasattr(message, "__msgtype__"):
        names = [name for name, _ in STORE.fielddefs[message.__msgtype__][1]]
        return np.concatenate([_numbers_without_strings(definition, getattr(message, name)) for name in names])
    return definition.numbers(message)


def test_every_type_has_a_definition_and_is_read_by_something() -> None:
    for kind in messages.SENSORS:
        assert messages.known(kind)
    single = {messages.CAMERA_INFO, *messages.PICTURES, messages.TF, messages.TAG_DETECTIONS}
    assert set(messages.SENSORS) == NUMERIC_TYPES | single


def test_groups_of_types_are_those_that_have_columns() -> None:
    imu, vector, pose = ({each.TYPE, *each.OTHERS} for each in (ImuSeries, VectorSeries, PoseSeries))
    assert set(messages.IMUS) == imu
    assert {*messages.RATES, messages.ACCEL} == imu | vector
    assert set(messages.ATTITUDES) == pose | {messages.IMU}


@pytest.mark.parametrize("kind", messages.IMUS)
def test_every_imu_is_one_for_reading_discovery_and_noise(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    stamps = [T0 + 10**7 * i for i in range(100)]
    data = [bytes(STORE.serialize_cdr(random_message(kind, rng, t, "imu"), kind)) for t in stamps]
    path = write_raw(tmp_path / "x.mcap", "/x", kind, messages.definition_text(kind), data, stamps)
    recording = open_recording(path)
    derived = recording.with_config([TopicSource(gyro="/x", accel="/x")])
    (name,) = derived.topics.keys() - recording.topics.keys()
    for imu in (recording.imu("/x"), derived.imu(name)):
        assert np.isfinite([imu.gyro, imu.accel]).all()
    found = suggestions(recording, Config())
    assert any(source.name == "/x" for each in found for source in each.topics.values())
    with pytest.raises(InputError, match="topic /x: acceleration has a norm of"):
        alidade.noise(path)


@pytest.mark.parametrize("cut", [0, 3, 4, 20, 100])
def test_layout_refuses_a_cut_message(cut: int) -> None:
    message = random_message(messages.IMU, np.random.default_rng(0), T0, "imu")
    data = bytes(STORE.serialize_cdr(message, messages.IMU))
    assert messages.known(messages.IMU).layout(data[:cut]) is None


def test_layout_refuses_a_sequence_longer_than_the_message() -> None:
    message = random_message(messages.JOINT_STATE, np.random.default_rng(0), T0, "")
    data = bytearray(STORE.serialize_cdr(message, messages.JOINT_STATE))
    struct.pack_into("<I", data, 20, 2**31)  # number of names
    assert messages.known(messages.JOINT_STATE).layout(bytes(data)) is None


@pytest.mark.parametrize("kind", [*FLAT, messages.JOINT_STATE])
def test_fast_and_slow_decoding_give_the_same_arrays(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mixed frame names, byte orders and stamps, so that the fast path has to leave messages out."""
    rng = np.random.default_rng(5)
    log = [T0 + 1000 * i for i in range(300)]
    data = []
    for i, t in enumerate(log):
        frame_id = "imu" if i % 7 else ["imv", "imu_link", "imu"][i % 3] + f"_{i}"
        message = random_message(kind, rng, t - 17, frame_id)
        data.append(bytes(STORE.serialize_cdr(message, kind, little_endian=i % 11 != 3)))
    path = write_raw(tmp_path / "x.mcap", "/x", kind, messages.definition_text(kind), data, log, chunk_size=20_000)
    decoded = []
    decode = messages.Definition.decode

    def slow(self: messages.Definition, data: bytes) -> Any:
        decoded.append(data)
        return decode(self, data)

    monkeypatch.setattr(messages.Definition, "decode", slow)
    fast = read_any(path, kind)
    assert len(decoded) < 100  # most of the 300 took the fast path
    monkeypatch.setattr(messages.Definition, "layout", lambda *_: None)
    decoded.clear()
    one_by_one = read_any(path, kind)
    assert len(decoded) == 300
    assert len(fast["t_ns"]) == 300
    for name, value in one_by_one.items():
        np.testing.assert_array_equal(fast[name], value, err_msg=name)


def test_joints_are_found_by_name_in_any_order_and_others_are_counted(tmp_path: Path) -> None:
    store, kind = STORE, messages.JOINT_STATE
    data, want = [], []
    orders = [["azimuth", "elevation"], ["elevation", "azimuth"], ["x", "azimuth", "elevation"], ["azimuth"]]
    for i in range(40):
        message = random_message(kind, np.random.default_rng(i), T0 + i, "")
        message.name = orders[i % 4]
        message.position = np.arange(len(message.name)) + 10.0 * i
        data.append(bytes(store.serialize_cdr(message, kind)))
        if len(message.name) > 1:
            want.append([message.position[message.name.index(n)] for n in ("azimuth", "elevation")])
    log = list(range(T0, T0 + 40))
    path = write_raw(tmp_path / "j.mcap", "/j", kind, messages.definition_text(kind), data, log)
    joints = open_recording(path).joints("/j", ["azimuth", "elevation"])
    np.testing.assert_array_equal(joints.position, want)
    assert joints.without == 10
    with pytest.raises(InputError, match=r"joints outer_x.*its joints: .*azimuth.*elevation"):
        open_recording(path).joints("/j", ["outer_x"])


@pytest.mark.parametrize("text", [OLD_TAGS, POINT_TAGS])
def test_tag_detections_of_older_definitions(text: str, tmp_path: Path) -> None:
    kind = messages.TAG_DETECTIONS
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, kind))
    rng = np.random.default_rng(1)
    made = [random_message(kind, rng, T0 + i, "tag36h11", store) for i in range(3)]
    made[1].detections = []
    data = [bytes(store.serialize_cdr(message, kind)) for message in made]
    path = write_raw(tmp_path / "t.mcap", "/t", kind, text, data, [T0, T0 + 1, T0 + 2])
    found = open_recording(path).detections("/t")
    assert found.frame.tolist() == [0, 0, 0, 2, 2, 2]
    assert found.tag_id.tolist() == [tag.id for message in made for tag in message.detections]
    numbers = messages.Definition(kind, text).numbers
    corners = [numbers(tag.corners).reshape(4, -1)[:, :2] for message in made for tag in message.detections]
    np.testing.assert_array_equal(found.corners, corners)
    assert set(found.family.tolist()) == {"tag36h11"}


def test_stamps_are_replaced_by_log_times_where_most_are_zero(tmp_path: Path) -> None:
    kind = messages.IMU
    rng = np.random.default_rng(2)
    log = [T0 + 100 * i for i in range(20)]
    made = [random_message(kind, rng, t - 5 if i % 4 == 0 else 0, "imu") for i, t in enumerate(log)]
    data = [bytes(STORE.serialize_cdr(message, kind)) for message in made]
    path = write_raw(tmp_path / "z.mcap", "/x", kind, messages.definition_text(kind), data, log)
    imu = open_recording(path).imu("/x")
    assert imu.stamped_by_log == 20
    np.testing.assert_array_equal(imu.t_ns, log)


def test_a_definition_without_the_field_is_named(tmp_path: Path) -> None:
    text = messages.definition_text(messages.VECTOR)
    other = text.replace("geometry_msgs/Vector3 vector", "geometry_msgs/Vector3 wektor")
    message = random_message(messages.VECTOR, np.random.default_rng(2), T0, "")
    data = [bytes(STORE.serialize_cdr(message, messages.VECTOR))]
    path = write_raw(tmp_path / "v.mcap", "/v", messages.VECTOR, other, data, [T0])
    with pytest.raises(InputError, match=r"/v.*vector"):
        open_recording(path).vector("/v")


def test_a_definition_with_more_fields_is_followed(tmp_path: Path) -> None:
    """The layout comes from the text in the file, not from what we expect of the type's name."""
    kind = messages.VECTOR
    text = messages.definition_text(kind).replace(
        "geometry_msgs/Vector3 vector", "uint8 quality # own\nstring note\ngeometry_msgs/Vector3 vector\nfloat32[] more"
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, kind))
    rng = np.random.default_rng(4)
    made = [random_message(kind, rng, T0 + i, "abc", store) for i in range(5)]
    data = [bytes(store.serialize_cdr(message, kind)) for message in made]
    path = write_raw(tmp_path / "v.mcap", "/v", kind, text, data, [T0 + i for i in range(5)])
    want = [[message.vector.x, message.vector.y, message.vector.z] for message in made]
    np.testing.assert_array_equal(open_recording(path).vector("/v").vector, want)


def test_a_message_that_is_not_its_type_is_an_error(tmp_path: Path) -> None:
    kind = messages.IMU
    path = write_raw(tmp_path / "i.mcap", "/i", kind, messages.definition_text(kind), [b"\0\1\0\0" + b"\0" * 40], [T0])
    with pytest.raises(InputError, match=r"/i.*does not agree with the definition"):
        open_recording(path).imu("/i")


def test_unreadable_definition_is_one_line(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "i.mcap", "/i", messages.IMU, "float64 ---\n\nwhat", [b"\0\1\0\0"], [T0])
    with pytest.raises(InputError, match="cannot be read") as caught:
        open_recording(path).imu("/i")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (messages.IMU, "std_msgs/Header header\nstring angular_velocity"),
        (messages.IMU, "std_msgs/Header header\nfloat64[4] angular_velocity"),
        (messages.JOINT_STATE, "std_msgs/Header header\nfloat64[] name\nfloat64[] position"),
        (messages.JOINT_STATE, "std_msgs/Header header\nstring[] name\nstring[] position"),
        (messages.CAMERA_INFO, "std_msgs/Header header\nuint32 height\nuint32 width"),
        (messages.CAMERA_INFO, "std_msgs/Header header\nstring k\nstring r\nstring p"),
        (messages.COMPRESSED_IMAGE, "std_msgs/Header header\nstring format\nstring data"),
        (messages.TAG_DETECTIONS, "std_msgs/Header header\nuint8[] detections"),
        (messages.TAG_DETECTIONS, "std_msgs/Header header\nstring detections"),
        (messages.IMU, "float64 x"),
    ],
)
def test_a_wrong_schema_of_the_right_name_is_one_line(kind: str, text: str, tmp_path: Path) -> None:
    header = OLD_TAGS[OLD_TAGS.index("=" * 80) : OLD_TAGS.index("=" * 80 + "\nMSG: apriltag")]
    store = get_typestore(Stores.EMPTY)
    full = f"{text}\n{header}"
    store.register(get_types_from_msg(full, kind))
    made = messages.Definition(kind, full).new(kind) if "header" not in text else None
    rng = np.random.default_rng(0)
    data = store.serialize_cdr(made or random_message(kind, rng, T0, "abc", store), kind)
    path = write_raw(tmp_path / "x.mcap", "/x", kind, full, [bytes(data)] * 2, [T0, T0 + 1])
    recording = open_recording(path)
    read: dict[str, Any] = {
        messages.IMU: recording.imu,
        messages.JOINT_STATE: lambda topic: recording.joints(topic, ["ab", "c"]),
        messages.CAMERA_INFO: recording.camera_info,
        messages.COMPRESSED_IMAGE: lambda topic: list(recording.images(topic)),
        messages.TAG_DETECTIONS: recording.detections,
    }
    with pytest.raises(InputError, match=r"topic /x: the messages have no usable field|/x has no message with"):
        read[kind]("/x")


@pytest.mark.parametrize(
    ("message", "schema", "kind", "shown"),
    [
        ("json", "jsonschema", "own.Gyro", r"/imu \(own.Gyro, json/jsonschema\)"),
        ("protobuf", "protobuf", "own.Gyro", r"/imu \(own.Gyro, protobuf/protobuf\)"),
        ("flatbuffer", "flatbuffer", "foxglove.Log", r"/imu \(foxglove.Log, flatbuffer/flatbuffer\)"),
        ("ros1", "", "sensor_msgs/Imu", r"\(a ROS 1 recording\): /imu \(Imu, ros1/\)"),
        ("cdr", "omgidl", messages.IMU, r"/imu \(Imu, cdr/omgidl\)"),
        ("cdr", "", messages.IMU, r"/imu \(Imu, cdr/\)"),
    ],
)
def test_another_encoding_is_named_with_what_is_needed(
    message: str, schema: str, kind: str, shown: str, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros1" if message == "ros1" else "")
        number = writer.register_schema(kind, schema, b"{}")
        channel = writer.register_channel("/imu", message, number)
        writer.add_message(channel, T0, b"{}", T0)
        writer.finish()  # type: ignore[no-untyped-call]
    recording = open_recording(path)
    facts = session_facts(recording, Config())
    assert [topic.count for topic in facts.topics] == [1]
    assert not facts.methods
    with pytest.raises(InputError, match=rf"no usable topics.*{shown}.*needed are ROS 2 messages \(cdr/ros2msg\)"):
        resolve_method(None, recording, Config())
    with pytest.raises(InputError, match=r"topic /imu (holds|has the encoding) .*needed is .*cdr/ros2msg") as found:
        recording.imu("/imu")
    assert ("flatc --json" in str(found.value)) == (message == "flatbuffer")
