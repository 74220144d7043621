"""Factors of the head method: rotation increments and attitudes seen by a camera.

Frames: v helmet IMU, b platform, c camera fixed to the platform, h marker frame fixed to the helmet, i the platform's
frame at the session's start, held fixed ("inertial"). Source: methods page, section 3; the relative rates of
"Comprehensive measurement of head motion based on MIMU", Electronics Optics & Control 2018(4), integrated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np

from factors import so3
from factors.model import ROT3, Array, Model, Residuals
from factors.preintegration import GyroPath, Increments


def ahrs_factors(
    keys_i: list[int], keys_j: list[int], bias_keys: list[int], increments: Increments, bias_hat: Array, variance: Array
) -> list[gtsam.AHRSFactor]:
    """Native factors iRv_j = iRv_i dV(bias) for n windows.

    With iRv = iRb bRv and the platform's rotation iRb integrated from its own gyro these are the relative-attitude
    factors, exactly: the platform's gyro noise only adds to the variance, which is isotropic and so the same in
    every frame.

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


@dataclass(frozen=True)
class RelativeAttitudeFactor(Model):
    """Relative attitude over n windows when the attitude itself is wanted as the variable: bRv_j = dB^T bRv_i dV(bias).

    Blocks: bRv_i, bRv_j (rotations), gyro bias (3). The head method uses `ahrs_factors` on iRv instead, which is the
    same constraint as a native factor; this form serves graphs that hold bRv.

    Attributes:
        time: (n,) ends of the windows, s.
        platform: (n, 4) dB, the platform's rotation over each window.
        helmet: dV over the windows.
        bias_hat: (3,), taken off when `helmet` was integrated.
        sigma: (n,) rad per axis, helmet and platform together.
    """

    time: Array
    platform: Array
    helmet: Increments
    bias_hat: Array
    sigma: Array
    rows: int = 3
    blocks = (ROT3, ROT3, 3)

    def __call__(self, bRv_i: Array, bRv_j: Array, bias: Array) -> Residuals:
        """Residual Log((dB^T bRv_i dV)^T bRv_j) / sigma, (n, 3)."""
        correction = np.einsum("nij,nj->ni", self.helmet.bias_jacobian, bias - self.bias_hat)
        dV = so3.multiply(self.helmet.wxyz, so3.exp(correction))
        predicted = so3.compose(so3.inverse(self.platform), bRv_i, dV)
        error = so3.log(so3.multiply(so3.inverse(predicted), bRv_j))
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[:, None, None]
            right = so3.right_jacobian_inverse(error) * weight[:, None, None]
            by_bias = so3.right_jacobian(correction) @ self.helmet.bias_jacobian
            return left @ so3.matrix(so3.inverse(dV)), right, left @ by_bias

        return error * weight[:, None], jacobians


@dataclass(frozen=True)
class VisionAttitudeFactor(Model):
    """Attitudes of the helmet's marker frame seen by the platform's camera, at an unknown time offset.

    Predicted: cRh = cRb bRv(t + dt) vRh with bRv(t + dt) = iRb(t + dt)^T iRv(t) dV(t, t + dt; bias), the gyros' own
    samples carrying the attitude from the stamp to the true time. Blocks: iRv at the stamps (rotations), gyro bias (3),
    cRb, vRh (rotations), dt (1, s; positive when the picture was taken later than its stamp says).

    Attributes:
        time: (n,) stamps, s.
        measured: (n, 4) cRh.
        sqrt_information: (n, 3, 3); the error is cRh * Exp(delta), delta in frame h.
        helmet: the helmet's gyro.
        platform: the platform's gyro, None for a platform at rest.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    helmet: GyroPath
    platform: GyroPath | None
    rows: int = 3
    blocks = (ROT3, 3, ROT3, ROT3, 1)
    stacked: ClassVar = ("time", "measured", "sqrt_information")

    def __call__(self, iRv: Array, bias: Array, cRb: Array, vRh: Array, dt: Array) -> Residuals:
        """Residual sqrt_information * Log(predicted^T measured), (n, 3)."""
        at = self.time + dt[:, 0]
        step = self.helmet.increments(self.time, at)
        bias_error = bias - self.helmet.bias_hat
        correction = np.einsum("nij,nj->ni", step.bias_jacobian, bias_error)
        dV = so3.multiply(step.wxyz, so3.exp(correction))
        bRi = so3.identity(len(at)) if self.platform is None else so3.inverse(self.platform.attitude(at))
        bRv = so3.compose(bRi, iRv, dV)
        predicted = so3.compose(cRb, bRv, vRh)
        error = so3.log(so3.multiply(so3.inverse(predicted), self.measured))

        def jacobians() -> tuple[Array, ...]:
            # A right perturbation eta of the prediction changes the error by -Jr^-1(-error) eta.
            weight = -self.sqrt_information @ so3.right_jacobian_inverse(-error)
            hRv = so3.matrix(so3.inverse(vRh))
            vRb = so3.matrix(so3.inverse(bRv))
            by_correction = so3.right_jacobian(correction)
            # Rate of dV: the gyro's rate seen through the bias correction, and the correction's own growth.
            growth = np.einsum("nij,nj->ni", so3.hat(step.rate) @ step.bias_jacobian + np.eye(3), -bias_error)
            rate = so3.rotate(so3.exp(-correction), step.rate) + np.einsum("nij,nj->ni", by_correction, growth)
            if self.platform is not None:
                rate = rate - np.einsum("nij,nj->ni", vRb, self.platform.rate(at))
            return (
                weight @ hRv @ so3.matrix(so3.inverse(dV)),
                weight @ hRv @ by_correction @ step.bias_jacobian,
                weight @ hRv @ vRb,
                weight,
                weight @ hRv @ rate[..., None],
            )

        return np.einsum("nij,nj->ni", self.sqrt_information, error), jacobians
