"""How fast recordings are read, against rosbags' and mcap-ros2-support's readers and decompression alone."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_file import McapFile
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from benchmarks.measure import Ratio, costs

TOPIC = "/imu"
HOUR = 3_600_000  # messages of an hour at 1 kHz
FEW = 50_000  # messages for the readers that take them one by one


def make_imu(count: int) -> series.ImuSeries:
    """Noise in gyro and accelerometer at 1 kHz, constant covariances, as a driver sends it."""
    rng = np.random.default_rng(1)
    t_ns = 1_800_000_000_000_000_000 + 1_000_000 * np.arange(count)
    cov = 1e-6 * np.eye(3)
    return series.ImuSeries(t_ns, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), gyro_cov=cov, accel_cov=cov)


def read_ours(path: Path) -> tuple[Any, Any]:
    imu = open_recording(path).imu(TOPIC)
    return imu.t_ns, imu.gyro


def read_rosbags(path: Path) -> tuple[Any, Any]:
    t_ns, gyro = [], []
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages([c for c in reader.connections if c.topic == TOPIC]):
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp, w = message.header.stamp, message.angular_velocity
            t_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
            gyro.append((w.x, w.y, w.z))
    return np.array(t_ns), np.array(gyro)


def read_mcap_ros2(path: Path) -> tuple[Any, Any]:
    t_ns, gyro = [], []
    for message in read_ros2_messages(str(path), topics=[TOPIC]):
        stamp, w = message.ros_msg.header.stamp, message.ros_msg.angular_velocity
        t_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        gyro.append((w.x, w.y, w.z))
    return np.array(t_ns), np.array(gyro)


def decompress(path: Path) -> int:
    """Chunks decompressed and checked, messages located, nothing decoded."""
    file = McapFile(path)
    return sum(len(block.start) for block in file.blocks(set(file.channels)))


def run() -> Iterator[Ratio]:
    """Against each peer by time per message, and the memory for an hour."""
    with tempfile.TemporaryDirectory() as folder:
        few, hour = Path(folder) / "few.mcap", Path(folder) / "hour.mcap"
        write_session(few, {TOPIC: make_imu(FEW)})
        write_session(hour, {TOPIC: make_imu(HOUR)})
        for name, whose, read in (
            ("rosbags", "rosbags'", read_rosbags),
            ("mcap_ros2", "mcap-ros2-support's", read_mcap_ros2),
        ):
            for ours, theirs in zip(read_ours(few), read(few), strict=True):
                np.testing.assert_array_equal(ours, theirs)
            # As many messages as one of them takes, read by each.
            a, b = costs([partial(read_ours, few), partial(read, few)])
            compared = f"{whose} time over ours, {FEW:,} Imu"
            wanted = 10.0 if name == "rosbags" else None
            yield Ratio(f"reading.{name}", compared, b.seconds / a.seconds, "higher", wanted=wanted, ours=a, theirs=b)
        a, b = costs([partial(read_ours, hour), partial(decompress, hour)])
        yield Ratio(
            "reading.decompress",
            f"decompression's time over ours, {HOUR:,} Imu",
            b.seconds / a.seconds,
            "higher",
            wanted=0.6,
            ours=a,
            theirs=b,
        )
        yield Ratio(
            "reading.memory",
            f"peak, GiB, of reading {HOUR:,} Imu",
            (a.peak_mib or 0.0) / 1024.0,
            tolerance=0.1,
            wanted=1.0,
        )
