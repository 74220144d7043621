"""A gyro with the errors of its data sheet: measured = (I + S) w + G f + bias + noise.

S is symmetric, scale errors on its diagonal and half the angle errors between two axes off it; what else a 3x3 matrix
could hold is a rotation, which is the mounting's. G is the g-sensitivity, rad/s per m/s^2, f the specific force that
the accelerometer of the same IMU measures, in the same frame. As a variable, `errors`, they are 6 numbers of S, xx yy
zz xy xz yz, and, where there is a specific force, 9 of G by rows: row for the gyro's axis, column for the force's.

The rate from a reading m is w = N (m - G f - bias) with N = (I + S)^-1, linear in N, N G and N bias. So is the rotation
vector by which an increment, once integrated, has to be turned further, but for a twelfth of its square times the angle
by which its direction turns over the window. Against integrating again, with swings of 2 rad/s about three axes, a bias
off by 0.02 rad/s and a scale off by 1e-2 (5e-2), that is 5e-9 (6e-8) rad over 1/60 s, 8e-7 (1.3e-5) over 0.1 s, 6e-6
(9e-5) over 0.2 s and 1.6e-4 (2.4e-3) over 1 s. So windows stay short, and nothing is integrated twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from factors import so3
from factors.model import ROT3, Array, Block, Model, Residuals
from factors.preintegration import GyroPath, Increments

# Derivatives by bias (n, 3, 3) and, where they are variables, by errors (n, 3, 6 or 15).
Derivatives = Callable[[], tuple[Array, ...]]

# Numbers of S, of S and G, and of a platform's gyro: its bias and S.
SCALE, SCALE_AND_G, PLATFORM = 6, 15, 9
_ROW, _COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def symmetric(numbers: Array) -> Array:
    """The matrices (..., 3, 3) of the numbers xx yy zz xy xz yz, (..., 6)."""
    out = np.empty((*numbers.shape[:-1], 3, 3))
    out[..., _ROW, _COLUMN] = numbers
    out[..., _COLUMN, _ROW] = numbers
    return out


def corrected(turns: Increments, bias_error: Array, errors: Array | None) -> tuple[Array, Derivatives]:
    """Increments (n, 4) with the errors of their gyro taken off, and how these turn them further (on the right).

    Args:
        turns: n increments, with their scale_jacobian if there are errors and their g_jacobian if G is among them.
        bias_error: (n, 3), the bias beyond what was taken off the rates.
        errors: (n, 6 or 15); None for a perfect gyro.
    """
    if errors is None:
        phi = _apply(turns.bias_jacobian, bias_error)
        return so3.multiply(turns.wxyz, so3.exp(phi)), lambda: (so3.right_jacobian(phi) @ turns.bias_jacobian,)
    _, N, off = _inverse(errors)
    bias_off = _apply(N, bias_error)
    phi = _apply(turns.bias_jacobian, bias_off) + _apply(needed(turns.scale_jacobian), off.reshape(-1, 9))
    G = _sensitivity(errors)
    g_off = None if G is None else N @ G
    if g_off is not None:
        phi = phi + _apply(needed(turns.g_jacobian), g_off.reshape(-1, 9))

    def derivatives() -> tuple[Array, ...]:
        # dN = -N dS N, so dS acts on all three of bias_off, off = I - N and g_off.
        to_end = so3.right_jacobian(phi)
        by_bias = to_end @ turns.bias_jacobian @ N
        by_scale = N[:, None] @ (to_end @ needed(turns.scale_jacobian)).reshape(-1, 3, 3, 3) @ N[:, None]
        by_scale -= by_bias[..., None] * bias_off[:, None, None]
        if g_off is None:
            return by_bias, by_symmetric(by_scale)
        by_g = N[:, None] @ (to_end @ needed(turns.g_jacobian)).reshape(-1, 3, 3, 3)
        by_scale -= by_g @ np.swapaxes(g_off, 1, 2)[:, None]
        return by_bias, np.concatenate([by_symmetric(by_scale), by_g.reshape(-1, 3, 9)], axis=2)

    return so3.multiply(turns.wxyz, so3.exp(phi)), derivatives


def errors_block(turns: Increments) -> int:
    """Numbers of the errors that increments have derivatives by; 0 for a perfect gyro."""
    if turns.scale_jacobian is None:
        return 0
    return SCALE if turns.g_jacobian is None else SCALE_AND_G


def parted(blocks: Sequence[Array], sizes: Sequence[int]) -> tuple[Array | None, Array | None]:
    """A gyro's errors and those of a platform's gyro, None for a perfect one, from blocks of these sizes."""
    by_size = dict(zip(sizes, blocks, strict=True))
    platform = by_size.pop(PLATFORM, None)
    return next(iter(by_size.values()), None), platform


def platform_errors(gyro: GyroPath, variable: Array | None, n: int) -> tuple[Array, Array | None]:
    """Bias (n, 3) and errors (n, 6) of a platform's gyro, which are one variable (n, 9); None: perfect."""
    if variable is None:
        return np.broadcast_to(gyro.bias_hat, (n, 3)), None
    return variable[:, :3], variable[:, 3:]


def by_platform_errors(derivatives: Derivatives, variable: Array | None) -> tuple[Array, ...]:
    """Derivatives by that variable."""
    return () if variable is None else (np.concatenate(derivatives(), axis=2),)


def carried(
    gyro: GyroPath, start: Array, middle: Array, stop: Array, bias: Array, errors: Array | None
) -> tuple[Array, Array, Derivatives]:
    """Increments over windows so short that what the gyro reads too much is constant in them.

    Args:
        gyro: the stream.
        start, stop: (n,) the windows' ends, s.
        middle: (n,) s, where the errors are evaluated; does not move with the windows' ends.
        bias: (n, 3) rad/s.
        errors: (n, 6 or 15); None for a perfect gyro.

    Returns:
        The increments (n, 4), the true rate at their ends (n, 3) in the turned frame, and how bias and errors turn
        the increments further (on the right).
    """
    turns = gyro.increments(start, stop)
    rate = turns.rate if errors is None else gyro.rate(middle)
    force = None if errors is None or errors.shape[1] == SCALE else gyro.specific_force(middle)
    excess, by_excess = rate_error(bias - gyro.bias_hat, errors, rate, force)
    phi = _apply(turns.bias_jacobian, excess)
    to_end = so3.right_jacobian(phi)
    # The gyro's rate seen through the correction, and the correction's own growth.
    growth = _apply(so3.hat(turns.rate) @ turns.bias_jacobian + np.eye(3), -excess)
    rate = so3.rotate(so3.exp(-phi), turns.rate) + _apply(to_end, growth)

    def derivatives() -> tuple[Array, ...]:
        by_phi = to_end @ turns.bias_jacobian
        return tuple(by_phi @ each for each in by_excess())

    return so3.multiply(turns.wxyz, so3.exp(phi)), rate, derivatives


@dataclass(frozen=True)
class GyroIncrementFactor(Model):
    """Attitudes joined by what a gyro measured between them, over n windows: iRm_j = iRm_i dV(bias, errors).

    Equal to gtsam's AHRSFactor where the errors are zero. On a platform that turns and has a gyro of its own the
    attitudes are those on the platform: bRm_j = dB(platform)^T bRm_i dV. Blocks: attitudes i and j (rotations), gyro
    bias (3, rad/s); unless all are perfect, errors (6 or 15) and, on a platform, its gyro's bias and S (3 + 6).

    Attributes:
        time: (n,) ends of the windows, s.
        turns: over the windows, by `gyro`, with the derivatives that the blocks need.
        gyro: whose bias_hat was taken off.
        sigma: (n,) rad per axis of each increment, both gyros together.
        platform_turns, platform: the same of the platform's gyro; None where the attitudes are inertial.
    """

    time: Array
    turns: Increments
    gyro: GyroPath
    sigma: Array
    platform_turns: Increments | None = None
    platform: GyroPath | None = None
    rows: int = 3
    stacked: ClassVar = ("time", "turns", "sigma", "platform_turns")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Attitudes, bias and, where the increments have derivatives by them, errors and those of the platform."""
        return ROT3, ROT3, 3, *self._error_blocks

    @property
    def _error_blocks(self) -> tuple[int, ...]:
        own = errors_block(self.turns)
        platform = self.platform_turns is not None and self.platform_turns.scale_jacobian is not None
        return (*([own] if own else []), *([PLATFORM] if platform else []))

    def __call__(self, i: Array, j: Array, bias: Array, *of_gyros: Array) -> Residuals:
        """Residual Log(predicted_j^T j) / sigma, (n, 3)."""
        errors, platform = parted(of_gyros, self._error_blocks)
        dV, by_gyro = corrected(self.turns, bias - self.gyro.bias_hat, errors)
        predicted = so3.multiply(i, dV)
        by_dB: Derivatives = tuple
        if self.platform_turns is not None and self.platform is not None:
            base_bias, base_errors = platform_errors(self.platform, platform, len(i))
            dB, by_dB = corrected(self.platform_turns, base_bias - self.platform.bias_hat, base_errors)
            predicted = so3.multiply(so3.inverse(dB), predicted)
        error = so3.log(so3.multiply(so3.inverse(predicted), j))
        weight = (1.0 / self.sigma)[:, None]

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[..., None]
            right = so3.right_jacobian_inverse(error) * weight[..., None]
            ahead = -left @ so3.matrix(so3.inverse(predicted))
            return (
                left @ so3.matrix(so3.inverse(dV)),
                right,
                *(left @ each for each in by_gyro()),
                *(ahead @ each for each in by_platform_errors(by_dB, platform)),
            )

        return error * weight, jacobians


def rate_error(bias_error: Array, errors: Array | None, rate: Array, force: Array | None) -> tuple[Array, Derivatives]:
    """What a gyro reads too much (n, 3), rad/s, given what it reads and the specific force, and its derivatives.

    Args:
        bias_error: (n, 3), the bias beyond what was taken off the rates.
        errors: (n, 6 or 15); None for a perfect gyro.
        rate: (n, 3) as read.
        force: (n, 3), needed where G is among the errors.
    """
    if errors is None:
        return bias_error, lambda: (np.eye(3),)
    S, N, _ = _inverse(errors)
    excess = bias_error + _apply(S, rate)
    G = _sensitivity(errors)
    if G is not None:
        excess = excess + _apply(G, needed(force))
    excess = _apply(N, excess)

    def derivatives() -> tuple[Array, ...]:
        by_errors = by_symmetric(N[..., None] * (rate - excess)[:, None, None])
        if G is None:
            return N, by_errors
        return N, np.concatenate([by_errors, (N[..., None] * needed(force)[:, None, None]).reshape(-1, 3, 9)], axis=2)

    return excess, derivatives


def _inverse(errors: Array) -> tuple[Array, Array, Array]:
    """S, N = (I + S)^-1 and I - N, all symmetric, (n, 3, 3) each, or (1, 3, 3) when all rows are one."""
    S = symmetric(_distinct(errors)[:, :SCALE])
    N = np.linalg.inv(np.eye(3) + S).astype(float, copy=False)
    return S, N, N @ S


def _sensitivity(errors: Array) -> Array | None:
    """G, (n or 1, 3, 3), if it is among the errors."""
    return _distinct(errors)[:, SCALE:].reshape(-1, 3, 3) if errors.shape[1] > SCALE else None


def _distinct(rows: Array) -> Array:
    """One row instead of many that are one variable."""
    return rows[:1] if rows.strides[0] == 0 else rows


def needed(given: Array | None) -> Array:
    """What variables were told to depend on. Raises ValueError when it was not given."""
    if given is None:
        raise ValueError(
            "errors of a gyro need increments with scale=True and, for G, a specific force; skew and scale of pictures "
            "need elapsed and first"
        )
    return given


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.einsum("...ij,...j->...i", matrices, vectors)


def by_symmetric(by_entry: Array) -> Array:
    """Derivatives by the entries of a matrix, (n, 3, 3, 3), to those by the numbers of a symmetric one, (n, 3, 6)."""
    out = by_entry[..., _ROW, _COLUMN]
    out[..., 3:] += by_entry[..., _COLUMN[3:], _ROW[3:]]
    return out
