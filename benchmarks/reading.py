"""How fast recordings are read and written, against rosbags' own reader in the same run.

python -m benchmarks.reading [messages]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from pipelines.sessions import series
from pipelines.sessions.container import McapFile
from pipelines.sessions.reading import open_recording
from pipelines.sessions.writing import write_session

TOPIC = "/imu"
HOUR = 3_600_000  # messages of an hour at 1 kHz


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


def decompress(path: Path) -> int:
    """Chunks decompressed and checked, messages located, nothing decoded."""
    file = McapFile(path)
    return sum(len(rows.start) for rows in file.rows(set(file.channels)))


def seconds(work: Callable[[], Any], repeat: int) -> float:
    """The shortest of several runs."""
    best = np.inf
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return float(best)


def measure_rates(path: Path, count: int) -> dict[str, float]:
    """Messages per second of writing, reading, rosbags' reading and decompression of one file."""
    imu = make_imu(count)
    rates = {"write": count / seconds(lambda: write_session(path, {TOPIC: imu}), 3)}
    for ours, theirs in zip(read_ours(path), read_rosbags(path), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    rates["read"] = count / seconds(lambda: read_ours(path), 3)
    rates["read by rosbags"] = count / seconds(lambda: read_rosbags(path), 1)
    rates["decompress only"] = count / seconds(lambda: decompress(path), 3)
    return rates


def measure_peak_mib(path: Path, work: str) -> float:
    """Peak memory of a process of its own that does nothing but `work`, a function of this module, on the file."""
    code = f"from benchmarks.reading import *; {work}(Path({str(path)!r})); print(peak_mib())"
    return float(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout)


def peak_mib() -> float:
    """High-water mark of this process; getrusage would give the parent's, if that was larger."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))


def import_only(path: Path) -> None:
    """The yardstick of memory."""


def main(count: int = 200_000) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "imu.mcap"
        rates = measure_rates(path, count)
        for name, rate in rates.items():
            print(f"{name:16s} {rate / 1e3:8.0f} thousand Imu/s")
        print(f"reading is {rates['read'] / rates['read by rosbags']:.1f} times rosbags' (10 wanted)")
        print(f"reading is {rates['read'] / rates['decompress only']:.2f} of decompression alone")
        write_session(path, {TOPIC: make_imu(HOUR)})
        base, peak = (measure_peak_mib(path, work) for work in ("import_only", "read_ours"))
        print(
            f"peak memory of {HOUR / 1e6:.1f} million Imu: {peak:.0f} MiB (1024 wanted), {base:.0f} MiB of it imports"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
