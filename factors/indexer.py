"""Factors of the indexer method: mean rate of a gyro that two axes turn, over any window.

Frames: n local level (East-North-Up), base the indexer's fixed part, t its platform, m the IMU on the platform.

    baseRt(alpha, beta) = Exp(alpha ex) Exp(epsilon ey) Exp(beta ez)

alpha turns about the outer axis x, beta about the inner axis z; epsilon, the axes' deviation from a right angle, is the
tilt of the inner axis about +y, zero when they are perpendicular. The mounting angles theta are those of
C_t^m = Rx(theta_x) Ry(theta_y) Rz(theta_z) with the passive matrices Rx(a) = Exp(a ex).T and so on, that is
tRm = Exp(theta_z ez) Exp(theta_y ey) Exp(theta_x ex). Source: CN115265591B; methods page, section 2.

An encoder reads angle + s sin(angle) + c cos(angle), at a time `delay` later than its stamp says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.gyro import by_symmetric, needed, symmetric
from alidade.factors.model import Block, Model, Residuals

Option = Literal["errors", "temperature", "encoder", "epsilon", "tilt"]
# What the encoders' errors are, in the order of their block.
ENCODER_ERRORS = ("outer sin", "outer cos", "inner sin", "inner cos", "delay")

_EX, _EY, _EZ = np.eye(3)
_SIZES: dict[Option, int] = {"errors": 6, "temperature": 3, "encoder": len(ENCODER_ERRORS), "epsilon": 1, "tilt": 3}
# Nodes of two-point Gauss quadrature on [0, 1], weights 1/2.
_GAUSS = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12.0)


def base_from_platform(outer: ArrayLike, inner: ArrayLike, epsilon: ArrayLike = 0.0) -> Array:
    """Rotation baseRt (..., 4) of the platform at the axis angles, rad."""
    alpha, beta, tilt = (np.asarray(a, dtype=float)[..., None] for a in (outer, inner, epsilon))
    return so3.compose(so3.exp(alpha * _EX), so3.exp(tilt * _EY), so3.exp(beta * _EZ))


@dataclass(frozen=True)
class PlatformRates:
    """Mean inertial rate of the platform, in t, over n adjoining windows.

    With the axes' deviation epsilon it is fixed + cos(epsilon) cosine + sin(epsilon) sine, exactly.

    Attributes:
        edges: (n + 1,) s, where the windows begin and end.
        fixed, cosine, sine: (n, 3) rad/s.
        by_encoder: (n, 3, 3, 5), how those three change with the encoders' errors, ENCODER_ERRORS.
        noise: (3 n, 2 (n + 1) + n) 1/s, change of the means with encoder noise of 1 rad a sample. Columns: the outer
            and the inner encoder at each edge, one after the other, then the inner one's mean over each window.
    """

    edges: Array
    fixed: Array
    cosine: Array
    sine: Array
    by_encoder: Array
    noise: Array

    def parts(self, encoder: Array) -> Array:
        """Rate parts (n, part, 3) corrected for encoder errors (5,) or (n, 5)."""
        parts = np.stack([self.fixed, self.cosine, self.sine], axis=1)
        return parts + np.einsum("npie,ne->npi", self.by_encoder, np.broadcast_to(encoder, (len(parts), 5)))


class AxisPath:
    """Integrated encoder stream, which gives the platform's mean rate over any window by look-up.

    Between samples both axes are taken to turn uniformly; the angles at a window's ends are interpolated to third
    order.

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
        self._speed = np.gradient(self._angles, self.t, axis=0)
        self._base_rate = np.asarray(base_rate, dtype=float)
        pieces = self._arc(np.diff(self.t), self._angles[:-1], self._angles[1:])
        self._integral = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(pieces, axis=0)])

    def rates(self, edges: ArrayLike) -> PlatformRates:
        """Mean platform rates over the windows between increasing edges (n + 1,), s, within the stamps.

        Raises:
            ValueError: an edge lies beyond the stamps, or a window is empty.
        """
        edges = np.asarray(edges, dtype=float)
        if edges[0] < self.t[0] or edges[-1] > self.t[-1] or (np.diff(edges) <= 0.0).any():
            raise ValueError(f"windows must lie within [{self.t[0]}, {self.t[-1]}] s and not be empty")
        i = np.clip(np.searchsorted(self.t, edges, side="right") - 1, 0, len(self.t) - 2)
        weights, samples = self._interpolation(edges, i)
        angles, speed = (np.einsum("nk,nkd->nd", weights, each[samples]) for each in (self._angles, self._speed))
        integral = self._integral[i] + self._arc(edges - self.t[i], self._angles[i], angles)
        duration = np.diff(edges)[:, None, None]
        mean = np.diff(integral, axis=0) / duration
        # The axes in t at the edges; interpolation averages the noise of the samples.
        spread = np.sqrt((weights**2).sum(axis=1))
        axes = np.zeros((len(edges), 3, 2))
        axes[:, 0, 0], axes[:, 1, 0], axes[:, 2, 1] = np.cos(angles[:, 1]), -np.sin(angles[:, 1]), 1.0
        axes *= spread[:, None, None]
        n = len(edges) - 1
        noise = np.zeros((n, 3, n + 1, 2))
        noise[np.arange(n), :, np.arange(n)] = -axes[:-1] / duration
        noise[np.arange(n), :, np.arange(1, n + 1)] = axes[1:] / duration
        # The mean error of the inner angle turns the outer axis, and with it the rate, about z.
        samples = np.maximum(np.diff(np.searchsorted(self.t, edges)), 1)
        turned = np.zeros((n, 3, n))
        turned[np.arange(n), :, np.arange(n)] = so3.cross(mean[:, 0] + mean[:, 1], _EZ) / np.sqrt(samples)[:, None]
        columns = [noise.reshape(3 * n, 2 * (n + 1)), turned.reshape(3 * n, n)]
        by_encoder = self._by_encoder(edges, angles, speed)
        return PlatformRates(edges, mean[:, 0], mean[:, 1], mean[:, 2], by_encoder, np.hstack(columns))

    def _by_encoder(self, edges: Array, angles: Array, speed: Array) -> Array:
        """Derivatives (n, part, 3, 5) of the mean rate parts by the encoder errors, from values at the edges.

        Errors of the axes' angles turn the platform by phi, and a turned body's rate w grows by phi' + w x phi: the
        first integrates to the edges, the second is summed over the samples between them.
        """
        inside = slice(np.searchsorted(self.t, edges[0], side="right"), np.searchsorted(self.t, edges[-1]))
        order = np.argsort(np.concatenate([self.t[inside], edges]), kind="stable")
        t, angles, speed = (
            np.concatenate([each[inside], at])[order]
            for each, at in ((self.t, edges), (self._angles, angles), (self._speed, speed))
        )
        at_edge = np.flatnonzero(order >= len(order) - len(edges))
        # By how much each axis is elsewhere than read, (k, axis, 5).
        change = np.zeros((len(t), 2, len(ENCODER_ERRORS)))
        for axis in range(2):
            change[:, axis, 2 * axis] = -np.sin(angles[:, axis])
            change[:, axis, 2 * axis + 1] = -np.cos(angles[:, axis])
        change[:, :, 4] = -speed
        begin, end = angles[:-1], angles[1:]
        middle, duration = 0.5 * (begin + end), np.diff(t)
        outer_axis = _in_platform(np.broadcast_to(_EX, (len(t), 3)), angles[:, 1])
        axes = np.stack([outer_axis, np.zeros_like(outer_axis)], axis=3)
        axes[:, 0, 2, 1] = 1.0
        # w x phi of 1 rad about each axis; the outer axis carries what it turns through the base's rate.
        crossing = np.stack(
            [
                so3.cross(_EZ, _in_platform(np.broadcast_to(_EX, (len(duration), 3)), middle[:, 1]))
                * (end - begin)[:, 1, None, None]
                + duration[:, None, None]
                * _in_platform(so3.cross(self._base_rate_turned(middle[:, 0]), _EX), middle[:, 1]),
                so3.cross(self._arc(duration, begin, end), _EZ),
            ],
            axis=3,
        )
        mean = 0.5 * (change[:-1] + change[1:])
        windows = [slice(*ends) for ends in pairwise(at_edge)]
        swept = [np.tensordot(crossing[rows], mean[rows], axes=((0, 3), (0, 1))) for rows in windows]
        turned = np.einsum("kpia,kae->kpie", axes[at_edge], change[at_edge])
        total = np.diff(turned, axis=0) + np.array(swept)
        return np.asarray(total / np.diff(edges)[:, None, None, None])

    def _interpolation(self, at: Array, i: Index) -> tuple[Array, Index]:
        """Weights and sample indices (n, 4) for cubic interpolation of the angles at times in the intervals i.

        Cubic: the straight line between the two neighbours, corrected by the curvature that the next two show.
        """
        samples = np.clip(i[:, None] + np.array([-1, 0, 1, 2]), 0, len(self.t) - 1)
        share = (at - self.t[i]) / (self.t[i + 1] - self.t[i])
        # Where a neighbour lies beyond a pause or the ends, the line stays straight.
        steps = np.diff(self.t[samples], axis=1)
        even = (np.ptp(steps, axis=1) < 0.1 * steps[:, 1]) & (steps > 0.0).all(axis=1)
        bend = np.where(even, 0.25 * share * (1.0 - share), 0.0)
        return np.stack([-bend, 1.0 - share + bend, share + bend, -bend], axis=1), samples

    def _arc(self, duration: Array, begin: Array, end: Array) -> Array:
        """Integrals (n, part, 3) of the platform rate for uniform rotation of both axes from begin to end (n, 2)."""
        turned = end - begin
        middle, half = begin[:, 1] + 0.5 * turned[:, 1], 0.5 * turned[:, 1]
        by_outer = (turned[:, 0] * np.sinc(half / np.pi))[:, None]
        out = np.zeros((len(duration), 3, 3))
        out[:, 0, 2] = turned[:, 1]
        out[:, 1, :2] = by_outer * np.stack([np.cos(middle), -np.sin(middle)], axis=1)
        out[:, 2, 2] = turned[:, 0]
        for share in _GAUSS:
            angles = begin + share * turned
            out += 0.5 * duration[:, None, None] * _in_platform(self._base_rate_turned(angles[:, 0]), angles[:, 1])
        return out

    def _base_rate_turned(self, outer: Array) -> Array:
        """Inertial rate of the base in the frame behind the outer axis, (n, 3), rad/s."""
        x, y, z = self._base_rate
        c, s = np.cos(outer), np.sin(outer)
        return np.stack([np.full_like(c, x), c * y + s * z, c * z - s * y], axis=1)


def _in_platform(vectors: Array, inner: Array) -> Array:
    """Rotate vectors (n, 3) from the frame behind the outer axis to t, as parts (n, part, 3)."""
    vx, vy, vz = vectors.T
    c, s = np.cos(inner), np.sin(inner)
    zero = np.zeros_like(vx)
    parts = [[s * vy, c * vy, zero], [c * vx, -s * vx, vz], [-c * vz, s * vz, vx]]
    return np.moveaxis(np.array(parts), 2, 0)


def gyro_edges(t: Array) -> Array:
    """Edges (N + 1,), s, of the averaging intervals of gyro samples at stamps (N,): midpoints of stamps."""
    middle = 0.5 * (t[1:] + t[:-1])
    return np.concatenate([[2.0 * t[0] - middle[0]], middle, [2.0 * t[-1] - middle[-1]]])


def gyro_means(edges: Array, rate: Array, cuts: Index) -> Array:
    """Mean gyro rates (n, 3) between consecutive cuts (n + 1,), weighted by the intervals between edges."""
    edges = edges[cuts[0] : cuts[-1] + 1]
    moved = rate[cuts[0] : cuts[-1]] * np.diff(edges)[:, None]
    at = cuts - cuts[0]
    return np.asarray(np.add.reduceat(moved, at[:-1], axis=0) / np.diff(edges[at])[:, None])


@dataclass(frozen=True)
class IndexerAverageFactor(Model):
    """Mean gyro rate over n adjoining windows against the mean rate by encoders and earth.

        gyro = (I + S) mRt w + bias + c dT,    w = fixed + cos(epsilon) cosine + sin(epsilon) sine

    compared in frame t, where encoder noise has fixed directions. Blocks: theta (3), gyro bias (3, rad/s), then
    the options: "errors" (6), the numbers of S as alidade.factors.gyro has them; "temperature" (3, rad/s/K), which is
    c; "encoder" (5), the encoders' errors, on which w depends linearly; "epsilon" (1, rad); "tilt" (3, rad), a small
    rotation of the true platform rate against the encoders' account of it, w -> Exp(tilt) w, for errors that come again
    with every turn.

    Attributes:
        gyro: (n, 3) mean rates, rad/s.
        rates: the platform's mean rates over the same windows.
        sqrt_information: (3 n, 3 n) of the difference, in t: neighbours share the encoder noise at their common edge.
        options: those that are variables, in the order of their blocks; the others are zero.
        theta_unit: rad, what theta's block counts.
        temperature: (n,) dT, K: mean over the windows, above the temperature that the bias refers to; needed for c.
    """

    gyro: Array
    rates: PlatformRates
    sqrt_information: Array
    options: tuple[Option, ...] = ()
    theta_unit: float = 1.0
    temperature: Array | None = None
    shapes: ClassVar = {"gyro": (3,)}
    rows: int = 3

    @classmethod
    def of(
        cls,
        gyro: Array,
        rates: PlatformRates,
        density: float,
        encoder: ArrayLike,
        options: tuple[Option, ...] = (),
        wander: float = 0.0,
        theta_unit: float = 1.0,
        temperature: Array | None = None,
    ) -> IndexerAverageFactor:
        """Build a factor with sqrt_information from the noise of the sensors.

        Args:
            gyro, rates, options, theta_unit, temperature: as the attributes.
            density: gyro noise, rad/s/sqrt(Hz): angle random walk in each window.
            encoder: white encoder noise at the edges, rad, one for both axes or (2,) for outer and inner.
            wander: error of the encoders' account of the platform's attitude, about any axis, rad, that changes from
                edge to edge: it turns the platform between the edges, and its mean turns the rate.
        """
        both = np.broadcast_to(np.asarray(encoder, dtype=float), 2)
        sigmas = np.concatenate([np.tile(both, len(rates.edges)), np.repeat(both[1], len(gyro))])
        covariance = (rates.noise * sigmas**2) @ rates.noise.T
        covariance += np.diag(np.repeat(density**2 / np.diff(rates.edges), 3))
        ends = np.diff(np.eye(len(rates.edges)), axis=0) / np.diff(rates.edges)[:, None]
        covariance += wander**2 * np.kron(ends @ ends.T, np.eye(3))
        across = so3.hat(rates.fixed + rates.cosine)
        for i, block in enumerate(across @ np.swapaxes(across, 1, 2)):
            covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += wander**2 * block
        return cls(gyro, rates, np.linalg.inv(np.linalg.cholesky(covariance)), options, theta_unit, temperature)

    @property
    def time(self) -> Array:
        """End times of the windows (n,), s."""
        return self.rates.edges[1:]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: theta, bias and the options."""
        return (3, 3, *(_SIZES[option] for option in self.options))

    def __call__(self, theta: Array, bias: Array, *more: Array) -> Residuals:
        """Residual sqrt_information * (tRm (I + S)^-1 (gyro - bias - c dT) - Exp(tilt) w), (n, 3)."""
        given = dict(zip(self.options, more, strict=True))
        epsilon, tilt = given.get("epsilon", np.zeros(1)), given.get("tilt", np.zeros(3))
        theta = self.theta_unit * theta
        tRm = so3.from_angles(theta)
        corrected, N = self.gyro - bias, np.asarray(np.eye(3))
        if "temperature" in given:
            corrected = corrected - needed(self.temperature)[:, None] * given["temperature"]
        if "errors" in given:
            N = np.asarray(np.linalg.inv(np.eye(3) + symmetric(given["errors"])))
            corrected = np.einsum("nij,nj->ni", N, corrected)
        parts = self.rates.parts(given.get("encoder", np.zeros(len(ENCODER_ERRORS))))
        encoders = parts[:, 0] + np.cos(epsilon) * parts[:, 1] + np.sin(epsilon) * parts[:, 2]
        turn = so3.exp(tilt)
        error = so3.rotate(tRm, corrected) - so3.rotate(turn, encoders)

        def jacobians() -> tuple[Array, ...]:
            by_gyro = so3.matrix(tRm) @ N
            cosine, sine = np.cos(epsilon)[..., None], np.sin(epsilon)[..., None]
            by_encoder = self.rates.by_encoder
            by_epsilon = -np.sin(epsilon) * parts[:, 1] + np.cos(epsilon) * parts[:, 2]
            blocks: dict[Option, Callable[[], Array]] = {
                "errors": lambda: -by_symmetric(by_gyro[..., None] * corrected[:, None, None]),
                "temperature": lambda: -by_gyro * needed(self.temperature)[:, None, None],
                "encoder": lambda: (
                    -so3.matrix(turn) @ (by_encoder[:, 0] + cosine * by_encoder[:, 1] + sine * by_encoder[:, 2])
                ),
                "epsilon": lambda: -so3.rotate(turn, by_epsilon)[..., None],
                "tilt": lambda: so3.matrix(turn) @ so3.hat(encoders) @ so3.right_jacobian(tilt),
            }
            by_theta = -so3.matrix(tRm) @ so3.hat(corrected) @ _angle_axes(theta) * self.theta_unit
            return tuple(self._whiten(block) for block in (by_theta, -by_gyro, *(blocks[o]() for o in self.options)))

        return self._whiten(error[..., None])[..., 0], jacobians

    def _whiten(self, block: Array) -> Array:
        """Multiply blocks (n, 3, d) by sqrt_information."""
        return np.asarray((self.sqrt_information @ block.reshape(-1, block.shape[2])).reshape(block.shape))


def _angle_axes(theta: Array) -> Array:
    """Rotation axes in m, columns (n, 3, 3), for increments of theta_x, theta_y, theta_z."""
    about_x = so3.exp(-theta[:, :1] * _EX)
    about_y = so3.multiply(about_x, so3.exp(-theta[:, 1:2] * _EY))
    axes = [np.broadcast_to(_EX, theta.shape), so3.rotate(about_x, _EY), so3.rotate(about_y, _EZ)]
    return np.stack(axes, axis=2)
