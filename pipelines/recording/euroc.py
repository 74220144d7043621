"""Data sets in the form of EuRoC (ASL), as TUM-VI has it too: a folder a sensor, with data.csv and sensor.yaml.

Of the table's header the names count: w_ and a_ are an IMU, p_ and q_ poses, filename pictures. The topic of a sensor
is the name of its folder, `/imu0`; of a camera `/cam0/image` and `/cam0/camera_info`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, open_binary, read_bytes
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer
from alidade.pipelines.recording.camera_files import camera
from alidade.pipelines.recording.table_values import nanoseconds
from alidade.pipelines.recording.tables import numbers, read_columns, table_form


def find_euroc(path: Path) -> Path | None:
    """Return the folder that contains the sensors' folders, `path` or its `mav0`; None if there is no such data set."""
    return next((root for root in (path, path / "mav0") if any(root.glob("*/data.csv"))), None)


def read_euroc(path: Path, root: Path) -> ArrayContainer:
    """Read all sensors of a EuRoC data set into a container."""
    topics: dict[str, series.Topic] = {}
    assumptions = []
    tables = sorted(root.glob("*/data.csv"))
    for table in tables:
        sensor = _sensor(table.with_name("sensor.yaml"))
        found = _topics(table, f"/{table.parent.name}", sensor)
        topics |= found
        if not found:
            assumptions.append(f"{table.parent.name} is not used: columns {', '.join(table_form(table, table).names)}")
    return ArrayContainer(path, topics, assumptions, tables[0], tables)


def _topics(table: Path, name: str, sensor: Mapping[str, Any]) -> dict[str, series.Topic]:
    """Return the topics made of one sensor's table, by topic name."""
    layout = table_form(table, table)
    names = layout.names
    columns, _ = read_columns(layout, names)
    t_ns = nanoseconds(table, columns[names[0]], "ns")

    def chosen(letter: str) -> list[str]:
        """Return the names of the columns of a quantity (w, a, q or p), in the order of the axes."""
        return [one for one in names[1:] if one.split(" ")[0].startswith(f"{letter}_")]

    def of(letter: str) -> NDArray[np.float64]:
        return numbers(table, columns, chosen(letter))

    if len(chosen("w")) == len(chosen("a")) == 3:
        gyro_var, accel_var = (
            (sensor.get(key, 0.0) ** 2) * sensor.get("rate_hz", 0.0)
            for key in ("gyroscope_noise_density", "accelerometer_noise_density")
        )
        imu = series.ImuSeries(
            t_ns, of("w"), of("a"), gyro_cov=gyro_var * np.eye(3), accel_cov=accel_var * np.eye(3), frame_id=name
        )
        return {name: imu}
    if len(chosen("q")) == 4:
        return {name: series.PoseSeries(t_ns, of("q"), of("p") if len(chosen("p")) == 3 else np.zeros(3))}
    if "filename" in names:
        files = [table.parent / "data" / Path(file).name for file in columns["filename"].tolist()]
        form = files[0].suffix.lstrip(".") if files else ""
        found: dict[str, series.Topic] = {f"{name}/image": series.ImageSeries(t_ns, _Pictures(files), form)}
        if sensor:
            found[f"{name}/camera_info"] = _camera_info(table, int(t_ns[0]) if len(t_ns) else 0, sensor)
        return found
    return {}


class _Pictures:
    """Iterable of the contents of picture files, each read in its turn, anew on each iteration."""

    def __init__(self, files: list[Path]) -> None:
        self._files = files

    def __iter__(self) -> Iterator[bytes]:
        for file in self._files:
            with open_binary(file) as stream:
                yield stream.read()


def _camera_info(table: Path, t_ns: int, sensor: Mapping[str, Any]) -> series.CameraInfo:
    try:
        return camera(sensor, table.parent.name, t_ns)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{table.with_name('sensor.yaml')}: no usable camera ({error})") from error


def _sensor(path: Path) -> dict[str, Any]:
    """Content of a sensor.yaml; empty if there is none."""
    if not path.is_file() or path.stat().st_size > MAX_YAML_BYTES:
        return {}
    text = read_bytes(path, MAX_YAML_BYTES).decode(errors="replace").removeprefix("%YAML:1.0\n")
    content = load_yaml(text, str(path))
    if not isinstance(content, dict):
        return {}
    for key in ("gyroscope_noise_density", "accelerometer_noise_density", "rate_hz"):
        if key in content and not isinstance(content[key], (int, float)):
            raise InputError(f"{path}: {key} is no number")
    return content
