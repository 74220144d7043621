"""Validation: the mean rate of gyro b over short windows against the one that gyro a and a calibration predict."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.settings import Config
from gyro_pair.graph import windows
from gyro_pair.recording import GyroPairData

Array = NDArray[np.float64]


def validate(data: GyroPairData, _: Config, values: Mapping[str, float]) -> tuple[Validation, ...]:
    """Rate of b less that by a: before compensation with all parameters at zero.

    Raises InputError when the gyros have too little time in common.
    """
    start, by_b, before = rates(data, {})
    after = rates(data, values)[2]
    return (Validation("rate of gyro b against gyro a's", "rad/s", start, by_b - before, by_b - after),)


def rates(data: GyroPairData, values: Mapping[str, float]) -> tuple[Array, Array, Array]:
    """Starts of windows (n,), s, and mean rates (n, 3), rad/s in b: as b reads, and as predicted from a."""

    def vector(name: str) -> Array:
        return np.array([values.get(f"{name}_{axis}", 0.0) for axis in "xyz"])

    start, stop = windows(data)
    offset = values.get("time_offset", 0.0)
    a, b = GyroPath(data.a_t, data.a_gyro), GyroPath(data.b_t, data.b_gyro)
    by_a, by_b = (
        so3.log(turns.wxyz) / turns.duration[:, None]
        for turns in (a.increments(start + offset, stop + offset), b.increments(start, stop))
    )
    return start, by_b, so3.rotate(so3.inverse(so3.exp(vector("rotation"))), by_a) + vector("bias_difference")
