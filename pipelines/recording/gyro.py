"""The gyro of an Imu topic as methods read it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording.checks import LEAST_GYRO, SLOWEST_GYRO_S, check_gyro, clean, count, taken
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.placeholders import density, is_there
from alidade.pipelines.recording.plausibility import implausible
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.series import ImuSeries

Array = NDArray[np.float64]


def read_gyro(
    recording: Recording, topic: str, epoch_ns: int, dropped: dict[str, int]
) -> tuple[Array, Array, float | None]:
    """Times (N,) s from the epoch, rates (N, 3) rad/s, and the density its messages state (rad/s/sqrt(Hz)) or None.

    Samples that cannot be used are counted in `dropped`. Raises InputError as alidade.pipelines.recording.checks does.
    For the gyro of a platform: one that is parked may read zero throughout, by a simulator or a driver that cuts off
    noise.
    """
    imu = recording.imu(topic)
    t, keep = usable(topic, imu, epoch_ns, dropped, may_stand=True)
    return t, taken(imu.gyro, keep), density(topic, "gyro", t, taken(imu.gyro_cov, keep), LEAST_GYRO, dropped)


def read_imu(
    recording: Recording, topic: str, epoch_ns: int, dropped: dict[str, int]
) -> tuple[Array, Array, float | None, Array | None]:
    """As `read_gyro`, and the specific force (N, 3), m/s^2, of the same samples, None where the Imu has none.

    It has none when it is a placeholder, when a number is missing, or when it is not in m/s^2, gravity in it.
    """
    imu = recording.imu(topic)
    t, keep = usable(topic, imu, epoch_ns, dropped)
    force = taken(imu.accel, keep)
    told = np.isfinite(force).all() and is_there("accel", force, taken(imu.accel_cov, keep))
    if told and (said := implausible("accel", force)):
        count(dropped, f"{topic}: {said}: not used", len(force))
        told = False
    noise = density(topic, "gyro", t, taken(imu.gyro_cov, keep), LEAST_GYRO, dropped)
    return t, taken(imu.gyro, keep), noise, force if told else None


def usable(
    topic: str, imu: ImuSeries, epoch_ns: int, dropped: dict[str, int], least: int = 2, may_stand: bool = False
) -> tuple[Array, NDArray[np.intp]]:
    """Times (N,) s from the epoch of the samples whose rates can be used, and which they are (indexes into the series).

    Raises InputError as alidade.pipelines.recording.checks and alidade.pipelines.recording.faults do.
    """
    count(dropped, f"{topic}: stamped by log time (kept)", imu.stamped_by_log)
    t, keep = clean(topic, imu.t_ns, epoch_ns, imu.gyro, dropped, least, SLOWEST_GYRO_S)
    sound = drop_faults(topic, t, taken(imu.gyro, keep), dropped, "rad/s", may_stand)
    t, keep = taken(t, sound), keep[sound]
    check_gyro(topic, t, taken(imu.gyro, keep))
    return t, keep
