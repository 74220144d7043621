"""A cube session into a recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.data import Array, CubeData, Sightings
from alidade.pipelines.methods.cube.topics import REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.recording.mcap_writer import attached, write_session
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, MAG

if TYPE_CHECKING:
    from alidade.pipelines.vision.camera import Camera


def write_cube(
    path: Path | str,
    data: CubeData,
    truth: Mapping[str, float] | None = None,
    config_yaml: str | None = None,
    pictures: Iterable[bytes] | None = None,
) -> None:
    """Write a cube session under the default topic names, with its truth and config as attachments.

    Stamps are rounded to ns. With pictures (JPEG files, one for each frame of the sightings, in their order) these are
    written instead of the detections. read_cube gives the same data back if the first sample is the one at t = 0.
    """
    epoch = data.epoch_ns

    def covariance(t: Array, density: float | None) -> Array:
        return (0.0 if density is None else density**2 / float(np.median(np.diff(t)))) * np.eye(3)

    topics: dict[str, series.Topic] = {
        IMU.name: series.ImuSeries(
            nanoseconds(data.imu_t, epoch),
            data.gyro,
            data.accel,
            gyro_cov=covariance(data.imu_t, data.gyro_density),
            accel_cov=covariance(data.imu_t, data.accel_density),
            frame_id="imu",
        )
    }
    if data.mag_t is not None and data.mag is not None:
        cov = covariance(data.mag_t, data.mag_density)
        topics[MAG.name] = series.MagneticSeries(
            nanoseconds(data.mag_t, epoch), data.mag, field_cov=cov, frame_id="imu"
        )
    if data.reference_t is not None and data.reference_wxyz is not None:
        n = len(data.reference_t)
        topics[REFERENCE_IMU.name] = series.ImuSeries(
            nanoseconds(data.reference_t, epoch),
            np.zeros((n, 3)),
            wxyz=data.reference_wxyz,
            wxyz_cov=np.zeros((3, 3)) if data.reference_cov is None else data.reference_cov,
            frame_id="reference",
        )
    start = np.array([epoch])
    if data.latitude is not None and data.longitude is not None:
        latitude, longitude = np.rad2deg([data.latitude, data.longitude])
        topics[REFERENCE_FIX.name] = series.FixSeries(
            start, np.array([latitude]), np.array([longitude]), np.array([data.height]), frame_id="reference"
        )
    if data.camera is not None and data.sightings is not None:
        topics[CAMERA_INFO.name] = _info_message(data.camera, epoch)
        topics |= _pictures_or_tags(data.sightings, epoch, pictures)
    topics |= temperature.topics(data.temperature, epoch)
    write_session(path, topics, attached(truth, config_yaml))


def _info_message(camera: Camera, epoch_ns: int) -> series.CameraInfo:
    return series.CameraInfo(
        epoch_ns,
        camera.width,
        camera.height,
        camera.distortion_model,
        camera.coefficients,
        camera.K,
        np.eye(3),
        np.hstack([camera.K, np.zeros((3, 1))]),
        frame_id="camera",
    )


def _pictures_or_tags(seen: Sightings, epoch_ns: int, pictures: Iterable[bytes] | None) -> dict[str, series.Topic]:
    t_ns = nanoseconds(seen.t, epoch_ns)
    if pictures is not None:
        return {IMAGE.name: series.ImageSeries(t_ns, pictures, format="jpeg", frame_id="camera")}
    m = len(seen.ids)
    zero = np.zeros(m, dtype=np.int64)
    found = series.DetectionSeries(
        t_ns, seen.frame, seen.ids, seen.corners, zero, np.zeros(m), np.full(m, "tag36h11"), frame_id="camera"
    )
    return {TAG_DETECTIONS.name: found}
