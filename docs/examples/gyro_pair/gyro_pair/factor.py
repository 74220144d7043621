"""What two gyros on one body say of each other, vectorised, with analytic Jacobians.

Let gyro a read w_a + e_a and gyro b read w_b + e_b with constant biases e_a, e_b, and w_a = aRb w_b. Less the bias
difference d = e_b - bRa e_a, b's rates are bRa (w_a + e_a): a's readings in other coordinates. So the rotations that
the two readings integrate to over one window, dA and dB(d), are conjugate: dB(d) = bRa dA aRb. This is exact, with
neither bias known by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.model import ROT3, Array, Model, Residuals
from alidade.factors.preintegration import GyroPath, Increments


@dataclass(frozen=True)
class GyroPairFactor(Model):
    """Rotations by gyro b over n windows against those by gyro a at the same moments.

    Blocks: aRb (rotation), time offset (1, s; positive when b's samples were taken later than their stamps say), bias
    difference (3, rad/s, in b).

    Attributes:
        time: (n,) ends of the windows by b's stamps, s.
        start: (n,) their starts.
        turns: of gyro `b` over the windows.
        sigma: (n,) rad per axis, both gyros together.
        a, b: the gyros; b has a first guess of the bias difference taken off, a nothing.
    """

    time: Array
    start: Array
    turns: Increments
    sigma: Array
    a: GyroPath
    b: GyroPath
    rows: int = 3
    blocks = (ROT3, 1, 3)
    stacked: ClassVar = ("time", "start", "turns", "sigma")

    def __call__(self, aRb: Array, offset: Array, difference: Array) -> Residuals:
        """Residual Log((bRa dA aRb)^T dB) / sigma, (n, 3)."""
        begin, end = self.start + offset[:, 0], self.time + offset[:, 0]
        dA = self.a.increments(begin, end)
        predicted = so3.compose(so3.inverse(aRb), dA.wxyz, aRb)
        correction = np.einsum("nij,nj->ni", self.turns.bias_jacobian, difference - self.b.bias_hat)
        dB = so3.multiply(self.turns.wxyz, so3.exp(correction))
        error = so3.log(so3.multiply(so3.inverse(predicted), dB))
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            by_predicted = -so3.right_jacobian_inverse(-error) * weight[:, None, None]
            by_dB = so3.right_jacobian_inverse(error) * weight[:, None, None]
            # aRb Exp(d) makes of the prediction P: Exp(-d) P Exp(d) = P Exp((I - P^T) d), to first order.
            by_rotation = np.eye(3) - so3.matrix(so3.inverse(predicted))
            # A later window gains the rate at its end and loses the one at its start.
            drift = dA.rate - so3.rotate(so3.inverse(dA.wxyz), self.a.rate(begin))
            by_offset = so3.rotate(so3.inverse(aRb), drift)[..., None]
            by_difference = so3.right_jacobian(correction) @ self.turns.bias_jacobian
            return by_predicted @ by_rotation, by_predicted @ by_offset, by_dB @ by_difference

        return error * weight[:, None], jacobians
