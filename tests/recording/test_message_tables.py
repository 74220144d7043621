"""Messages of a laboratory's own types, described as tables: ROS 2, ROS 1, JSON, protobuf."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.applications.table_discovery import propose_columns
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.decoding import MessageFormat
from alidade.pipelines.recording.opening import open_container
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.table_topics import TableTopic
from alidade.pipelines.recording.tables import message_tables
from tests.support.command import Command

START = 1_700_000_000_000_000_000
# What a laboratory calls its IMU: rates in deg/s, one array and three numbers, a device's number and name.
RAW = "float64[3] rate_dps\nfloat32 ax\nfloat32 ay\nfloat32 az\nuint8 device\nstring name\n"
COLUMNS = ["rate_dps[0]", "rate_dps[1]", "rate_dps[2]", "ax", "ay", "az"]
RNG = np.random.default_rng(5)


@dataclass(frozen=True)
class Motion:
    """A body that turns: stamps (n,) s, attitude (n, 4), rates (n, 3) rad/s and specific force (n, 3) m/s^2."""

    t: Array
    wxyz: Array
    rates: Array
    force: Array


@pytest.fixture(scope="module")
def motion() -> Motion:
    """20 s at 100 Hz, swings of half a radian about three axes."""
    t = np.arange(0.0, 20.0, 1e-2)
    hertz, phase = np.array([[0.31], [0.43], [0.23]]), np.array([[0.0], [1.0], [2.0]])
    yaw, pitch, roll = 0.5 * np.sin(2.0 * np.pi * hertz * t + phase)
    axes = np.eye(3)
    about = [so3.exp(angle[:, None] * axis) for angle, axis in zip((yaw, pitch, roll), axes[::-1], strict=True)]
    wxyz = so3.multiply(so3.multiply(about[0], about[1]), about[2])
    rates = so3.log(so3.multiply(so3.inverse(wxyz[:-1]), wxyz[1:])) / 1e-2
    force = so3.rotate(so3.inverse(wxyz), np.array([0.0, 0.0, 9.81]))
    return Motion(t[:-1], wxyz[:-1], rates + RNG.normal(0.0, 2e-3, rates.shape), force[:-1])


def _stamp(t: float, kind: Any) -> Any:
    return kind(*divmod(START + int(1e9 * t), 1_000_000_000))


def write_ros2(path: Path, motion: Motion, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Write the IMU as a type of ROS 2, and an attitude at 25 Hz as PoseStamped; a third IMU message is another's."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(f"std_msgs/Header header\n{RAW}", "lab_msgs/msg/Raw"))
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    with Ros2Writer(path, version=9, storage_plugin=storage) as bag:
        raw = bag.add_connection("/lab/raw", "lab_msgs/msg/Raw", typestore=store)
        pose = bag.add_connection("/mocap/pose", "geometry_msgs/msg/PoseStamped", typestore=store)
        for i, t in enumerate(motion.t):
            log_ns, stamped = START + int(1e9 * t) + 2_000_000, header(_stamp(t, time), "body")
            rates = np.rad2deg(motion.rates[i])
            for device, name, sign in ((2, "head", 1.0), *([(7, "hand, left", -1.0)] if i % 3 == 0 else [])):
                message = types["lab_msgs/msg/Raw"](stamped, sign * rates, *motion.force[i], device, name)
                bag.write(raw, log_ns, store.serialize_cdr(message, "lab_msgs/msg/Raw"))
            if i % 4 == 0:
                w, x, y, z = motion.wxyz[i]
                attitude = types["geometry_msgs/msg/Quaternion"](x, y, z, w)
                place = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
                message = types["geometry_msgs/msg/PoseStamped"](
                    stamped, types["geometry_msgs/msg/Pose"](place, attitude)
                )
                bag.write(pose, log_ns, store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped"))
    return path


def write_ros1(path: Path, motion: Motion) -> Path:
    """Write the IMU as a type of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(f"Header header\n{RAW}", "lab_msgs/msg/Raw"))
    types = store.types
    with Ros1Writer(path) as bag:
        raw = bag.add_connection("/lab/raw", "lab_msgs/msg/Raw", typestore=store)
        for i, t in enumerate(motion.t):
            header = types["std_msgs/msg/Header"](i, _stamp(t, types["builtin_interfaces/msg/Time"]), "body")
            message = types["lab_msgs/msg/Raw"](header, np.rad2deg(motion.rates[i]), *motion.force[i], 2, "head")
            bag.write(raw, START + int(1e9 * t), store.serialize_ros1(message, "lab_msgs/msg/Raw"))
    return path


def write_mcap(path: Path, motion: Motion, encoding: str, schema: tuple[str, str, bytes], message: Any) -> Path:
    """Write the IMU's messages (from a dict of their fields) in an encoding, every tenth."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_channel("/lab/raw", encoding, writer.register_schema(*schema))
        for i in range(0, len(motion.t), 10):
            sec, nanosec = divmod(START + int(1e9 * motion.t[i]), 1_000_000_000)
            fields = {"rate_dps": np.rad2deg(motion.rates[i]).tolist()}
            fields |= dict(zip(("ax", "ay", "az"), motion.force[i].tolist(), strict=True))
            log_ns = START + int(1e9 * motion.t[i])
            writer.add_message(number, log_ns, message({"sec": sec, "nanosec": nanosec}, fields), log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_json(path: Path, motion: Motion) -> Path:
    def message(stamp: dict[str, int], fields: dict[str, Any]) -> bytes:
        return json.dumps({"header": {"stamp": stamp}, **fields, "ok": True, "device": 2}).encode()

    return write_mcap(path, motion, "json", ("lab.Raw", "jsonschema", b'{"type": "object"}'), message)


def write_protobuf(path: Path, motion: Motion) -> Path:
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="lab.proto", package="lab", syntax="proto3")
    stamp, header, raw = (file.message_type.add(name=name) for name in ("Stamp", "Header", "Raw"))
    stamp.field.add(name="sec", number=1, type=kinds.TYPE_INT64, label=1)
    stamp.field.add(name="nanosec", number=2, type=kinds.TYPE_INT64, label=1)
    header.field.add(name="stamp", number=1, type=kinds.TYPE_MESSAGE, type_name=".lab.Stamp", label=1)
    raw.field.add(name="header", number=1, type=kinds.TYPE_MESSAGE, type_name=".lab.Header", label=1)
    raw.field.add(name="rate_dps", number=2, type=kinds.TYPE_DOUBLE, label=3)
    for number, name in enumerate(("ax", "ay", "az"), start=3):
        raw.field.add(name=name, number=number, type=kinds.TYPE_FLOAT, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.Raw"))
    data = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()

    def message(stamp: dict[str, int], fields: dict[str, Any]) -> bytes:
        return bytes(kind(header={"stamp": stamp}, **fields).SerializeToString())

    return write_mcap(path, motion, "protobuf", ("lab.Raw", "protobuf", data), message)


WRITERS: dict[str, tuple[Callable[[Path, Motion], Path], str]] = {
    "ROS 2": (write_ros2, "bag"),
    "ROS 1": (write_ros1, "lab.bag"),
    "JSON": (write_json, "json.mcap"),
    "protobuf": (write_protobuf, "protobuf.mcap"),
}


def described(path: Path, **given: Any) -> Any:
    table = {"file": "/lab/raw", "time": "header.stamp", "unit": "ns", "gyro": COLUMNS[:3], "accel": COLUMNS[3:]}
    columns = {"/head/imu": TableTopic(**table | {"units": {"gyro": "deg/s"}} | given)}
    return open_recording(path).with_config((), columns)


@pytest.mark.parametrize("form", WRITERS)
def test_messages_are_read_as_described(form: str, motion: Motion, tmp_path: Path) -> None:
    write, name = WRITERS[form]
    recording = described(write(tmp_path / name, motion), **({"where": {"device": 2}} if form == "ROS 2" else {}))
    step = 10 if name.endswith("mcap") else 1
    imu = recording.imu("/head/imu")
    np.testing.assert_array_equal(imu.t_ns, START + (1e9 * motion.t[::step]).astype(np.int64))
    np.testing.assert_allclose(imu.gyro, motion.rates[::step], rtol=1e-12)
    np.testing.assert_allclose(imu.accel, motion.force[::step], rtol=1e-6, atol=1e-6)
    assert recording.duration_s == pytest.approx(motion.t[::step][-1], abs=1e-6)


def test_a_word_selects_the_messages_of_one_device(motion: Motion, tmp_path: Path) -> None:
    """Their layouts differ, and messages of both are mixed."""
    path = write_ros2(tmp_path / "bag", motion)
    imu = described(path, where={"name": "hand, left"}).imu("/head/imu")
    np.testing.assert_allclose(imu.gyro, -motion.rates[::3], rtol=1e-12)


def test_messages_one_by_one_and_all_at_once_are_the_same(motion: Motion, tmp_path: Path) -> None:
    container = open_container(write_ros1(tmp_path / "lab.bag", motion))
    (number,) = container.channels
    form = MessageFormat(container.channels[number], container.schemas[container.channels[number].schema_id])
    block = container.first_blocks({number})[number]
    cells = list(form.cells(block))
    names = list(cells[0])
    assert names == ["header.seq", "header.stamp", "header.frame_id", *COLUMNS, "device", "name", "log_time"]
    for name, texts in zip(names, form.texts(block, names), strict=True):
        assert texts.tolist() == [str(each[name]) for each in cells]


@pytest.mark.parametrize("form", WRITERS)
def test_columns_are_proposed(form: str, motion: Motion, tmp_path: Path) -> None:
    write, name = WRITERS[form]
    found = propose_columns(open_recording(write(tmp_path / name, motion)))
    assert found is not None
    (table,) = found.columns.values()
    assert (table.file, table.time, table.unit) == ("/lab/raw", "header.stamp", "ns")
    assert list(table.gyro or ()) == COLUMNS[:3]
    assert list(table.accel or ()) == COLUMNS[3:]
    assert table.units == {"gyro": "deg/s"}


def test_known_messages_are_not_proposed_and_may_be_described(motion: Motion, tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", motion)
    found = propose_columns(open_recording(path))
    assert found is not None
    assert [table.file for table in found.columns.values()] == ["/lab/raw"]
    names = [f"pose.orientation.{axis}" for axis in "wxyz"]
    pose = TableTopic(file="/mocap/pose", time="header.stamp", unit="ns", wxyz=tuple(names))  # type: ignore[arg-type]
    read = open_recording(path).with_config((), {"/vision/attitude": pose}).poses("/vision/attitude")
    np.testing.assert_array_equal(read.wxyz, motion.wxyz[::4])


@pytest.mark.parametrize(
    ("topic", "given", "problem"),
    [
        ("/head/imu", {"file": "/lab/rw"}, "no table /lab/rw; the nearest known key is /lab/raw"),
        ("/head/imu", {"time": "stamp"}, "no column stamp; the columns are header.stamp"),
        ("/lab/raw", {}, "columns./lab/raw: a topic of that name was recorded"),
    ],
)
def test_what_is_not_there_is_named(
    topic: str, given: dict[str, Any], problem: str, motion: Motion, tmp_path: Path
) -> None:
    table = {"file": "/lab/raw", "time": "header.stamp", "unit": "ns", "gyro": COLUMNS[:3]} | given
    recording = open_recording(write_json(tmp_path / "lab.mcap", motion))
    with pytest.raises(InputError, match=problem.replace(".", r"\.")):
        recording.with_config((), {topic: TableTopic(**table)})


def test_a_bag_of_ones_own_messages_is_calibrated(motion: Motion, tmp_path: Path, alidade: Command) -> None:
    """The config selects one of two devices on the topic."""
    path = write_ros2(tmp_path / "bag", motion, StoragePlugin.SQLITE3)
    (tmp_path / "lab.yaml").write_text(
        "columns:\n"
        f"  /head/imu: {{file: /lab/raw, time: header.stamp, unit: ns, gyro: {COLUMNS[:3]}, accel: {COLUMNS[3:]}, "
        "units: {gyro: deg/s}, where: {device: 2}}\n"
        "topics: {vision_attitude: /mocap/pose}\n"
    )
    command = ("--config", str(tmp_path / "lab.yaml"), "--out", str(tmp_path / "out"))
    done = alidade("calibrate", str(path), *command)
    assert done.code == 0, done.err + done.out
    found = json.loads((tmp_path / "out" / "result.json").read_text())["parameters"]
    mount = [each for each in found if each["name"].startswith("helmet_mount_")]
    assert len(mount) == 3
    assert all(abs(each["value"]) < 4.0 * each["sigma"] for each in mount)


def _messages(path: Path) -> Iterator[Sequence[str]]:
    yield from (table.form.names for table in message_tables(open_container(path)).values())


def test_pictures_are_no_columns(tmp_path: Path) -> None:
    """Nor are numbers by the thousand."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("uint8[] data\nfloat32[100] ranges\nfloat32 range\n", "lab_msgs/msg/Scan"))
    with Ros2Writer(tmp_path / "bag", version=9) as bag:
        scan = bag.add_connection("/scan", "lab_msgs/msg/Scan", typestore=store)
        message = store.types["lab_msgs/msg/Scan"](np.zeros(5000, np.uint8), np.zeros(100, np.float32), 1.0)
        bag.write(scan, START, store.serialize_cdr(message, "lab_msgs/msg/Scan"))
    assert list(_messages(tmp_path / "bag")) == [("range", "log_time")]


def _write_split(folder: Path, motion: Motion) -> Path:
    """Write the JSON recording as a folder of two parts."""
    folder.mkdir()
    half = len(motion.t) // 2
    for number, rows in enumerate((slice(half), slice(half, None))):
        part = Motion(motion.t[rows], motion.wxyz[rows], motion.rates[rows], motion.force[rows])
        write_json(folder / f"lab_{number}.mcap", part)
    return folder


def test_all_parts_of_a_split_bag_are_read(motion: Motion, tmp_path: Path) -> None:
    """Numbers of channels of the second part once met those of the topics that were made."""
    recording = described(_write_split(tmp_path / "split", motion))
    half = len(motion.t) // 2
    stamps = np.concatenate([motion.t[:half:10], motion.t[half::10]])
    np.testing.assert_array_equal(recording.imu("/head/imu").t_ns, START + (1e9 * stamps).astype(np.int64))
    assert recording.topics["/lab/raw"].count == len(stamps)


@pytest.mark.parametrize(
    "fields",
    [{"sec": [1], "nanosec": {}}, {"sec": float("inf"), "nanosec": 0}, {"1": 2.0, "deep": [[1.0] * 64] * 64}],
)
def test_odd_messages_are_no_proposal_and_no_traceback(fields: Any, motion: Motion, tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    schema = ("lab.Odd", "jsonschema", b"{}")
    write_mcap(path, motion, "json", schema, lambda _, __: json.dumps({"odd": fields}).encode())
    assert propose_columns(open_recording(path)) is None


def test_times_of_ones_own_type_are_read_message_by_message(tmp_path: Path) -> None:
    """`sec` and `nsec` are two columns."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("int64 sec\nuint32 nsec\n", "lab_msgs/msg/Stamp"))
    with Ros2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/stamp", "lab_msgs/msg/Stamp", typestore=store)
        for i in range(3):
            message = store.types["lab_msgs/msg/Stamp"](100 + i, 7 * i)
            bag.write(topic, START + i, store.serialize_cdr(message, "lab_msgs/msg/Stamp"))
    table = message_tables(open_container(tmp_path / "bag"))["/stamp"]
    assert {name: texts.tolist() for name, texts in table.read(["sec", "nsec"])[0].items()} == {
        "sec": ["100", "101", "102"],
        "nsec": ["0", "7", "14"],
    }


def test_a_first_message_without_fields_hides_none(motion: Motion, tmp_path: Path) -> None:
    sparse = iter([b"{}"])
    path = tmp_path / "sparse.mcap"

    def message(stamp: dict[str, int], fields: dict[str, Any]) -> bytes:
        return next(sparse, json.dumps({"header": {"stamp": stamp}, **fields}).encode())

    write_mcap(path, motion, "json", ("lab.Raw", "jsonschema", b"{}"), message)
    found = propose_columns(open_recording(path))
    assert found is not None
    assert [table.gyro for table in found.columns.values()] == [tuple(COLUMNS[:3])]


def test_a_column_of_a_file_may_be_called_log_time(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.01 * i:.2f},{i % 7},{i % 5},{i % 3}" for i in range(300))
    (tmp_path / "log.csv").write_text(f"log_time,gx,gy,gz\n{rows}\n")
    columns = {"/imu": TableTopic(time="log_time", unit="s", gyro=("gx", "gy", "gz"))}
    recording = open_recording(tmp_path / "log.csv").with_config((), columns)
    assert recording.topics["/imu"].count == 300
    assert recording.duration_s == pytest.approx(2.99)


def test_a_field_called_log_time_is_the_messages_own(motion: Motion, tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 log_time\nfloat64[3] rate\n", "lab_msgs/msg/Logged"))
    with Ros2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/lab/raw", "lab_msgs/msg/Logged", typestore=store)
        for i in range(50):
            message = store.types["lab_msgs/msg/Logged"](1.0 + 0.01 * i, motion.rates[i])
            bag.write(topic, START + 10_000_000 * i + 3_000_000, store.serialize_cdr(message, "lab_msgs/msg/Logged"))
    table = TableTopic(file="/lab/raw", time="log_time", unit="s", gyro=("rate[0]", "rate[1]", "rate[2]"))
    recording = open_recording(tmp_path / "bag").with_config((), {"/imu": table})
    np.testing.assert_allclose(recording.imu("/imu").t_ns, 10_000_000 * np.arange(100, 150), atol=1)
    assert recording.times["/imu"][1][0] == START + 3_000_000, "logged when the container says"

    def message_of(stamp: dict[str, int], fields: dict[str, Any]) -> bytes:
        return json.dumps({"log_time": stamp["nanosec"], **fields}).encode()

    path = write_mcap(tmp_path / "j.mcap", motion, "json", ("lab.Raw", "jsonschema", b"{}"), message_of)
    texts, *_ = message_tables(open_container(path))["/lab/raw"].read(["log_time"])
    assert texts["log_time"][1] == str((START + int(1e9 * motion.t[10])) % 1_000_000_000)


@pytest.mark.parametrize(("package", "is_ros"), [("lab", False), ("sensor_msgs", True)])
def test_fields_of_ones_own_make_a_type_with_the_name_of_one_of_ros_another(
    package: str, is_ros: bool, motion: Motion, tmp_path: Path
) -> None:
    path = tmp_path / "j.mcap"

    def message(stamp: dict[str, int], fields: dict[str, Any]) -> bytes:
        return json.dumps({"header": {"stamp": stamp}, **fields}).encode()

    write_mcap(path, motion, "json", (f"{package}.Imu", "jsonschema", b"{}"), message)
    recording = open_recording(path)
    assert recording.topics["/lab/raw"].type == ("sensor_msgs/msg/Imu" if is_ros else "lab.Imu")
    assert (propose_columns(recording) is None) == is_ros
    if not is_ros:
        with pytest.raises(InputError, match=r"topic /lab/raw holds lab.Imu \(json/jsonschema\), needed is"):
            recording.imu("/lab/raw")


@pytest.mark.parametrize("odd", [b"{}", b"{broken", b'{"angular_velocity": "none"}'])
def test_one_odd_message_does_not_make_a_type_another(odd: bytes, motion: Motion, tmp_path: Path) -> None:
    """As of a driver whose sensor is not there yet."""
    path, first = tmp_path / "j.mcap", [odd]
    rate = {"angular_velocity": {"x": 1.0, "y": 2.0, "z": 3.0}}

    def message(stamp: dict[str, int], _: dict[str, Any]) -> bytes:
        return first.pop() if first else json.dumps({"header": {"stamp": stamp}, **rate}).encode()

    write_mcap(path, motion, "json", ("lab.Imu", "jsonschema", b"{}"), message)
    assert open_recording(path).topics["/lab/raw"].type == "sensor_msgs/msg/Imu"


@pytest.mark.parametrize("in_first", [True, False])
def test_log_times_of_a_topic_are_of_one_clock(in_first: bool, motion: Motion, tmp_path: Path) -> None:
    path, count = tmp_path / "j.mcap", iter(range(10_000))

    def message(_: dict[str, int], fields: dict[str, Any]) -> bytes:
        own = {"log_time": 1.0} if next(count) % 2 == (not in_first) else {}
        return json.dumps(own | fields).encode()

    write_mcap(path, motion, "json", ("lab.Raw", "jsonschema", b"{}"), message)
    texts, *_ = message_tables(open_container(path))["/lab/raw"].read(["log_time"])
    second = "" if in_first else str(START + int(1e9 * motion.t[10]))
    assert texts["log_time"][1] == second


@pytest.mark.parametrize("rate", [{"x": 1.0, "y": 2.0, "z": 3.0}, [1.0, 2.0, 3.0]])
def test_a_type_of_an_unknown_package_with_the_fields_of_ros_is_that_of_ros(
    rate: Any, motion: Motion, tmp_path: Path
) -> None:
    path = tmp_path / "j.mcap"
    data = json.dumps({"header": {"stamp": {"sec": 5, "nanosec": 0}}, "angular_velocity": rate}).encode()
    write_mcap(path, motion, "json", ("lab.Imu", "jsonschema", b"{}"), lambda *_: data)
    recording = open_recording(path)
    assert (recording.topics["/lab/raw"].type == "sensor_msgs/msg/Imu") == isinstance(rate, dict)
