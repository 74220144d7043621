"""Random messages, as rosbags encodes them, in files of one topic."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.recording import open_recording

STORE = get_typestore(Stores.ROS2_HUMBLE)
T0 = 1_700_000_000_000_000_000
READERS: dict[type[series.Series], str] = {
    series.ImuSeries: "imu",
    series.MagneticSeries: "magnetic",
    series.VectorSeries: "vector",
    series.QuaternionSeries: "poses",
    series.PoseSeries: "poses",
    series.FixSeries: "fixes",
    series.TemperatureSeries: "temperature",
}
# Every type of message that becomes a series -> how a recording reads it.
FLAT = {kind: READERS[each] for each in series.Series.__subclasses__() for kind in (each.TYPE, *each.OTHERS)}
for _kind in FLAT.keys() - STORE.types.keys():
    STORE.register(get_types_from_msg(messages.definition_text(_kind), _kind))


OLD_TAGS = """std_msgs/Header header
apriltag_msgs/AprilTagDetection[] detections
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 decision_margin
float64[2] centre
float64[8] corners
float64[9] homography
"""


POINT_TAGS = OLD_TAGS.replace("float64[2] centre", "geometry_msgs/Point centre").replace(
    "float64[8] corners", "geometry_msgs/Point[4] corners"
) + (f"{'=' * 80}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n")


def random_message(kind: str, rng: np.random.Generator, t_ns: int, frame_id: str, store: Any = STORE) -> Any:
    """A message of a type with every number random."""

    def value(desc: Any) -> Any:
        node, what = int(desc[0]), desc[1]
        if node == 2:
            return message(what)
        if node == 1:
            return frame_id if what[0] == "string" else number(what[0])
        (inner, name), count = what
        count = count if node == 3 else 3
        if int(inner) == 2:
            return [message(name) for _ in range(count)]
        return ["ab", "c", "defgh"][:count] if name[0] == "string" else rng.normal(size=count).astype(name[0])

    def number(name: str) -> Any:
        return float(rng.normal()) if name.startswith("float") else int(rng.integers(0, 2 if name == "bool" else 100))

    def message(name: str) -> Any:
        return store.types[name](**{field: value(desc) for field, desc in store.fielddefs[name][1]})

    made = message(kind)
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(t_ns, 10**9)
    return made


def write_raw(
    path: Path, topic: str, kind: str, text: str, data: list[bytes], log_ns: list[int], **options: Any
) -> Path:
    """A recording of ready CDR messages, made with the mcap package."""
    with path.open("wb") as stream:
        writer = Writer(stream, **{"compression": CompressionType.ZSTD, **options})
        writer.start("ros2")
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for one, log in zip(data, log_ns, strict=True):
            writer.add_message(channel, log, one, log)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def read_any(path: Path, kind: str) -> dict[str, Any]:
    recording = open_recording(path)
    read: Any = getattr(recording, FLAT[kind]) if kind in FLAT else partial(recording.joints, names=["defgh", "ab"])
    return dict(vars(read("/x")))
