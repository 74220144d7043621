"""A recording of the cube method as arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.data import Array, CubeData
from alidade.pipelines.methods.cube.parameters import TEMPERATURE
from alidade.pipelines.methods.cube.sightings import read_camera, read_sightings
from alidade.pipelines.methods.cube.topics import REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS, CubeConfig
from alidade.pipelines.methods.cube.units import Readings, check_units
from alidade.pipelines.methods.place import read_place
from alidade.pipelines.recording.checks import (
    SLOWEST_GYRO_S,
    check_overlap,
)
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.streams import StreamReader
from alidade.pipelines.recording.topics import IMAGE, IMU, MAG, wanted
from alidade.pipelines.settings import Config

# rad^2; no reference is as good.
_LEAST_VARIANCE = 1e-11

_NUMBERS = (IMU, MAG, REFERENCE_IMU, REFERENCE_FIX)


def read_cube(recording: Recording, config: Config) -> CubeData:
    """Read and check a cube session; without tag detections they are taken from the pictures of the static poses.

    What the recording holds decides what there is: magnetometer, reference and camera may each be missing.

    Raises InputError when a topic is unusable (alidade.pipelines.recording.checks) or in an implausible unit, when the
    topics have no time in common, and with pictures when there is no static pose or no tag in any.
    """
    reader = StreamReader(recording, dict.fromkeys(map(config.topic, _NUMBERS), ()))
    name = config.topic(IMU)
    imu = reader.samples(name, recording.imu(name), "gyro", "accel", least=3, slowest_s=SLOWEST_GYRO_S)
    raw = config.section(CubeConfig).raw
    sensors = [
        Readings(name, imu.t, imu.series.accel, raw.accel),
        Readings(name, imu.t, imu.series.gyro, raw.gyro),
    ]
    gyro_density, accel_density = reader.density(name, "gyro", imu), reader.density(name, "accel", imu)
    spans = {name: imu.t}

    mag = mag_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        mag = reader.magnetic_field(name)
        mag_density = reader.density(name, "mag", mag)
        sensors.append(Readings(name, mag.t, mag.series.field, raw.mag))
        spans[name] = mag.t
    check_units(*sensors)

    reference_t = reference_wxyz = reference_cov = None
    if wanted(recording, config, REFERENCE_IMU):
        reference_t, reference_wxyz, reference_cov = _reference(reader, config.topic(REFERENCE_IMU))
        spans[config.topic(REFERENCE_IMU)] = reference_t
    check_overlap(spans)

    latitude, longitude, height = read_place(recording, config, REFERENCE_FIX)
    data = CubeData(
        epoch_ns=reader.epoch_ns,
        imu_t=imu.t,
        gyro=imu.series.gyro,
        accel=imu.series.accel,
        mag_t=mag and mag.t,
        mag=mag and mag.series.field,
        reference_t=reference_t,
        reference_wxyz=reference_wxyz,
        reference_cov=reference_cov,
        latitude=latitude,
        longitude=longitude,
        height=height,
        camera=read_camera(recording, config) if _has_camera(recording, config) else None,
        gyro_density=gyro_density,
        accel_density=accel_density,
        mag_density=mag_density,
        dropped=reader.dropped,
        temperature=temperature.read(reader, config, tuple(TEMPERATURE.values()), imu.t),
    )
    if data.camera is None:
        return data
    whole = replace(data, sightings=read_sightings(recording, data, config, reader.dropped))
    whole.computed.update(data.computed)  # the static intervals do not depend on what the camera saw
    return whole


def _has_camera(recording: Recording, config: Config) -> bool:
    return any(wanted(recording, config, topic) for topic in (IMAGE, TAG_DETECTIONS))


def _reference(reader: StreamReader, topic: str) -> tuple[Array, Array, Array | None]:
    t, wxyz, cov = reader.attitude(topic, _LEAST_VARIANCE, least=1)
    known = (np.linalg.eigvalsh(0.5 * (cov + cov.swapaxes(1, 2)))[:, 0] > 0.0).all()
    return t, wxyz, cov if known else None
