"""Factors of the los method: where a fixed target stands in the camera of a gyro-stabilised two-axis gimbal.

Frames: m gyro (IMU) on the carrier; b carrier; c camera on the gimbal, x right, y along the line of sight (LOS), z up;
t target, y towards it, z up its texture. The target does not turn, so t serves as the inertial frame: where the target
stands is part of the attitudes tRm, and a new target is a new chain of attitudes.

With the passive matrices Rx(a) = Exp(a ex)^T of CN102288133B, azimuth eta and elevation eps,

    cRm = Ry(camera_roll) Rz(collimation) Rx(eps + px) Ry(axis_nonperpendicularity) Rz(eta + dz) Rx(-gx) Ry(-gy),

dz = pz - gz. The LOS error (phx, phz) says that the target lies along (tan phz, 1, -tan phx) in c. Source: methods
page, section 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import so3
from factors.model import ROT3, Array, Block, Model, Residuals

# The turns of cRm, right to left, and their axes.
_TURNS = {
    "gy": 1,
    "gx": 0,
    "azimuth": 2,
    "axis_nonperpendicularity": 1,
    "elevation": 0,
    "collimation": 2,
    "camera_roll": 1,
}
# Motion around a picture is smoothed over this time to either side, s: long against noise, short against sway.
SMOOTHING = 0.2

# Which turn an angle adds to, and its sign.
_PLACES = {
    "delta_px": ("elevation", 1.0),
    "delta_gx": ("gx", -1.0),
    "delta_gy": ("gy", -1.0),
    "delta_z": ("azimuth", 1.0),
    "delta_pz": ("azimuth", 1.0),
    "delta_gz": ("azimuth", -1.0),
    "camera_roll": ("camera_roll", 1.0),
    "collimation": ("collimation", 1.0),
    "axis_nonperpendicularity": ("axis_nonperpendicularity", 1.0),
}


class GimbalPath:
    """Gimbal angles at any time: the cubic through the two encoder samples on either side.

    Args:
        t: (G,) stamps, s, increasing, G >= 4.
        angles: (G, 2) azimuth and elevation, rad, continuous.
    """

    def __init__(self, t: ArrayLike, angles: ArrayLike) -> None:
        self.t = np.asarray(t, dtype=float)
        self.angles = np.asarray(angles, dtype=float)
        if len(self.t) < 4 or self.angles.shape != (len(self.t), 2):
            raise ValueError(f"needs stamps (G,) and angles (G, 2), G >= 4; got {self.t.shape} and {self.angles.shape}")

    def weights(self, at: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        """The four samples (n, 4) around each time and their weights (n, 4), Lagrange's polynomials."""
        at = np.asarray(at, dtype=float)
        first = np.clip(np.searchsorted(self.t, at, side="right") - 2, 0, len(self.t) - 4)
        samples = first[:, None] + np.arange(4)
        nodes = self.t[samples]
        away, apart = at[:, None] - nodes, nodes[:, :, None] - nodes[:, None, :] + np.eye(4)
        factors = np.where(np.eye(4, dtype=bool), 1.0, away[:, None, :] / apart)
        return samples, factors.prod(axis=2)

    def at(self, at: ArrayLike) -> Array:
        """Angles (n, 2), rad, at the times."""
        samples, weights = self.weights(at)
        return np.einsum("nk,nki->ni", weights, self.angles[samples])


@dataclass(frozen=True)
class LocalMotion:
    """How gyro and gimbal move around the stamps of n pictures, smoothed.

    A time offset must not be read off the noise of the sensors: what the stabilisation leaves of the picture's motion
    is no larger than what noise puts into rates from sample to sample.

    Attributes:
        rate, acceleration: (n, 3) of the gyro, rad/s and rad/s^2.
        gimbal_rate, gimbal_acceleration: (n, 2) of azimuth and elevation, rad/s and rad/s^2.
    """

    rate: Array
    acceleration: Array
    gimbal_rate: Array
    gimbal_acceleration: Array
    stacked: ClassVar = ("rate", "acceleration", "gimbal_rate", "gimbal_acceleration")

    @classmethod
    def around(cls, at: Array, gyro_t: Array, gyro: Array, gimbal: GimbalPath) -> LocalMotion:
        """From polynomials fitted to the samples within about SMOOTHING s: of degree 2 to rates, 3 to angles."""
        rates = _local_polynomials(at, gyro_t, gyro, 2)
        angles = _local_polynomials(at, gimbal.t, gimbal.angles, 3)
        return cls(rates[:, 0], rates[:, 1], angles[:, 1], 2.0 * angles[:, 2])

    def __getitem__(self, rows: Any) -> LocalMotion:
        """The motion around some of the pictures."""
        return LocalMotion(
            self.rate[rows], self.acceleration[rows], self.gimbal_rate[rows], self.gimbal_acceleration[rows]
        )


def _local_polynomials(at: Array, t: Array, values: Array, degree: int) -> Array:
    """Coefficients (n, degree + 1, d), lowest first, of polynomials about the times fitted to the samples."""
    count = int(np.clip(2.0 * SMOOTHING / np.median(np.diff(t)), 2 * degree + 1, len(t)))
    scale = SMOOTHING ** np.arange(degree + 1)
    out = np.empty((len(at), degree + 1, values.shape[1]))
    for some in np.array_split(np.arange(len(at)), len(at) // 2000 + 1):
        first = np.clip(np.searchsorted(t, at[some]) - count // 2, 0, len(t) - count)
        samples = first[:, None] + np.arange(count)
        powers = ((t[samples] - at[some, None]) / SMOOTHING)[..., None] ** np.arange(degree + 1)
        transposed = np.swapaxes(powers, 1, 2)
        out[some] = np.linalg.solve(transposed @ powers, transposed @ values[samples]) / scale[:, None]
    return out


@dataclass(frozen=True)
class LosDirectionFactor(Model):
    """LOS errors of one fixed target, exact for mounting angles of any size.

    Predicted: phz = atan2(dx, dy), phx = -atan2(dz, dy) with d = cRm tRm^T ey and, as a third row, the camera's roll
    about its line of sight, the twist about y that takes the target's texture to its picture: the rotation part of the
    picture's local similarity. Blocks: tRm at the stamps (rotations), the mounting angles `names` (rad), and with
    `motion` the gyro bias (3, rad/s) and the time offset (1, s; positive when the picture was taken later than its
    stamp says).

    Attributes:
        time: (n,) stamps of the pictures, s.
        measured: (n, 2) phx, phz, or (n, 3) with the roll, rad.
        sqrt_information: (n, 2, 2) or (n, 3, 3), 1/rad.
        gimbal: (n, 2) azimuth and elevation at the stamps, rad.
        names: the mounting angles that are variables; all others are zero.
        motion: around the stamps, when the time offset is a variable.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    gimbal: Array
    names: tuple[str, ...] = ("delta_px", "delta_gx", "delta_gy", "delta_z")
    motion: LocalMotion | None = None
    stacked: ClassVar = ("time", "measured", "sqrt_information", "gimbal", "motion")

    @property
    def rows(self) -> int:
        """2, or 3 with the roll."""
        return self.measured.shape[1]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """tRm, the angles and, with motion, bias and time offset."""
        return (ROT3, len(self.names)) if self.motion is None else (ROT3, len(self.names), 3, 1)

    def __call__(self, tRm: Array, angles: Array, bias: Array | None = None, dt: Array | None = None) -> Residuals:
        """Residual sqrt_information * (measured - predicted), (n, 2) or (n, 3)."""
        if self.motion is None or bias is None or dt is None:
            return self._residuals(tRm, angles, self.gimbal)
        move = self.motion
        gimbal_rate = move.gimbal_rate + move.gimbal_acceleration * dt
        gimbal = self.gimbal + (move.gimbal_rate + 0.5 * move.gimbal_acceleration * dt) * dt
        rate = move.rate + move.acceleration * dt - bias
        arc = (move.rate + 0.5 * move.acceleration * dt - bias) * dt
        turn = so3.exp(arc)
        residual, late_jacobians = self._residuals(so3.multiply(tRm, turn), angles, gimbal, gimbal_rate)

        def jacobians() -> tuple[Array, ...]:
            by_attitude, by_angles, by_gimbal = late_jacobians()
            by_arc = by_attitude @ so3.right_jacobian(arc)
            return (
                by_attitude @ so3.matrix(so3.inverse(turn)),
                by_angles,
                by_arc * -dt[:, :, None],
                by_arc @ rate[..., None] + by_gimbal,
            )

        return residual, jacobians

    def camera(self, angles: Array) -> Array:
        """cRm (n, 4) at the stamps and mounting angles (n, d), rad."""
        turned = self._camera(so3.identity(len(angles)), angles, self.gimbal)
        return so3.from_matrix(turned[:, :3].transpose(2, 0, 1))

    def predict(self, tRm: Array, angles: Array) -> Array:
        """phx, phz and roll, (n, 3), rad, at attitudes tRm (n, 4) and angles (n, d)."""
        return _picture(self._camera(tRm, angles, self.gimbal)[:, :3])

    @cached_property
    def _places(self) -> tuple[list[str], Array]:
        """The turns that matter, and what each angle adds to each of them."""
        touched = {_PLACES[name][0] for name in self.names} | {"azimuth", "elevation"}
        turns = [turn for turn in _TURNS if turn in touched]
        places = np.zeros((len(turns), len(self.names)))
        for i, name in enumerate(self.names):
            turn, sign = _PLACES[name]
            places[turns.index(turn), i] = sign
        return turns, places

    def _camera(self, tRm: Array, angles: Array, gimbal: Array) -> Array:
        """cRt and beside it the axes of the turns in c, (3, 3 + turns, n)."""
        turns, places = self._places
        angle = places @ angles.T
        angle[turns.index("azimuth")] += gimbal[:, 0]
        angle[turns.index("elevation")] += gimbal[:, 1]
        out = np.zeros((3, 3 + len(turns), len(tRm)))
        out[:, :3] = so3.matrix(tRm).transpose(2, 1, 0)
        cosine, sine = np.cos(angle), np.sin(angle)
        for i, turn in enumerate(turns):
            axis = _TURNS[turn]
            j, k = (axis + 1) % 3, (axis + 2) % 3
            upper, lower = out[j, : 3 + i], out[k, : 3 + i]
            rows = cosine[i] * upper + sine[i] * lower, cosine[i] * lower - sine[i] * upper
            out[j, : 3 + i], out[k, : 3 + i] = rows
            out[axis, 3 + i] = 1.0
        return out

    def _residuals(self, tRm: Array, angles: Array, gimbal: Array, gimbal_rate: Array | None = None) -> Residuals:
        """Residuals; Jacobians by tRm, by the angles and, given the gimbal's rates, by time through the gimbal."""
        camera = self._camera(tRm, angles, gimbal)
        error = self.measured - _picture(camera[:, :3])[:, : self.rows]
        if self.rows == 3:
            error[:, 2] = (error[:, 2] + np.pi) % (2.0 * np.pi) - np.pi

        def jacobians() -> tuple[Array, ...]:
            turns, places = self._places
            # A passive turn by da moves the picture by Exp(-da axis), a right perturbation of tRm by Exp(-cRm delta).
            cRt = camera[:, :3].transpose(2, 0, 1)
            weighted = self.sqrt_information @ _picture_jacobian(camera[:, :3])[:, : self.rows]
            by_turn = weighted @ camera[:, 3:].transpose(2, 0, 1)
            blocks = weighted @ cRt @ so3.matrix(tRm), by_turn @ places
            if gimbal_rate is None:
                return blocks
            columns = [turns.index("azimuth"), turns.index("elevation")]
            return *blocks, by_turn[:, :, columns] @ gimbal_rate[..., None]

        return np.einsum("nij,nj->ni", self.sqrt_information, error), jacobians


def _picture(cRt: Array) -> Array:
    """phx, phz, roll, (n, 3), of the target in cameras cRt (3, 3, n)."""
    x, y, z = cRt[:, 1]
    roll = np.arctan2(cRt[2, 0] - cRt[0, 2], cRt[0, 0] + cRt[2, 2])
    return np.stack([-np.arctan2(z, y), np.arctan2(x, y), roll], axis=1)


def _picture_jacobian(cRt: Array) -> Array:
    """Derivative (n, 3, 3) of phx, phz, roll by xi in Exp(xi) cRt."""
    x, y, z = cRt[:, 1]
    out = np.empty((cRt.shape[2], 3, 3))
    yz, xy = y * y + z * z, x * x + y * y
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = -1.0, x * y / yz, x * z / yz
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = x * z / xy, y * z / xy, -1.0
    sine, cosine = cRt[2, 0] - cRt[0, 2], cRt[0, 0] + cRt[2, 2]
    square = sine * sine + cosine * cosine
    a, b = cRt[1, 0], cRt[1, 2]
    out[:, 2, 0] = (cosine * a - sine * b) / square
    out[:, 2, 1] = -1.0
    out[:, 2, 2] = (cosine * b + sine * a) / square
    return out


@dataclass(frozen=True)
class LosRateFactor(Model):
    """The linear model: LOS rates = H X, X = [px, gx, gy, dz] (static), second-order terms dropped. Block: X (4, rad).

    Attributes:
        time: (n,) middles of the intervals between pictures, s.
        measured: (n, 2) mean rates of phx and phz over the intervals, rad/s.
        H: (n, 2, 4) means over the intervals, rad/s per rad.
        sigma: (n,) of each rate, rad/s.
    """

    time: Array
    measured: Array
    H: Array
    sigma: Array
    rows: int = 2
    blocks = (4,)

    @classmethod
    def between(
        cls,
        t: Array,
        error: Array,
        gyro_t: Array,
        gyro: Array,
        gimbal: GimbalPath,
        sigma: float,
        exact: bool = True,
        roll: bool = True,
    ) -> LosRateFactor:
        """The factor over the intervals between pictures.

        Args:
            t: (K,) stamps of the pictures, s, within the gyro's and the gimbal's.
            error: (K, 2) phx, phz, rad.
            gyro_t, gyro: (N,) and (N, 3), s and rad/s.
            gimbal: the gimbal's angles.
            sigma: of one LOS error, rad; differencing makes it sqrt(2) sigma / interval.
            exact: H with the term -sin(eps) eta' of H2,1 that the publication leaves out.
            roll: take the rates in a frame that does not roll with the camera.
        """
        angles = gimbal.at(gyro_t)
        H = rate_matrix(angles, gyro, exact)
        if roll:
            rho = _running_integral(gyro_t, roll_rate(angles, gyro))
            H = _turned_back(rho) @ H
            error = np.einsum("nij,nj->ni", _turned_back(np.interp(t, gyro_t, rho)), error)
        integral = _running_integral(gyro_t, H.reshape(-1, 8))
        at_pictures = np.stack([np.interp(t, gyro_t, column) for column in integral.T], axis=1).reshape(-1, 2, 4)
        duration = np.diff(t)
        return cls(
            0.5 * (t[1:] + t[:-1]),
            np.diff(error, axis=0) / duration[:, None],
            np.diff(at_pictures, axis=0) / duration[:, None, None],
            np.sqrt(2.0) * sigma / duration,
        )

    def __call__(self, X: Array) -> Residuals:
        """Residual (H X - measured) / sigma, (n, 2)."""
        error = np.einsum("nij,nj->ni", self.H, X) - self.measured
        return error / self.sigma[:, None], lambda: (self.H / self.sigma[:, None, None],)


def rate_matrix(gimbal: Array, rate: Array, exact: bool = True) -> Array:
    """H (n, 2, 4) at azimuths and elevations (n, 2), rad, and carrier rates (n, 3), rad/s.

    CN102288133B without the stray elevation in H2,2; exact: with d(w_l)/d(px) complete, H2,1 = sec(eps)(s wx - c wy).
    """
    s, c = np.sin(gimbal[:, 0]), np.cos(gimbal[:, 0])
    se, ce = np.sin(gimbal[:, 1]), np.cos(gimbal[:, 1])
    wx, wy, wz = rate.T
    right, ahead = c * wx + s * wy, c * wy - s * wx
    by_px = -ahead / ce if exact else -ce * ahead - se * wz
    H = np.zeros((len(rate), 2, 4))
    H[:, 0, 1], H[:, 0, 2], H[:, 0, 3] = -s * wz, c * wz, ahead
    H[:, 1, 0] = by_px
    H[:, 1, 1], H[:, 1, 2] = se * c * wz + ce * wy, se * s * wz - ce * wx
    H[:, 1, 3] = se * right
    return H


def roll_rate(gimbal: Array, rate: Array) -> Array:
    """Rate (n,), rad/s, of the stabilised camera about its line of sight: sec(eps) (cos(eta) wy - sin(eta) wx)."""
    azimuth, elevation = gimbal.T
    return np.asarray((np.cos(azimuth) * rate[:, 1] - np.sin(azimuth) * rate[:, 0]) / np.cos(elevation))


def _turned_back(rho: Array) -> Array:
    """Rot(-rho), (n, 2, 2)."""
    c, s = np.cos(rho), np.sin(rho)
    return np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)


def _running_integral(t: Array, f: Array) -> Array:
    """Integral of samples f (N, ...) from the first stamp to each, by trapezoid."""
    steps = np.diff(t).reshape(-1, *[1] * (f.ndim - 1)) * 0.5 * (f[1:] + f[:-1])
    return np.concatenate([np.zeros((1, *f.shape[1:])), np.cumsum(steps, axis=0)])
