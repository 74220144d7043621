"""A gyro with the errors of its data sheet: measured = (I + S) w + G f + bias + noise.

S is symmetric, scale errors on its diagonal and half the angle errors between two axes off it; what else a 3x3 matrix
could hold is a rotation, which is the mounting's. G is the g-sensitivity, rad/s per m/s^2, f the specific force that
the accelerometer of the same IMU measures, in the same frame. As variables S is 6 numbers, xx yy zz xy xz yz, and G is
9, by rows: row for the gyro's axis, column for the force's.

The rate from a reading m is w = N (m - G f - bias) with N = (I + S)^-1, linear in N, N G and N bias. So is the rotation
vector by which an increment, once integrated, has to be turned further, but for a twelfth of its square times the angle
by which its direction turns over the window. Against integrating again, with swings of 2 rad/s about three axes, a bias
off by 0.02 rad/s and a scale off by 1e-2 (5e-2), that is 5e-9 (6e-8) rad over 1/60 s, 8e-7 (1.3e-5) over 0.1 s, 6e-6
(9e-5) over 0.2 s and 1.6e-4 (2.4e-3) over 1 s. So windows stay short, and nothing is integrated twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from factors import so3
from factors.model import ROT3, Array, Block, Model
from factors.preintegration import GyroPath, Increments

# Derivatives by bias (n, 3, 3), by scale (n, 3, 6) and, where there is one, by g-sensitivity (n, 3, 9).
Jacobians = Callable[[], tuple[Array, ...]]

_ROW, _COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def symmetric(numbers: Array) -> Array:
    """The matrices (..., 3, 3) of the numbers xx yy zz xy xz yz, (..., 6)."""
    out = np.empty((*numbers.shape[:-1], 3, 3))
    out[..., _ROW, _COLUMN] = numbers
    out[..., _COLUMN, _ROW] = numbers
    return out


def rate_error(
    bias_error: Array, scale: Array, g: Array | None, rate: Array, force: Array | None
) -> tuple[Array, Jacobians]:
    """What a gyro reads too much, (n, 3) rad/s.

    Args:
        bias_error: (n, 3), the bias beyond what was taken off the rate.
        scale: (n, 6).
        g: (n, 9), None for a gyro without g-sensitivity.
        rate: (n, 3) as read, rad/s.
        force: (n, 3) specific force, m/s^2; needed with g.
    """
    N, _ = _inverse(scale)
    error = bias_error + _apply(symmetric(scale), rate)
    if g is not None and force is not None:
        error = error + _apply(g.reshape(-1, 3, 3), force)
    error = _apply(N, error)

    def jacobians() -> tuple[Array, ...]:
        by_scale = _folded(np.einsum("nad,ne->nade", N, rate - error))
        return (N, by_scale) if force is None else (N, by_scale, np.einsum("nad,ne->nade", N, force).reshape(-1, 3, 9))

    return error, jacobians


def correction(turns: Increments, bias_error: Array, scale: Array, g: Array | None) -> tuple[Array, Jacobians]:
    """Rotation vectors (n, 3) that turn increments further for the errors of their gyro: wxyz * Exp(correction).

    Args:
        turns: n increments with their scale_jacobian and, with g, their g_jacobian.
        bias_error: (n, 3), the bias beyond what was taken off the rates.
        scale: (n, 6).
        g: (n, 9), None for a gyro without g-sensitivity.
    """
    assert turns.scale_jacobian is not None
    N, off = _inverse(scale)
    bias_off = _apply(N, bias_error)
    phi = _apply(turns.bias_jacobian, bias_off) + _apply(turns.scale_jacobian, off.reshape(-1, 9))
    if g is not None:
        assert turns.g_jacobian is not None
        g_off = N @ g.reshape(-1, 3, 3)
        phi = phi + _apply(turns.g_jacobian, g_off.reshape(-1, 9))

    def jacobians() -> tuple[Array, ...]:
        # dN = -N dS N, so dS acts on all three of bias_off, off = I - N and g_off.
        by_bias = turns.bias_jacobian @ N
        by_entry = N[:, None] @ _tensor(turns.scale_jacobian) @ N[:, None]
        by_entry -= np.einsum("nid,ne->nide", by_bias, bias_off)
        if g is None:
            return by_bias, _folded(by_entry)
        by_g = N[:, None] @ _tensor(turns.g_jacobian)
        by_entry -= by_g @ np.swapaxes(g_off, 1, 2)[:, None]
        return by_bias, _folded(by_entry), by_g.reshape(-1, 3, 9)

    return phi, jacobians


@dataclass(frozen=True)
class GyroIncrementFactor(Model):
    """Attitudes joined by what a gyro measured between them, over n windows: iRm_j = iRm_i dV(bias, scale, g).

    The gyro's part of gtsam's AHRSFactor, to which it is equal where scale and g are zero. Blocks: iRm_i, iRm_j
    (rotations), gyro bias (3, rad/s), scale (6) and, unless left out, g-sensitivity (9, rad/s per m/s^2).

    Attributes:
        time: (n,) ends of the windows, s.
        turns: over the windows, by `gyro`, with their scale_jacobian and, for the last block, their g_jacobian.
        gyro: whose bias_hat was taken off.
        sigma: (n,) rad per axis of each increment.
    """

    time: Array
    turns: Increments
    gyro: GyroPath
    sigma: Array
    rows: int = 3
    stacked: ClassVar = ("time", "turns", "sigma")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """iRm_i, iRm_j, bias, scale and, with the turns' g_jacobian, g."""
        return (ROT3, ROT3, 3, 6) if self.turns.g_jacobian is None else (ROT3, ROT3, 3, 6, 9)

    def __call__(
        self, iRm_i: Array, iRm_j: Array, bias: Array, scale: Array, g: Array | None = None
    ) -> tuple[Array, Jacobians]:
        """Residual Log((iRm_i dV)^T iRm_j) / sigma, (n, 3)."""
        phi, by_errors = correction(self.turns, bias - self.gyro.bias_hat, scale, g)
        dV = so3.multiply(self.turns.wxyz, so3.exp(phi))
        error = so3.log(so3.multiply(so3.inverse(so3.multiply(iRm_i, dV)), iRm_j))
        weight = (1.0 / self.sigma)[:, None]

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[..., None]
            right = so3.right_jacobian_inverse(error) * weight[..., None]
            by_correction = left @ so3.right_jacobian(phi)
            return left @ so3.matrix(so3.inverse(dV)), right, *(by_correction @ each for each in by_errors())

        return error * weight, jacobians


def _inverse(scale: Array) -> tuple[Array, Array]:
    """N = (I + S)^-1 and I - N, which is symmetric too, (n, 3, 3) each."""
    S = symmetric(scale)
    N = np.linalg.inv(np.eye(3) + S).astype(float, copy=False)
    return N, N @ S


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.einsum("nij,nj->ni", matrices, vectors)


def _tensor(jacobian: Array | None) -> Array:
    """By the entries of a 3x3 matrix, (n, 3, 9) -> (n, 3, 3, 3)."""
    assert jacobian is not None
    return jacobian.reshape(-1, 3, 3, 3)


def _folded(by_entry: Array) -> Array:
    """By the entries of a matrix, (n, 3, 3, 3), to by the six numbers of a symmetric one, (n, 3, 6)."""
    out = by_entry[..., _ROW, _COLUMN]
    out[..., 3:] += by_entry[..., _COLUMN[3:], _ROW[3:]]
    return out
