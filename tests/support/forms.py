"""A recording in the forms that people's recordings come in, written by others' writers."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from alidade.pipelines.recording.messages import TAG_DETECTIONS, definition_text

# Topic, type, log time in ns, CDR.
Message = tuple[str, str, int, bytes]


def stores() -> tuple[Any, Any]:
    """ROS 2's types and ROS 1's."""
    ros2, ros1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    tags = get_types_from_msg(definition_text(TAG_DETECTIONS), TAG_DETECTIONS)
    own = {name: fields for name, fields in tags.items() if name.startswith("apriltag_msgs")}
    ros2.register(own)
    ros1.register(own)
    return ros2, ros1


ROS2, ROS1 = stores()
IDL_NAMES = {"float64": "double", "float32": "float", "bool": "boolean", "byte": "octet"}


def raw_messages(path: Path) -> Iterator[Message]:
    """The messages of an MCAP file."""
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield channel.topic, schema.name, message.log_time, message.data


def schemas(path: Path) -> Iterator[tuple[str, str, bytes]]:
    """Topic, name and text of the schemas of an MCAP file."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        yield channel.topic, schema.name, schema.data


def rosbag2(source: Path, path: Path, storage: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Path:
    """A bag folder."""
    writer = Ros2Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_ns, data in raw_messages(source):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], log_ns, data)
    return path


def split(source: Path, path: Path, count: int = 3) -> Path:
    """A bag folder of several MCAP files, with the metadata.yaml that names them."""
    path.mkdir()
    whole = list(raw_messages(source))
    names = [f"{path.name}_{i}.mcap" for i in range(count)]
    for i, name in enumerate(names):
        part = whole[i * len(whole) // count : (i + 1) * len(whole) // count]
        mcap(part, path / name, lambda _, data: data, "cdr", "ros2msg", ros2_schema)
    listed = "\n".join(f"    - {name}" for name in names)
    (path / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n{listed}\n"
    )
    return path


def zstd(source: Path, path: Path) -> Path:
    """A file compressed as a whole."""
    packer, data = zstandard.ZstdCompressor().compressobj(), source.read_bytes()
    with path.open("wb") as stream:
        for at in range(0, len(data), 4096):  # in small blocks, as a long file has many
            stream.write(packer.compress(data[at : at + 4096]) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
        stream.write(packer.flush())
    return path


def rosbag1(
    source: Path, path: Path, compression: Ros1Writer.CompressionFormat | None = None, chunk: int = 1 << 20
) -> Path:
    """A ROS 1 bag with chunks of so many bytes."""
    writer = Ros1Writer(path)
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, log_ns, data in raw_messages(source):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], log_ns, _to_ros1(kind, data))
    return path


def mcap(
    messages: Any,
    path: Path,
    convert: Callable[[str, bytes], bytes],
    encoding: str,
    schema_encoding: str,
    schema_of: Callable[[str], tuple[str, bytes]],
) -> Path:
    """An MCAP file of messages in another encoding."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD, chunk_size=20_000)
        writer.start("ros1" if encoding == "ros1" else "ros2" if encoding == "cdr" else "")
        channels: dict[str, int] = {}
        for topic, kind, log_ns, data in messages:
            if topic not in channels:
                name, text = schema_of(kind)
                channels[topic] = writer.register_channel(
                    topic, encoding, writer.register_schema(name, schema_encoding, text)
                )
            writer.add_message(channels[topic], log_ns, convert(kind, data), log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def ros2_recording(path: Path, topics: dict[str, list[tuple[int, Any]]]) -> Path:
    """Messages, (log time, message) by topic, of rosbags' types."""
    whole = [
        (name, message.__msgtype__, log_ns, bytes(ROS2.serialize_cdr(message, message.__msgtype__)))
        for name, found in topics.items()
        for log_ns, message in found
    ]
    return mcap(whole, path, lambda _, data: data, "cdr", "ros2msg", ros2_schema)


def header(t_ns: int, frame: str = "") -> Any:
    types = ROS2.types
    time = types["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9))
    return types["std_msgs/msg/Header"](time, frame)


def mcap_ros1(source: Path, path: Path) -> Path:
    """MCAP with ROS 1 messages."""

    def schema(kind: str) -> tuple[str, bytes]:
        return kind.replace("/msg/", "/"), ROS1.generate_msgdef(kind, ros_version=1)[0].encode()

    return mcap(raw_messages(source), path, _to_ros1, "ros1", "ros1msg", schema)


def mcap_idl(source: Path, path: Path) -> Path:
    """MCAP with ROS 2 messages defined in IDL."""
    return mcap(raw_messages(source), path, lambda _, data: data, "cdr", "ros2idl", idl)


def idl(kind: str) -> tuple[str, bytes]:
    """A type, and those it holds, as rosidl writes them: arrays are types of their own."""
    parts: dict[str, str] = {}

    def name_of(what: str) -> str:
        return what.replace("/", "::")

    def describe(kind: str) -> None:
        if kind in parts:
            return
        parts[kind] = ""
        package, _, name = kind.split("/")
        arrays, members = [], []
        for field, (node, what) in ROS2.fielddefs[kind][1]:
            repeated = int(node) > 2
            (inner, element), count = what if repeated else ((node, what), 0)
            if int(inner) == 2:
                describe(element)
            base = name_of(element) if int(inner) == 2 else IDL_NAMES.get(element[0], element[0])
            if int(node) == 3:
                arrays.append(f"    typedef {base} {field}__{count}[{count}];")
                base = f"{field}__{count}"
            elif int(node) == 4:
                base = f"sequence<{base}>"
            members.append(f'      @verbatim (language="comment", text="of what") {base} {field};')
        inside = [*arrays, f"    struct {name} {{", *members, "    };"]
        parts[kind] = "\n".join([f"module {package} {{", "  module msg {", *inside, "  };", "};", ""])

    describe(kind)
    return kind, "".join(f"{'=' * 80}\nIDL: {name}\n{text}" for name, text in parts.items()).encode()


def mcap_json(source: Path, path: Path) -> Path:
    """MCAP with the messages as JSON."""

    def convert(kind: str, data: bytes) -> bytes:
        return json.dumps(_tree(ROS2.deserialize_cdr(data, kind))).encode()

    def schema(kind: str) -> tuple[str, bytes]:
        return kind.replace("/msg", ""), b"{}"

    return mcap(raw_messages(source), path, convert, "json", "jsonschema", schema)


def mcap_protobuf(source: Path, path: Path) -> Path:
    """MCAP with the messages as protobuf types of the same fields."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    made: dict[str, tuple[Any, bytes]] = {}

    def kind_of(kind: str) -> tuple[Any, bytes]:
        if kind not in made:
            file = descriptor_pb2.FileDescriptorProto(name=f"{kind}.proto", package="ros", syntax="proto3")
            _describe(kind, file, set())
            pool = descriptor_pool.DescriptorPool()
            pool.Add(file)
            found = pool.FindMessageTypeByName(f"ros.{kind.rpartition('/')[2]}")
            files = descriptor_pb2.FileDescriptorSet(file=[file])
            made[kind] = message_factory.GetMessageClass(found), files.SerializeToString()
        return made[kind]

    def convert(kind: str, data: bytes) -> bytes:
        message = kind_of(kind)[0]()
        _fill(message, ROS2.deserialize_cdr(data, kind))
        return bytes(message.SerializeToString())

    def schema(kind: str) -> tuple[str, bytes]:
        return f"ros.{kind.rpartition('/')[2]}", kind_of(kind)[1]

    return mcap(raw_messages(source), path, convert, "protobuf", "protobuf", schema)


def ulog(path: Path, topics: dict[str, dict[str, np.ndarray[Any, Any]]]) -> Path:
    """A PX4 log by its specification: topics, name -> fields -> values; a field of two dimensions is an array."""
    kinds = {"u8": "uint64_t", "f4": "float", "f8": "double", "u4": "uint32_t", "i4": "int32_t", "u1": "uint8_t"}

    def record(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), record(b"B", bytes(40))]
    dtypes = {}
    for name, columns in topics.items():
        fields = [(key, values.dtype.str[1:], values.shape[1:]) for key, values in columns.items()]
        dtypes[name] = np.dtype([(key, f"<{kind}" if kind != "u1" else kind, shape) for key, kind, shape in fields])
        text = "".join(f"{kinds[kind]}{f'[{shape[0]}]' if shape else ''} {key};" for key, kind, shape in fields)
        out.append(record(b"F", f"{name}:{text}".encode()))
    for number, name in enumerate(topics):
        out.append(record(b"A", struct.pack("<BH", 0, number) + name.encode()))
    rows = []
    for number, (name, columns) in enumerate(topics.items()):
        table = np.zeros(len(columns["timestamp"]), dtypes[name])
        for key, values in columns.items():
            table[key] = values
        head = struct.pack("<H", number)
        rows += [
            (int(t), record(b"D", head + row.tobytes())) for t, row in zip(columns["timestamp"], table, strict=True)
        ]
    path.write_bytes(b"".join([*out, *(data for _, data in sorted(rows, key=lambda row: row[0]))]))
    return path


def dataflash(path: Path, kinds: dict[str, tuple[str, dict[str, np.ndarray[Any, Any]]]]) -> Path:
    """An ArduPilot log: kinds, name -> letters of the format and columns, the first of which is the time."""
    letters = {"c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "N": "16s", "Z": "64s"}

    def record(number: int, body: bytes) -> bytes:
        return b"\xa3\x95" + bytes([number]) + body

    def form(number: int, length: int, name: str, codes: str, columns: str) -> bytes:
        texts = name.encode(), codes.encode(), columns.encode()
        return record(0x80, struct.pack("<BB4s16s64s", number, length, *texts))

    out, rows = [form(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")], []
    for number, (name, (codes, columns)) in enumerate(kinds.items(), start=1):
        packed = "<" + "".join(letters.get(code, code) for code in codes)
        out.append(form(number, 3 + struct.calcsize(packed), name, codes, ",".join(columns)))
        lines = zip(*(values.tolist() for values in columns.values()), strict=True)
        rows += [(int(line[0]), record(number, struct.pack(packed, *line))) for line in lines]
    path.write_bytes(b"".join([*out, *(data for _, data in sorted(rows, key=lambda row: row[0]))]))
    return path


def h264(pictures: Any) -> list[bytes]:
    """Grey pictures (n, height, width), in multiples of 16, as H.264: a key picture a message, of raw macroblocks."""
    _, height, width = pictures.shape
    out = []
    for i, grey in enumerate(pictures):
        # The slice's head, in the order of ITU-T H.264, 7.3.3: first macroblock, kind, parameters, numbers, filter off.
        bits, blocks = "".join([_ue(0), _ue(7), _ue(0), "0000", _ue(i % 2), "00", _ue(0), _ue(1)]), b""
        for row in range(0, height, 16):
            for column in range(0, width, 16):
                blocks += _bytes(bits + _ue(25))
                blocks += grey[row : row + 16, column : column + 16].tobytes() + bytes([128]) * 128
                bits = ""
        out.append(h264_parameters(width, height) + _unit(0x65, blocks + b"\x80"))
    return out


# Three grey pictures of 64 x 64, brightness 40, 100, 160, a key picture and what follows: x265, SVT-AV1, libvpx.
VIDEOS = {
    "h265": (
        "AAAAAUABDAH//wFgAAADAJAAAAMAAAMAHroCQAAAAAFCAQEBYAAAAwCQAAADAAADAB6gIIEFlukpMLmgIAAAAwAgAAADAUEAAAABRAHAcYESAAAB"
        "KAGt4NEX/77FzI4u",
        "AAAAAQIB0Al4gdyAI//5YsAaLg8=",
        "AAAAAQIB0BH+IHWAI8J5NKAaLg8=",
    ),
    "av1": (
        "EgAKCgAAAAKv/4lfIAgyDxAAloAQQIIAAAAA68lRwA==",
        "EgAyEjACAAAAACMYAAACAAIAGCWzFw==",
        "EgAyEzAEAIAAAGLwAAACAAIAGCWyOcA=",
    ),
    "vp9": (
        "gkmDQgAD8AP2ADgkHBhKAAAwYAAAZz///uxDCd2Y",
        "hgBAkpwAUAAAA2AAACA////sNX///9hq////sNX//7DQAA==",
        "hgBAkpwATuAAA2AAACA////vkJ///98hP///vkJ//98fAA==",
    ),
}


def h264_parameters(width: int, height: int) -> bytes:
    """Sequence and picture parameter sets (7.3.2.1 and 7.3.2.2): baseline profile, the full range of brightness."""
    vui = "00110110000000"
    size = _ue(width // 16 - 1) + _ue(height // 16 - 1)
    sequence = "".join([f"{66:08b}{0:08b}{40:08b}", _ue(0), _ue(0), _ue(2), _ue(0), "0", size, "1001", vui, "1"])
    picture = "".join([_ue(0), _ue(0), "00", 3 * _ue(0), "000", 3 * _ue(0), "100", "1"])
    return _unit(0x67, _bytes(sequence)) + _unit(0x68, _bytes(picture))


def _ue(value: int) -> str:
    """An exponential Golomb code."""
    digits = f"{value + 1:b}"
    return "0" * (len(digits) - 1) + digits


def _bytes(bits: str) -> bytes:
    bits += "0" * (-len(bits) % 8)
    return int(bits, 2).to_bytes(len(bits) // 8, "big")


def _unit(head: int, body: bytes) -> bytes:
    """A unit after its start code, with what looks like one in it told apart."""
    return b"\0\0\0\1" + bytes([head]) + re.sub(rb"\0\0(?=[\0-\3])", b"\0\0\3", body)


def ros2_schema(kind: str) -> tuple[str, bytes]:
    return kind, definition_text(kind).encode()


def _to_ros1(kind: str, data: bytes) -> bytes:
    return bytes(ROS2.cdr_to_ros1(data, kind))


def _tree(message: Any) -> Any:
    """A message as JSON's objects."""
    if hasattr(message, "__msgtype__"):
        return {name: _tree(getattr(message, name)) for name, _ in ROS2.fielddefs[message.__msgtype__][1]}
    if isinstance(message, np.ndarray):
        return base64.b64encode(message.tobytes()).decode() if message.dtype == np.uint8 else message.tolist()
    return [_tree(one) for one in message] if isinstance(message, list) else message


def _describe(kind: str, file: Any, done: set[str]) -> None:
    """Add the type, and those it holds, to a file of descriptors."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field

    if kind in done:
        return
    done.add(kind)
    described = file.message_type.add(name=kind.rpartition("/")[2])
    scalars = {"float64": Field.TYPE_DOUBLE, "float32": Field.TYPE_FLOAT, "string": Field.TYPE_STRING}
    for number, (name, (node, what)) in enumerate(ROS2.fielddefs[kind][1], start=1):
        repeated = int(node) > 2
        if repeated:
            node, what = what[0]
        field = described.field.add(name=name, number=number)
        field.label = Field.LABEL_REPEATED if repeated else Field.LABEL_OPTIONAL
        if int(node) == 2:
            field.type, field.type_name = Field.TYPE_MESSAGE, f".ros.{what.rpartition('/')[2]}"
            _describe(what, file, done)
        elif repeated and what[0] == "uint8":
            field.type, field.label = Field.TYPE_BYTES, Field.LABEL_OPTIONAL
        else:
            field.type = scalars.get(what[0], Field.TYPE_INT64)


def _fill(target: Any, message: Any) -> None:
    for name, _ in ROS2.fielddefs[message.__msgtype__][1]:
        value = getattr(message, name)
        if hasattr(value, "__msgtype__"):
            getattr(target, name).SetInParent()
            _fill(getattr(target, name), value)
        elif isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
            for one in value:
                _fill(getattr(target, name).add(), one)
        elif isinstance(value, np.ndarray) and value.dtype == np.uint8:
            setattr(target, name, value.tobytes())
        elif isinstance(value, (list, np.ndarray)):
            getattr(target, name).extend(list(value))
        else:
            setattr(target, name, int(value) if isinstance(value, bool) else value)


MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3

# What writes a recording anew, from its path into a folder.
FORMS: dict[str, Callable[[Path, Path], Path]] = {
    "rosbag2 sqlite": lambda s, f: rosbag2(s, f / "bag", SQLITE),
    "rosbag2 mcap": lambda s, f: rosbag2(s, f / "bag", MCAP),
    "rosbag2 mcap, compressed by message": lambda s, f: rosbag2(s, f / "bag", MCAP, CompressionMode.MESSAGE),
    "rosbag2 sqlite, compressed by message": lambda s, f: rosbag2(s, f / "bag", SQLITE, CompressionMode.MESSAGE),
    "rosbag2 sqlite, compressed by file": lambda s, f: rosbag2(s, f / "bag", SQLITE, CompressionMode.FILE),
    "rosbag2 split": lambda s, f: split(s, f / "bag"),
    "db3": lambda s, f: rosbag2(s, f / "bag", SQLITE) / "bag.db3",
    "db3.zstd": lambda s, f: zstd(rosbag2(s, f / "bag", SQLITE) / "bag.db3", f / "b.db3.zstd"),
    "mcap.zstd": lambda s, f: zstd(s, f / "s.mcap.zstd"),
    "pattern": lambda s, f: split(s, f / "bag") / "bag_*.mcap",
    "ros 1": lambda s, f: rosbag1(s, f / "s.bag"),
    "ros 1 lz4": lambda s, f: rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.LZ4),
    "ros 1 bz2": lambda s, f: rosbag1(s, f / "s.bag", Ros1Writer.CompressionFormat.BZ2),
    "mcap ros 1": lambda s, f: mcap_ros1(s, f / "r.mcap"),
    "mcap IDL": lambda s, f: mcap_idl(s, f / "i.mcap"),
    "mcap json": lambda s, f: mcap_json(s, f / "j.mcap"),
    "mcap protobuf": lambda s, f: mcap_protobuf(s, f / "p.mcap"),
}


def video_file(path: Path, count: int) -> None:
    """MPEG-4 in .mp4 or motion JPEG in .avi: pictures of 48 x 32 that become brighter, 20, 50, 80, ..."""
    import cv2

    codec = {".mp4": "mp4v", ".avi": "MJPG"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, (48, 32))
    for i in range(count):
        writer.write(np.full((32, 48, 3), 30 * i + 20, np.uint8))
    writer.release()
