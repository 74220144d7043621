"""The forms that recordings come in: the same arrays out of each, to the last bit where the form carries them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from pipelines.errors import InputError
from pipelines.recording import series
from pipelines.recording.reading import Recording, open_recording
from pipelines.recording.writing import write_session
from tests import forms
from tests.recorded import T0, assert_same, session

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("forms") / "s.mcap"
    write_session(path, session(600))
    return path


def read_topics(recording: Recording, names: Any) -> dict[str, Any]:
    readers: dict[str, Callable[[str], Any]] = {
        "/imu": recording.imu,
        "/mag": recording.magnetic,
        "/joints": lambda topic: recording.joints(topic, ("azimuth", "elevation")),
        "/vector": recording.vector,
        "/quaternion": recording.quaternion,
        "/pose": recording.poses,
        "/fix": recording.fixes,
        "/camera_info": recording.camera_info,
        "/image": lambda topic: list(recording.images(topic)),
        "/tags": recording.detections,
    }
    return {name: readers[name](name) for name in names}


FORMS: dict[str, Callable[[Path, Path], Path]] = {
    "rosbag2 sqlite": lambda s, f: forms.rosbag2(s, f / "bag", SQLITE),
    "rosbag2 mcap": lambda s, f: forms.rosbag2(s, f / "bag", MCAP),
    "rosbag2 sqlite, compressed by file": lambda s, f: forms.rosbag2(s, f / "bag", SQLITE, CompressionMode.FILE),
    "rosbag2 split": lambda s, f: forms.split(s, f / "bag"),
    "db3": lambda s, f: forms.rosbag2(s, f / "bag", SQLITE) / "bag.db3",
    "db3.zstd": lambda s, f: forms.zstd(forms.rosbag2(s, f / "bag", SQLITE) / "bag.db3", f / "b.db3.zstd"),
    "mcap.zstd": lambda s, f: forms.zstd(s, f / "s.mcap.zstd"),
    "pattern": lambda s, f: forms.split(s, f / "bag") / "bag_*.mcap",
    "ros 1": lambda s, f: forms.rosbag1(s, f / "s.bag"),
    "ros 1 lz4": lambda s, f: forms.rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.LZ4),
    "ros 1 bz2": lambda s, f: forms.rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.BZ2),
    "mcap ros 1": lambda s, f: forms.mcap_ros1(s, f / "r.mcap"),
    "mcap json": lambda s, f: forms.mcap_json(s, f / "j.mcap"),
    "mcap protobuf": lambda s, f: forms.mcap_protobuf(s, f / "p.mcap"),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_same_arrays_out_of_every_form(form: str, source: Path, tmp_path: Path) -> None:
    made = session(600)
    recording = open_recording(FORMS[form](source, tmp_path))
    recording.read_together({"/imu": (), "/joints": ("azimuth", "elevation"), "/pose": ()})
    assert_same(read_topics(recording, made), made)
    assert recording.epoch_ns == T0
    assert recording.notes == ()
    assert recording.duration_s == pytest.approx(open_recording(source).duration_s, abs=1e-9)
    assert len(recording.sha256()) == 64
    for name, (t_ns, _) in open_recording(source).times.items():
        np.testing.assert_array_equal(recording.times[name][0], t_ns)


def test_a_list_of_parts_in_any_order_is_one_recording(source: Path, tmp_path: Path) -> None:
    folder = forms.split(source, tmp_path / "bag")
    parts = sorted(folder.glob("*.mcap"))
    made = session(600)
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
    assert len(open_recording(tmp_path).imu("/imu")) == 600
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
    np.testing.assert_array_equal(found.imu("/imu").accel, _imu(session(600)).accel)


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
        text = next(s.data for s in whole._container.schemas.values() if s.name == "ros.Imu")
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


_MADE: dict[int, dict[str, Any]] = {}


def _channels(module: Any, context: Any) -> dict[str, Any]:
    if id(context) not in _MADE:
        kinds = {"/pose": "PoseInFrame", "/frame": "FrameTransform", "/picture": "CompressedImage"}
        kinds |= {"/raw": "RawImage", "/info": "CameraCalibration", "/fix": "LocationFix"}
        _MADE[id(context)] = {
            name: getattr(module, f"{kind}Channel")(name, context=context) for name, kind in kinds.items()
        }
    return _MADE[id(context)]
