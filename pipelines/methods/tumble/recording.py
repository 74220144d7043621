"""A recording of a tumbled device as arrays, and back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import accel_curvature
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.place import place_topics, read_place
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import check_overlap, clean, nanoseconds, too_fast
from alidade.pipelines.recording.plausibility import GRAVITY_REMOVED, is_there, lacks_gravity
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Fields, Forces, Numbers, PlatformRates
from alidade.pipelines.recording.streams import Samples, StreamReader, Temperature, white_covariance
from alidade.pipelines.recording.topics import FIX, IMU, MAG, TEMPERATURE, Need, Setting, wanted
from alidade.pipelines.settings import Config

TOPICS = (MAG, IMU, FIX, TEMPERATURE)
_METHOD = Setting("`method: tumble` in the config", lambda config: config.method == "tumble")
# An accelerometer by itself is in most recordings, and seldom meant.
REQUIREMENTS: tuple[Need, ...] = (((MAG,), (IMU, _METHOD)),)

# Why a gyro is left out.
NO_RATE = "gyro beyond what rad/s can be, not used"

SLOPES = temperature.GYRO_SLOPE, temperature.ACCEL_SLOPE
# Along each axis an accelerometer reads f + square f^2 + cube f (f^2 - LINE). At 1 g the terms are 3e-4 and 2e-3 of f,
# a nonlinearity of .2 % of 2 g: an ADXL355 states .1 % and had .3 %, consumer parts state .5 %.
ACCEL_CURVATURE = accel_curvature(3e-5, 2e-5)
# (m/s^2)^2: K is a line, as other calibrations have it. It is half-way between the one through what is read at +-1 g,
# where this is g^2, and the one that fits best over all directions of gravity, 27/35 g^2: least squares of lengths, in
# which u_x^4 has 6/7 u_x^2 - 3/35 of degrees 2 and 0.
LINE = 31.0 / 35.0 * 9.80665**2


def beside(force: Array) -> tuple[Array, Array]:
    """What the terms of `ACCEL_CURVATURE` multiply, at forces of shape (..., 3), m/s^2."""
    return force**2, force * (force**2 - LINE)


@dataclass(frozen=True, eq=False)
class TumbleData:
    """Measurements of a tumble session. Times are s from epoch_ns (Unix ns), strictly increasing.

    mag_t (N,), mag (N, 3): T, or counts; accel_t (M,), accel (M, 3): m/s^2, or counts; None for a sensor that there is
    not, but one there is. gyro_t (L,), gyro (L, 3): rad/s, where there is one beside a magnetometer. mag_density,
    accel_density, gyro_density: from the covariances of the messages, in the unit recorded per sqrt(Hz), None if they
    have none. latitude, longitude, rad, height, m: None if unknown. dropped: reason -> messages. temperature: of gyro
    and accelerometer, None where nobody measures it.
    """

    epoch_ns: int
    mag_t: Numbers | None = None
    mag: Fields | None = None
    accel_t: Numbers | None = None
    accel: Forces | None = None
    mag_density: float | None = None
    accel_density: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    height: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    gyro_t: Numbers | None = None
    gyro: PlatformRates | None = None
    gyro_density: float | None = None
    temperature: Temperature | None = None


def read_tumble(recording: Recording, config: Config) -> TumbleData:
    """Read and check magnetometer and accelerometer, one of which may be missing.

    Raises InputError when both are, when a topic is unusable, and when they have no time in common.
    """
    reader = StreamReader(recording, dict.fromkeys(map(config.topic, (MAG, IMU, FIX)), ()))
    spans = {}
    mag = accel = gyro = mag_density = accel_density = gyro_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        mag = reader.magnetic_field(name)
        mag_density = reader.density(name, "mag", mag)
        spans[name] = mag.t
    name = config.topic(IMU)
    if wanted(recording, config, IMU):
        imu = recording.imu(name)
        if is_there("accel", imu.accel, imu.accel_cov):
            accel = reader.samples(name, imu, "accel")
            if lacks_gravity(np.linalg.norm(accel.series.accel, axis=1)):
                raise InputError(f"topic {name}: {GRAVITY_REMOVED}")
            accel_density = reader.density(name, "accel", accel)
            spans[name] = accel.t
        if mag is not None and (gyro := _gyro(reader, name, imu)) is not None:
            gyro_density = reader.density(name, "gyro", gyro)
    if not spans:
        raise InputError(
            f"neither {config.topic(MAG)} (MagneticField) nor an accelerometer in {config.topic(IMU)} (Imu); "
            f"{recording.there()}"
        )
    check_overlap(spans)
    latitude, longitude, height = read_place(recording, config, FIX)
    warmed = accel or gyro
    warming = None if warmed is None else temperature.read(reader, config, SLOPES, warmed.t)
    return TumbleData(
        epoch_ns=reader.epoch_ns,
        mag_t=mag and mag.t,
        mag=mag and mag.series.field,
        accel_t=accel and accel.t,
        accel=accel and accel.series.accel,
        mag_density=mag_density,
        accel_density=accel_density,
        latitude=latitude,
        longitude=longitude,
        height=height,
        dropped=reader.dropped,
        gyro_t=gyro and gyro.t,
        gyro=gyro and gyro.series.gyro,
        gyro_density=gyro_density,
        temperature=warming,
    )


def _gyro(reader: StreamReader, topic: str, imu: series.ImuSeries) -> Samples[series.ImuSeries] | None:
    """Read the gyro beside a magnetometer; None if missing or not in rad/s.

    Raises InputError where an axis is dead beside others, or a fifth of the samples is lost.
    """
    if not is_there("gyro", imu.gyro, imu.gyro_cov):
        return None
    t, keep = clean(topic, imu.t_ns, reader.epoch_ns, imu.gyro, {})
    if too_fast(topic, t, imu.gyro[keep]):
        reader.count(topic, NO_RATE, len(t))
        return None
    return reader.samples(topic, imu, "gyro", may_be_constant=True)


def tumble_topics(data: TumbleData, _pictures: None = None) -> dict[str, series.Topic]:
    """Topics of a recording under their default names."""
    epoch = data.epoch_ns
    topics: dict[str, series.Topic] = {}
    if data.mag_t is not None and data.mag is not None:
        cov = white_covariance(data.mag_t, data.mag_density)
        topics[MAG.name] = series.MagneticSeries(nanoseconds(data.mag_t, epoch), data.mag, field_cov=cov, frame_id="b")
    imu_t = data.gyro_t if data.accel_t is None else data.accel_t
    if imu_t is not None:
        absent = np.diag([-1.0, 0.0, 0.0])
        topics[IMU.name] = series.ImuSeries(
            nanoseconds(imu_t, epoch),
            np.zeros((len(imu_t), 3)) if data.gyro is None else data.gyro,
            np.zeros((len(imu_t), 3)) if data.accel is None else data.accel,
            gyro_cov=absent if data.gyro is None else white_covariance(imu_t, data.gyro_density),
            accel_cov=absent if data.accel is None else white_covariance(imu_t, data.accel_density),
            frame_id="b",
        )
    topics |= place_topics(FIX, epoch, data.latitude, data.longitude, data.height)
    return topics | temperature.topics(data.temperature, epoch)
