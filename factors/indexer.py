"""Factors of the indexer method: mean rate of a gyro that two axes turn, over any window.

Frames: n local level (East-North-Up), base the indexer's fixed part, t its platform, m the IMU on the platform.

    baseRt(alpha, beta) = Exp(alpha ex) Exp(epsilon ey) Exp(beta ez)

alpha turns about the outer axis x, beta about the inner axis z; epsilon, the axes' deviation from a right angle, is the
tilt of the inner axis about +y, zero when they are perpendicular. The mounting is told by the angles theta of
C_t^m = Rx(theta_x) Ry(theta_y) Rz(theta_z) with the passive matrices Rx(a) = Exp(a ex).T and so on, that is
tRm = Exp(theta_z ez) Exp(theta_y ey) Exp(theta_x ex). Source: CN115265591B; methods page, section 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import so3

Array = NDArray[np.float64]
Residuals = tuple[Array, Callable[[], tuple[Array, ...]]]

_EX, _EY, _EZ = np.eye(3)
# Nodes of two-point Gauss quadrature on [0, 1], weights 1/2.
_GAUSS = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12.0)


def mounting(theta: ArrayLike) -> Array:
    """Angles theta, shape (..., 3), rad -> tRm, shape (..., 4)."""
    x, y, z = (np.asarray(theta, dtype=float)[..., i, None] for i in range(3))
    return so3.compose(so3.exp(z * _EZ), so3.exp(y * _EY), so3.exp(x * _EX))


def mounting_angles(tRm: ArrayLike) -> Array:
    """tRm, shape (..., 4) -> angles theta, shape (..., 3), rad, theta_y within +-pi/2."""
    m = so3.matrix(tRm)
    y = -np.arcsin(np.clip(m[..., 2, 0], -1.0, 1.0))
    return np.stack([np.arctan2(m[..., 2, 1], m[..., 2, 2]), y, np.arctan2(m[..., 1, 0], m[..., 0, 0])], axis=-1)


def base_from_platform(outer: ArrayLike, inner: ArrayLike, epsilon: ArrayLike = 0.0) -> Array:
    """baseRt, shape (..., 4), at the axis angles (rad)."""
    alpha, beta, tilt = (np.asarray(a, dtype=float)[..., None] for a in (outer, inner, epsilon))
    return so3.compose(so3.exp(alpha * _EX), so3.exp(tilt * _EY), so3.exp(beta * _EZ))


@dataclass(frozen=True)
class PlatformRates:
    """Mean inertial rate of the platform, in t, over n windows: fixed + cos(epsilon) cosine + sin(epsilon) sine.

    Attributes:
        start, stop: (n,) s.
        fixed, cosine, sine: (n, 3) rad/s. Exact for any epsilon, since baseRt is linear in its cosine and sine.
        covariance: (n, 3, 3) of the mean for encoder noise of 1 rad, independent from sample to sample, at both ends.
    """

    start: Array
    stop: Array
    fixed: Array
    cosine: Array
    sine: Array
    covariance: Array


class AxisPath:
    """The encoder stream integrated once; the platform's mean rate over any window then costs a look-up.

    Between samples both axes are taken to turn uniformly.

    Args:
        t: (M,) stamps, s, increasing, M >= 2.
        outer, inner: (M,) continuous angles, rad.
        base_rate: (3,) rate of the base against inertial space (the earth's), in base, rad/s.
    """

    def __init__(self, t: ArrayLike, outer: ArrayLike, inner: ArrayLike, base_rate: ArrayLike) -> None:
        self.t = np.asarray(t, dtype=float)
        self._angles = np.stack([np.asarray(outer, dtype=float), np.asarray(inner, dtype=float)], axis=1)
        if len(self.t) < 2 or len(self._angles) != len(self.t):
            raise ValueError(f"needs at least two stamps with their angles; got {self.t.shape}, {self._angles.shape}")
        self._base_rate = np.asarray(base_rate, dtype=float)
        pieces = self._arc(np.diff(self.t), self._angles[:-1], self._angles[1:])
        self._integral = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(pieces, axis=0)])

    def angles(self, at: ArrayLike) -> Array:
        """Outer and inner angle at the times, shape (n, 2), rad."""
        at = np.asarray(at, dtype=float)
        return np.stack([np.interp(at, self.t, a) for a in self._angles.T], axis=1)

    def rates(self, start: ArrayLike, stop: ArrayLike) -> PlatformRates:
        """Mean rates over the windows [start, stop], (n,) each, s, within the stamps.

        Raises:
            ValueError: a window reaches beyond the stamps or is empty.
        """
        start, stop = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)
        if (start < self.t[0]).any() or (stop > self.t[-1]).any() or (stop <= start).any():
            raise ValueError(f"windows must lie within [{self.t[0]}, {self.t[-1]}] s and not be empty")
        begin, noise_begin = self._at(start)
        end, noise_end = self._at(stop)
        duration = (stop - start)[:, None, None]
        mean = (end - begin) / duration
        return PlatformRates(start, stop, mean[:, 0], mean[:, 1], mean[:, 2], (noise_begin + noise_end) / duration**2)

    def _at(self, at: Array) -> tuple[Array, Array]:
        """Integral of the three parts up to the times, and the covariance of the angle there per encoder variance."""
        i = np.clip(np.searchsorted(self.t, at, side="right") - 1, 0, len(self.t) - 2)
        share = (at - self.t[i]) / (self.t[i + 1] - self.t[i])
        angles = self._angles[i] + share[:, None] * (self._angles[i + 1] - self._angles[i])
        integral = self._integral[i] + self._arc(at - self.t[i], self._angles[i], angles)
        # Interpolation averages the noise of two samples.
        variance = (1.0 - share) ** 2 + share**2
        outer_axis = np.stack([np.cos(angles[:, 1]), -np.sin(angles[:, 1]), np.zeros(len(at))], axis=1)
        axes = outer_axis[:, :, None] * outer_axis[:, None, :] + np.outer(_EZ, _EZ)
        return integral, variance[:, None, None] * axes

    def _arc(self, duration: Array, begin: Array, end: Array) -> Array:
        """Integrals (n, part, 3) of the platform's rate while both axes turn uniformly from begin to end (n, 2)."""
        turned = end - begin
        middle, half = begin[:, 1] + 0.5 * turned[:, 1], 0.5 * turned[:, 1]
        by_outer = (turned[:, 0] * np.sinc(half / np.pi))[:, None]
        out = np.zeros((len(duration), 3, 3))
        out[:, 0, 2] = turned[:, 1]
        out[:, 1, :2] = by_outer * np.stack([np.cos(middle), -np.sin(middle)], axis=1)
        out[:, 2, 2] = turned[:, 0]
        for share in _GAUSS:
            out += 0.5 * duration[:, None, None] * self._base_rate_in_platform(begin + share * turned)
        return out

    def _base_rate_in_platform(self, angles: Array) -> Array:
        """The base's rate in t, as its three parts, (n, part, 3)."""
        v = so3.rotate(so3.exp(-angles[:, :1] * _EX), self._base_rate)
        vx, vy, vz = v.T
        c, s = np.cos(angles[:, 1]), np.sin(angles[:, 1])
        zero = np.zeros_like(vx)
        parts = [[s * vy, c * vy, zero], [c * vx, -s * vx, vz], [-c * vz, s * vz, vx]]
        return np.moveaxis(np.array(parts), 2, 0)


def gyro_edges(t: Array) -> Array:
    """Edges (N + 1,) of the intervals that gyro samples at the stamps (N,) are the means of: halfway between stamps."""
    middle = 0.5 * (t[1:] + t[:-1])
    return np.concatenate([[2.0 * t[0] - middle[0]], middle, [2.0 * t[-1] - middle[-1]]])


def gyro_means(t: Array, rate: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """Mean gyro rate (n, 3) over the samples first..last-1 of each window, weighed with their intervals."""
    edges = gyro_edges(t)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rate * np.diff(edges)[:, None], axis=0)])
    return np.asarray((total[last] - total[first]) / (edges[last] - edges[first])[:, None])


@dataclass(frozen=True)
class IndexerAverageFactor:
    """Mean gyro rate over n windows against the mean the encoders and the earth's rate say.

        gyro = (1 + scale) * mRt w + bias,    w = fixed + cos(epsilon) cosine + sin(epsilon) sine

    compared in frame t, where encoder noise has fixed directions. Blocks: theta (3, rad), gyro bias (3, rad/s), gyro
    scale error (3), epsilon (1, rad) and, if wanted, tilt (3, rad): a small rotation of the true platform rate
    against the encoders' account of it, w = Exp(tilt) w_encoders, for errors that come again with every turn.

    Attributes:
        time: (n,) ends of the windows, s.
        gyro: (n, 3) mean rates, rad/s.
        rates: the platform's mean rates.
        sqrt_information: (n, 3, 3) of the difference, in t.
    """

    time: Array
    gyro: Array
    rates: PlatformRates
    sqrt_information: Array
    rows: int = 3

    def __call__(self, theta: Array, bias: Array, scale: Array, epsilon: Array, tilt: Array | None = None) -> Residuals:
        """Residual sqrt_information * (tRm (gyro - bias) / (1 + scale) - Exp(tilt) w), (n, 3)."""
        tRm = mounting(theta)
        corrected = (self.gyro - bias) / (1.0 + scale)
        encoders = self.rates.fixed + np.cos(epsilon) * self.rates.cosine + np.sin(epsilon) * self.rates.sine
        turn = so3.identity() if tilt is None else so3.exp(tilt)
        platform = so3.rotate(turn, encoders)
        error = so3.rotate(tRm, corrected) - platform

        def jacobians() -> tuple[Array, ...]:
            matrix = so3.matrix(tRm)
            by_corrected = self.sqrt_information @ matrix
            by_scale = -by_corrected * (corrected / (1.0 + scale))[:, None, :]
            by_epsilon = -np.sin(epsilon) * self.rates.cosine + np.cos(epsilon) * self.rates.sine
            blocks = (
                -by_corrected @ so3.hat(corrected) @ _angle_axes(theta),
                -by_corrected / (1.0 + scale)[:, None, :],
                by_scale,
                -self.sqrt_information @ so3.rotate(turn, by_epsilon)[..., None],
            )
            if tilt is None:
                return blocks
            by_tilt = self.sqrt_information @ so3.matrix(turn) @ so3.hat(encoders) @ so3.right_jacobian(tilt)
            return (*blocks, by_tilt)

        return np.einsum("nij,nj->ni", self.sqrt_information, error), jacobians


def _angle_axes(theta: Array) -> Array:
    """Axes in m, as columns (n, 3, 3), about which m turns in t when theta_x, theta_y, theta_z grow."""
    about_x = so3.exp(-theta[:, :1] * _EX)
    about_y = so3.multiply(about_x, so3.exp(-theta[:, 1:2] * _EY))
    axes = [np.broadcast_to(_EX, theta.shape), so3.rotate(about_x, _EY), so3.rotate(about_y, _EZ)]
    return np.stack(axes, axis=2)
