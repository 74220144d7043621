"""The forms that recordings come in: the same arrays out of each, to the last bit where the form carries them."""

from __future__ import annotations

import base64
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gtsam import Rot3
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from alidade.pipelines.applications.session import session_facts
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method, simulate
from alidade.pipelines.methods.head.recording import VISION_ATTITUDE
from alidade.pipelines.methods.indexer.simulation import Position
from alidade.pipelines.recording import images, messages, series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.plausibility import density
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.streams import StreamReader
from alidade.pipelines.recording.topics import IMU, TopicSource, inverted
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from tests.support import forms, live
from tests.support.forms import header, ros2_recording
from tests.support.recorded import T0, assert_same, session
from tests.support.short_problems import FOUR_POSITIONS
from tests.support.solved import calibrate
from tests.support.turning import turning, write_csv

BRISK = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=1.1)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.7)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.9)],
)
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("forms") / "s.mcap"
    write_session(path, session(300))
    return path


def read_topics(recording: Recording, names: Any) -> dict[str, Any]:
    readers: dict[str, Callable[[str], Any]] = {
        "/imu": recording.imu,
        "/mag": recording.magnetic,
        "/joints": lambda topic: recording.joints(topic, ("azimuth", "elevation")),
        "/vector": recording.vector,
        "/quaternion": recording.poses,
        "/pose": recording.poses,
        "/fix": recording.fixes,
        "/camera_info": recording.camera_info,
        "/image": lambda topic: list(recording.images(topic)),
        "/tags": recording.detections,
    }
    return {name: readers[name](name) for name in names}


@pytest.mark.parametrize("form", forms.FORMS)
def test_the_same_arrays_out_of_every_form(form: str, source: Path, tmp_path: Path) -> None:
    made = session(300)
    recording = open_recording(forms.FORMS[form](source, tmp_path))
    recording.read_together({"/imu": (), "/joints": ("azimuth", "elevation"), "/pose": ()})
    assert_same(read_topics(recording, made), made)
    assert recording.epoch_ns == T0
    assert recording.notes == ()
    assert recording.duration_s == pytest.approx(open_recording(source).duration_s, abs=1e-9)
    assert len(recording.sha256()) == 64
    for name, (t_ns, _) in open_recording(source).times.items():
        np.testing.assert_array_equal(recording.times[name][0], t_ns)


def test_messages_that_are_not_compressed_as_said_are_one_line(source: Path, tmp_path: Path) -> None:
    bag = forms.rosbag2(source, tmp_path / "bag", MCAP)
    said = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(re.sub("compression_mode: .*", "compression_mode: MESSAGE", said))
    with pytest.raises(InputError, match="topic /imu: a compressed message is damaged"):
        open_recording(bag).imu("/imu")


def test_a_list_of_parts_in_any_order_is_one_recording(source: Path, tmp_path: Path) -> None:
    folder = forms.split(source, tmp_path / "bag")
    parts = sorted(folder.glob("*.mcap"))
    made = session(300)
    whole = open_recording(parts[::-1])
    np.testing.assert_array_equal(whole.imu("/imu").gyro, _imu(made).gyro)
    assert whole.sha256() == open_recording(folder).sha256()
    with pytest.raises(InputError, match="the same file is named twice"):
        open_recording([parts[0], parts[0]])


def _imu(made: dict[str, Any]) -> series.ImuSeries:
    imu = made["/imu"]
    assert isinstance(imu, series.ImuSeries)
    return imu


def test_one_part_of_a_bag_is_read_and_said(source: Path, tmp_path: Path) -> None:
    folder = forms.split(source, tmp_path / "bag")
    part = open_recording(folder / "bag_1.mcap")
    assert 0 < len(part.imu("/imu")) < 600
    assert part.notes == ("part 2 of 3 of a bag; name the folder to read all of it",)
    (folder / "bag_1.mcap").unlink()
    rest = open_recording(folder)
    assert rest.notes == ("1 of 3 parts are not there: bag_1.mcap",)
    with pytest.raises(InputError, match="parts are not there"):
        open_recording(folder, strict=True)


def test_folders_that_are_no_recording_are_one_line(source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a folder without a recording"):
        open_recording(tmp_path)
    shutil.copy(source, tmp_path / "run_a.mcap")
    assert len(open_recording(tmp_path).imu("/imu")) == 300
    shutil.copy(source, tmp_path / "other.mcap")
    with pytest.raises(InputError, match=r"a folder of several recordings \(other.mcap, run_a.mcap\)"):
        open_recording(tmp_path)
    with pytest.raises(InputError, match="no file is named so"):
        open_recording(tmp_path / "x*.mcap")


def test_a_topic_in_parts_of_other_forms_is_one(source: Path, tmp_path: Path) -> None:
    """The container does not matter: half a bag in SQLite, half in MCAP."""
    folder = forms.split(source, tmp_path / "bag", 2)
    late = forms.rosbag2(folder / "bag_1.mcap", tmp_path / "late", SQLITE) / "late.db3"
    found = open_recording([late, folder / "bag_0.mcap"])
    np.testing.assert_array_equal(found.imu("/imu").accel, _imu(session(300)).accel)


def test_what_a_translated_message_does_not_say_is_nan(tmp_path: Path) -> None:
    path = forms.mcap(
        [("/imu", "", T0, b""), ("/imu", "", T0 + 1, b"")],
        tmp_path / "j.mcap",
        lambda *_: b'{"header": {"stamp": {"sec": 5, "nsec": 7}}, "angular_velocity": {"x": 1, "y": 2, "z": "NaN"}}',
        "json",
        "jsonschema",
        lambda _: ("sensor_msgs.Imu", b""),
    )
    imu = open_recording(path).imu("/imu")
    np.testing.assert_array_equal(imu.t_ns, [5_000_000_007] * 2)
    np.testing.assert_array_equal(imu.gyro[0], [1.0, 2.0, np.nan])
    assert np.isnan(imu.accel).all()
    np.testing.assert_array_equal(imu.gyro_cov, 0.0)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [("json", b"[]"), ("json", b"{"), ("json", b'{"angular_velocity": 5, "header": 1}'), ("protobuf", b"\xff\xff")],
)
def test_a_message_that_does_not_translate_is_one_line(
    encoding: str, data: bytes, source: Path, tmp_path: Path
) -> None:
    text = b""
    if encoding == "protobuf":
        whole = open_recording(forms.mcap_protobuf(source, tmp_path / "p.mcap"))
        text = next(s.data for s in whole.container.schemas.values() if s.name == "ros.Imu")
    path = forms.mcap(
        [("/imu", "", T0, b"")],
        tmp_path / "x.mcap",
        lambda *_: data,
        encoding,
        {"json": "jsonschema"}.get(encoding, encoding),
        lambda _: ("ros.Imu", text),
    )
    with pytest.raises(
        InputError, match=r"topic /imu: a message of \d+ bytes does not translate into sensor_msgs"
    ) as found:
        open_recording(path).imu("/imu")
    assert "\n" not in str(found.value)


def test_a_protobuf_definition_that_is_none_is_one_line(tmp_path: Path) -> None:
    path = forms.mcap(
        [("/imu", "", T0, b"")],
        tmp_path / "x.mcap",
        lambda *_: b"",
        "protobuf",
        "protobuf",
        lambda _: ("a.Imu", b"\xff"),
    )
    with pytest.raises(InputError, match=r"the definition of message type a.Imu cannot be read"):
        open_recording(path).imu("/imu")


def test_foxglove_types(tmp_path: Path) -> None:
    import foxglove
    from foxglove import channels
    from foxglove import messages as fox

    path = tmp_path / "fox.mcap"
    context = foxglove.Context()
    stamp = partial(fox.Timestamp, 1_700_000_000)
    position, rotation = fox.Vector3(x=1.0, y=2.0, z=3.0), fox.Quaternion(x=0.1, y=0.2, z=0.3, w=0.9)
    pose = fox.Pose(position=position, orientation=rotation)
    with foxglove.open_mcap(path, context=context):
        for i in range(5):
            nanosec = 10_000_000 * i
            log = 1_700_000_000_000_000_000 + nanosec
            channels_ = _channels(channels, context)
            channels_["/pose"].log(fox.PoseInFrame(timestamp=stamp(nanosec), frame_id="a", pose=pose), log_time=log)
            frame = fox.FrameTransform(
                timestamp=stamp(nanosec),
                parent_frame_id="a",
                child_frame_id="b",
                translation=position,
                rotation=rotation,
            )
            channels_["/frame"].log(frame, log_time=log)
            picture = fox.CompressedImage(timestamp=stamp(nanosec), data=b"jpeg%d" % i, format="jpeg")
            channels_["/picture"].log(picture, log_time=log)
            raw = fox.RawImage(
                timestamp=stamp(nanosec), width=2, height=2, encoding="mono8", step=2, data=bytes([1, 2, 3, 4])
            )
            channels_["/raw"].log(raw, log_time=log)
            k = [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
            info = fox.CameraCalibration(
                timestamp=stamp(nanosec),
                width=640,
                height=480,
                distortion_model="plumb_bob",
                D=[0.1] * 5,
                K=k,
                R=k,
                P=[0.0] * 12,
            )
            channels_["/info"].log(info, log_time=log)
            fix = fox.LocationFix(timestamp=stamp(nanosec), latitude=47.0, longitude=8.5, altitude=400.0)
            channels_["/fix"].log(fix, log_time=log)
    recording = open_recording(path)
    t_ns = T0 - T0 % 10**9 + 10_000_000 * np.arange(5)
    for topic in ("/pose", "/frame"):
        poses = recording.poses(topic)
        np.testing.assert_array_equal(poses.t_ns, t_ns)
        np.testing.assert_array_equal(poses.wxyz, [[0.9, 0.1, 0.2, 0.3]] * 5)
        np.testing.assert_array_equal(poses.position, [[1.0, 2.0, 3.0]] * 5)
    assert list(recording.images("/picture")) == [(t, b"jpeg%d" % i) for i, t in enumerate(t_ns.tolist())]
    assert next(recording.images("/raw")) == (t_ns[0], b"P5 2 2 255\n\x01\x02\x03\x04")
    camera = recording.camera_info("/info")
    np.testing.assert_array_equal(camera.k.ravel(), k)
    np.testing.assert_array_equal(camera.d, [0.1] * 5)
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "plumb_bob")
    fixes = recording.fixes("/fix")
    np.testing.assert_array_equal(fixes.latitude_deg, [47.0] * 5)


# Fields of Foxglove's types in ROS, behind the stamp.
FOXGLOVE_MSGS = {
    "PoseInFrame": "string frame_id\ngeometry_msgs/Pose pose\n",
    "FrameTransform": "string parent_frame_id\nstring child_frame_id\n"
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "RawImage": "string frame_id\nuint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n",
    "CompressedVideo": "string frame_id\nuint8[] data\nstring format\n",
    "CameraCalibration": "string frame_id\nuint32 width\nuint32 height\nstring distortion_model\n"
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n",
}


@pytest.mark.parametrize("ros", [2, 1])
def test_foxglove_types_in_ros(ros: int, tmp_path: Path) -> None:
    """As their equals in protobuf: the same arrays, from the definitions that the recording carries."""
    store = get_typestore(Stores.ROS2_HUMBLE if ros == 2 else Stores.ROS1_NOETIC)
    stamp_of = "builtin_interfaces/Time" if ros == 2 else "time"
    for kind, fields in FOXGLOVE_MSGS.items():
        store.register(get_types_from_msg(f"{stamp_of} timestamp\n{fields}", f"foxglove_msgs/msg/{kind}"))
    types = store.types
    position = types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    rotation = types["geometry_msgs/msg/Quaternion"](0.1, 0.2, 0.3, 0.9)
    pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0), rotation)
    k, d = np.array([500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]), np.full(5, 0.1)
    pictures = np.random.default_rng(1).integers(0, 256, (6, 32, 48), dtype=np.uint8)
    whole: list[forms.Message] = []
    for i, packet in enumerate(forms.h264(pictures)):
        stamp = T0 + 10_000_000 * i
        made = {
            "PoseInFrame": ("a", pose),
            "FrameTransform": ("a", "b", position, rotation),
            "RawImage": ("a", 2, 2, "mono8", 2, np.array([1, 2, 3, 4], np.uint8)),
            "CompressedVideo": ("a", np.frombuffer(packet, np.uint8), "h264"),
            "CameraCalibration": ("a", 640, 480, "plumb_bob", d, k, k, np.zeros(12)),
        }
        for kind, values in made.items():
            name = f"foxglove_msgs/msg/{kind}"
            message = types[name](types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), *values)
            write = store.serialize_cdr if ros == 2 else store.serialize_ros1
            whole.append((f"/{kind}", name, stamp + 5_000_000, bytes(write(message, name))))

    def schema(name: str) -> tuple[str, bytes]:
        text = store.generate_msgdef(name, ros_version=ros)[0].encode()
        return (name if ros == 2 else name.replace("/msg/", "/")), text

    encoding = {2: ("cdr", "ros2msg"), 1: ("ros1", "ros1msg")}[ros]
    recording = open_recording(forms.mcap(whole, tmp_path / "f.mcap", lambda _, data: data, *encoding, schema))
    t_ns = T0 + 10_000_000 * np.arange(6)
    assert recording.epoch_ns == T0
    for topic in ("/PoseInFrame", "/FrameTransform"):
        poses = recording.poses(topic)
        np.testing.assert_array_equal(poses.t_ns, t_ns)
        np.testing.assert_array_equal(poses.wxyz, [[0.9, 0.1, 0.2, 0.3]] * 6)
        np.testing.assert_array_equal(poses.position, [[1.0, 2.0, 3.0]] * 6)
    assert list(recording.images("/RawImage")) == [(t, b"P5 2 2 255\n\x01\x02\x03\x04") for t in t_ns.tolist()]
    assert [t for t, _ in recording.images("/CompressedVideo")] == t_ns.tolist()
    camera = recording.camera_info("/CameraCalibration")
    np.testing.assert_array_equal(camera.k.ravel(), k)
    np.testing.assert_array_equal(camera.d, d)
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "plumb_bob")


_MADE: dict[int, dict[str, Any]] = {}


def _channels(module: Any, context: Any) -> dict[str, Any]:
    if id(context) not in _MADE:
        kinds = {"/pose": "PoseInFrame", "/frame": "FrameTransform", "/picture": "CompressedImage"}
        kinds |= {"/raw": "RawImage", "/info": "CameraCalibration", "/fix": "LocationFix"}
        _MADE[id(context)] = {
            name: getattr(module, f"{kind}Channel")(name, context=context) for name, kind in kinds.items()
        }
    return _MADE[id(context)]


# -- logs and tables


def test_euroc_folders(tmp_path: Path) -> None:
    t_ns, gyro, wxyz = turning()
    accel, position = gyro[::-1], gyro * 3.0
    root = tmp_path / "MH_01" / "mav0"
    for name in ("imu0", "cam0/data", "vicon0"):
        (root / name).mkdir(parents=True)
    axes = [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    rows = np.hstack([gyro, accel])
    write_csv(root / "imu0" / "data.csv", ["#timestamp [ns]", *axes], t_ns, rows)
    (root / "imu0" / "sensor.yaml").write_text(
        "%YAML:1.0\nrate_hz: 100\ngyroscope_noise_density: 1.0e-3\naccelerometer_noise_density: 2e-2\n"
    )
    names = [f"p_RS_R_{a} [m]" for a in "xyz"] + [f"q_RS_{a} []" for a in "wxyz"]
    write_csv(root / "vicon0" / "data.csv", ["#timestamp [ns]", *names], t_ns, np.hstack([position, wxyz]))
    pictures = [bytes([i]) * 10 for i in range(3)]
    for stamp, picture in zip(t_ns[:3].tolist(), pictures, strict=True):
        (root / "cam0" / "data" / f"{stamp}.png").write_bytes(picture)
    lines = "".join(f"{stamp},{stamp}.png\n" for stamp in t_ns[:3].tolist())
    (root / "cam0" / "data.csv").write_text("#timestamp [ns],filename\r\n" + lines)
    (root / "cam0" / "sensor.yaml").write_text(
        "rate_hz: 20\nresolution: [752, 480]\nintrinsics: [458.6, 457.3, 367.2, 248.4]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    recording = open_recording(tmp_path / "MH_01")
    assert set(recording.topics) == {"/imu0", "/vicon0", "/cam0/image", "/cam0/camera_info"}
    imu = recording.imu("/imu0")
    np.testing.assert_array_equal(imu.t_ns, t_ns)
    np.testing.assert_array_equal(imu.gyro, gyro)
    np.testing.assert_array_equal(imu.accel, accel)
    np.testing.assert_allclose(imu.gyro_cov[0], 1e-6 * 100.0 * np.eye(3))
    poses = recording.poses("/vicon0")
    np.testing.assert_array_equal(poses.wxyz, wxyz)
    np.testing.assert_array_equal(poses.position, position)
    assert list(recording.images("/cam0/image")) == list(zip(t_ns[:3].tolist(), pictures, strict=True))
    camera = recording.camera_info("/cam0/camera_info")
    assert (camera.width, camera.distortion_model, len(camera.d)) == (752, "plumb_bob", 5)


def test_tum_trajectories_keep_their_stamps_to_the_nanosecond(tmp_path: Path) -> None:
    t_ns, position, wxyz = turning()
    path = tmp_path / "groundtruth.txt"
    rows = np.hstack([position, wxyz[:, [1, 2, 3, 0]]]).tolist()
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in t_ns.tolist()]
    lines = [f"{t} {' '.join(map(repr, row))}" for t, row in zip(seconds, rows, strict=True)]
    path.write_text("# ground truth\n# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines))
    poses = open_recording(path).poses("/trajectory")
    np.testing.assert_array_equal(poses.t_ns, t_ns)
    np.testing.assert_array_equal(poses.wxyz, wxyz)
    np.testing.assert_array_equal(poses.position, position)
    path.write_text("\n".join([*lines[:3], "1 2 3"]))
    assert len(open_recording(path).poses("/trajectory")) == 3, "a last row that is cut"
    path.write_text("\n".join([*lines[:3], "1 2 3", "1 2 3", lines[3]]))
    with pytest.raises(InputError, match="line 4 has 3 columns instead of 8"):
        open_recording(path)


CSV_CONFIG = b"""
columns:
  /imu: {file: imu.csv, time: t, unit: us, gyro: [wx, wy, wz], accel: [ax, ay, az], units: {gyro: deg/s}}
  /pose: {file: pose.csv, time: t, unit: ns, wxyz: [qw, qx, qy, qz]}
  /joints: {file: pose.csv, time: t, unit: ns, joints: {azimuth: az}, units: {joints: deg}}
"""


def test_csv_with_columns_from_the_config(tmp_path: Path) -> None:
    t_ns, gyro, wxyz = turning()
    write_csv(tmp_path / "imu.csv", ["t", "wx", "wy", "wz", "ax", "ay", "az"], t_ns // 1000, np.hstack([gyro, -gyro]))
    rows = np.hstack([wxyz, gyro[:, :1]])
    pose = write_csv(tmp_path / "pose.csv", ["t", "qw", "qx", "qy", "qz", "az"], t_ns, rows)
    pose.write_text(pose.read_text() + f"{T0 + 10**10},,,,,3.5\r\n")
    recording = open_recording(tmp_path / "*.csv")
    assert not recording.topics
    assert "a table with the columns t, wx, wy" in recording.notes[0]
    config = load_config(CSV_CONFIG)
    recording = recording.with_config(config.topics.values(), config.columns)
    imu = recording.imu("/imu")
    np.testing.assert_array_equal(imu.t_ns, t_ns // 1000 * 1000)
    np.testing.assert_array_equal(imu.gyro, gyro * (np.pi / 180.0))
    np.testing.assert_array_equal(imu.accel, -gyro)
    np.testing.assert_array_equal(recording.poses("/pose").wxyz, wxyz)
    joints = recording.joints("/joints", ["azimuth"])
    assert (len(joints), joints.position[-1, 0]) == (501, pytest.approx(np.deg2rad(3.5)))
    assert recording.notes == ()


def test_a_config_can_be_given_again_and_changes_no_other_recording(tmp_path: Path) -> None:
    t_ns, gyro, _ = turning()
    table = write_csv(tmp_path / "imu.csv", ["t", "wx", "wy", "wz"], t_ns, gyro)
    plain = open_recording(table)
    given = [load_config(f"columns: {{{name}: {{time: t, unit: ns, gyro: [wx, wy, wz]}}}}".encode()) for name in "ab"]
    first, second = (plain.with_config(config.topics.values(), config.columns) for config in given)
    again = first.with_config(given[1].topics.values(), given[1].columns)
    assert [list(each.topics) for each in (plain, first, second, again)] == [[], ["a"], ["b"], ["b"]]
    np.testing.assert_array_equal(again.imu("b").gyro, gyro)
    derived = first.with_config([TopicSource(topic="a", axes=("-y", "x", "z"))])
    assert len(derived.topics) == 2, "columns stay where none are given"
    assert len(first.topics) == 1


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("{time: t, gyro: [a, b, c]}", r"columns./imu.file: which table is meant\?; tables there: imu.csv, pose.csv"),
        ("{file: imu.cvs, time: t, gyro: [a, b, c]}", "no table imu.cvs; the nearest known key is imu.csv"),
        ("{file: imu.csv, time: t, gyro: [a, wy, wz]}", "imu.csv: no column a; the columns are t, wx"),
        ("{file: imu.csv, time: t, gyro: [note, wy, wz]}", "row 1, column note: 'x' is no number"),
        ("{file: imu.csv, time: note, gyro: [wx, wy, wz]}", "imu.csv: a time that is no number in s"),
        ("{file: imu.csv, time: t}", "exactly one of gyro, .*latitude_deg, celsius, joints, video is needed"),
        (
            "{file: imu.csv, time: t, gyro: [a, b, c], units: {gyro: rpm}}",
            "rpm is not one of rad/s, deg/s, mdeg/s; counts",
        ),
        ("{file: imu.csv, time: t, gyro: [a, b, c], units: {gyros: deg/s}}", "units.gyros: only gyro, accel, field,"),
        ("{file: imu.csv, time: t, gyro: [a, b]}", "columns./imu.gyro"),
        ("{file: imu.csv, time: t, video: a.mp4, gyro: [a, b, c]}", "joints, video is needed, not gyro and video"),
        ("{file: imu.csv, time: t, video: a.mp4}", r"a.mp4: cannot be opened \(No such file"),
        ("{file: imu.csv, time: t, video: pose.csv}", "pose.csv: neither an MP4 nor an AVI file"),
    ],
)
def test_columns_that_do_not_fit_are_one_line(columns: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text("t,wx,wy,wz,note\n1,2,3,4,x\n2,2,3,4,y\n")
    (tmp_path / "pose.csv").write_text("t,qw\n1,2\n")
    recording = open_recording(tmp_path / "*.csv")

    def use() -> None:
        config = load_config(f"columns: {{/imu: {columns}}}".encode())
        recording.with_config(config.topics.values(), config.columns)

    with pytest.raises(InputError, match=message) as found:
        use()
    assert "\n" not in str(found.value)


def test_px4_logs(tmp_path: Path) -> None:
    n = 100
    rng = np.random.default_rng(1)
    us = 5_000_000 + 4000 * np.arange(n, dtype=np.uint64)
    f4 = {name: rng.normal(size=(n, 3)).astype(np.float32) for name in ("gyro", "accel", "mag")}
    q = rng.normal(size=(n, 4)).astype(np.float32)
    path = forms.ulog(
        tmp_path / "log.ulg",
        {
            "sensor_combined": {"timestamp": us, "gyro_rad": f4["gyro"], "accelerometer_m_s2": f4["accel"]},
            "sensor_mag": {
                "timestamp": us + np.uint64(300),
                "timestamp_sample": us,
                **{axis: f4["mag"][:, i] for i, axis in enumerate("xyz")},
                "temperature": np.full(n, np.nan, np.float32),
            },
            "vehicle_imu_status": {
                "timestamp": us[::25],
                "temperature_gyro": np.array([np.nan, 30.5, 31.0, 31.5], np.float32),
            },
            "vehicle_attitude": {"timestamp": us, "q": q},
            "vehicle_imu": {
                "timestamp": us,
                "timestamp_sample": us,
                "delta_angle": f4["gyro"],
                "delta_velocity": f4["accel"],
                "delta_angle_dt": np.full(n, 4000, np.uint32),
                "delta_velocity_dt": np.full(n, 4000, np.uint32),
            },
            "sensor_gyro_fifo": {
                "timestamp": us[:3],
                "timestamp_sample": us[:3],
                "dt": np.full(3, 1000.0, np.float32),
                "scale": np.full(3, 0.5, np.float32),
                "samples": np.full(3, 2, np.uint8),
                **{axis: np.arange(12, dtype=np.int32).reshape(3, 4) for axis in "xyz"},
            },
            "vehicle_gps_position": {
                "timestamp": us[:5],
                "time_utc_usec": us[:5] + np.uint64(T0 // 1000),
                "lat": np.full(5, 470_000_000, np.int32),
                "lon": np.full(5, 85_000_000, np.int32),
                "alt": np.full(5, 400_000, np.int32),
                "fix_type": np.full(5, 3, np.uint8),
            },
        },
    )
    recording = open_recording(path)
    assert recording.notes == ()
    t_ns = T0 // 1000 * 1000 + 1000 * us.astype(np.int64)
    imu = recording.imu("/sensor_combined")
    np.testing.assert_array_equal(imu.t_ns, t_ns)
    np.testing.assert_array_equal(imu.gyro, f4["gyro"].astype(float))
    np.testing.assert_array_equal(imu.accel, f4["accel"].astype(float))
    magnetic = recording.magnetic("/sensor_mag")
    np.testing.assert_array_equal(magnetic.t_ns, t_ns)
    np.testing.assert_array_equal(magnetic.field, 1e-4 * f4["mag"].astype(float))
    warm = recording.temperature("/vehicle_imu_status/temperature_gyro")
    np.testing.assert_array_equal(warm.t_ns, t_ns[25::25])
    np.testing.assert_array_equal(warm.celsius, [30.5, 31.0, 31.5])
    assert {topic for topic in recording.topics if "temperature" in topic} == {"/vehicle_imu_status/temperature_gyro"}
    means = recording.imu("/vehicle_imu")
    np.testing.assert_array_equal(means.t_ns, t_ns - 2_000_000)
    np.testing.assert_allclose(means.gyro, f4["gyro"].astype(float) / 0.004, rtol=1e-12)
    fifo = recording.vector("/sensor_gyro_fifo")
    np.testing.assert_array_equal(fifo.vector[:, 0], [0.0, 0.5, 2.0, 2.5, 4.0, 4.5])
    np.testing.assert_array_equal(fifo.t_ns[:2], [t_ns[0] - 1_000_000, t_ns[0]])
    assert recording.fixes("/vehicle_gps_position").latitude_deg[0] == pytest.approx(47.0)
    # A vehicle that is level and heads north points along North in East-North-Up: its forward axis is n's second.
    level = forms.ulog(
        tmp_path / "level.ulg",
        {"vehicle_attitude": {"timestamp": us, "q": np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))}},
    )
    found = open_recording(level)
    assert "no fix says what time it was" in found.notes[0]
    w, x, y, z = found.poses("/vehicle_attitude").wxyz[0]
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    np.testing.assert_allclose(forward, [0.0, 1.0, 0.0], atol=1e-12)


# -- messages


def test_attitudes_of_all_types(tmp_path: Path) -> None:
    types = forms.ROS2.types
    t_ns, position, wxyz = turning(20)
    cov = np.arange(36.0)

    def each(make: Callable[[Any, Any, Any], Any]) -> list[tuple[int, Any]]:
        made = []
        for t, p, (w, x, y, z) in zip(t_ns.tolist(), position.tolist(), wxyz.tolist(), strict=True):
            rotation = types["geometry_msgs/msg/Quaternion"](x, y, z, w)
            made.append((t + 100, make(header(t, "camera"), p, rotation)))
        return made

    def pose(p: Any, q: Any) -> Any:
        return types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*p), q)

    def transform(h: Any, p: Any, q: Any, child: str) -> Any:
        moved = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](*p), q)
        return types["geometry_msgs/msg/TransformStamped"](h, child, moved)

    def tf(h: Any, p: Any, q: Any) -> Any:
        return types["tf2_msgs/msg/TFMessage"]([transform(h, [0, 0, 0], q, "other"), transform(h, p, q, "helmet")])

    def odometry(h: Any, p: Any, q: Any) -> Any:
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
        )
        measured = types["geometry_msgs/msg/PoseWithCovariance"](pose(p, q), cov)
        return types["nav_msgs/msg/Odometry"](h, "helmet", measured, twist)

    path = ros2_recording(
        tmp_path / "a.mcap",
        {
            "/pose": each(lambda h, p, q: types["geometry_msgs/msg/PoseStamped"](h, pose(p, q))),
            "/transform": each(lambda h, p, q: transform(h, p, q, "helmet")),
            "/odometry": each(odometry),
            "/tf": each(tf),
        },
    )
    recording = open_recording(path)
    config = load_config(
        b"topics:\n  vision_attitude: {topic: /tf, frames: [camera, helmet]}\n"
        b"  truth_attitude: {topic: /odometry, invert: true}\n"
    )
    recording = recording.with_config(config.topics.values(), config.columns)
    assert config.topic(VISION_ATTITUDE) == "/tf (camera to helmet)"
    for topic in ("/pose", "/transform", "/odometry", config.topic(VISION_ATTITUDE)):
        found = recording.poses(topic)
        np.testing.assert_array_equal(found.t_ns, t_ns)
        np.testing.assert_array_equal(found.wxyz, wxyz)
        np.testing.assert_array_equal(found.position, position)
    np.testing.assert_array_equal(recording.poses("/odometry").cov[3].ravel(), cov)
    assert recording.topics["/tf (camera to helmet)"].type == messages.POSE
    source = TopicSource(topic="/tf", frames=("camera", "nose"))
    recording = recording.with_config([source])
    with pytest.raises(InputError, match="no transform from camera to nose; there: camera to helmet, camera to other"):
        recording.poses(source.name)


def test_an_inverted_attitude_and_its_covariance() -> None:
    """Against finite rotations of the pose itself."""
    rng = np.random.default_rng(2)
    t_ns, position, wxyz = turning(4)
    root = rng.normal(size=(4, 6, 6))
    poses = series.PoseSeries(t_ns, wxyz, position, root @ root.swapaxes(1, 2))
    back = inverted(poses)
    np.testing.assert_allclose(inverted(back).wxyz, wxyz, atol=1e-14)
    np.testing.assert_allclose(inverted(back).position, position, atol=1e-14)
    np.testing.assert_allclose(inverted(back).cov[:, 3:, 3:], poses.cov[:, 3:, 3:], atol=1e-12)
    for i in range(4):
        w, x, y, z = wxyz[i]
        R = Rot3.Quaternion(w, x, y, z)
        np.testing.assert_allclose(Rot3.Quaternion(*back.wxyz[i]).matrix(), R.matrix().T, atol=1e-12)
        np.testing.assert_allclose(R.matrix() @ back.position[i] + position[i], 0.0, atol=1e-12)
        delta = 1e-4 * rng.normal(size=3)
        moved = Rot3.Logmap(R.compose(R.compose(Rot3.Expmap(delta)).inverse()))
        np.testing.assert_allclose(moved, -R.matrix() @ delta, rtol=1e-3, atol=1e-9)


def test_a_gyro_and_an_accelerometer_make_an_imu(tmp_path: Path) -> None:
    t_ns, gyro, _ = turning()
    later = t_ns[10:-10:2] + 5_000_000
    accel = np.stack([(later - T0) * 1e-9, np.ones(len(later)), -(later - T0) * 1e-8], axis=1)
    write_session(
        tmp_path / "s.mcap",
        {
            "/gyro": series.VectorSeries(t_ns, gyro),
            "/accel": series.VectorSeries(later, accel),
            "/imu_accel": series.ImuSeries(later, np.zeros((len(later), 3)), accel),
        },
    )
    for name in ("/accel", "/imu_accel"):
        recording = open_recording(tmp_path / "s.mcap")
        config = load_config(f"topics: {{imu: {{gyro: /gyro, accel: {name}}}}}".encode())
        recording = recording.with_config(config.topics.values(), config.columns)
        imu = recording.imu(config.topic(IMU))
        np.testing.assert_array_equal(imu.t_ns, t_ns)
        np.testing.assert_array_equal(imu.gyro, gyro)
        inside = (t_ns >= later[0]) & (t_ns <= later[-1])
        np.testing.assert_allclose(imu.accel[inside, 0], (t_ns[inside] - T0) * 1e-9, atol=1e-9)
        assert np.isnan(imu.accel[~inside]).all()
        assert len(recording.times[config.topic(IMU)][0]) == len(t_ns)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("topics: {imu: {gyro: /g, topic: /x}}", "topics.imu: either a topic or a gyro is needed"),
        ("topics: {imu: {accel: /g, topic: /x}}", "topics.imu: accel goes with a gyro"),
        ("topics: {imu: {gyro: /g, invert: true}}", "topics.imu: frame, frames and invert go with a topic"),
        (
            "topics: {imu: {topic: /g, farmes: [a, b]}}",
            r"unknown key topics\.imu\.farmes; the nearest known key is frames",
        ),
    ],
)
def test_sources_that_make_no_sense_are_one_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_config(text.encode())


@pytest.mark.parametrize(
    "encoding",
    [
        "mono8",
        "mono16",
        "rgb8",
        "bgr8",
        "rgba8",
        "bgra8",
        "bayer_rggb8",
        "bayer_grbg8",
        "bayer_bggr16",
        "bayer_gbrg8",
        "yuv422",
        "yuv422_yuy2",
    ],
)
def test_raw_pictures_of_every_encoding(encoding: str, tmp_path: Path) -> None:
    """A scene of smooth colours comes out as it is, up to what the encoding loses."""
    import cv2

    height, width = 32, 48
    v, u = np.mgrid[:height, :width]
    rgb = np.stack([40 + 3 * u, 60 + 4 * v, 120 + u + v], axis=2).astype(np.uint8)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    pixels = raw_pixels(encoding, rgb, grey)
    step = pixels.shape[1] + 4  # rows may be padded
    data = np.pad(pixels, ((0, 0), (0, 4))).ravel()
    picture = forms.ROS2.types["sensor_msgs/msg/Image"](header(T0), height, width, encoding, 0, step, data)
    recording = open_recording(ros2_recording(tmp_path / "i.mcap", {"/image": [(T0, picture)]}))
    ((t_ns, file),) = recording.images("/image")
    assert t_ns == T0
    found = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert found is not None
    inside = slice(2, -2)
    # Bayer squares are filled in between neighbours.
    np.testing.assert_allclose(
        found[inside, inside].astype(float), grey[inside, inside], atol=3 if "bayer" in encoding else 1
    )
    bad = forms.ROS2.types["sensor_msgs/msg/Image"](header(T0), height, width, encoding, 0, step, data[:-1])
    broken = open_recording(ros2_recording(tmp_path / "b.mcap", {"/image": [(T0, bad)]}))
    with pytest.raises(InputError, match=r"topic /image: the messages have no usable field \(32 rows"):
        list(broken.images("/image"))


def raw_pixels(encoding: str, rgb: Any, grey: Any) -> Any:
    """A picture as rows of bytes."""
    height, width = grey.shape
    if encoding.startswith("mono"):
        return grey if encoding == "mono8" else (grey.astype("<u2") << 4).view(np.uint8)
    if encoding.startswith("yuv"):
        flat = np.full((height, 2 * width), 128, np.uint8)
        flat[:, 0 if encoding.endswith("yuy2") else 1 :: 2] = grey
        return flat
    if encoding.startswith("bayer"):
        mosaic = np.zeros_like(grey)
        for i, colour in enumerate(encoding[6:10]):
            mosaic[i // 2 :: 2, i % 2 :: 2] = rgb[i // 2 :: 2, i % 2 :: 2, "rgb".index(colour)]
        return (mosaic.astype("<u2") << 8).view(np.uint8) if encoding.endswith("16") else mosaic
    order = ["rgba".index(colour) for colour in encoding[:-1]]
    return np.dstack([rgb, np.full_like(grey, 255)])[:, :, order].reshape(height, -1)


def test_another_encoding_of_pictures_is_one_line(tmp_path: Path) -> None:
    picture = forms.ROS2.types["sensor_msgs/msg/Image"](header(T0), 2, 2, "32FC1", 0, 8, np.zeros(16, np.uint8))
    recording = open_recording(ros2_recording(tmp_path / "i.mcap", {"/image": [(T0, picture)]}))
    with pytest.raises(InputError, match="the encoding '32FC1' is not one of mono, rgb"):
        list(recording.images("/image"))


def video(
    path: Path,
    pictures: Any,
    change: Callable[[list[bytes]], list[bytes]] = list,
    form: str = "h264",
    unstamped: Sequence[int] = (),
) -> Recording:
    """A recording of Foxglove's CompressedVideo, 10 pictures a second, some of which have no stamp."""
    import foxglove
    from foxglove import channels
    from foxglove import messages as fox

    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context, allow_overwrite=True):
        channel = channels.CompressedVideoChannel("/video", context=context)
        for i, data in enumerate(change(forms.h264(pictures))):
            stamp = fox.Timestamp(0, 0) if i in unstamped else fox.Timestamp(1_700_000_000, 100_000_000 * i)
            channel.log(fox.CompressedVideo(timestamp=stamp, frame_id="camera", data=data, format=form), log_time=i + 1)
    return open_recording(path)


def test_pictures_of_a_video(tmp_path: Path) -> None:
    import cv2

    pictures = np.random.default_rng(1).integers(0, 256, (6, 32, 48), dtype=np.uint8)
    found = list(video(tmp_path / "v.mcap", pictures).images("/video"))
    assert [t_ns for t_ns, _ in found] == [1_700_000_000_000_000_000 + 100_000_000 * i for i in range(6)]
    for (_, file), picture in zip(found, pictures, strict=True):
        grey = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(grey, picture)


@pytest.mark.parametrize("form", forms.VIDEOS)
def test_pictures_of_videos_of_other_forms(form: str, tmp_path: Path) -> None:
    import cv2

    if form in images.BY_PYAV:
        pytest.importorskip("av", reason="needs the extra alidade[video]")
    packets = [base64.b64decode(each) for each in forms.VIDEOS[form]]

    def recorded(made: list[bytes], *unstamped: int) -> Recording:
        return video(tmp_path / "v.mcap", np.zeros((0, 16, 16), np.uint8), lambda _: made, form, unstamped)

    found = list(recorded(packets).images("/video"))
    assert [t_ns % 10**9 for t_ns, _ in found] == [0, 100_000_000, 200_000_000]
    # One without a stamp is left out, and those that follow are decoded by it.
    assert list(recorded(packets, 0).images("/video")) == found[1:]
    files = [np.frombuffer(file, np.uint8) for _, file in found]
    grey = np.array([cv2.imdecode(file, cv2.IMREAD_GRAYSCALE) for file in files], float)
    assert grey.shape == (3, 64, 64)
    np.testing.assert_allclose(grey.mean(axis=(1, 2)), [40.0, 100.0, 160.0], atol=2.0)
    for wrong in (packets[1:], [packets[0], b"junk" + packets[1]]):
        with pytest.raises(InputError, match=r"topic /video: .*(picture|Annex B)"):
            list(recorded(wrong).images("/video"))


def test_a_video_without_its_decoder_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    recording = video(tmp_path / "v.mcap", np.full((3, 16, 16), 90, np.uint8), form="av1")
    with pytest.raises(InputError, match=r"a video in av1 needs PyAV: pip install 'alidade\[video\]'"):
        list(recording.images("/video"))


@pytest.mark.parametrize(
    ("change", "form", "message"),
    [
        (lambda whole: [b"#EXTM3U\n" + whole[0], *whole[1:]], "h264", r"is no H264 \(Annex B\)"),
        (lambda whole: [whole[0][:9], *whole[1:]], "h264", r"only 2 of 3 pictures of the video can be decoded"),
        (lambda whole: [whole[0] + whole[1], *whole[1:]], "h264", "more pictures than its 3 messages"),
        (lambda _: [b"\0\0\0\1\x67junk"] * 3, "h264", "only 0 of 3 pictures"),
    ],
)
def test_a_video_that_is_not_as_it_should_be_is_one_line(change: Any, form: str, message: str, tmp_path: Path) -> None:
    recording = video(tmp_path / "v.mcap", np.full((3, 16, 16), 90, np.uint8), change, form)
    with pytest.raises(InputError, match=f"topic /video: .*{message}"):
        list(recording.images("/video"))


def with_video(where: str | Path, name: str, time: str = "column 1") -> Recording:
    recording = open_recording(where)
    config = load_config(f"columns: {{/image: {{file: stamps.txt, time: {time}, video: {name}}}}}".encode())
    recording = recording.with_config(config.topics.values(), config.columns)
    return recording


@pytest.mark.parametrize("name", ["v.mp4", "v.avi"])
@pytest.mark.parametrize("head", ["", "t\n"])
def test_a_video_file_with_a_list_of_stamps(name: str, head: str, tmp_path: Path) -> None:
    import cv2

    forms.video_file(tmp_path / name, 7)
    (tmp_path / "stamps.txt").write_text(head + "".join(f"1700000000.{i}00000001\n" for i in range(7)))
    recording = with_video(tmp_path / "*", name, "t" if head else "column 1")
    assert recording.topics["/image"].type == messages.COMPRESSED_IMAGE
    found = list(recording.images("/image"))
    assert [t_ns for t_ns, _ in found] == [1_700_000_000_000_000_001 + 100_000_000 * i for i in range(7)]
    grey = np.array([cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE) for _, file in found], float)
    np.testing.assert_allclose(grey.mean(axis=(1, 2)), 30.0 * np.arange(7) + 20.0, atol=3.0)
    assert recording.notes == ()
    digest = recording.sha256()
    forms.video_file(tmp_path / name, 6)
    assert with_video(tmp_path / "stamps.txt", name, "t" if head else "column 1").sha256() != digest


@pytest.mark.parametrize(
    ("count", "message"),
    [(6, "only 6 of 7 pictures of the video can be decoded"), (8, "the video has more pictures than its 7 stamps")],
)
def test_a_video_file_with_another_number_of_pictures_is_one_line(count: int, message: str, tmp_path: Path) -> None:
    forms.video_file(tmp_path / "v.mp4", count)
    (tmp_path / "stamps.txt").write_text("".join(f"{i}.5\n" for i in range(7)))
    with pytest.raises(InputError, match=f"v.mp4: {message}"):
        list(with_video(tmp_path / "stamps.txt", "v.mp4").images("/image"))


def test_a_video_file_alone_says_what_it_needs(tmp_path: Path) -> None:
    forms.video_file(tmp_path / "v.avi", 7)
    assert "`columns:` in the config says which table" in open_recording(tmp_path / "v.avi").notes[0]
    (tmp_path / "v.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(100))
    (tmp_path / "stamps.txt").write_text("1.5\n")
    with pytest.raises(InputError, match=r"v.mp4: only 0 of 1 pictures"):
        list(with_video(tmp_path / "stamps.txt", "v.mp4").images("/image"))


def test_messages_without_a_stamp_are_told_with_the_jitter_of_what_stands_in(tmp_path: Path) -> None:
    types = forms.ROS2.types
    rng = np.random.default_rng(4)
    logged = T0 + 10_000_000 * np.arange(400) + rng.normal(0.0, 400_000.0, 400).astype(int)
    vector = types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    made = [(t, types["geometry_msgs/msg/Vector3Stamped"](header(0), vector)) for t in logged.tolist()]
    recording = open_recording(ros2_recording(tmp_path / "v.mcap", {"/v": made}))
    assert recording.vector("/v").stamped_by_log == 400
    recording.vector("/v")
    (note,) = recording.notes
    assert note.startswith("topic /v: 400 of 400 messages have no stamp; all get their log times")
    assert 0.3 < float(note.split("jitter by ")[1].split(" ms")[0]) < 0.5
    assert recording.stamp_sigma_s == pytest.approx(np.hypot(0.01, 4e-4), rel=0.01)


STEP, JITTER = 10_000_000, np.random.default_rng(5).normal(0.0, 400_000.0, 400).astype(int)
LATE = STEP * np.arange(400) + 2_000_000 + JITTER
FLOAT_S = np.rint((1.7e9 + 0.0099945 * np.arange(400)) * 1e9).astype(np.int64) - 1_700_000_000_000_000_000
BUNCHES = 8 * STEP * (np.arange(400) // 8) + 30_000 * (np.arange(400) % 8) + JITTER[np.arange(400) // 8]


@pytest.mark.parametrize(
    ("stamps", "logged", "says"),
    [
        (STEP * np.arange(400), LATE, "100 % of the stamps are exactly 10 ms apart while log times jitter by 0."),
        (FLOAT_S, LATE, "100 % of the stamps are exactly 9.99"),
        (STEP * (np.arange(400) + (np.arange(400) > 200)), LATE, "100 % of the stamps are exactly 10 ms"),
        (BUNCHES, BUNCHES, "88 % of stamps in bursts"),
        (STEP * np.arange(400), STEP * np.arange(400), ""),
        (STEP * np.arange(400) + JITTER // 10, LATE, ""),
        (STEP * np.arange(400) + JITTER // 10, BUNCHES, ""),
        (LATE, LATE, ""),
    ],
)
def test_stamps_that_were_not_measured_are_told(stamps: Any, logged: Any, says: str, tmp_path: Path) -> None:
    """Counted ones where the log times beside them jitter, and those of arrival; a simulated recording has neither."""
    types = forms.ROS2.types
    vector = types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    path = tmp_path / "v.mcap"
    messages = zip((T0 + logged).tolist(), (T0 + stamps).tolist(), strict=True)
    made = [(log, types["geometry_msgs/msg/Vector3Stamped"](header(t), vector)) for log, t in messages]
    recording = open_recording(ros2_recording(path, {"/v": made}))
    recording.vector("/v")
    assert [note.partition(says)[0] for note in recording.notes] == (["topic /v: "] if says else [])
    assert session_facts(open_recording(path), Config()).notes == recording.notes


@pytest.mark.parametrize(
    ("name", "scenario", "brief", "topic", "delay"),
    [
        pytest.param(
            "head",
            "head_mounts",
            {"duration_s": 10.0, "gyro_rate_hz": 100.0, "platform_gyro_rate_hz": 100.0, "vision_rate_hz": 10.0},
            "/vision/attitude",
            "time_offset",
            marks=pytest.mark.slow,
        ),
        (
            "los",
            None,
            {
                "duration_s": 15.0,
                "gyro_rate_hz": 100.0,
                "gimbal_rate_hz": 100.0,
                "image_rate_hz": 10.0,
                "carrier": BRISK,
            },
            "/los/error",
            "time_offset",
        ),
        pytest.param(
            "indexer",
            None,
            {
                "gyro_rate_hz": 20.0,
                "encoder_rate_hz": 20.0,
                "positions": [Position.model_validate(each) for each in FOUR_POSITIONS["positions"]],
            },
            "/indexer/joint_states",
            "encoder_delay",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_log_times_in_place_of_stamps_stand_in_the_sigma_of_the_delay(
    name: str, scenario: str | None, brief: dict[str, Any], topic: str, delay: str, tmp_path: Path
) -> None:
    """A topic without stamps, logged 8 ms late: the delay reported is 8 ms off, and says that it may be."""
    chosen = method(name)
    simulated = chosen.simulate(chosen.settings(scenario).model_copy(update=brief), 2)
    chosen.write(tmp_path / "s.mcap", simulated)
    late = 8_000_000

    def unstamped(message: live.Message) -> live.Message:
        schema, channel, log_ns, data = message
        if channel.topic != topic:
            return message
        return schema, channel, log_ns + late, data[:4] + bytes(8) + data[12:]

    whole = sorted(map(unstamped, live.messages(tmp_path / "s.mcap")), key=lambda message: message[2])
    with (tmp_path / "late.mcap").open("wb") as out:
        live.write(whole, out)
    config = tmp_path / "c.yaml"
    config.write_bytes(open_recording(tmp_path / "s.mcap").attachment("alidade.yaml") or b"")
    found = calibrate(tmp_path / "late.mcap", ["batch"], name, config)[0]
    offset = found.parameters[delay]
    assert abs(simulated.truth.get(delay, 0.0) - offset.value) == pytest.approx(8e-3, abs=2e-3)
    assert 0.01 < offset.sigma < 0.012
    assert found.status in ("calibrated", "weak"), found.headline
    assert any("no stamp; all get their log times" in note for note in found.notes)


@pytest.mark.parametrize(
    ("variance", "least", "believed"), [(1e-6, 1e-7, 1e-4), (1e-12, 1e-6, None), (-1.0, 1e-7, None), (0.0, 1e-7, None)]
)
def test_covariances_that_no_sensor_has_are_not_believed(variance: float, least: float, believed: float | None) -> None:
    dropped: dict[str, int] = {}
    covariance = np.broadcast_to(np.diag([variance, *(2 * [abs(variance)])]), (50, 3, 3))
    found = density("/imu", "gyro", 0.01 * np.arange(50.0), covariance, least, dropped)
    assert found == (None if believed is None else pytest.approx(believed))
    assert sum(dropped.values()) == (50 if variance in (1e-12, -1.0) else 0)


def test_a_covariance_no_gyro_has_is_not_believed(tmp_path: Path) -> None:
    t_ns, gyro, _ = turning()
    for variance, believed in ((1e-12, None), (1e-6, 1e-4), (0.0, None), (-1.0, None)):
        imu = series.ImuSeries(t_ns, gyro, gyro_cov=variance * np.eye(3))
        write_session(tmp_path / "s.mcap", {"/imu": imu})
        reader = StreamReader(open_recording(tmp_path / "s.mcap"), {})
        density, dropped = reader.density("/imu", "gyro", reader.gyro("/imu")), reader.dropped
        assert density == (None if believed is None else pytest.approx(believed))
        assert (500 in dropped.values()) == (variance in (1e-12, -1.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["los", "indexer", "cube"])
def test_the_same_calibration_of_every_method_out_of_other_forms(name: str, tmp_path: Path) -> None:
    simulate(name, None, 2, tmp_path / "s.mcap")
    config = tmp_path / "c.yaml"
    config.write_bytes(open_recording(tmp_path / "s.mcap").attachment("alidade.yaml") or b"")
    ours = calibrate(tmp_path / "s.mcap", ["batch"], name, config)[0]
    for form in ("rosbag2 sqlite", "ros 1 bz2", "mcap protobuf"):
        (tmp_path / form).mkdir()
        theirs = calibrate(forms.FORMS[form](tmp_path / "s.mcap", tmp_path / form), ["batch"], name, config)[0]
        assert theirs.status == ours.status
        np.testing.assert_equal(theirs.estimate.values, ours.estimate.values)
        np.testing.assert_array_equal(theirs.estimate.covariance, ours.estimate.covariance)
