"""Damaged, cut and hostile recordings of the other forms: read soundly as far as the form can tell, or one line."""

from __future__ import annotations

import base64
import bz2
import resource
import sqlite3
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import images, messages
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.ros1_bag import MAGIC
from tests.support import forms
from tests.support.damage import CONFIG, Whole, flips, read, spoilt, topics
from tests.support.turning import turning, write_csv

MIB = 1 << 20
CSV = b"columns: {/imu: {time: t, unit: ns, gyro: [x, y, z], accel: [x, y, z]}}"


def make_csv(_: Path, folder: Path) -> Path:
    t_ns, gyro, _wxyz = turning(200)
    return write_csv(folder / "s.csv", ["t", "x", "y", "z"], t_ns, gyro)


def make_ulog(_: Path, folder: Path) -> Path:
    t_ns, gyro, _wxyz = turning(200)
    stamps = (t_ns // 1000).astype(np.uint64)
    columns = {"timestamp": stamps, "gyro_rad": gyro, "accelerometer_m_s2": gyro}
    return forms.ulog(folder / "s.ulg", {"sensor_combined": columns})


def make_dataflash(_: Path, folder: Path) -> Path:
    t_ns, gyro, _wxyz = turning(200)
    axes = {f"{kind}{axis}": gyro[:, i] for kind in ("Gyr", "Acc") for i, axis in enumerate("XYZ")}
    return forms.dataflash(folder / "s.bin", {"IMU": ("Qdddddd", {"TimeUS": t_ns // 1000, **axes})})


def make_tum(_: Path, folder: Path) -> Path:
    t_ns, position, wxyz = turning(200)
    path = folder / "s.tum"
    rows = np.hstack([position, wxyz]).tolist()
    stamps = [f"{t // 10**9}.{t % 10**9:09d}" for t in t_ns.tolist()]
    path.write_text("".join(f"{t} {' '.join(map(repr, row))}\n" for t, row in zip(stamps, rows, strict=True)))
    return path


def make_euroc(_: Path, folder: Path) -> Path:
    """The table of a data set's IMU."""
    t_ns, gyro, _wxyz = turning(200)
    path = folder / "set" / "mav0" / "imu0" / "data.csv"
    path.parent.mkdir(parents=True)
    names = [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    return write_csv(path, ["#timestamp [ns]", *names], t_ns, np.hstack([gyro, -gyro]))


MAKERS: dict[str, Callable[[Path, Path], Path]] = {
    "db3": lambda s, f: forms.rosbag2(s, f / "bag", StoragePlugin.SQLITE3) / "bag.db3",
    "bag": lambda s, f: forms.rosbag1(s, f / "s.bag"),
    "bag bz2": lambda s, f: forms.rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.BZ2),
    "bag lz4": lambda s, f: forms.rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.LZ4),
    "db3 by message": lambda s, f: (
        forms.rosbag2(s, f / "bag", StoragePlugin.SQLITE3, CompressionMode.MESSAGE) / "bag.db3"
    ),
    "mcap ros 1": lambda s, f: forms.mcap_ros1(s, f / "r.mcap"),
    "mcap IDL": lambda s, f: forms.mcap_idl(s, f / "i.mcap"),
    "mcap json": lambda s, f: forms.mcap_json(s, f / "j.mcap"),
    "mcap protobuf": lambda s, f: forms.mcap_protobuf(s, f / "p.mcap"),
    "mcap.zstd": lambda s, f: forms.zstd(s, f / "s.mcap.zstd"),
    "ulg": make_ulog,
    "bin": make_dataflash,
    "csv": make_csv,
    "tum": make_tum,
    "euroc": make_euroc,
}
# Forms that have checksums of all data: what is read of a damaged copy is what was recorded.
CHECKED = ("mcap json", "mcap protobuf", "mcap ros 1", "mcap IDL", "bag bz2")
# Tables: a line may end within a number, and a number that is none is refused with its line.
TABLES = ("csv", "tum", "euroc")
# Folders, of which a file is damaged: so many levels above it.
FOLDERS = {"euroc": 2, "db3 by message": 0}


class Small:
    """A small recording of a form: its bytes, what is in it, and a place for damaged copies."""

    def __init__(self, form: str, folder: Path) -> None:
        write_session(folder / "whole.mcap", topics(), {"alidade.yaml": CONFIG})
        path = MAKERS[form](folder / "whole.mcap", folder)
        self.form, self.data, self.copy = form, path.read_bytes(), folder / f"copy{''.join(path.suffixes)}"
        if form in FOLDERS:
            self.copy = path
        self.whole = self._read(path)
        assert self.whole

    def _read(self, path: Path) -> Whole:
        recording = open_recording(path.parents[FOLDERS[self.form]] if self.form in FOLDERS else path)
        if self.form == "csv":
            config = load_config(CSV)
            recording = recording.with_config(config.topics.values(), config.columns)
        if self.form == "tum":
            poses = recording.poses("/trajectory")
            return {"/trajectory": (poses.t_ns, np.hstack([poses.position, poses.wxyz]))}
        own = {"ulg": "/sensor_combined", "bin": "/IMU", "euroc": "/imu0"}.get(self.form)
        if own is None:
            return read(recording)
        imu = recording.imu(own)
        return {own: (imu.t_ns, np.hstack([imu.gyro, imu.accel]))}

    def outcomes(self, copies: Iterable[bytes], is_sound: bool) -> Counter[str]:
        """How many damaged copies were read, or refused in one line; anything else goes through."""
        found: Counter[str] = Counter()
        for data in copies:
            self.copy.write_bytes(data)
            try:
                left = self._read(self.copy)
            except InputError as error:
                found["refused" if "\n" not in str(error) else "refused in several lines"] += 1
                continue
            found["read"] += 1
            if is_sound:
                self._check_sound(left)
        assert "refused in several lines" not in found
        return found

    def _check_sound(self, left: Whole) -> None:
        for name, (t_ns, values) in left.items():
            rows = np.searchsorted(self.whole[name][0], t_ns)
            np.testing.assert_array_equal(t_ns, self.whole[name][0][rows])
            np.testing.assert_array_equal(values, self.whole[name][1][rows])


@pytest.fixture(scope="module", params=list(MAKERS))
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Small:
    return Small(request.param, tmp_path_factory.mktemp("damaged"))


def test_cut_anywhere(small: Small) -> None:
    places = np.linspace(1, len(small.data) - 1, 7).astype(int)
    found = small.outcomes((small.data[:at] for at in places), is_sound=small.form not in TABLES)
    assert sum(found.values()) == 7
    assert found["read"] > 0


def test_flipped_bytes(small: Small) -> None:
    found = small.outcomes(flips(small.data, 5, 1), is_sound=small.form in CHECKED)
    assert found["read"] > 0 or small.form in TABLES


def test_stretches_zeroed_missing_inserted_random(small: Small) -> None:
    small.outcomes(spoilt(small.data, 8, 2), is_sound=small.form in CHECKED)


@pytest.mark.slow
def test_many_cuts_and_flips(small: Small) -> None:
    rng = np.random.default_rng(3)
    for name, copies, is_sound in (
        ("cut", (small.data[:at] for at in rng.integers(1, len(small.data), 150)), small.form not in TABLES),
        ("one byte", flips(small.data, 200, 3), small.form in CHECKED),
        ("stretches and several bytes", spoilt(small.data, 200, 4), small.form in CHECKED),
    ):
        print(small.form, name, dict(small.outcomes(copies, is_sound)))


def damaged_videos(whole: list[bytes], number: int, seed: int, form: str) -> Counter[str]:
    """What becomes of videos whose messages are damaged: as many pictures as messages, or one line."""
    rng = np.random.default_rng(seed)
    found: Counter[str] = Counter()
    for i in range(number):
        packets = list(whole)
        at = int(rng.integers(len(packets)))
        if i % 3 == 0:
            packets[at] = packets[at][: int(rng.integers(1, len(packets[at])))]
        else:
            packets[at] = next(iter((flips if i % 3 == 1 else spoilt)(packets[at], 1, seed + i)))
        try:
            pictures = list(images.decode_video(enumerate(packets), form))
        except ValueError as error:
            found["refused" if "\n" not in str(error) else "refused in several lines"] += 1
            continue
        assert [t_ns for t_ns, _ in pictures] == list(range(len(whole)))
        found["read"] += 1
    return found


@pytest.mark.parametrize("number", [20, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("form", ["h264", *forms.VIDEOS])
def test_damaged_videos(form: str, number: int) -> None:
    """A video has no checksums: what is damaged in a picture is seen, if at all, by what is measured in it."""
    if form in images.BY_PYAV:
        pytest.importorskip("av", reason="needs the extra alidade[video]")
    whole = [base64.b64decode(each) for each in forms.VIDEOS.get(form, ())]
    whole = whole or forms.h264(np.random.default_rng(1).integers(0, 256, (4, 32, 48), dtype=np.uint8))
    found = damaged_videos(whole, number, 5, form)
    print("video", form, dict(found))
    assert found["read"] + found["refused"] == number
    assert found["read"] > 0


@pytest.mark.parametrize("number", [40, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("form", ["mp4", "avi"])
def test_damaged_video_files(form: str, number: int, tmp_path: Path) -> None:
    """As many pictures as stamps, or one line."""
    path = tmp_path / f"v.{form}"
    forms.video_file(path, 7)
    data, rng, found = path.read_bytes(), np.random.default_rng(5), Counter[str]()
    cut = (data[:at] for at in rng.integers(1, len(data), number // 2).tolist())
    for copy in (*cut, *flips(data, number // 4, 3), *spoilt(data, number // 4, 4)):
        path.write_bytes(copy)
        try:
            found["read"] += len(list(images.VideoFile(path, 7))) == 7
        except InputError as error:
            found["refused"] += "\n" not in str(error)
    print(form, dict(found))
    assert found["read"] + found["refused"] == number
    assert found["read"] > 0


# -- hostile


def bag_record(header: dict[str, bytes], data: bytes, length: int | None = None) -> bytes:
    fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in header.items())
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data) if length is None else length) + data


def bz2_bomb(path: Path) -> None:
    packed = bz2.compress(bytes(60 * MIB))
    for size in (60 * MIB, 1000):
        chunk = {"op": b"\5", "compression": b"bz2", "size": struct.pack("<I", size)}
        path.write_bytes(MAGIC + bag_record(chunk, packed) * 3)


def bag_of_connections(path: Path) -> None:
    records = (bag_record({"op": b"\7", "conn": struct.pack("<I", i), "topic": b"/x"}, b"") for i in range(20_000))
    path.write_bytes(MAGIC + b"".join(records))


def bag_lengths(path: Path) -> None:
    path.write_bytes(MAGIC + b"\xff\xff\xff\xff" * 10)


def sqlite_file(path: Path, *statements: str) -> None:
    database = sqlite3.connect(path)
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()


def endless_view(path: Path) -> None:
    sqlite_file(
        path,
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)",
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        "SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n",
    )


def odd_values(path: Path) -> None:
    sqlite_file(
        path,
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)",
        "INSERT INTO topics VALUES (1, x'ff00', NULL, 5), (2, '/imu', 'sensor_msgs/msg/Imu', 'cdr')",
        "INSERT INTO messages VALUES (1, 2, 'x', 'y'), (2, 2, 9e18, NULL), (3, 'z', 5, x'00'), (4, NULL, 5, x'00')",
    )


def zstd_bomb(path: Path) -> None:
    frame = zstandard.compress(bytes(600 * MIB), 1)
    path.write_bytes(frame)


def twice_compressed(path: Path) -> None:
    path.write_bytes(zstandard.compress(zstandard.compress(b"x" * 100)))


def long_line(path: Path) -> None:
    path.write_bytes(b"a," * (20 * MIB))


def deep_json(path: Path) -> None:
    deep = b'{"a":' * 100_000 + b"1" + b"}" * 100_000
    forms.mcap([("/imu", "", 1, b"")] * 2, path, lambda *_: deep, "json", "jsonschema", lambda _: ("a.Imu", b""))


def long_arrays(path: Path) -> None:
    data = b'{"name": [' + b'"a",' * 500_000 + b'"b"], "position": [1e400, 2]}'
    forms.mcap([("/imu", "", 1, b"")], path, lambda *_: data, "json", "jsonschema", lambda _: ("a.Imu", b""))


def idl_of(text: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        name = "sensor_msgs/msg/Imu"
        forms.mcap(
            [("/imu", "", 1, b"")], path, lambda *_: bytes(400), "cdr", "ros2idl", lambda _: (name, text.encode())
        )

    return make


def huge_video(path: Path) -> None:
    """One macroblock of a picture that its parameters say is 16,384 pixels wide and high."""
    import foxglove
    from foxglove import channels
    from foxglove import messages as fox

    small, large = (forms.h264_parameters(size, size) for size in (16, 16_384))
    data = large + forms.h264(np.zeros((1, 16, 16), np.uint8))[0][len(small) :]
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        channel = channels.CompressedVideoChannel("/imu", context=context)
        for i in range(3):
            channel.log(fox.CompressedVideo(timestamp=fox.Timestamp(i), data=data, format="h264"), log_time=i)


HOSTILE = {
    "IDL of 250 KB": (idl_of("module a { " + "const long x = 1; " * 13_000 + "};"), ".mcap"),
    "IDL nested deep": (idl_of("module a { " * 20_000), ".mcap"),
    "IDL of long sums": (
        idl_of("module a { const long x = " + "(1 + " * 20_000 + "1" + ")" * 20_000 + "; };"),
        ".mcap",
    ),
    "IDL of a large array": (
        idl_of("module sensor_msgs { module msg { typedef double a__9[4000000000]; " + "struct Imu { a__9 x; }; }; };"),
        ".mcap",
    ),
    "a video of 16,384 x 16,384": (huge_video, ".mcap"),
    "bz2 bomb": (bz2_bomb, ".bag"),
    "20,000 connections": (bag_of_connections, ".bag"),
    "lengths": (bag_lengths, ".bag"),
    "endless view": (endless_view, ".db3"),
    "odd values": (odd_values, ".db3"),
    "zstd bomb": (zstd_bomb, ".mcap.zstd"),
    "twice compressed": (twice_compressed, ".mcap.zstd"),
    "a line of 40 MB": (long_line, ".csv"),
    "deep JSON": (deep_json, ".mcap"),
    "long arrays": (long_arrays, ".mcap"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_line(name: str, tmp_path: Path) -> None:
    make, suffix = HOSTILE[name]
    path = tmp_path / f"x{suffix}"
    make(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()

    def read_imu() -> Any:
        recording = open_recording(path)
        if recording.topics and recording.topics["/imu"].type == messages.COMPRESSED_IMAGE:
            list(recording.images("/imu"))
        imu = recording.imu("/imu")
        assert np.isnan(imu.gyro).all()  # what is not said
        raise InputError("nothing")

    with pytest.raises(InputError) as found:
        read_imu()
    assert "\n" not in str(found.value)
    assert time.process_time() - start < 10.0
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < 600
