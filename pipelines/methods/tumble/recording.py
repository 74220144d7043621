"""A recording of a tumbled device as arrays, and back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.assumptions import Assumption, temperature_assumption
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.place import read_place
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import (
    LEAST_ACCEL,
    LEAST_GYRO,
    LEAST_MAG,
    check_overlap,
    clean,
    count,
    nanoseconds,
    too_fast,
)
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.placeholders import density, is_there, measured_once
from alidade.pipelines.recording.plausibility import GRAVITY_REMOVED, lacks_gravity
from alidade.pipelines.recording.reading import Recording
from alidade.pipelines.recording.shapes import Numbers, Vectors
from alidade.pipelines.recording.temperature import Temperature
from alidade.pipelines.recording.topics import FIX, IMU, MAG, wanted
from alidade.pipelines.recording.writing import attached, write_session
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.simulated import Simulated

Array = NDArray[np.float64]

# Why a gyro is left out.
NO_RATE = "gyro beyond what rad/s can be, not used"

# What a temperature does to the offsets of consumer sensors, one sigma.
SLOPES = GYRO_SLOPE, ACCEL_SLOPE = (
    temperature_assumption("gyro", "rad/s", 1e-4),
    temperature_assumption("accel", "m/s^2", 1e-2),
)
# Three of 1e-4 of what is felt at 1 g: what consumer accelerometers read beside it, along each axis.
ACCEL_SQUARE = Assumption(tuple(f"accel_square_{i}" for i in "123"), "s^2/m", "accel", "square", 3e-5)


@dataclass(frozen=True, eq=False)
class TumbleData:
    """What was measured. Times are s from epoch_ns (Unix ns), strictly increasing.

    mag_t (N,), mag (N, 3): T, or counts; accel_t (M,), accel (M, 3): m/s^2, or counts; None for a sensor that there is
    not, but one there is. gyro_t (L,), gyro (L, 3): rad/s, where there is one beside a magnetometer. mag_density,
    accel_density, gyro_density: from the covariances of the messages, in the unit recorded per sqrt(Hz), None if they
    have none. latitude, longitude, rad, height, m: None if unknown. dropped: reason -> messages. temperature: of gyro
    and accelerometer, None where nobody measures it.
    """

    epoch_ns: int
    mag_t: Numbers | None = None
    mag: Vectors | None = None
    accel_t: Numbers | None = None
    accel: Vectors | None = None
    mag_density: float | None = None
    accel_density: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    height: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    gyro_t: Numbers | None = None
    gyro: Vectors | None = None
    gyro_density: float | None = None
    temperature: Temperature | None = None


def read_tumble(recording: Recording, config: Config) -> TumbleData:
    """Read and check magnetometer and accelerometer, one of which may be missing.

    Raises InputError when both are, when a topic is unusable, and when they have no time in common.
    """
    dropped: dict[str, int] = {}
    epoch = recording.epoch_ns
    recording.read_together(dict.fromkeys(map(config.topic, (MAG, IMU, FIX)), ()))
    spans = {}
    mag_t = mag = mag_density = accel_t = accel = accel_density = None
    gyro_t = gyro = gyro_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        measured = recording.magnetic(name)
        count(dropped, f"{name}: stamped by log time (kept)", measured.stamped_by_log)
        mag_t, keep = clean(name, measured.t_ns, epoch, measured.field, dropped)
        sound = drop_faults(name, mag_t, measured.field[keep], dropped, "T")
        sound = sound[measured_once(name, measured.field[keep[sound]], dropped)]
        mag_t, keep = mag_t[sound], keep[sound]
        mag, mag_density = (
            measured.field[keep],
            density(name, "mag", mag_t, measured.field_cov[keep], LEAST_MAG, dropped),
        )
        spans[name] = mag_t
    name = config.topic(IMU)
    if wanted(recording, config, IMU):
        imu = recording.imu(name)
        if is_there("accel", imu.accel, imu.accel_cov):
            count(dropped, f"{name}: stamped by log time (kept)", imu.stamped_by_log)
            accel_t, keep = clean(name, imu.t_ns, epoch, imu.accel, dropped)
            sound = drop_faults(name, accel_t, imu.accel[keep], dropped, "m/s^2")
            accel_t, keep = accel_t[sound], keep[sound]
            _check_gravity(name, imu.accel[keep])
            accel, accel_density = (
                imu.accel[keep],
                density(name, "accel", accel_t, imu.accel_cov[keep], LEAST_ACCEL, dropped),
            )
            spans[name] = accel_t
        if mag is not None:
            gyro_t, gyro, gyro_density = _gyro(name, imu, epoch, dropped)
    if not spans:
        raise InputError(
            f"neither {config.topic(MAG)} (MagneticField) nor an accelerometer in {config.topic(IMU)} (Imu); "
            f"{recording.there()}"
        )
    check_overlap(spans)
    latitude, longitude, height = read_place(recording, config, FIX)
    imu_t = gyro_t if accel_t is None else accel_t
    warming = None if imu_t is None else temperature.read(recording, config, SLOPES, imu_t, dropped)
    return TumbleData(
        epoch_ns=epoch,
        mag_t=mag_t,
        mag=mag,
        accel_t=accel_t,
        accel=accel,
        mag_density=mag_density,
        accel_density=accel_density,
        latitude=latitude,
        longitude=longitude,
        height=height,
        dropped=dropped,
        gyro_t=gyro_t,
        gyro=gyro,
        gyro_density=gyro_density,
        temperature=warming,
    )


def _check_gravity(topic: str, accel: Array) -> None:
    """Raise InputError where gravity, which calibrates an accelerometer, is not in its readings."""
    if lacks_gravity(np.linalg.norm(accel, axis=1)):
        raise InputError(f"topic {topic}: {GRAVITY_REMOVED}")


def _gyro(
    topic: str, imu: series.ImuSeries, epoch: int, dropped: dict[str, int]
) -> tuple[Array | None, Array | None, float | None]:
    """Times, rates and density; None where there is none, or one that is not in rad/s.

    Raises InputError where an axis is dead beside others, or a fifth of the samples is lost.
    """
    if not is_there("gyro", imu.gyro, imu.gyro_cov):
        return None, None, None
    t, keep = clean(topic, imu.t_ns, epoch, imu.gyro, {})
    if too_fast(topic, t, imu.gyro[keep]):
        count(dropped, f"{topic}: {NO_RATE}", len(t))
        return None, None, None
    sound = drop_faults(topic, t, imu.gyro[keep], dropped, "rad/s", may_stand=True)
    t, keep = t[sound], keep[sound]
    return t, imu.gyro[keep], density(topic, "gyro", t, imu.gyro_cov[keep], LEAST_GYRO, dropped)


def write_tumble(path: Path, simulated: Simulated) -> None:
    """Write simulated data under the default topic names, with truth and config attached."""
    data: TumbleData = simulated.data
    epoch = data.epoch_ns

    def covariance(t: Array, noise: float | None) -> Array:
        return (0.0 if noise is None else noise**2 / float(np.median(np.diff(t)))) * np.eye(3)

    topics: dict[str, series.Topic] = {}
    if data.mag_t is not None and data.mag is not None:
        cov = covariance(data.mag_t, data.mag_density)
        topics[MAG.name] = series.MagneticSeries(nanoseconds(data.mag_t, epoch), data.mag, field_cov=cov, frame_id="b")
    imu_t = data.gyro_t if data.accel_t is None else data.accel_t
    if imu_t is not None:
        absent = np.diag([-1.0, 0.0, 0.0])
        topics[IMU.name] = series.ImuSeries(
            nanoseconds(imu_t, epoch),
            np.zeros((len(imu_t), 3)) if data.gyro is None else data.gyro,
            np.zeros((len(imu_t), 3)) if data.accel is None else data.accel,
            gyro_cov=absent if data.gyro is None else covariance(imu_t, data.gyro_density),
            accel_cov=absent if data.accel is None else covariance(imu_t, data.accel_density),
            frame_id="b",
        )
    if data.latitude is not None and data.longitude is not None:
        place = np.rad2deg([data.latitude, data.longitude])
        topics[FIX.name] = series.FixSeries(
            np.array([epoch]), place[:1], place[1:], np.array([data.height]), frame_id="gnss"
        )
    topics |= temperature.topics(data.temperature, epoch)
    write_session(path, topics, attached(simulated.truth, simulated.config))
