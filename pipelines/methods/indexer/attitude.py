"""The carrier's attitude, from what the INS puts out, the encoders and a mounting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.indexer import base_from_platform, mounting
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.runs import AxisMotion

# Of the trajectory, Hz.
_ATTITUDE_RATE = 10.0


def frames(data: IndexerData, motion: AxisMotion) -> NDArray[np.intp]:
    """Gyro samples for the trajectory; none when the INS puts out no attitude."""
    if data.attitude is None:
        return np.empty(0, dtype=np.intp)
    stride = max(1, round(1.0 / (_ATTITUDE_RATE * float(np.median(np.diff(data.gyro_t))))))
    return np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))[::stride]


def carrier(
    data: IndexerData, motion: AxisMotion, rows: NDArray[np.intp], theta: Array, epsilon: float, encoder: Array
) -> Array:
    """nRb = nRm mRt tRb at gyro samples; the encoders' errors (5,) as alidade.factors.indexer has them."""
    assert data.attitude is not None
    at = data.gyro_t[rows] - encoder[4]
    outer, inner = (
        angle - sine * np.sin(angle) - cosine * np.cos(angle)
        for angle, (sine, cosine) in zip(
            (np.interp(at, motion.t, read) for read in motion.angles.T), encoder[:4].reshape(2, 2), strict=True
        )
    )
    mRb = so3.multiply(so3.inverse(mounting(theta)), so3.inverse(base_from_platform(outer, inner, epsilon)))
    return so3.multiply(data.attitude[rows], mRb)
