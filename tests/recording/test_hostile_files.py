"""Files made to hurt: refused in one line within bounded memory and time."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from alidade.pipelines.applications.session import resolve_method, session_facts
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError, printable
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.mcap_records import HEAD, MAGIC, index_is_complete
from alidade.pipelines.recording.recording import open_recording
from tests.support.raw_messages import STORE, T0, random_message

MIB = 1 << 20


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return HEAD.pack(opcode, len(body) if length is None else length) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def schema(number: int, name: str, definition: str, encoding: str = "ros2msg") -> bytes:
    return record(Opcode.SCHEMA, struct.pack("<H", number) + text(name) + text(encoding) + text(definition))


def channel(number: int, topic: str, schema_id: int, encoding: str = "cdr") -> bytes:
    body = struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + struct.pack("<I", 0)
    return record(Opcode.CHANNEL, body)


def message(number: int, data: bytes, t_ns: int = T0) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, t_ns, t_ns) + data)


def chunk(packed: bytes, size: int, compression: str, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", T0, T0, size, crc) + text(compression)
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def file(*records: bytes) -> bytes:
    """A whole file without summary."""
    end = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20))
    return MAGIC + record(Opcode.HEADER, text("ros2") + text("x")) + b"".join(records) + end + MAGIC


def imu_with(*more: bytes) -> bytes:
    """A file with an Imu topic beside what is hostile."""
    made = random_message(messages.IMU, np.random.default_rng(0), T0, "")
    data = bytes(STORE.serialize_cdr(made, messages.IMU))
    own = schema(9, messages.IMU, messages.definition_text(messages.IMU)) + channel(9, "/imu", 9)
    return file(own, *(message(9, data, T0 + i) for i in range(3)), *more)


def one_message(kind: str, definition: str, data: bytes, topic: str = "/imu") -> bytes:
    return file(schema(1, kind, definition), channel(1, topic, 1), message(1, data))


def bomb_without_size() -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join([*(packer.compress(bytes(MIB)) for _ in range(300)), packer.flush()])


NOISE = np.random.default_rng(0).bytes(10_000)
NESTED = "\n".join(
    [f"{'=' * 80}\nMSG: a/T{i}\n" + f"a/T{i + 1} x\na/T{i + 1} y" for i in range(20)]
    + [f"{'=' * 80}\nMSG: a/T20\nfloat64 x"]
)
CYCLE = f"a/A x\n{'=' * 80}\nMSG: a/A\na/B x\n{'=' * 80}\nMSG: a/B\na/A x"
IMU = messages.definition_text(messages.IMU)
JOINTS = messages.definition_text(messages.JOINT_STATE)

HOSTILE: dict[str, Callable[[], bytes]] = {
    "zstd bomb": lambda: file(chunk(zstandard.compress(bytes(300 * MIB)), 300 * MIB, "zstd")),
    "zstd bomb that says it is small": lambda: file(chunk(zstandard.compress(bytes(300 * MIB)), 1000, "zstd")),
    "zstd bomb without a size": lambda: file(chunk(bomb_without_size(), 1 << 30, "zstd")),
    "lz4 bomb": lambda: file(chunk(lz4.frame.compress(bytes(300 * MIB)), 300 * MIB, "lz4")),
    "lz4 bomb that says it is small": lambda: file(chunk(lz4.frame.compress(bytes(300 * MIB)), 1000, "lz4")),
    # Each chunk alone might hold constant images.
    "many bombs": lambda: file(chunk(zstandard.compress(NOISE + bytes(10 * MIB - 10_000)), 10 * MIB, "zstd") * 50),
    "chunk of 2^60 bytes": lambda: file(chunk(b"", 1 << 60, "")),
    "record of 2^63 bytes": lambda: imu_with(record(Opcode.CHUNK, b"", 1 << 63)),
    "name of 2^32 bytes": lambda: imu_with(record(Opcode.ATTACHMENT, bytes(16) + b"\xff\xff\xff\xff" + bytes(30))),
    "schema of 2^32 bytes": lambda: imu_with(record(Opcode.SCHEMA, b"\1\0\xff\xff\xff\xff")),
    "200,000 channels": lambda: imu_with(*(channel(i % 65536, f"/t{i}", 0) for i in range(200_000))),
    "200,000 tiny records": lambda: imu_with(record(Opcode.METADATA, text("") + bytes(4)) * 200_000),
    "200,000 unknown records": lambda: imu_with(record(0x90, b"") * 200_000),
    "many large schemas": lambda: imu_with(*(schema(i + 10, f"a/B{i}", "x" * MIB) for i in range(100))),
    "chunk of empty records": lambda: file(chunk(record(0x90, b"") * MIB, 9 * MIB, "")),
    "nothing but chunk opcodes": lambda: imu_with(b"\x06" * (MIB)),
    "likely chunks everywhere": lambda: imu_with((b"\x06" + struct.pack("<Q", 50)) * 100_000),
    "types that double": lambda: one_message(messages.IMU, "a/T0 x\n" + NESTED, bytes(40)),
    "types in a circle": lambda: one_message(messages.IMU, CYCLE, bytes(40)),
    "array of 10^9 structures": lambda: one_message(
        messages.IMU, IMU.replace("Vector3 angular_velocity", "Vector3[1000000000] angular_velocity"), bytes(40)
    ),
    "definition of 10 MB": lambda: one_message(messages.IMU, IMU + "# and so on\n" * 900_000, bytes(40)),
    "definition of 20,000 fields": lambda: one_message(
        messages.IMU, "".join(f"int8 f{i}\n" for i in range(20_000)), bytes(40)
    ),
    "number of 100,000 digits": lambda: one_message(messages.IMU, f"float64[{'9' * 100_000}] x", bytes(40)),
    "code for a name": lambda: one_message(messages.IMU, "float64 __import__('os').abort()", bytes(40)),
    "2^31 joints": lambda: one_message(
        messages.JOINT_STATE, JOINTS, b"\0\1\0\0" + bytes(12) + b"\xff\xff\xff\x7f" + bytes(40), "/gimbal/joint_states"
    ),
    "message of 0 bytes": lambda: one_message(messages.IMU, IMU, b""),
    "message of 64 MiB": lambda: one_message(messages.IMU, IMU, bytes(64 * MIB)),
}


def use(path: Path) -> str:
    """Everything that `info` and a method do with a file; the error if it is refused."""
    try:
        recording = open_recording(path)
        session_facts(recording, load_config(recording.attachment("alidade.yaml")))
        for name, topic in recording.topics.items():
            if topic.type == messages.IMU:
                recording.imu(name)
            elif topic.type == messages.JOINT_STATE:
                recording.joints(name, ("azimuth", "elevation"))
        resolve_method(None, recording, load_config(None))
    except InputError as error:
        return str(error)
    raise AssertionError("no method can be served")


MEASURE = """
import json, sys, time
from pathlib import Path
from benchmarks.measure import peak_mib
from tests.recording.test_hostile_files import HOSTILE, use
for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
    start = time.process_time()
    error = use(path)
    print(json.dumps([path.stem, error, time.process_time() - start, peak_mib()]), flush=True)
"""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, float, float]]:
    """Case -> error, seconds and peak memory (MiB) so far, all read by one process of its own."""
    folder = tmp_path_factory.mktemp("hostile")
    for name, make in HOSTILE.items():
        (folder / f"{name}.mcap").write_bytes(make())
    command = [sys.executable, "-c", MEASURE, str(folder)]
    run = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=300)
    assert not run.stderr
    lines = (json.loads(line) for line in run.stdout.splitlines())
    return {name: (error, seconds, peak) for name, error, seconds, peak in lines}


def test_a_hostile_file_is_refused_in_one_line(measured: dict[str, tuple[str, float, float]]) -> None:
    assert measured.keys() == HOSTILE.keys()
    for case, (error, seconds, _) in measured.items():
        assert 0 < len(error) < 3000, case
        assert error.isprintable(), case
        assert seconds < 10.0, case


def test_hostile_files_take_little_memory(measured: dict[str, tuple[str, float, float]]) -> None:
    assert max(peak for *_, peak in measured.values()) < 600.0


def test_what_is_wrong_is_named(measured: dict[str, tuple[str, float, float]]) -> None:
    for case, words in {
        "zstd bomb": "hold 314572800",
        "many bombs": "exhaust the memory",
        "200,000 channels": "more than 10000 channels",
        "types in a circle": "nested too deep",
        "types that double": "1048576 fields",
        "array of 10^9 structures": "fields",
        "definition of 10 MB": "a definition of 1048577 bytes",
        "message of 0 bytes": "a message of 0 bytes does not agree with the definition of sensor_msgs/msg/Imu",
        "message of 64 MiB": "a message of 67108864 bytes, which is no sensor_msgs/msg/Imu",
        "2^31 joints": "/gimbal/joint_states: a message of",
    }.items():
        assert words in measured[case][0], case


def test_names_are_printed_without_control_characters(tmp_path: Path) -> None:
    """A topic's name can neither make two lines of one nor steer the terminal."""
    path = tmp_path / "x.mcap"
    path.write_bytes(file(schema(1, messages.VECTOR, ""), channel(1, "/a\nb\x1b[2J", 1), message(1, bytes(40))))
    with pytest.raises(InputError) as caught:
        open_recording(path).imu("/imu")
    assert r"/a\nb\x1b[2J" in str(caught.value)
    assert printable("x" * 1000) == "x" * 100 + " ... " + "x" * 100


def test_checksums_are_checked_without_an_index(tmp_path: Path) -> None:
    made = [random_message(messages.IMU, np.random.default_rng(i), T0 + i, "") for i in range(20)]
    data = b"".join(message(1, bytes(STORE.serialize_cdr(m, messages.IMU)), T0 + i) for i, m in enumerate(made))
    own = schema(1, messages.IMU, IMU) + channel(1, "/imu", 1)
    path = tmp_path / "x.mcap"
    path.write_bytes(file(own, chunk(data, len(data), "", zlib.crc32(data)), chunk(data, len(data), "", 7)))
    recording = open_recording(path)
    assert len(recording.imu("/imu")) == 20
    assert "its checksum is another" in recording.notes[0]


YAML = {
    "billion laughs": "a: &a [x, x]\n"
    + "".join(f"{chr(b + 1)}: &{chr(b + 1)} [{', '.join([f'*{chr(b)}'] * 9)}]\n" for b in range(ord("a"), ord("y"))),
    "laughs where a number should be": "x: &a [1, 1]\n"
    + "".join(f"{chr(b + 1)}: &{chr(b + 1)} [{', '.join([f'*{chr(b)}'] * 9)}]\n" for b in range(ord("a"), ord("y")))
    + "noise: {gyro_density: *y}",
    "deep": "a: " + "[" * 20_000,
    "long": "# and so on\n" * 1_000_000,
    "deep and whole": "topics: " + "{a: " * 3000 + "1" + "}" * 3000,
    "python": "topics: !!python/object/apply:os.system [echo]",
    "a circle": "topics: &a {imu: *a}",
    "merged": "noise: &a {gyro_density: 1.0}\npriors: {<<: [*a, *a]}\nx: 1",
    "many digits": f"latitude_deg: {'9' * 10_000}",
    "no text": "\x00\xff",
    "a key of two lines": '"a\\nb": 1',
}


@pytest.mark.parametrize("case", YAML)
def test_a_hostile_config_is_refused_in_one_line(case: str) -> None:
    start = time.process_time()
    with pytest.raises(InputError) as caught:
        load_config(YAML[case].encode("latin-1"))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 3000
    assert time.process_time() - start < 10.0


def test_an_index_with_an_offset_beyond_all_bounds_is_incomplete() -> None:
    buffer = np.zeros(100, dtype=np.uint8)
    assert not index_is_complete(buffer, {1: np.array([2**63 - 5], dtype=np.int64)})
