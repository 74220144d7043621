"""The gyro of an Imu topic as methods read it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.sessions.checks import check_gyro, clean, count, gyro_density
from pipelines.sessions.reading import Recording

Array = NDArray[np.float64]


def read_gyro(
    recording: Recording, topic: str, epoch_ns: int, dropped: dict[str, int]
) -> tuple[Array, Array, float | None]:
    """Times (N,) s from the epoch, rates (N, 3) rad/s, and the density its messages state (rad/s/sqrt(Hz)) or None.

    Samples that cannot be used are counted in `dropped`. Raises InputError as pipelines.sessions.checks does.
    """
    imu = recording.imu(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", imu.stamped_by_log)
    t, keep = clean(topic, imu.t_ns, epoch_ns, imu.gyro, dropped)
    gyro = imu.gyro[keep]
    check_gyro(topic, t, gyro)
    return t, gyro, gyro_density(t, imu.gyro_cov[keep])
