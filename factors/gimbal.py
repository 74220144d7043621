"""A two-axis gimbal as its encoders read it, and how it and a gyro move around given moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from alidade.factors.model import Array

# Motion around a picture is fitted over this time to either side, s, by polynomials of this degree: they follow swings
# of 5 Hz to 1e-2 (and to .02 s from the picture), and noise of a gyro is a fourth of what its samples have.
FITTED, DEGREE = 0.06, 4
# What a gimbal does beyond commands is slow over this time to either side, s, but for a share of these (a gyro's scale)
# and a delay (of its encoders), one sigma, s.
SLOW, SHARE, DELAY = 0.2, 1e-2, 1e-2
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
    """How gyro and gimbal move around the stamps of n pictures: polynomials fitted to their samples.

    A time offset must not be read off the noise of the sensors: what the stabilisation leaves of the picture's motion
    is no larger than what noise puts into rates, and the gimbal follows the noise of the gyro that drives it. So the
    gimbal's rate is its command at the gyro's samples, fitted as these are, with the same noise, and what it does
    beyond commands: a share of them and a delay, by least squares, and a rest that is slow.

    Attributes:
        rate: (n, DEGREE + 1, 3) of the gyro, coefficients by powers of the time from the stamp, rad/s^(k + 1).
        gimbal: (n, 2) azimuth and elevation at the stamps, rad.
        gimbal_rate: (n, DEGREE + 1, 2) of these, likewise.
        drivers: (n, d) of the gyro, see alidade.factors.gyro; None where it has none.
    """

    rate: Array
    gimbal: Array
    gimbal_rate: Array
    drivers: Array | None = None
    stacked: ClassVar = ("rate", "gimbal", "gimbal_rate", "drivers")

    @classmethod
    def around(
        cls, at: Array, gyro_t: Array, gyro: Array, gimbal: GimbalPath, drivers: Array | None = None
    ) -> LocalMotion:
        """From polynomials of degree DEGREE over about FITTED s to either side, of the rest of degree 3 over SLOW s."""
        commands = command(gyro, gimbal.at(gyro_t))
        commanded = np.zeros((len(gyro_t), 2))
        np.cumsum(0.5 * np.diff(gyro_t)[:, None] * (commands[1:] + commands[:-1]), axis=0, out=commanded[1:])
        (on_the_way, driven), (reached, driving_at) = (
            [np.stack([np.interp(t, gyro_t, each) for each in of.T], axis=1) for of in (commanded, commands)]
            for t in (gimbal.t, at)
        )
        others = [] if drivers is None else [drivers]
        fitted = _local_polynomials(at, gyro_t, FITTED, DEGREE, gyro, commands, *others)
        slow = _local_polynomials(at, gimbal.t, SLOW, 3, gimbal.angles - on_the_way, on_the_way, driven)
        causes = np.hstack([reached, driving_at]) - slow[:, 0, 2:]
        share = _shares(causes, gimbal.at(at) - reached - slow[:, 0, :2])
        rest = slow[..., :2] - slow[..., 2:] @ share
        rates = fitted[..., 3:5] @ (np.eye(2) + share[:2])
        steps = np.arange(1, DEGREE + 1)[:, None]
        rates[:, :-1] += steps * (fitted[:, 1:, 3:5] @ share[2:])
        rates[:, :3] += steps[:3] * rest[:, 1:]
        angles = reached + rest[:, 0] + np.hstack([reached, driving_at]) @ share
        return cls(fitted[..., :3].copy(), angles, rates, None if drivers is None else fitted[:, 0, 5:].copy())

    def __getitem__(self, rows: Any) -> LocalMotion:
        """The motion around some of the pictures."""
        drivers = None if self.drivers is None else self.drivers[rows]
        return LocalMotion(self.rate[rows], self.gimbal[rows], self.gimbal_rate[rows], drivers)


def polynomial(coefficients: Array, at: Array) -> Array:
    """Polynomials (n, d) with coefficients (n, k, d), lowest first, at (n,)."""
    return np.einsum("nkd,nk->nd", coefficients, at[:, None] ** np.arange(coefficients.shape[1]))


def integral(coefficients: Array, to: Array) -> Array:
    """Integrals (n, d) of polynomials with coefficients (n, k, d), lowest first, from 0 to (n,)."""
    powers = np.arange(1, coefficients.shape[1] + 1)
    return np.einsum("nkd,nk->nd", coefficients, to[:, None] ** powers / powers)


def command(rate: Array, angles: Array) -> Array:
    """Rates of azimuth and elevation (n, 2), rad/s, that hold the line of sight still at carrier rates (n, 3), rad/s.

    CN102288133B, of a gyro and a camera mounted straight; angles (n, 2) are azimuth and elevation, rad.
    """
    s, c = np.sin(angles[:, 0]), np.cos(angles[:, 0])
    wx, wy, wz = rate.T
    return np.stack([np.tan(angles[:, 1]) * (c * wy - s * wx) - wz, -c * wx - s * wy], axis=1)


def _shares(causes: Array, left: Array) -> Array:
    """(4, 2) shares of causes (n, 4), angles and rates of two commands, in what is left (n, 2) of the angles.

    Where motion is slow nothing of the causes is left, and of shares only what is usual is known: SHARE and DELAY.
    """
    noise = np.maximum(left.std(axis=0), 1e-12)
    usual = np.repeat([SHARE, DELAY], 2)
    scaled = causes * usual
    return np.stack(
        [
            usual * np.linalg.solve(scaled.T @ scaled + s**2 * np.eye(4), scaled.T @ y)
            for y, s in zip(left.T, noise, strict=True)
        ],
        axis=1,
    )


def _local_polynomials(at: Array, t: Array, within: float, degree: int, *values: Array) -> Array:
    """Coefficients (n, degree + 1, d), lowest first, of polynomials about the times, fitted to samples side by side.

    Within so many s to either side of each.
    """
    count = int(np.clip(2.0 * within / np.median(np.diff(t)), 2 * degree + 1, len(t)))
    scale = within ** np.arange(degree + 1)
    out = np.empty((len(at), degree + 1, sum(each.shape[1] for each in values)))
    stamps, rows = sliding_window_view(t, count), [sliding_window_view(each, count, axis=0) for each in values]
    for some in np.array_split(np.arange(len(at)), len(at) // _TOGETHER + 1):
        first = np.clip(np.searchsorted(t, at[some]) - count // 2, 0, len(t) - count)
        x = (stamps[first] - at[some, None]) / within
        powers = np.ones((len(x), degree + 1, count))
        for k in range(degree):  # by products, which cost a tenth of powers
            powers[:, k + 1] = powers[:, k] * x
        samples = np.swapaxes(np.concatenate([each[first] for each in rows], axis=1), 1, 2)
        out[some] = np.linalg.solve(powers @ np.swapaxes(powers, 1, 2), powers @ samples) / scale[:, None]
    return out
