"""A recording of each method in every form: the same data to the last bit, and the same calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.methods import method
from alidade.pipelines.methods.indexer.simulation import Position
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from datasets.broad import CONFIG as BROAD_CONFIG
from tests.support import forms
from tests.support.broad_trials import TRIALS, converted
from tests.support.solved import calibrate
from tests.support.turning import write_csv

SWAY = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.5)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.3)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.4)],
)
# Short, and with everything that the method can read.
BRIEF: dict[str, dict[str, Any]] = {
    "head": {"duration_s": 5.0, "gyro_rate_hz": 50.0, "platform_gyro_rate_hz": 50.0, "vision_rate_hz": 10.0},
    "los": {"duration_s": 5.0, "carrier": SWAY, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 5.0},
    "indexer": {
        "gyro_rate_hz": 5.0,
        "encoder_rate_hz": 5.0,
        "positions": [Position(axis="outer", other_deg=0.0, turns=1.0)],
    },
    "cube": {"poses": 3, "static_s": 1.0, "imu_rate_hz": 50.0},
}


@pytest.fixture(scope="module")
def as_recorded(sources: Any) -> Callable[[str], Any]:
    """What a method reads of its recording, read once."""
    return cache(lambda name: read(name, *sources(name)))


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Path]]:
    """A recording of a method as MCAP with ROS 2 messages, and its config."""
    folder = tmp_path_factory.mktemp("methods")

    def source(name: str) -> tuple[Path, Path]:
        path, config = folder / f"{name}.mcap", folder / f"{name}.yaml"
        if not path.exists():
            chosen = method(name)
            scenario = "head_mounts" if name == "head" else None
            chosen.write(path, chosen.simulate(chosen.settings(scenario).model_copy(update=BRIEF[name]), 2))
            config.write_bytes(open_recording(path).attachment("alidade.yaml") or b"")
        return path, config

    return source


def read(name: str, path: Path, config: Path) -> Any:
    recording = open_recording(path)
    settings = load_config(config.read_bytes())
    recording = recording.with_config(settings.topics.values(), settings.columns)
    return method(name).read(recording, settings)


def assert_same(ours: Any, theirs: Any, where: str) -> None:
    """To the last bit."""
    assert type(ours) is type(theirs), where
    if is_dataclass(ours):
        for field in fields(ours):
            if field.compare:
                assert_same(getattr(ours, field.name), getattr(theirs, field.name), f"{where}.{field.name}")
    elif isinstance(ours, np.ndarray):
        np.testing.assert_array_equal(ours, theirs, err_msg=where)
    else:
        assert ours == theirs, where


# Every form with head's messages, and one of each family with those of the others.
OF_ALL = ("rosbag2 sqlite", "ros 1 lz4", "mcap json", "mcap protobuf")


@pytest.mark.parametrize(
    ("name", "form"),
    [
        pytest.param(name, form, marks=[pytest.mark.slow] * (name != "head" and form not in OF_ALL))
        for name in BRIEF
        for form in forms.FORMS
    ],
)
def test_every_method_reads_the_same_out_of_every_form(
    name: str, form: str, sources: Any, as_recorded: Any, tmp_path: Path
) -> None:
    source, config = sources(name)
    made = forms.FORMS[form](source, tmp_path)
    assert_same(as_recorded(name), read(name, made, config), name)


@pytest.mark.slow
@pytest.mark.parametrize("form", forms.FORMS)
def test_the_same_calibration_out_of_every_form(form: str, sources: Any, tmp_path: Path) -> None:
    source, config = sources("head")
    made = forms.FORMS[form](source, tmp_path)
    ours, theirs = (calibrate(path, ["batch"], "head", config)[0] for path in (source, made))
    assert ours.status == theirs.status
    np.testing.assert_equal(theirs.estimate.values, ours.estimate.values)
    np.testing.assert_array_equal(theirs.estimate.covariance, ours.estimate.covariance)


# -- forms that carry less: numbers without covariances, stamps to the microsecond

# What of a method's data they carry.
CARRIED = {
    "head": ("head_t", "head_gyro", "platform_t", "platform_gyro", "vision_t", "vision_wxyz"),
    "los": ("gyro_t", "gyro", "force", "gimbal_t", "gimbal", "image_t", "error"),
    "indexer": ("gyro_t", "gyro", "encoder_t", "outer", "inner", "latitude_deg"),
    "cube": ("imu_t", "gyro", "accel", "mag_t", "mag"),
}
# Columns of a table, by what they are.
COLUMNS = {
    "gyro": ["wx", "wy", "wz"],
    "accel": ["ax", "ay", "az"],
    "wxyz": ["qw", "qx", "qy", "qz"],
    "field": ["mx", "my", "mz"],
    "vector": ["x", "y", "z"],
}


def tables(source: Path, folder: Path, joints: tuple[str, ...] = ()) -> tuple[Path, str]:
    """A table a topic of sensors, and what the config says of them."""
    recording, lines = open_recording(source), []
    for i, (name, topic) in enumerate(recording.topics.items()):
        imu = ("gyro", "accel")
        kinds: dict[str, tuple[Any, tuple[str, ...]]] = {
            messages.IMU: (recording.imu, imu),
            messages.POSE: (recording.poses, ("wxyz",)),
            messages.MAGNETIC_FIELD: (recording.magnetic, ("field",)),
            messages.VECTOR: (recording.vector, ("vector",)),
        }
        if topic.type == messages.JOINT_STATE:
            found: Any = recording.joints(name, joints)
            columns, what = found.position, f"joints: {{{', '.join(f'{j}: {j}' for j in joints)}}}"
            header = list(joints)
        elif topic.type == messages.NAV_SAT_FIX:
            found, header = recording.fixes(name), ["latitude", "longitude", "height"]
            columns = np.stack([found.latitude_deg, found.longitude_deg, found.height], axis=1)
            what = "latitude_deg: latitude, longitude_deg: longitude, height: height"
        elif topic.type in kinds:
            read_topic, parts = kinds[topic.type]
            found = read_topic(name)
            columns = np.hstack([getattr(found, part) for part in parts])
            what = ", ".join(f"{part}: [{', '.join(COLUMNS[part])}]" for part in parts)
            header = [column for part in parts for column in COLUMNS[part]]
        else:
            continue
        write_csv(folder / f"{i}.csv", ["t", *header], found.t_ns, columns)
        lines.append(f"  {name}: {{file: {i}.csv, time: t, unit: ns, {what}}}")
    return folder / "*.csv", "columns:\n" + "\n".join(lines) + "\n"


def euroc(source: Path, folder: Path) -> tuple[Path, str]:
    """A head's recording as a data set in EuRoC's form: the IMU and the tracker."""
    recording, root = open_recording(source), folder / "mav0"
    imu, poses = recording.imu("/head/imu"), recording.poses("/vision/attitude")
    for name in ("imu0", "vicon0"):
        (root / name).mkdir(parents=True)
    axes = [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    write_csv(root / "imu0" / "data.csv", ["#timestamp [ns]", *axes], imu.t_ns, np.hstack([imu.gyro, imu.accel]))
    names = [f"p_RS_R_{a} [m]" for a in "xyz"] + [f"q_RS_{a} []" for a in "wxyz"]
    rows = np.hstack([poses.position, poses.wxyz])
    write_csv(root / "vicon0" / "data.csv", ["#timestamp [ns]", *names], poses.t_ns, rows)
    return folder, "topics: {head_imu: /imu0, vision_attitude: /vicon0}\n"


def px4(source: Path, folder: Path) -> tuple[Path, str]:
    """A head's recording as a PX4 log, with double precision; the fix tells the time."""
    recording = open_recording(source)
    imu, poses = recording.imu("/head/imu"), recording.poses("/vision/attitude")
    start = recording.epoch_ns - 1_000_000_000

    def us(t_ns: Any) -> Any:
        return ((t_ns - start + 500) // 1000).astype(np.uint64)

    forms.ulog(
        folder / "log.ulg",
        {
            "sensor_combined": {"timestamp": us(imu.t_ns), "gyro_rad": imu.gyro, "accelerometer_m_s2": imu.accel},
            "vehicle_visual_odometry": {"timestamp": us(poses.t_ns), "q": poses.wxyz, "position": poses.position},
            "vehicle_gps_position": {
                "timestamp": np.array([1], np.uint64),
                "time_utc_usec": np.array([start // 1000 + 1], np.uint64),
                **{name: np.zeros(1, np.int32) for name in ("lat", "lon", "alt")},
                "fix_type": np.full(1, 3, np.uint8),
            },
        },
    )
    return folder / "log.ulg", "topics: {head_imu: /sensor_combined, vision_attitude: /vehicle_visual_odometry}\n"


def foxglove(source: Path, folder: Path) -> tuple[Path, str]:
    """Attitudes as Foxglove's poses, the rest in protobuf types with the fields of ROS."""
    from foxglove import messages as fox

    whole = forms.mcap_protobuf(source, folder / "protobuf.mcap")
    schema, pose = fox.PoseInFrame.get_schema(), "geometry_msgs/msg/PoseWithCovarianceStamped"

    def convert(topic: str, data: bytes) -> bytes:
        if topic not in attitudes:
            return data
        found = forms.ROS2.deserialize_cdr(data, pose)
        q, p = found.pose.pose.orientation, found.pose.pose.position
        stamp = fox.Timestamp(found.header.stamp.sec, found.header.stamp.nanosec)
        turned = fox.Pose(
            position=fox.Vector3(x=p.x, y=p.y, z=p.z), orientation=fox.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w)
        )
        return fox.PoseInFrame(timestamp=stamp, frame_id="a", pose=turned).encode()

    attitudes = {topic for topic, kind, _, _ in forms.raw_messages(source) if kind == pose}
    rest = ((topic, topic, t, data) for topic, kind, t, data in forms.raw_messages(whole) if topic not in attitudes)
    poses = ((topic, topic, t, data) for topic, kind, t, data in forms.raw_messages(source) if topic in attitudes)
    schemas = {topic: (kind, text) for topic, kind, text in forms.schemas(whole)}
    schemas |= dict.fromkeys(attitudes, (schema.name, schema.data))
    path = folder / "foxglove.mcap"
    forms.mcap(sorted([*rest, *poses], key=lambda m: m[2]), path, convert, "protobuf", "protobuf", schemas.__getitem__)
    return path, ""


def as_config(config: Path, more: str, folder: Path) -> Path:
    """A config with further sections."""
    path = folder / "more.yaml"
    path.write_text(config.read_text() + more)
    return path


@pytest.mark.parametrize("name", CARRIED)
def test_tables_carry_the_same_numbers(name: str, sources: Any, tmp_path: Path) -> None:
    source, config = sources(name)
    joints = {"los": ("azimuth", "elevation"), "indexer": ("outer_x", "inner_z")}.get(name, ())
    path, more = tables(source, tmp_path, joints)
    alone = "method: cube\nlatitude_deg: 47.0\n"  # a reference's attitude goes with its rates, which tables do not say
    config = as_config(config, more, tmp_path)
    if name == "cube":
        more = "\n".join(line for line in more.splitlines() if "/reference" not in line)
        config.write_text(alone + more)
    ours, theirs = read(name, source, sources(name)[1]), read(name, path, config)
    for field in CARRIED[name]:
        assert_same(getattr(ours, field), getattr(theirs, field), field)


@pytest.mark.parametrize("make", [euroc, px4, foxglove, tables])
def test_the_forms_of_data_sets_and_logs_carry_the_same_numbers(make: Any, sources: Any, tmp_path: Path) -> None:
    source, config = sources("head")
    path, more = make(source, tmp_path)
    ours, theirs = read("head", source, config), read("head", path, as_config(config, more, tmp_path))
    for field in ("head_t", "head_gyro", "vision_t", "vision_wxyz"):
        ours_, theirs_ = getattr(ours, field), getattr(theirs, field)
        if make is px4 and field.endswith("_t"):
            np.testing.assert_allclose(theirs_, ours_, atol=0.6e-6, rtol=0.0)
        else:
            np.testing.assert_array_equal(ours_, theirs_, field)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIALS)
def test_real_recordings_in_other_forms(name: str, shared_data: Path, tmp_path: Path) -> None:
    """BROAD trials: the same arrays and the same calibration, to the last bit but for a log's microseconds."""
    source, config = tmp_path / "s.mcap", tmp_path / "c.yaml"
    ours = converted(shared_data / "broad" / f"{name}.mat", source)
    config.write_text(BROAD_CONFIG)
    right = calibrate(source, ["batch"], "head", config)[0]
    made: dict[str, tuple[Path, str]] = {}
    for form in ("rosbag2 sqlite", "ros 1 lz4"):
        (tmp_path / form).mkdir()
        made[form] = forms.FORMS[form](source, tmp_path / form), ""
    for make in (foxglove, tables, euroc, px4):
        folder = tmp_path / make.__name__
        folder.mkdir()
        made[make.__name__] = make(source, folder)
    for form, (path, more) in made.items():
        text = as_config(config, more, tmp_path)
        theirs = read("head", path, text)
        np.testing.assert_array_equal(theirs.head_gyro, ours.head_gyro, form)
        np.testing.assert_array_equal(theirs.vision_wxyz, ours.vision_wxyz, form)
        calibration = calibrate(path, ["batch"], "head", text)[0]
        assert calibration.status == right.status == "calibrated", form
        off = np.abs(calibration.estimate.values - right.estimate.values)
        if form == "px4":
            np.testing.assert_allclose(theirs.head_t, ours.head_t, atol=0.6e-6, rtol=0.0)
            assert (off <= 0.02 * right.estimate.sigmas).all(), form
        else:
            np.testing.assert_array_equal(theirs.head_t, ours.head_t, form)
            np.testing.assert_array_equal(theirs.vision_t, ours.vision_t, form)
            assert off.max() == 0.0, form
