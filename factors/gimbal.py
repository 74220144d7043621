"""A two-axis gimbal as its encoders read it, and how it and a gyro move around given moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from alidade.factors.array import Array, Index, interpolated
from alidade.factors.model import Stacked

# Motion around a picture is smoothed over one of these times to either side, s: the longest that follows it. The first
# is long against noise, the last follows swings of 10 Hz.
WINDOWS = (0.2, 0.1, 0.05, 0.025)
# Samples left out to choose it, and the part by which prediction errors differ by chance.
_TRIED, _AS_GOOD = 500, 1.05
# Interval of the angles whose third differences are compared, s.
_FOLLOWING_INTERVAL = 0.1
# Of the polynomials.
_DEGREE = 3
# Moments whose samples are held at a time: few enough for the processor's cache.
_TOGETHER = 500
# Times worked on at once.
_BLOCK = 10_000


class GimbalPath:
    """Gimbal angles at any time, by cubic interpolation of two encoder samples on either side.

    Args:
        t: (G,) stamps, s, increasing, G >= 4.
        angles: (G, 2) azimuth and elevation, rad, continuous.
    """

    def __init__(self, t: ArrayLike, angles: ArrayLike) -> None:
        self.t = np.asarray(t, dtype=float)
        self.angles = np.asarray(angles, dtype=float)
        if len(self.t) < 4 or self.angles.shape != (len(self.t), 2):
            raise ValueError(f"needs stamps (G,) and angles (G, 2), G >= 4; got {self.t.shape} and {self.angles.shape}")

    def weights(self, at: ArrayLike) -> tuple[Index, Array]:
        """Indices (n, 4) of the four samples around each time, and Lagrange weights (n, 4)."""
        at = np.asarray(at, dtype=float)
        first = np.clip(np.searchsorted(self.t, at, side="right") - 2, 0, len(self.t) - 4)
        samples = first[:, None] + np.arange(4)
        nodes = self.t[samples]
        away, apart = at[:, None] - nodes, nodes[:, :, None] - nodes[:, None, :] + np.eye(4)
        factors = np.where(np.eye(4, dtype=bool), 1.0, away[:, None, :] / apart)
        return samples, factors.prod(axis=2)

    def at(self, at: ArrayLike) -> Array:
        """Gimbal angles (n, 2), rad, at the times."""
        at = np.asarray(at, dtype=float)
        out = np.empty((len(at), 2))
        # Weights of all at once would take fifty times the memory of the times.
        for i in range(0, len(at), _BLOCK):
            samples, weights = self.weights(at[i : i + _BLOCK])
            out[i : i + _BLOCK] = np.einsum("nk,nki->ni", weights, self.angles[samples])
        return out


@dataclass(frozen=True)
class LocalMotion(Stacked):
    """Smoothed motion of gyro and gimbal near the stamps of n pictures.

    A time offset must not be read off the noise of the sensors: what the stabilisation leaves of the picture's motion
    is no larger than what noise puts into rates, and the gimbal follows the noise of the gyro that drives it. So the
    gimbal moves by its commands at the gyro's smoothed rates, with the same noise, and by what it does beyond commands.
    Both are cubics fitted over the longest time in which they predict left-out samples about as well as over any.

    Attributes:
        rate: (n, 4, 3) of the gyro, coefficients by powers of the time from the stamps, rad/s^(k + 1).
        read: (n, 2) azimuth and elevation that the encoders read at the stamps, rad: between samples by the commands.
        rest: (n, 3, 2) coefficients, from the first power on, of the readings less the commanded angles, rad/s^k.
        rest_by_delay: (n, 3, 2) derivative of the rest by the encoders' delay: commands by the gyro read later, for the
            angles that the readings were then.
        windows: half the time over which rates and rest are smoothed, s.
        following: the share of its commands by the gyro that the gimbal follows, noise of the gyro included.
        drivers: (n, d) of the gyro, see alidade.factors.gyro; None where it has none.
    """

    rate: Array
    read: Array
    rest: Array
    rest_by_delay: Array
    windows: tuple[float, float]
    following: float
    drivers: Array | None = None
    stacked: ClassVar = ("rate", "read", "rest", "rest_by_delay", "drivers")

    @classmethod
    def around(
        cls,
        at: Array,
        gyro_t: Array,
        gyro: Array,
        gimbal: GimbalPath,
        drivers: Array | None = None,
        before: LocalMotion | None = None,
    ) -> LocalMotion:
        """Fit the motion of a gyro (N, 3), its drivers (N, d) and a gimbal around times (n,), s.

        Of a recording that grows windows and following stay as they were `before`.
        """
        angles, by_delay = _commanded(gyro_t, gyro, gimbal)
        commanded = GimbalPath(gyro_t, angles)
        rest, reached = gimbal.angles - commanded.at(gimbal.t), commanded.at(at)
        following = _following(gimbal, commanded) if before is None else before.following
        del angles, commanded  # As large as the recording, like the rates by delay.
        windows = (_smoothing(at, gyro_t, gyro), _smoothing(at, gimbal.t, rest)) if before is None else before.windows
        return cls(
            _local_cubics(at, gyro_t, gyro, windows[0]),
            reached + GimbalPath(gimbal.t, rest).at(at),
            _local_cubics(at, gimbal.t, rest, windows[1])[:, 1:].copy(),
            _local_cubics(at, gyro_t, by_delay, windows[1])[:, 1:].copy(),
            windows,
            following,
            None if drivers is None else interpolated(at, gyro_t, drivers),
        )

    def turned(self, begin: Array, end: Array) -> Array:
        """Gyro rotation vectors (n, 3), rad, between two times (n, 1), s, relative to the stamps."""
        powers = np.arange(1, _DEGREE + 2)
        return np.einsum("nk,nki->ni", (end**powers - begin**powers) / powers, self.rate)

    def turning(self, at: Array) -> Array:
        """Gyro rates (n, 3), rad/s, at times (n, 1), s, relative to the stamps."""
        return np.einsum("nk,nki->ni", at ** np.arange(_DEGREE + 1), self.rate)

    def moved(self, read: Array, late: Array, delay: Array) -> tuple[Array, Array, Array]:
        """Gimbal angles (n, 2), rad, `late` (n, 1) s after the stamps, and derivatives by late and delay.

        What is read at a stamp, (n, 2), the gimbal reaches `delay` (n, 1) later. From there it moves by its commands,
        after the midpoint rule, and by what it does beyond them.
        """
        rest, x = self.rest - delay[..., None] * self.rest_by_delay, (late - delay)[..., None]
        powers = np.arange(1, _DEGREE + 1)[:, None]
        beyond, beyond_rate = (rest * x**powers).sum(axis=1), (powers * rest * x ** (powers - 1)).sum(axis=1)
        turned, slope, x = self.turned(delay, late), self.rate[:, 1], x[..., 0]
        start = command(turned, read) + beyond
        middle = read + 0.5 * start
        # Rate and angles change together within the window: x^3 / 12 of the product of both slopes.
        reached = read + command(turned, middle) + beyond + x**2 / 12.0 * _command_change(slope, read, start)

        def change(by_turned: Array, by_beyond: Array) -> Array:
            by_start = command(by_turned, read) + by_beyond
            by_middle = _command_change(turned, middle, 0.5 * by_start)
            by_both = x / 12.0 * _command_change(slope, read, x * by_start + 2.0 * start)
            return command(by_turned, middle) + by_beyond + by_middle + by_both

        late_rest = (self.rest_by_delay * x[..., None] ** powers).sum(axis=1)
        by_delay = -change(self.turning(delay), beyond_rate + late_rest)
        return reached, change(self.turning(late), beyond_rate), by_delay


def command(rate: Array, angles: Array) -> Array:
    """Azimuth and elevation rates (n, 2), rad/s, that keep the line of sight fixed at carrier rates (n, 3), rad/s.

    CN102288133B, of a gyro and a camera mounted straight; angles (n, 2) are azimuth and elevation, rad.
    """
    s, c = np.sin(angles[:, 0]), np.cos(angles[:, 0])
    wx, wy, wz = rate.T
    return np.stack([np.tan(angles[:, 1]) * (c * wy - s * wx) - wz, -c * wx - s * wy], axis=1)


def _command_change(rate: Array, angles: Array, by: Array) -> Array:
    """Change (n, 2) of the commanded rates, rad/s, at carrier rates (n, 3), for angle changes `by` (n, 2), rad."""
    s, c, tangent = np.sin(angles[:, 0]), np.cos(angles[:, 0]), np.tan(angles[:, 1])
    ahead, right = c * rate[:, 1] - s * rate[:, 0], c * rate[:, 0] + s * rate[:, 1]
    azimuth, elevation = by.T
    return np.stack([elevation * ahead * (1.0 + tangent**2) - azimuth * tangent * right, -azimuth * ahead], axis=1)


def _commanded(t: Array, rate: Array, gimbal: GimbalPath) -> tuple[Array, Array]:
    """Integrated commanded angles of the gimbal since the first sample, and their derivative by a delay.

    Returns:
        (N, 2) azimuth and elevation, rad; (N, 2) by how much more each is with the gyro read so much later, rad/s.
    """
    angles, by_delay = np.zeros((len(t), 2)), np.zeros((len(t), 2))
    for i in range(0, len(t) - 1, _BLOCK):
        some, then = slice(i, i + _BLOCK + 1), slice(i + 1, i + _BLOCK + 1)
        rates, read = rate[some], gimbal.at(t[some])
        middle, mean = 0.5 * (read[1:] + read[:-1]), 0.5 * (rates[1:] + rates[:-1])
        angles[then] = angles[i] + np.cumsum(np.diff(t[some])[:, None] * command(mean, middle), axis=0)
        by_delay[then] = by_delay[i] + np.cumsum(command(np.diff(rates, axis=0), middle), axis=0)
    return angles, by_delay


def _following(gimbal: GimbalPath, commanded: GimbalPath) -> float:
    """Share, 0 to 1, of commanded motion that the gimbal performs, from motion within tenths of a second.

    The sway in slower motion hides the gyro's noise, and faster motion is lost in the noise of pictures. Least absolute
    deviations of third differences, on which slews to another target have next to no influence.
    """
    ends = max(gimbal.t[0], commanded.t[0]), min(gimbal.t[-1], commanded.t[-1])
    t = np.arange(*ends, _FOLLOWING_INTERVAL)
    read, asked = (np.diff(path.at(t), 3, axis=0).ravel() for path in (gimbal, commanded))
    moving = asked != 0.0
    if not moving.any():
        return 0.0
    ratio, weights = read[moving] / asked[moving], np.abs(asked[moving])
    return float(np.clip(np.quantile(ratio, 0.5, weights=weights, method="inverted_cdf"), 0.0, 1.0))


def _smoothing(at: Array, t: Array, values: Array) -> float:
    """Half width, s, of the smoothing windows: the longest that predicts samples (N, d) about best.

    Each sample by the others; of the squared errors the median, so that a few samples beside a slew do not count.
    """
    begin, end = np.clip(np.searchsorted(t, [at.min(), at.max()]), 0, len(t) - 1).tolist()
    rows = np.arange(begin, end + 1, (end - begin) // _TRIED + 1)
    errors = []
    for half in WINDOWS:
        # At its middle a cubic's own sample has 9/4 of a mean's weight.
        others = 1.0 - 2.25 / _count(t, half)
        missed = values[rows] - _local_cubics(t[rows], t, values, half)[:, 0]
        errors.append(np.median(np.square(missed / others), axis=0).sum())
    return next(half for half, error in zip(WINDOWS, errors, strict=True) if error <= _AS_GOOD * min(errors))


def _count(t: Array, half: float) -> int:
    """Number of samples in a window of half width `half`, s."""
    return int(np.clip(np.round(2.0 * half / np.median(np.diff(t))), 2 * _DEGREE + 1, len(t)))


def _local_cubics(at: Array, t: Array, values: Array, half: float) -> Array:
    """Coefficients (n, 4, d), lowest first, of cubics fitted to samples (N, d) within `half` s of each time."""
    count, scale = _count(t, half), half ** np.arange(_DEGREE + 1)
    out = np.empty((len(at), _DEGREE + 1, values.shape[1]))
    stamps, rows = sliding_window_view(t, count), sliding_window_view(values, count, axis=0)
    for some in np.array_split(np.arange(len(at)), len(at) // _TOGETHER + 1):
        first = np.clip(np.searchsorted(t, at[some]) - count // 2, 0, len(t) - count)
        x = (stamps[first] - at[some, None]) / half
        powers = np.ones((len(x), _DEGREE + 1, count))
        for k in range(_DEGREE):  # by products, which cost a tenth of powers
            powers[:, k + 1] = powers[:, k] * x
        transposed = np.swapaxes(powers, 1, 2)
        out[some] = np.linalg.solve(powers @ transposed, powers @ np.swapaxes(rows[first], 1, 2)) / scale[:, None]
    return out
