"""The published linear model of line-of-sight rates, with and without the terms that the publication leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors.array import Array
from alidade.factors.gimbal import GimbalPath
from alidade.factors.model import Model, Residuals


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
    shapes: ClassVar = {"measured": (2,), "H": (2, 4), "sigma": ()}
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
