"""A two-axis gimbal as its encoders read it, and how it and a gyro move around given moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from alidade.factors.model import Array

# Motion around a picture is smoothed over this time to either side, s: long against noise, short against sway.
SMOOTHING = 0.2
# A central difference over this time, s, has a command's own rate to 1e-8.
_STEP = 1e-4
# Moments whose samples are held at a time: few enough for the processor's cache.
_TOGETHER = 500
# Times worked on at once.
_BLOCK = 100_000


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
        at = np.asarray(at, dtype=float)
        out = np.empty((len(at), 2))
        # Weights of all at once would take fifty times the memory of the times.
        for i in range(0, len(at), _BLOCK):
            samples, weights = self.weights(at[i : i + _BLOCK])
            out[i : i + _BLOCK] = np.einsum("nk,nki->ni", weights, self.angles[samples])
        return out


@dataclass(frozen=True)
class LocalMotion:
    """How gyro and gimbal move around the stamps of n pictures, smoothed.

    A time offset must not be read off the noise of the sensors: what the stabilisation leaves of the picture's motion
    is no larger than what noise puts into rates, and the gimbal follows the noise of the gyro that drives it. So the
    gimbal's rate is its command at the gyro's smoothed rate, with the same noise, and what it does beyond commands.

    Attributes:
        rate, acceleration: (n, 3) of the gyro, rad/s and rad/s^2.
        gimbal, gimbal_rate, gimbal_acceleration: (n, 2) of azimuth and elevation, rad, rad/s and rad/s^2.
        drivers: (n, d) of the gyro, see alidade.factors.gyro; None where it has none.
    """

    rate: Array
    acceleration: Array
    gimbal: Array
    gimbal_rate: Array
    gimbal_acceleration: Array
    drivers: Array | None = None
    stacked: ClassVar = ("rate", "acceleration", "gimbal", "gimbal_rate", "gimbal_acceleration", "drivers")

    @classmethod
    def around(
        cls, at: Array, gyro_t: Array, gyro: Array, gimbal: GimbalPath, drivers: Array | None = None
    ) -> LocalMotion:
        """From polynomials fitted to the samples within about SMOOTHING s: of degree 2 to rates, 3 to angles."""
        rates = _local_polynomials(at, gyro_t, gyro, 2)
        driving = None if drivers is None else _local_polynomials(at, gyro_t, drivers, 2)[:, 0].copy()
        commanded = _commanded(gyro_t, gyro, gimbal)
        on_the_way, reached = (
            np.stack([np.interp(t, gyro_t, each) for each in commanded.T], axis=1) for t in (gimbal.t, at)
        )
        rest = _local_polynomials(at, gimbal.t, gimbal.angles - on_the_way, 3)
        angles, rate, acceleration = gimbal.at(at), rates[:, 0], rates[:, 1]
        gimbal_rate = command(rate, angles) + rest[:, 1]
        # How the command changes with the rate and with the angles.
        ahead = command(rate + _STEP * acceleration, angles + _STEP * gimbal_rate)
        back = command(rate - _STEP * acceleration, angles - _STEP * gimbal_rate)
        gimbal_acceleration = (ahead - back) / (2.0 * _STEP) + 2.0 * rest[:, 2]
        return cls(rate, acceleration, reached + rest[:, 0], gimbal_rate, gimbal_acceleration, driving)

    def __getitem__(self, rows: Any) -> LocalMotion:
        """The motion around some of the pictures."""
        return LocalMotion(
            self.rate[rows],
            self.acceleration[rows],
            self.gimbal[rows],
            self.gimbal_rate[rows],
            self.gimbal_acceleration[rows],
            None if self.drivers is None else self.drivers[rows],
        )


def command(rate: Array, angles: Array) -> Array:
    """Rates of azimuth and elevation (n, 2), rad/s, that hold the line of sight still at carrier rates (n, 3), rad/s.

    CN102288133B, of a gyro and a camera mounted straight; angles (n, 2) are azimuth and elevation, rad.
    """
    s, c = np.sin(angles[:, 0]), np.cos(angles[:, 0])
    wx, wy, wz = rate.T
    return np.stack([np.tan(angles[:, 1]) * (c * wy - s * wx) - wz, -c * wx - s * wy], axis=1)


def _commanded(t: Array, rate: Array, gimbal: GimbalPath) -> Array:
    """Angles (n, 2), rad, through which the gimbal has been commanded since the first of the gyro's samples."""
    out = np.zeros((len(t), 2))
    for i in range(0, len(t) - 1, _BLOCK):
        some = slice(i, i + _BLOCK + 1)
        rates = command(rate[some], gimbal.at(t[some]))
        steps = 0.5 * np.diff(t[some])[:, None] * (rates[1:] + rates[:-1])
        out[i + 1 : i + _BLOCK + 1] = out[i] + np.cumsum(steps, axis=0)
    return out


def _local_polynomials(at: Array, t: Array, values: Array, degree: int) -> Array:
    """Coefficients (n, degree + 1, d), lowest first, of polynomials about the times fitted to the samples."""
    count = int(np.clip(2.0 * SMOOTHING / np.median(np.diff(t)), 2 * degree + 1, len(t)))
    scale = SMOOTHING ** np.arange(degree + 1)
    out = np.empty((len(at), degree + 1, values.shape[1]))
    stamps, rows = sliding_window_view(t, count), sliding_window_view(values, count, axis=0)
    for some in np.array_split(np.arange(len(at)), len(at) // _TOGETHER + 1):
        first = np.clip(np.searchsorted(t, at[some]) - count // 2, 0, len(t) - count)
        x = (stamps[first] - at[some, None]) / SMOOTHING
        powers = np.ones((len(x), degree + 1, count))
        for k in range(degree):  # by products, which cost a tenth of powers
            powers[:, k + 1] = powers[:, k] * x
        transposed = np.swapaxes(powers, 1, 2)
        out[some] = np.linalg.solve(powers @ transposed, powers @ np.swapaxes(rows[first], 1, 2)) / scale[:, None]
    return out
