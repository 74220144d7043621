"""The gyro increment as gtsam's own factor, to be compared with ours."""

from __future__ import annotations

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.preintegration import Increments


def ahrs_factors(
    keys_i: list[int], keys_j: list[int], bias_keys: list[int], increments: Increments, bias_hat: Array, variance: Array
) -> list[gtsam.AHRSFactor]:
    """Native factors iRv_j = iRv_i dV(bias) for n windows.

    With iRv = iRb bRv and the platform's rotation iRb integrated from its own gyro these are the relative-attitude
    factors, exactly: the platform's gyro noise only adds to the variance, which is isotropic.

    Args:
        keys_i, keys_j, bias_keys: n keys each, of Rot3, Rot3 and a 3-vector.
        increments: the helmet gyro over the windows, integrated with bias_hat taken off.
        bias_hat: (3,), rad/s.
        variance: (n,), rad^2 per axis, of each increment.
    """
    factors = []
    covariance = variance[:, None, None] * np.eye(3)
    for n, (i, j, b) in enumerate(zip(keys_i, keys_j, bias_keys, strict=True)):
        duration = float(increments.duration[n])
        params = gtsam.PreintegratedRotationParams()
        params.setGyroscopeCovariance(covariance[n] / duration)
        measured = gtsam.PreintegratedAhrsMeasurements(
            params,
            bias_hat,
            duration,
            so3.to_gtsam(increments.wxyz[n]),
            increments.bias_jacobian[n],
            covariance[n],
        )
        factors.append(gtsam.AHRSFactor(i, j, b, measured))
    return factors
