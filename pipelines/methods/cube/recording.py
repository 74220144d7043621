"""A recording of the cube method as arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.data import Array, CubeData
from alidade.pipelines.methods.cube.parameters import TEMPERATURE
from alidade.pipelines.methods.cube.sightings import read_camera, read_sightings
from alidade.pipelines.methods.cube.topics import REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS, CubeConfig
from alidade.pipelines.methods.cube.units import Readings, check_units
from alidade.pipelines.methods.place import read_place
from alidade.pipelines.recording.checks import (
    LEAST_ACCEL,
    LEAST_GYRO,
    LEAST_MAG,
    SLOWEST_GYRO_S,
    check_overlap,
    clean,
    count,
    tracked,
    unit_quaternions,
)
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.placeholders import believed, density, measured_once
from alidade.pipelines.recording.recording import Recording
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
    dropped: dict[str, int] = {}
    epoch = recording.epoch_ns
    recording.read_together(dict.fromkeys(map(config.topic, _NUMBERS), ()))
    name = config.topic(IMU)
    imu = recording.imu(name)
    count(dropped, f"{name}: stamped by log time (kept)", imu.stamped_by_log)
    imu_t, keep = clean(name, imu.t_ns, epoch, np.hstack([imu.gyro, imu.accel]), dropped, 3, SLOWEST_GYRO_S)
    sound = np.intersect1d(
        drop_faults(name, imu_t, imu.gyro[keep], dropped, "rad/s"),
        drop_faults(name, imu_t, imu.accel[keep], dropped, "m/s^2"),
    )
    imu_t, keep = imu_t[sound], keep[sound]
    gyro, accel = imu.gyro[keep], imu.accel[keep]
    raw = config.section(CubeConfig).raw
    sensors = [Readings(name, imu_t, accel, raw.accel), Readings(name, imu_t, gyro, raw.gyro)]
    gyro_density = density(name, "gyro", imu_t, imu.gyro_cov[keep], LEAST_GYRO, dropped)
    accel_density = density(name, "accel", imu_t, imu.accel_cov[keep], LEAST_ACCEL, dropped)
    spans = {name: imu_t}

    mag_t = mag = mag_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        field_ = recording.magnetic(name)
        mag_t, keep = clean(name, field_.t_ns, epoch, field_.field, dropped)
        sound = drop_faults(name, mag_t, field_.field[keep], dropped, "T")
        sound = sound[measured_once(name, field_.field[keep[sound]], dropped)]
        mag_t, keep = mag_t[sound], keep[sound]
        mag, mag_density = field_.field[keep], density(name, "mag", mag_t, field_.field_cov[keep], LEAST_MAG, dropped)
        sensors.append(Readings(name, mag_t, mag, raw.mag))
        spans[name] = mag_t
    check_units(*sensors)

    reference_t = reference_wxyz = reference_cov = None
    if wanted(recording, config, REFERENCE_IMU):
        reference_t, reference_wxyz, reference_cov = _reference(recording, config, epoch, dropped)
        spans[config.topic(REFERENCE_IMU)] = reference_t
    check_overlap(spans)

    latitude, longitude, height = read_place(recording, config, REFERENCE_FIX)
    data = CubeData(
        epoch_ns=epoch,
        imu_t=imu_t,
        gyro=gyro,
        accel=accel,
        mag_t=mag_t,
        mag=mag,
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
        dropped=dropped,
        temperature=temperature.read(recording, config, tuple(TEMPERATURE.values()), imu_t, dropped),
    )
    if data.camera is None:
        return data
    whole = replace(data, sightings=read_sightings(recording, data, config, dropped))
    whole.computed.update(data.computed)  # the static intervals do not depend on what the camera saw
    return whole


def _has_camera(recording: Recording, config: Config) -> bool:
    return any(wanted(recording, config, topic) for topic in (IMAGE, TAG_DETECTIONS))


def _reference(
    recording: Recording, config: Config, epoch_ns: int, dropped: dict[str, int]
) -> tuple[Array, Array, Array | None]:
    topic = config.topic(REFERENCE_IMU)
    imu = recording.imu(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", imu.stamped_by_log)
    if (imu.wxyz_cov[:, 0, 0] < 0.0).all():
        raise InputError(
            f"topic {topic}: orientation_covariance starts with -1, so there is no attitude in it; the "
            "reference has to put out its attitude in East-North-Up"
        )
    given = tracked(topic, imu.wxyz, dropped)
    t, keep = clean(topic, imu.t_ns, epoch_ns, given, dropped, least=1)
    wxyz, cov = unit_quaternions(topic, t, given[keep]), imu.wxyz_cov[keep]
    cov = believed(topic, "attitude", cov, _LEAST_VARIANCE, dropped)
    known = (np.linalg.eigvalsh(0.5 * (cov + cov.swapaxes(1, 2)))[:, 0] > 0.0).all()
    return t, wxyz, cov if known else None
