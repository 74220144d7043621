"""PX4 logs (.ulg), read with pyulog.

Axes stay those of the log: forward, right, down. Of vehicle_attitude the world alone is turned from North-East-Down to
East-North-Up, as ROS has it. Times are those since the start of the autopilot, put into Unix time by the first fix
that knows it.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer

# Columns of one topic of a log, by name.
Columns = Mapping[str, NDArray[Any]]

_GAUSS = 1e-4
# East-North-Up from North-East-Down, w, x, y, z: half a turn about the line between the first two axes.
ENU_FROM_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])


def read_ulog(path: Path, data: Path) -> ArrayContainer:
    """Read the sensors, attitudes and fixes of a PX4 log as topics with the log's names, `/sensor_combined`.

    Further instances of a sensor are `/sensor_gyro/1` and so on, a sensor's temperature `/sensor_gyro/temperature`.
    Raises InputError when pyulog is not installed or the file is damaged beyond reading.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise InputError(f"{path}: a PX4 log; to read it: pip install 'alidade[px4]'") from error
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(str(data), [*_READERS, *_CLOCKS, _STATUS])
    except Exception as error:  # a parser on bytes that may be anything
        raise InputError(f"{path}: a PX4 log that cannot be read ({' '.join(str(error).split())[:200]})") from error
    try:
        offset = _unix_offset(log.data_list)
        topics = {name: read for found in log.data_list for name, read in _topics(found, offset)}
    except (KeyError, ValueError, IndexError) as error:  # fields that are missing or have another size
        raise InputError(f"{path}: a PX4 log without the fields of its topics ({error})") from error
    assumptions = []
    dropped = sum(dropout.duration for dropout in log.dropouts)
    if dropped:
        assumptions.append(f"the logger says that it lost {dropped} ms of messages, {len(log.dropouts)} times")
    return log_container(path, data, topics, assumptions, offset, log.file_corruption)


def log_container(
    path: Path, data: Path, topics: Mapping[str, series.Topic], assumptions: list[str], offset: int, is_damaged: bool
) -> ArrayContainer:
    """Return the container of an autopilot's log; notes that its times are not Unix times if the offset is 0."""
    if not offset:
        assumptions.append("no fix says what time it was: times are those since the autopilot was switched on")
    container = ArrayContainer(path, topics, assumptions, data)
    if is_damaged:
        container.incomplete = ("the log is damaged; what could be read of it is used",)
    return container


def _topics(found: Any, offset: int) -> Iterator[tuple[str, series.Topic]]:
    """Yield topics by name from one topic of the log, with the sensor's temperature where there is one."""
    if len(found.data["timestamp"]) == 0:
        return
    name = f"/{found.name}" + (f"/{found.multi_id}" if found.multi_id else "")
    if found.name in _READERS:
        yield name, _READERS[found.name](found.data, offset)
    for column in _TEMPERATURES & found.data.keys():
        celsius = found.data[column].astype(float)
        known = np.isfinite(celsius)
        if known.any():
            yield f"{name}/{column}", series.TemperatureSeries(_stamps(found.data, offset)[known], celsius[known])


def _unix_offset(topics: list[Any]) -> int:
    """Offset from log time to Unix time, us; 0 without a GNSS fix."""
    for found in topics:
        utc = found.data.get("time_utc_usec", np.zeros(0)) if found.name in _CLOCKS else np.zeros(0)
        if utc.any():
            first = int(np.argmax(utc > 0))
            return int(utc[first]) - int(found.data["timestamp"][first])
    return 0


def _stamps(data: Columns, offset: int) -> NDArray[np.int64]:
    """Return times of measurement, Unix ns."""
    sampled = data.get("timestamp_sample")
    stamps = data["timestamp"] if sampled is None or not np.any(sampled) else sampled
    return (stamps.astype(np.int64) + offset) * 1000


def columns(data: Columns, *names: str) -> Array:
    """Return named columns of messages side by side, (n, len(names))."""
    return np.stack([data[name].astype(float) for name in names], axis=1)


def _indexed(data: Columns, name: str, count: int) -> Array:
    return columns(data, *(f"{name}[{i}]" for i in range(count)))


def _sensor_combined(data: Columns, offset: int) -> series.ImuSeries:
    gyro, accel = _indexed(data, "gyro_rad", 3), _indexed(data, "accelerometer_m_s2", 3)
    return series.ImuSeries(_stamps(data, offset), gyro, accel)


def _vehicle_imu(data: Columns, offset: int) -> series.ImuSeries:
    """Return mean rates and accelerations over each integration interval, stamped at its middle."""
    turned, moved = _indexed(data, "delta_angle", 3), _indexed(data, "delta_velocity", 3)
    spans = [data[name] for name in ("delta_angle_dt", "delta_velocity_dt")]
    turning, moving = (span * (1e-6 if span.dtype.kind in "iu" else 1.0) for span in spans)
    middle = _stamps(data, offset) - np.rint(5e8 * turning).astype(np.int64)
    return series.ImuSeries(middle, turned / turning[:, None], moved / moving[:, None])


def _vector(data: Columns, offset: int) -> series.VectorSeries:
    return series.VectorSeries(_stamps(data, offset), columns(data, "x", "y", "z"))


def _fifo(data: Columns, offset: int) -> series.VectorSeries:
    """Return the readings of a sensor's FIFO, `samples` in a message, the last of which was taken at the stamp."""
    most = sum(1 for name in data if name.startswith("x["))
    raw = np.stack([_indexed(data, axis, most) for axis in "xyz"], axis=2) * data["scale"].astype(float)[:, None, None]
    samples = data["samples"].astype(int)[:, None]
    back = np.maximum(samples - 1 - np.arange(most), 0) * data["dt"].astype(float)[:, None]
    t_ns = _stamps(data, offset)[:, None] - np.rint(1000.0 * back).astype(np.int64)
    there = np.arange(most) < samples
    return series.VectorSeries(t_ns[there], raw[there])


def _magnetic(data: Columns, offset: int) -> series.MagneticSeries:
    field = columns(data, "x", "y", "z") if "x" in data else _indexed(data, "magnetometer_ga", 3)
    return series.MagneticSeries(_stamps(data, offset), _GAUSS * field)


def _attitude(data: Columns, offset: int) -> series.QuaternionSeries:
    return series.QuaternionSeries(_stamps(data, offset), so3.multiply(ENU_FROM_NED, _indexed(data, "q", 4)))


def _odometry(data: Columns, offset: int) -> series.PoseSeries:
    position = _indexed(data, "position", 3) if "position[0]" in data else columns(data, "x", "y", "z")
    return series.PoseSeries(_stamps(data, offset), _indexed(data, "q", 4), position)


def _fix(data: Columns, offset: int) -> series.FixSeries:
    degrees = "latitude_deg" in data
    latitude, longitude = (
        (data["latitude_deg"], data["longitude_deg"]) if degrees else (1e-7 * data["lat"], 1e-7 * data["lon"])
    )
    height = data["altitude_ellipsoid_m"] if degrees else 1e-3 * data.get("alt_ellipsoid", data["alt"])
    status = np.where(data["fix_type"] >= 3, 0.0, -1.0)
    return series.FixSeries(_stamps(data, offset), latitude, longitude, height, status=status)


_READERS: dict[str, Callable[[Columns, int], series.Topic]] = {
    "sensor_combined": _sensor_combined,
    "vehicle_imu": _vehicle_imu,
    "sensor_gyro": _vector,
    "sensor_accel": _vector,
    "sensor_gyro_fifo": _fifo,
    "sensor_accel_fifo": _fifo,
    "sensor_mag": _magnetic,
    "vehicle_magnetometer": _magnetic,
    "vehicle_attitude": _attitude,
    "vehicle_visual_odometry": _odometry,
    "vehicle_mocap_odometry": _odometry,
    "vehicle_gps_position": _fix,
    "sensor_gps": _fix,
}
# What drivers say of sensors once a second, their temperatures among it, and how columns with temperatures are called.
_STATUS = "vehicle_imu_status"
_TEMPERATURES = {"temperature", "temperature_gyro", "temperature_accel"}
# Topics that know what time it is.
_CLOCKS = ("vehicle_gps_position", "sensor_gps")
