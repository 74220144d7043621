"""A gyro with the errors of its data sheet: measured = (I + S) w + D f + bias + noise.

S is symmetric, scale errors on its diagonal and half the angle errors between two axes off it; what else a 3x3 matrix
could hold is a rotation, which is the mounting's. f are the drivers: the specific force that the accelerometer of the
same IMU measures, in the same frame, where D holds the g-sensitivity G, rad/s per m/s^2; the temperature above that at
which the bias is the bias, where D holds the slope c, rad/s/K; the sides, -1 or 1, on which readings are beyond a dead
band, 0 within, where D is -band on its diagonal, what the gyro subtracts from the size of its rates; or one after the
other, D = [G c -band I]. As a variable, `errors`, they are 6 numbers of S, xx yy zz xy xz yz, then 9 of G by rows, row
for the gyro's axis, column for the force's, 3 of c and the band, as far as there are such drivers: 6 to 19 numbers.

The rate from a reading m is w = N (m - D f - bias) with N = (I + S)^-1, linear in N, N D and N bias. So is the rotation
vector by which an increment, once integrated, has to be turned further, but for a twelfth of its square times the angle
by which its direction turns over the window. Against integrating again, with swings of 2 rad/s about three axes, a bias
off by 0.02 rad/s and a scale off by 1e-2 (5e-2), that is 5e-9 (6e-8) rad over 1/60 s, 8e-7 (1.3e-5) over 0.1 s, 6e-6
(9e-5) over 0.2 s and 1.6e-4 (2.4e-3) over 1 s. So windows stay short, and nothing is integrated twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.factors.preintegration import GyroPath, Increments

# Derivatives by bias (n, 3, 3) and, where they are variables, by errors (n, 3, 6 to 19).
Derivatives = Callable[[], tuple[Array, ...]]

# Numbers of S, and of a platform's gyro: its bias and S.
SCALE, PLATFORM = 6, 9
_ROW, _COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def symmetric(numbers: Array) -> Array:
    """Symmetric matrices (..., 3, 3) from the numbers xx yy zz xy xz yz, (..., 6)."""
    out = np.empty((*numbers.shape[:-1], 3, 3))
    out[..., _ROW, _COLUMN] = numbers
    out[..., _COLUMN, _ROW] = numbers
    return out


def corrected(turns: Increments, bias_error: Array, errors: Array | None) -> tuple[Array, Derivatives]:
    """Correct increments (n, 4) for the gyro's errors; also return right-side derivatives by these errors.

    Args:
        turns: n increments, with their scale_jacobian if there are errors and their driver_jacobian if D is among them.
        bias_error: (n, 3), the bias beyond what was taken off the rates.
        errors: (n, 6 to 19); None for a perfect gyro.
    """
    if errors is None:
        phi = _apply(turns.bias_jacobian, bias_error)
        return so3.multiply(turns.wxyz, so3.exp(phi)), lambda: (so3.right_jacobian(phi) @ turns.bias_jacobian,)
    _, N, off = _inverse(errors)
    bias_off = _apply(N, bias_error)
    phi = _apply(turns.bias_jacobian, bias_off) + _apply(needed(turns.scale_jacobian), off.reshape(-1, 9))
    D = _driver_matrix(errors)
    d_off = None if D is None else N @ D
    if d_off is not None:
        phi = phi + _apply(needed(turns.driver_jacobian), d_off.reshape(len(d_off), -1))

    def derivatives() -> tuple[Array, ...]:
        # dN = -N dS N, so dS acts on all three of bias_off, off = I - N and d_off.
        to_end = so3.right_jacobian(phi)
        by_bias = to_end @ turns.bias_jacobian @ N
        by_scale = N[:, None] @ (to_end @ needed(turns.scale_jacobian)).reshape(-1, 3, 3, 3) @ N[:, None]
        by_scale -= by_bias[..., None] * bias_off[:, None, None]
        if d_off is None:
            return by_bias, by_symmetric(by_scale)
        by_d = N[:, None] @ (to_end @ needed(turns.driver_jacobian)).reshape(len(by_bias), 3, 3, -1)
        by_scale -= by_d @ np.swapaxes(d_off, 1, 2)[:, None]
        return by_bias, np.concatenate([by_symmetric(by_scale), _by_driven(by_d, errors)], axis=2)

    return so3.multiply(turns.wxyz, so3.exp(phi)), derivatives


def error_blocks(own: int, platform: bool) -> tuple[int, ...]:
    """Sizes of the error blocks: the gyro's `own` numbers, if any, and those of a platform's gyro."""
    return (*([own] if own else []), *([PLATFORM] if platform else []))


def parted(blocks: Sequence[Array], own: bool) -> tuple[Array | None, Array | None]:
    """Split blocks into a gyro's own errors and those of a platform's gyro; None for an ideal gyro."""
    rest = list(blocks)
    errors = rest.pop(0) if own else None
    return errors, rest[0] if rest else None


def platform_errors(gyro: GyroPath, variable: Array | None, n: int) -> tuple[Array, Array | None]:
    """Split a platform gyro's variable (n, 9) into bias (n, 3) and errors (n, 6); None for an ideal gyro."""
    if variable is None:
        return np.broadcast_to(gyro.bias_hat, (n, 3)), None
    return variable[:, :3], variable[:, 3:]


def by_platform_errors(derivatives: Derivatives, variable: Array | None) -> tuple[Array, ...]:
    """Derivatives by the platform gyro's error variable."""
    return () if variable is None else (np.concatenate(derivatives(), axis=2),)


def carried(
    gyro: GyroPath,
    start: Array,
    middle: Array,
    stop: Array,
    bias: Array,
    errors: Array | None,
    turns: Increments | None = None,
) -> tuple[Array, Array, Derivatives]:
    """Gyro increments over windows so short that the gyro's error is constant within each.

    Args:
        gyro: the stream.
        start, stop: (n,) the windows' ends, s.
        middle: (n,) s, where the errors are evaluated; does not move with the windows' ends.
        bias: (n, 3) rad/s.
        errors: (n, 6 to 19); None for a perfect gyro.
        turns: the gyro's increments over the windows, where they are known.

    Returns:
        The increments (n, 4), the true rate at their ends (n, 3) in the turned frame, and how bias and errors turn
        the increments further (on the right).
    """
    turns = turns or gyro.increments(start, stop)
    rate = turns.rate if errors is None else gyro.rate(middle)
    drivers = None if errors is None or errors.shape[1] == SCALE else gyro.drivers(middle)
    excess, by_excess = rate_error(bias - gyro.bias_hat, errors, rate, drivers)
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
    """Gyro increments between attitudes over n windows: iRm_j = iRm_i dV(bias, errors).

    Equal to gtsam's AHRSFactor where the errors are zero. On a platform that turns and has a gyro of its own the
    attitudes are those on the platform: bRm_j = dB(platform)^T bRm_i dV. Blocks: attitudes i and j (rotations), gyro
    bias (3, rad/s); unless all are perfect, errors (6 to 19) and, on a platform, its gyro's bias and S (3 + 6).

    The residual is in the units in which noise is white, those of what the sensors read: (I + S) Log(predicted^T j).
    In true units a larger S would shrink the noise, which pays for nothing in the cost. Of two gyros each contributes
    its share of the variance: I + share S + (1 - share) S_platform, the latter turned to the helmet's axes.

    Attributes:
        time: (n,) ends of the windows, s.
        turns: over the windows, by `gyro`, with the derivatives that the blocks need.
        gyro: whose bias_hat was taken off.
        sigma: (n,) rad per axis of each increment, both gyros together.
        platform_turns, platform: the same of the platform's gyro; None where the attitudes are inertial.
        share: of the increments' variance that is the gyro's own; the rest is the platform's.
        errors: numbers of the gyro's errors, 0 for a perfect one.
    """

    time: Array
    turns: Increments
    gyro: GyroPath
    sigma: Array
    platform_turns: Increments | None = None
    platform: GyroPath | None = None
    share: float = 1.0
    errors: int = 0
    shapes: ClassVar = {"sigma": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "turns", "sigma", "platform_turns")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitudes, bias, gyro errors and platform gyro errors, where variable."""
        platform = self.platform_turns is not None and self.platform_turns.scale_jacobian is not None
        return ROT3, ROT3, 3, *error_blocks(self.errors, platform)

    def __call__(self, i: Array, j: Array, bias: Array, *of_gyros: Array) -> Residuals:
        """Residual (I + S) Log(predicted_j^T j) / sigma, (n, 3)."""
        errors, platform = parted(of_gyros, self.errors > 0)
        dV, by_gyro = corrected(self.turns, bias - self.gyro.bias_hat, errors)
        predicted = so3.multiply(i, dV)
        by_dB: Derivatives = tuple
        if self.platform_turns is not None and self.platform is not None:
            base_bias, base_errors = platform_errors(self.platform, platform, len(i))
            dB, by_dB = corrected(self.platform_turns, base_bias - self.platform.bias_hat, base_errors)
            predicted = so3.multiply(so3.inverse(dB), predicted)
        error = so3.local(predicted, j)
        weight = (1.0 / self.sigma)[:, None]
        units, by_own, by_platform, by_turning = self._units(errors, platform, j, error)

        def jacobians() -> tuple[Array, ...]:
            scaled = units * weight[..., None]
            left = -scaled @ so3.right_jacobian_inverse(-error)
            right = scaled @ so3.right_jacobian_inverse(error)
            ahead = -left @ so3.matrix(so3.inverse(predicted))
            by_bias, *by_errors = by_gyro()
            platform_jacobians = [ahead @ each for each in by_platform_errors(by_dB, platform)]
            own = [left @ each for each in by_errors]
            for of, direct in ((own, by_own), (platform_jacobians, by_platform)):
                if of:
                    of[0] = of[0] + weight[..., None] * direct()
            return (
                left @ so3.matrix(so3.inverse(dV)),
                right + weight[..., None] * by_turning(),
                left @ by_bias,
                *own,
                *platform_jacobians,
            )

        return _apply(units, error) * weight, jacobians

    def _units(
        self, errors: Array | None, platform: Array | None, j: Array, error: Array
    ) -> tuple[Array, Callable[[], Array], Callable[[], Array], Callable[[], Array | float]]:
        """Matrices (n or 1, 3, 3) from true units to those of white noise, and their derivatives' contributions.

        Returns:
            The matrices, and the derivatives of matrix times error by the gyro's errors, by those of the platform's
            gyro and by the attitudes j, (n, 3, d) each.
        """
        units = np.eye(3)[None]
        if errors is not None:
            units = units + self.share * symmetric(_distinct(errors)[:, :SCALE])
        bRm = turned = None
        if platform is not None and self.share < 1.0:
            bRm = so3.matrix(j)
            turned = np.swapaxes(bRm, 1, 2) @ symmetric(platform[:, 3:]) @ bRm
            units = units + (1.0 - self.share) * turned

        def by_own() -> Array:
            assert errors is not None
            out = np.zeros((len(error), 3, errors.shape[1]))
            out[:, :, :SCALE] = self.share * _by_scale(error)
            return out

        def by_platform() -> Array:
            out = np.zeros((len(error), 3, PLATFORM))
            if bRm is not None:
                out[:, :, 3:] = (1.0 - self.share) * np.swapaxes(bRm, 1, 2) @ _by_scale(_apply(bRm, error))
            return out

        def by_turning() -> Array | float:
            if turned is None:
                return 0.0
            return (1.0 - self.share) * (so3.hat(_apply(turned, error)) - turned @ so3.hat(error))

        return units, by_own, by_platform, by_turning


def _by_scale(vectors: Array) -> Array:
    """Derivatives (n, 3, 6) of S v by the numbers of S, for vectors v (n, 3)."""
    return by_symmetric(np.eye(3)[:, :, None] * vectors[:, None, None, :])


def rate_error(
    bias_error: Array, errors: Array | None, rate: Array, drivers: Array | None
) -> tuple[Array, Derivatives]:
    """Error (n, 3), rad/s, of a gyro's reading, by the reading and its drivers, with derivatives.

    Args:
        bias_error: (n, 3), the bias beyond what was taken off the rates.
        errors: (n, 6 to 19); None for a perfect gyro.
        rate: (n, 3) as read.
        drivers: (n, d), needed where D is among the errors.
    """
    if errors is None:
        return bias_error, lambda: (np.eye(3),)
    S, N, _ = _inverse(errors)
    excess = bias_error + _apply(S, rate)
    D = _driver_matrix(errors)
    if D is not None:
        excess = excess + _apply(D, needed(drivers))
    excess = _apply(N, excess)

    def derivatives() -> tuple[Array, ...]:
        # N e_a v_b + N e_b v_a for each number of S about the axes a and b, v the rate that there is.
        true = (rate - excess)[:, None]
        by_errors = N[..., _ROW] * true[..., _COLUMN]
        by_errors[..., 3:] += N[..., _COLUMN[3:]] * true[..., _ROW[3:]]
        if D is None:
            return N, by_errors
        by_d = N[..., None] * needed(drivers)[:, None, None]
        return N, np.concatenate([by_errors, _by_driven(by_d, errors)], axis=2)

    return excess, derivatives


def _inverse(errors: Array) -> tuple[Array, Array, Array]:
    """Symmetric matrices S, N = (I + S)^-1 and I - N, (n, 3, 3) each, or (1, 3, 3) if all rows are one variable."""
    S = symmetric(_distinct(errors)[:, :SCALE])
    N = np.linalg.inv(np.eye(3) + S).astype(float, copy=False)
    return S, N, N @ S


def _driver_matrix(errors: Array) -> Array | None:
    """Driver matrix D (n or 1, 3, d) among a gyro's errors; None if absent."""
    numbers = _distinct(errors)[:, SCALE:]
    count = numbers.shape[1]
    return (numbers @ _entries(count).T).reshape(len(numbers), 3, -1) if count else None


def _by_driven(by_entry: Array, errors: Array) -> Array:
    """Convert derivatives by the entries of D, (n, 3, 3, d), to derivatives by D's numbers."""
    entries = _entries(errors.shape[1] - SCALE)
    return np.asarray(by_entry.reshape(-1, len(entries)) @ entries).reshape(len(by_entry), 3, -1)


@cache
def _entries(numbers: int) -> Array:
    """Matrix (3 d, numbers) from the numbers of D to its entries by rows: 9 of G, 3 of c, 1 of a dead band."""
    from scipy.linalg import block_diag

    parts = [np.eye(9).reshape(3, 3, 9)] if numbers >= 9 else []
    parts += [np.eye(3)[:, None]] if numbers // 3 in (1, 4) else []
    parts += [-np.eye(3)[..., None]] if numbers % 3 == 1 else []
    return np.concatenate([block_diag(*(part[axis] for part in parts)) for axis in range(3)])


def _distinct(rows: Array) -> Array:
    """Reduce rows broadcast from one variable to a single row."""
    return rows[:1] if rows.strides[0] == 0 else rows


def needed(given: Array | None) -> Array:
    """Return an optional model input that its variables need. Raises ValueError if it is None."""
    if given is None:
        raise ValueError(
            "errors of a gyro need increments with scale=True and, for D, drivers; its slope over temperature needs "
            "temperature; skew and scale of pictures need elapsed and first"
        )
    return given


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.einsum("...ij,...j->...i", matrices, vectors)


def by_symmetric(by_entry: Array) -> Array:
    """Convert derivatives by matrix entries (n, 3, 3, 3) to those by a symmetric matrix's six numbers (n, 3, 6)."""
    out = by_entry[..., _ROW, _COLUMN]
    out[..., 3:] += by_entry[..., _COLUMN[3:], _ROW[3:]]
    return out
