"""ArduPilot logs (.bin, DataFlash), indexed with pymavlink.

Axes stay those of the log: forward, right, down. Of ATT the world alone is turned from North-East-Down to
East-North-Up, as ROS has it. Times are those since the start of the autopilot, put into Unix time by the fixes.
Columns and their units: ArduPilot's LogStructure.h of AP_InertialSensor, AP_Compass, AP_AHRS and AP_GPS.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer
from alidade.pipelines.recording.container import byte_windows
from alidade.pipelines.recording.table_topics import of_yaw_pitch_roll
from alidade.pipelines.recording.ulog import ENU_FROM_NED, Columns, columns, log_container

# Messages: their kind and the number of the sensor.
Kind = tuple[str, int]

_MILLIGAUSS = 1e-7
# Start of GPS time less its leap seconds since 2017, Unix us, and a week, us.
_GPS_EPOCH_US, _WEEK_US = 315_964_782_000_000, 604_800_000_000
# Bytes of every message before its columns: two marks and the number of its kind.
_HEAD = 3
# Bytes at the end of a log that need not be messages: logs are written in pages (pymavlink's own limit).
_TAIL = 528
_CORRECTED = "readings are as the autopilot corrected them: a calibration comes on top of its own"


def read_dataflash(path: Path, data: Path) -> ArrayContainer:
    """Read sensors, attitudes and fixes of an ArduPilot log as topics named as its messages, `/IMU`.

    Further instances of a sensor are `/IMU/1` and so on, an IMU's temperature `/IMU/temperature`. Raises InputError
    when pymavlink is not installed or the file is damaged beyond reading.
    """
    try:
        from pymavlink.DFReader import FORMAT_TO_STRUCT, DFReader_binary
    except ImportError as error:
        raise InputError(f"{path}: an ArduPilot log; to read it: pip install 'alidade[ardupilot]'") from error

    class Index(DFReader_binary):  # type: ignore[misc]
        """Index of a log's formats and messages; has no clock, for which pymavlink would read every message."""

        def init_clock(self) -> None:
            return

        def init_arrays_fast(self, progress_callback: Any = None) -> None:
            """Index the messages with pymavlink's Python code; its C code prints what is damaged."""
            self.init_arrays(progress_callback)

    content = np.fromfile(data, np.uint8)
    try:
        said = io.StringIO()
        with redirect_stdout(said), redirect_stderr(said), closing(Index(data)) as log:
            found = dict(_messages(log, FORMAT_TO_STRUCT, content))
            is_damaged = _is_damaged(log, len(content))
    except Exception as error:  # a parser on bytes that may be anything
        why = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: an ArduPilot log that cannot be read ({why})") from error
    try:
        offset = _unix_offset(found)
        topics = dict(_topics(found, offset))
    except KeyError as error:
        raise InputError(f"{path}: an ArduPilot log without the columns of its messages ({error})") from error
    return log_container(path, data, topics, [_CORRECTED], offset, is_damaged)


def _is_damaged(log: Any, size: int) -> bool:
    """Whether bytes that are no messages lie between the messages of a log, or more than _TAIL of them at its end."""
    there = [(log.offsets[number], form.len) for number, form in log.formats.items() if log.offsets[number]]
    end = max((at[-1] + length for at, length in there), default=0)
    return end > sum(len(at) * length for at, length in there) or size - end > _TAIL


def _messages(log: Any, codes: Mapping[str, Any], content: NDArray[np.uint8]) -> Iterator[tuple[Kind, Columns]]:
    """Yield the columns of the messages of each kind and instance, scaled to units as their format states.

    Logs before 2020 number instances in the name of the kind, `IMU2`. Raises ValueError and KeyError for formats that
    do not fit their messages.
    """
    for number, form in log.formats.items():
        name = form.name.rstrip("123")
        if name not in _READERS:
            continue
        types = [f"<{codes[code][0]}" for code in form.msg_fmts]
        dtype = np.dtype([("", f"V{_HEAD}"), *zip(form.columns, types, strict=True)])
        if dtype.itemsize != form.len:
            raise ValueError(f"the columns of {form.name} do not fill its messages")
        at = np.asarray(log.offsets[number], dtype=np.int64)
        read = byte_windows(content, form.len)[at[at + form.len <= len(content)]].view(dtype)
        # Division by the whole number of counts per unit is exact to the last bit.
        counts = (1 if scale is None else round(1.0 / scale) for scale in form.msg_mults)
        each = zip(form.columns, counts, strict=True)
        data = {column: read[column] if per_unit == 1 else read[column] / per_unit for column, per_unit in each}
        which = data.get("I", np.full(len(read), int(form.name.removeprefix(name) or 1) - 1))
        for instance in np.unique(which).tolist():
            yield (name, instance), {column: values[which == instance] for column, values in data.items()}


def _topics(found: Mapping[Kind, Columns], offset: int) -> Iterator[tuple[str, series.Topic]]:
    """Yield topics by name from the log's messages, with an IMU's temperature where its messages have one."""
    for (kind, instance), data in found.items():
        name = f"/{kind}" + (f"/{instance}" if instance else "")
        yield name, _READERS[kind](data, offset)
        if kind == "IMU" and "T" in data:
            yield f"{name}/temperature", series.TemperatureSeries(_stamps(data, offset), data["T"].astype(float))


def _unix_offset(found: Mapping[Kind, Columns]) -> int:
    """Return the offset from log time to Unix time, us, median over all GNSS fixes; 0 if none states the time."""
    offsets = [np.zeros(0, np.int64)]
    for data in (data for (kind, _), data in found.items() if kind == "GPS"):
        week, ms, logged = (data[name].astype(np.int64) for name in ("GWk", "GMS", "TimeUS"))
        offsets.append((_GPS_EPOCH_US + _WEEK_US * week + 1000 * ms - logged)[week > 0])
    known = np.concatenate(offsets)
    return int(np.median(known)) if len(known) else 0


def _stamps(data: Columns, offset: int) -> NDArray[np.int64]:
    """Return times of measurement, Unix ns; a compass logs the lower 32 bits of that time (column S)."""
    logged = data["TimeUS"].astype(np.int64)
    if np.any(data.get("S", 0)):
        logged = logged - (logged - data["S"].astype(np.int64)) % (1 << 32)
    return (data.get("SampleUS", logged).astype(np.int64) + offset) * 1000


def _imu(data: Columns, offset: int) -> series.ImuSeries:
    rates, forces = columns(data, "GyrX", "GyrY", "GyrZ"), columns(data, "AccX", "AccY", "AccZ")
    return series.ImuSeries(_stamps(data, offset), rates, forces)


def _vector(kind: str, data: Columns, offset: int) -> series.VectorSeries:
    return series.VectorSeries(_stamps(data, offset), columns(data, *(f"{kind}{axis}" for axis in "XYZ")))


def _magnetic(data: Columns, offset: int) -> series.MagneticSeries:
    """Return the magnetometer's readings, T, each once: the log repeats a reading until the next one."""
    t_ns = _stamps(data, offset)
    new = np.diff(t_ns, prepend=t_ns[0] - 1) != 0
    return series.MagneticSeries(t_ns[new], _MILLIGAUSS * columns(data, "MagX", "MagY", "MagZ")[new])


def _attitude(data: Columns, offset: int) -> series.QuaternionSeries:
    """Return attitudes in ENU: yaw about down, then pitch about right, then roll about forward."""
    turned = of_yaw_pitch_roll(np.radians(columns(data, "Yaw", "Pitch", "Roll")))
    return series.QuaternionSeries(_stamps(data, offset), so3.multiply(ENU_FROM_NED, turned))


def _fix(data: Columns, offset: int) -> series.FixSeries:
    """Return GNSS fixes with the height above mean sea level, m."""
    status = np.where(data["Status"] >= 3, 0.0, -1.0)
    return series.FixSeries(_stamps(data, offset), data["Lat"], data["Lng"], data["Alt"], status=status)


_READERS: dict[str, Callable[[Columns, int], series.Topic]] = {
    "IMU": _imu,
    "GYR": partial(_vector, "Gyr"),
    "ACC": partial(_vector, "Acc"),
    "MAG": _magnetic,
    "ATT": _attitude,
    "GPS": _fix,
}
