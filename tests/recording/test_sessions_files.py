"""Files: written and read back, of every container form, broken ones, and ones that others wrote."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import mcap_records as records
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.mcap_file import McapFile
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.opening import open_container
from alidade.pipelines.recording.recording import open_recording
from tests.support.recorded import T0, assert_same, session


def read_all(path: Path) -> dict[str, Any]:
    recording = open_recording(path)
    return {
        "/imu": recording.imu("/imu"),
        "/mag": recording.magnetic("/mag"),
        "/joints": recording.joints("/joints", ("azimuth", "elevation")),
        "/vector": recording.vector("/vector"),
        "/quaternion": recording.poses("/quaternion"),
        "/pose": recording.poses("/pose"),
        "/fix": recording.fixes("/fix"),
        "/camera_info": recording.camera_info("/camera_info"),
        "/image": list(recording.images("/image")),
        "/tags": recording.detections("/tags"),
    }


def test_a_session_written_and_read_back_is_identical(tmp_path: Path) -> None:
    made = session()
    path = tmp_path / "s.mcap"
    write_session(path, made, {"alidade.yaml": b"method: los\n", "truth.json": b"{}"})
    assert_same(read_all(path), made)
    recording = open_recording(path)
    assert recording.container.attachments == ("alidade.yaml", "truth.json")
    assert recording.attachment("alidade.yaml") == b"method: los\n"
    assert recording.attachment("else") is None
    assert recording.epoch_ns == T0
    assert recording.duration_s == pytest.approx(1.999, abs=1e-9)
    assert [p.name for p in tmp_path.iterdir()] == ["s.mcap"]


def test_what_we_write_is_sound_for_the_mcap_package_and_for_rosbags(tmp_path: Path) -> None:
    made = session(300)
    path = tmp_path / "s.mcap"
    write_session(path, made, {"alidade.yaml": b"method: los\n"})
    total = sum(1 if isinstance(one, series.CameraInfo) else len(one) for one in made.values())
    for kind in (make_reader, NonSeekingReader):
        with path.open("rb") as stream:
            logged = [m.log_time for _, _, m in kind(stream, validate_crcs=True).iter_messages(log_time_order=False)]
        assert len(logged) == total
        assert logged == sorted(logged)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == total
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    imu = made["/imu"]
    assert isinstance(imu, series.ImuSeries)
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/imu"]
        for i, (connection, _, raw) in enumerate(reader.messages(wanted)):
            message: Any = reader.deserialize(raw, connection.msgtype)
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == imu.t_ns[i]
            assert message.header.frame_id == "imu_link"
            q, w = message.orientation, message.angular_velocity
            assert [q.w, q.x, q.y, q.z, w.x, w.y, w.z] == [*imu.wxyz[i], *imu.gyro[i]]
        assert i == 299


def rewrite(source: Path, path: Path, order: Any = list, **options: Any) -> Path:
    """The same messages through the mcap package's own writer, with options of its."""
    with source.open("rb") as stream, path.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, **options)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in order(reader.iter_messages()):
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.ZSTD, "chunk_size": 3000},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
        {"index_types": IndexType.MESSAGE, "repeat_channels": False, "repeat_schemas": False},
        {"enable_crcs": False},
        {"order": lambda all_messages: sorted(all_messages, key=lambda m: (m[1].id, m[2].log_time))},
        {"order": lambda all_messages: list(all_messages)[::-1], "chunk_size": 3000},
    ],
    ids=lambda options: " ".join(options),
)
def test_every_form_of_the_container_reads_the_same(options: dict[str, Any], tmp_path: Path) -> None:
    made = session(200)
    write_session(tmp_path / "s.mcap", made)
    found = read_all(rewrite(tmp_path / "s.mcap", tmp_path / "t.mcap", **options))
    # Pictures and detections come in file order.
    found["/image"].sort()
    if options.get("chunk_size") and "order" in options:
        del found["/tags"], made["/tags"]
    assert_same(found, made)


def test_backward_stamps_stay_in_the_order_they_were_logged(tmp_path: Path) -> None:
    t = T0 + np.array([0, 10, 30, 20, 40])
    write_session(tmp_path / "s.mcap", {"/v": series.VectorSeries(t, np.arange(15.0).reshape(5, 3))})
    found = open_recording(tmp_path / "s.mcap").vector("/v")
    np.testing.assert_array_equal(found.t_ns, t)


def test_the_first_log_time_is_that_of_the_earliest_topic(tmp_path: Path) -> None:
    """Not of the channel that comes first: parts of a recording are ordered by it."""
    t = T0 + 10_000_000 * np.arange(5)
    late, early = (series.VectorSeries(t + shift, np.zeros((5, 3))) for shift in (70_000_000, 0))
    write_session(tmp_path / "s.mcap", {"/late": late, "/early": early})
    assert open_container(tmp_path / "s.mcap").first_log_ns == T0


def test_topics_read_together_take_one_pass_and_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s.mcap"
    write_session(path, session())
    joints = ("elevation", "azimuth")
    alone = open_recording(path)
    expected = alone.imu("/imu"), alone.joints("/joints", joints), alone.fixes("/fix")
    times = {name: alone.times[name] for name in ("/imu", "/image")}
    together = open_recording(path)
    assert together.epoch_ns == T0
    loads: list[Any] = []
    load = McapFile._load

    def counted(*args: Any) -> Any:
        loads.append(args)
        return load(*args)

    monkeypatch.setattr(McapFile, "_load", counted)
    together.read_together({"/imu": (), "/joints": joints, "/fix": (), "/image": (), "/nothing": ()})
    once = len(loads)
    found = together.imu("/imu"), together.joints("/joints", joints), together.fixes("/fix")
    assert len(loads) == once == len({block.start for _, _, block in loads})
    for a, b in zip(found, expected, strict=True):
        for name, value in vars(b).items():
            np.testing.assert_array_equal(getattr(a, name), value)
    # Stamps of what was decoded are known; the pictures' are not yet.
    for name, (t_ns, log_ns) in times.items():
        np.testing.assert_array_equal(together.times[name][0], t_ns)
        np.testing.assert_array_equal(together.times[name][1], log_ns)


def test_a_topic_that_cannot_be_read_together_is_told_when_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    topics = session()
    write_session(path, topics)
    recording = open_recording(path)
    recording.read_together({"/imu": (), "/joints": ("azimuth", "roll")})
    made = topics["/imu"]
    assert isinstance(made, series.ImuSeries)
    assert len(recording.imu("/imu")) == len(made)
    with pytest.raises(InputError, match="no message with positions of the joints azimuth, roll"):
        recording.joints("/joints", ("azimuth", "roll"))


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    def pictures() -> Any:
        yield b"one"
        raise OSError("camera unplugged")

    topic = series.ImageSeries(T0 + np.arange(2), pictures())
    with pytest.raises(InputError, match=r"s.mcap: cannot be written \(camera unplugged\)"):
        write_session(tmp_path / "s.mcap", {"/image": topic})
    assert not list(tmp_path.iterdir())


def test_series_of_wrong_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="t_ns"):
        series.VectorSeries(np.arange(3.0), np.zeros((3, 3)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="broadcast"):
        series.VectorSeries(np.arange(3), np.zeros((2, 3)))


# -- broken files


@pytest.fixture
def imu_file(tmp_path: Path) -> Path:
    """Uncompressed, so that damage is silent but for the checksum."""
    write_session(tmp_path / "z.mcap", {"/imu": session(300)["/imu"]}, {"alidade.yaml": b"method: head\n"})
    return rewrite(tmp_path / "z.mcap", tmp_path / "s.mcap", compression=CompressionType.NONE, chunk_size=20_000)


def damage(path: Path, at: int) -> Path:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    other = path.with_name("damaged.mcap")
    other.write_bytes(data)
    return other


def test_a_flipped_bit_in_a_chunk_is_found(imu_file: Path) -> None:
    gyro = open_recording(imu_file).imu("/imu").gyro
    at = imu_file.read_bytes().find(gyro[150].tobytes())
    broken = open_recording(damage(imu_file, at))
    left = broken.imu("/imu").gyro
    assert 0 < len(left) < len(gyro)
    assert not (left == gyro[150]).all(axis=1).any()
    assert broken.container.missing == {"/imu": len(gyro) - len(left)}
    assert "1 chunk" in broken.notes[0]
    assert "its checksum is another" in broken.notes[0]
    with pytest.raises(InputError, match=r"its checksum is another.*--strict"):
        open_recording(imu_file.with_name("damaged.mcap"), strict=True).imu("/imu")


def test_a_flipped_bit_in_a_compressed_chunk_is_found(imu_file: Path) -> None:
    compressed = imu_file.with_name("z.mcap")
    data = compressed.read_bytes()
    found = 0
    for at in range(data.find(b"zstd") + 20, len(data) // 2, len(data) // 20):
        with pytest.raises(InputError, match="damaged"):
            open_recording(damage(compressed, at), strict=True).imu("/imu")
        found += 1
    assert found > 5


def test_a_flipped_bit_in_a_message_index_loses_nothing(imu_file: Path) -> None:
    """The index is outside the checksums; the chunk has all that it says."""
    good = open_recording(imu_file).imu("/imu")
    entry = imu_file.read_bytes().rfind(int(good.t_ns[3]).to_bytes(8, "little"))
    broken = open_recording(damage(imu_file, entry + 9))
    np.testing.assert_array_equal(broken.imu("/imu").gyro, good.gyro)


def test_a_flipped_bit_in_the_config_is_found(imu_file: Path) -> None:
    path = imu_file.with_name("z.mcap")
    broken = open_recording(damage(path, path.read_bytes().find(b"method: head")))
    with pytest.raises(InputError, match=r"alidade\.yaml is damaged"):
        broken.attachment("alidade.yaml")


def test_a_file_cut_anywhere_is_known_for_it(imu_file: Path) -> None:
    data = imu_file.read_bytes()
    cut = imu_file.with_name("cut.mcap")
    for size in [9, 20, 1000, len(data) // 2, len(data) - 300, len(data) - 8, len(data) - 1]:
        cut.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"truncated|the file ends in it"):
            open_recording(cut, strict=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"hello, this is text", "not an MCAP file, .*or table: no line of numbers"),
        (b"#ROSBAG V2.0\n" + b"\0" * 50, "truncated.*nothing in it can be read"),
        (b"SQLite format 3\0" + b"\0" * 50, "cannot be opened .SQLite says: file is not a database"),
        (records.MAGIC, "truncated"),
        (records.MAGIC + b"\xff" * 60, "truncated"),
        (records.MAGIC + b"\x07" + (6).to_bytes(8, "little") + b"\0" * 60, "truncated"),
    ],
)
def test_what_is_no_recording_is_one_clear_line(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        open_recording(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["session.csv.gz", "session.zip", "session.tar.gz"])
def test_a_compressed_file_is_to_be_unpacked(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("session.csv", "t,gx\n0.0,1.0\n")
    with pytest.raises(InputError, match="unpack it first"):
        open_recording(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be opened"):
        open_recording(tmp_path / "none.mcap")
    with pytest.raises(InputError, match="a folder"):
        open_recording(tmp_path)


def test_random_damage_is_an_input_error_or_harmless(imu_file: Path) -> None:
    """Whatever byte is hit: an InputError, or the right gyro; never another exception."""
    rng = np.random.default_rng(11)
    compressed = imu_file.with_name("z.mcap")
    good = open_recording(compressed).imu("/imu")
    size = compressed.stat().st_size
    places = [*rng.integers(0, size, 150).tolist(), *range(0, 600, 3), *range(size - 900, size, 5)]
    errors = [error_of(damage(compressed, at), good.gyro) for at in places]
    assert None in errors
    assert any(errors)
    assert not any("\n" in error for error in errors if error)


def error_of(path: Path, gyro: np.ndarray[Any, Any]) -> str | None:
    """The InputError of reading a damaged file strictly; None if it gives the gyro all the same."""
    try:
        np.testing.assert_array_equal(open_recording(path, strict=True).imu("/imu").gyro, gyro)
    except InputError as error:
        return str(error)
    return None


# -- topics


def test_missing_topic_lists_what_is_there(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session(10))
    recording = open_recording(tmp_path / "s.mcap")
    with pytest.raises(
        InputError, match=r"no topic /head/imu \(sensor_msgs/msg/Imu or .*TwistStamped\);.*/imu \(Imu\).*`topics:`"
    ):
        recording.imu("/head/imu")
    with pytest.raises(
        InputError, match="topic /mag holds sensor_msgs/msg/MagneticField, needed is sensor_msgs/msg/Imu"
    ):
        recording.imu("/mag")
    with pytest.raises(InputError, match=r"topic /mag holds .*PoseWithCovarianceStamped or .*QuaternionStamped"):
        recording.poses("/mag")


def test_topic_without_messages(tmp_path: Path) -> None:
    empty = series.VectorSeries(np.empty(0, dtype=np.int64), np.empty((0, 3)))
    write_session(tmp_path / "s.mcap", {"/v": empty, "/w": session(10)["/vector"]})
    with pytest.raises(InputError, match="topic /v has no messages"):
        open_recording(tmp_path / "s.mcap").vector("/v")


def test_attitudes_without_covariance_are_accepted_as_poses(tmp_path: Path) -> None:
    made = session(100)["/quaternion"]
    assert isinstance(made, series.QuaternionSeries)
    write_session(tmp_path / "s.mcap", {"/q": made})
    poses = open_recording(tmp_path / "s.mcap").poses("/q")
    np.testing.assert_array_equal(poses.wxyz, made.wxyz)
    assert not poses.cov.any()


def test_images_are_taken_one_at_a_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    taken = []

    def pictures() -> Any:
        for i in range(200):
            taken.append(i)
            yield rng.bytes(60_000)

    write_session(tmp_path / "s.mcap", {"/i": series.ImageSeries(T0 + np.arange(200), pictures())})
    assert taken == list(range(200))
    images = open_recording(tmp_path / "s.mcap").images("/i")
    t_ns, data = next(images)
    assert (t_ns, zlib.crc32(data)) == (T0, zlib.crc32(np.random.default_rng(0).bytes(60_000)))


# -- files that others wrote


def test_contract_recordings(shared_data: Path) -> None:
    folder = shared_data / "contract"
    head = open_recording(folder / "head_mounts.mcap")
    assert len(head.imu("/head/imu")) == 30001
    assert len(head.imu("/platform/imu")) == 12001
    assert len(head.poses("/vision/attitude")) == 1797
    assert head.epoch_ns == 1_795_176_000_000_000_000
    assert head.duration_s == pytest.approx(60.0)
    los = open_recording(folder / "los_images_tag.mcap")
    assert los.camera_info("/camera/camera_info").width == 640
    assert sum(data[:2] in (b"\xff\xd8", b"\x89P") for _, data in los.images("/camera/image/compressed")) == 600
    assert len(los.joints("/gimbal/joint_states", ("azimuth", "elevation"))) == 6001
    cube = open_recording(folder / "cube_nominal.mcap")
    tags = cube.detections("/tag_detections")
    assert len(tags) == 3307
    assert set(tags.tag_id.tolist()) <= set(range(16, 22))
    assert len(cube.fixes("/reference/fix")) == 166


def test_contract_recordings_agree_with_rosbags_own_reader(shared_data: Path) -> None:
    path = shared_data / "contract" / "head_mounts.mcap"
    poses = open_recording(path).poses("/vision/attitude")
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/vision/attitude"]
        for i, (connection, _, raw) in enumerate(reader.messages(wanted)):
            message: Any = reader.deserialize(raw, connection.msgtype)
            q = message.pose.pose.orientation
            assert [q.w, q.x, q.y, q.z] == poses.wxyz[i].tolist()
            np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), poses.cov[i])
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == poses.t_ns[i]
    assert i + 1 == len(poses)


@pytest.mark.parametrize(
    ("name", "topic", "message"),
    [
        ("compressed", "/imu", "no topic /imu .*a ROS 1 recording.*/diagnostics"),
        ("compressed", "/tf", r"holds tf2_msgs/msg/TFMessage \(ros1/ros1msg\)"),
        ("ros2_talker", "/imu", "no topic /imu.*/rosout"),
        ("ros2_only_topics", "/imu", "no topic /imu"),
        ("ros2_service_events", "/imu", "no topic /imu"),
        ("ros2_wrong_encoding", "/test_topic", "holds test_msgs/msg/BasicTypes"),
    ],
)
def test_files_without_our_topics(name: str, topic: str, message: str, shared_data: Path) -> None:
    recording = open_recording(shared_data / "mcap_files" / f"{name}.mcap")
    for other in recording.topics:
        assert len(recording.times[other][0]) == recording.topics[other].count
    with pytest.raises(InputError, match=message):
        recording.imu(topic)


def test_wrong_encoding_is_named(tmp_path: Path) -> None:
    with (tmp_path / "s.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start("ros2")
        schema = writer.register_schema(messages.IMU, "ros2msg", messages.definition_text(messages.IMU).encode())
        writer.add_message(writer.register_channel("/imu", "json", schema), T0, b"{}", T0)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(InputError, match=r"topic /imu has the encoding json/ros2msg, needed is cdr/ros2msg"):
        open_recording(tmp_path / "s.mcap").imu("/imu")


@pytest.mark.parametrize(
    ("name", "message"),
    [("chunk_not_closed", "truncated"), ("zstd_chunk_with_padding", "does not define their channel")],
)
def test_broken_files_of_others(name: str, message: str, shared_data: Path) -> None:
    with pytest.raises(InputError, match=message):
        open_recording(shared_data / "mcap_files" / f"{name}.mcap")
