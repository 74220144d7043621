"""Rotation of a gyro over any window, with its derivatives with respect to the gyro's errors and the window's end.

A gyro sample is the mean rate over an interval centred on its stamp. The rate is taken as linear between stamps
(trapezoid), through points a little off the means: a mean m is w + h^2 w''/24 of the point rate w, the trapezoid's own
error is h^2 w''/12, so trapezoids on m - (second difference of m) / 8 integrate the true rate to fourth order. Inside a
sample interval of rates w0, w1 = w0 + a T the rotation vector is w0 s + a s^2 / 2 + (w0 x a) s^3 / 12, the Magnus
expansion of a linear rate (Iserles et al., Acta Numerica 2000).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import so3

Array = NDArray[np.float64]

# Neighbouring intervals that differ by more than this share are not taken as even.
_UNEVEN = 0.05
# A pause between samples longer than this many intervals is a gap.
_GAP = 1.5
# Sample intervals worked on at a time.
_BLOCK = 100_000


@dataclass(frozen=True)
class Increments:
    """Rotations over n windows: aRb with a the sensor at a window's start, b at its end.

    Attributes:
        duration: (n,), s.
        wxyz: (n, 4), with `bias_hat` taken off the rates.
        bias_jacobian: (n, 3, 3); for a bias near bias_hat the rotation is wxyz * Exp(J (bias - bias_hat)).
        rate: (n, 3), rate at the window's end with bias_hat taken off, rad/s.
        unseen: (n,) rad^2 per axis, variance of what the sensor may have turned in gaps of its record, beyond the
            straight line between the rates on either side.
        scale_jacobian: (n, 3, 9), None unless asked for; for a gyro that reads D w too much the rotation is
            wxyz * Exp(J vec(D)), to first order, w the rate with bias_hat taken off, vec by rows: xx, xy, xz, yx ...
        driver_jacobian: (n, 3, 3 d), likewise for a gyro that reads D f too much, D (3, d), f its drivers, or None.
    """

    duration: Array
    wxyz: Array
    bias_jacobian: Array
    rate: Array
    unseen: Array
    scale_jacobian: Array | None = None
    driver_jacobian: Array | None = None
    stacked: ClassVar = ("duration", "wxyz", "bias_jacobian", "rate", "unseen", "scale_jacobian", "driver_jacobian")

    def __getitem__(self, rows: Any) -> Increments:
        """Those over some of the windows."""

        def taken(part: Any) -> Any:
            return None if part is None else part[rows]

        return Increments(*(taken(getattr(self, name)) for name in self.stacked))


class GyroPath:
    """A gyro stream integrated once; the rotation over any window then costs the same as a look-up.

    Args:
        t: (N,) stamps, s, increasing, N >= 2.
        rate: (N, 3) angular rate, rad/s.
        bias_hat: (3,) taken off all rates.
        drivers: (N, d) what else than the rate moves what it reads, at the same stamps: the specific force by the
            accelerometer of the same IMU, in the same frame, m/s^2, its temperature above some other, K, or both.
    """

    def __init__(
        self,
        t: ArrayLike,
        rate: ArrayLike,
        bias_hat: ArrayLike = (0.0, 0.0, 0.0),
        drivers: ArrayLike | None = None,
    ) -> None:
        self.t = np.asarray(t, dtype=float)
        self.bias_hat = np.asarray(bias_hat, dtype=float)
        mean = np.asarray(rate, dtype=float)
        if len(self.t) < 2 or mean.shape != (len(self.t), 3):
            raise ValueError(f"needs stamps (N,) and rates (N, 3), N >= 2; got {self.t.shape} and {mean.shape}")
        self._drivers: Array | None = None
        if drivers is not None:
            driving = np.asarray(drivers, dtype=float)
            if driving.ndim != 2 or len(driving) != len(mean):
                raise ValueError(f"needs drivers for each rate; got {driving.shape} and {mean.shape}")
            self._drivers = driving - trapezoid_excess(self.t, driving)
        self._rate = mean - self.bias_hat - trapezoid_excess(self.t, mean)
        turns = np.empty((len(self.t) - 1, 4))
        for some in self._blocks():
            turns[some] = so3.exp(self._arcs(some))
        self._attitude = np.concatenate([so3.identity(1), _running_product(turns)])
        self._unseen = np.append(0.0, np.cumsum(_gap_variance(self.t, mean)))

    @cached_property
    def _integral(self) -> Array:
        """Integral (N, 3, 3) of the attitude matrix until each stamp: every window's bias Jacobian follows from it."""
        integral = np.zeros((len(self.t), 3, 3))
        for some in self._blocks():
            pieces = np.diff(self.t[some.start : some.stop + 1])[:, None, None] * so3.right_jacobian(-self._arcs(some))
            integral[some.start + 1 : some.stop + 1] = so3.matrix(self._attitude[some]) @ pieces
        return np.cumsum(integral, axis=0, out=integral)

    def _blocks(self) -> Iterator[slice]:
        """The sample intervals, some at a time: what is worked out for all of them takes many times their memory."""
        return (slice(i, min(i + _BLOCK, len(self.t) - 1)) for i in range(0, len(self.t) - 1, _BLOCK))

    def _arcs(self, some: slice) -> Array:
        """Rotation vectors (n, 3) over sample intervals."""
        rate, step = self._rate[some.start : some.stop + 1], np.diff(self.t[some.start : some.stop + 1])[:, None]
        return _arc(rate[:-1], np.diff(rate, axis=0) / step, step)

    def _slope(self, i: NDArray[np.intp]) -> Array:
        """Slopes (n, 3) of the rate over sample intervals (n,), rad/s^2."""
        return np.asarray((self._rate[i + 1] - self._rate[i]) / (self.t[i + 1] - self.t[i])[:, None])

    def attitude(self, at: ArrayLike) -> Array:
        """Attitude (n, 4) of the sensor at the times, in its frame at the first stamp."""
        i, s = self._place(np.asarray(at, dtype=float))
        return so3.multiply(self._attitude[i], so3.exp(_arc(self._rate[i], self._slope(i), s)))

    def rate(self, at: ArrayLike) -> Array:
        """Rate (n, 3) at the times, linear between samples, bias_hat taken off, rad/s."""
        i, s = self._place(np.asarray(at, dtype=float))
        return np.asarray(self._rate[i] + self._slope(i) * s)

    def drivers(self, at: ArrayLike) -> Array | None:
        """The drivers (n, d) at the times; None without."""
        if self._drivers is None:
            return None
        i, s = self._place(np.asarray(at, dtype=float))
        before, after = self._drivers[i], self._drivers[i + 1]
        return np.asarray(before + (after - before) * (s / (self.t[i + 1] - self.t[i])[:, None]))

    def increments(self, start: ArrayLike, stop: ArrayLike, scale: bool = False) -> Increments:
        """Rotations over the windows [start, stop], (n,) each, s; a window may be empty or run backwards.

        Beyond the first and the last stamp the outermost rates are continued; callers keep windows inside.

        Args:
            start, stop: the windows' ends.
            scale: also the derivatives by the gyro's scale and, with drivers, by what they add to it. They cost as much
                as the rest and one pass over the whole stream.
        """
        start, stop = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)
        # Both ends in one call: what a few windows cost is calls.
        ends = np.concatenate([start, stop])
        i, s = self._place(ends)
        w0, a = self._rate[i], self._slope(i)
        arc = _arc(w0, a, s)
        attitude = so3.multiply(self._attitude[i], so3.exp(arc))
        # The attitude matrix's integral since the samples before the ends.
        begun = so3.matrix(self._attitude[i]) @ (s[..., None] * so3.right_jacobian(-arc))
        (q0, q1), (c0, c1), (p0, p1) = (np.split(each, 2) for each in (attitude, self._integral[i], begun))
        to_end = -so3.matrix(so3.inverse(q1))
        n = len(start)
        turned = Increments(
            duration=stop - start,
            wxyz=so3.multiply(so3.inverse(q0), q1),
            bias_jacobian=to_end @ ((c1 - c0) + (p1 - p0)),
            rate=_rate(w0[n:], a[n:], s[n:], arc[n:]),
            unseen=np.abs(np.interp(stop, self.t, self._unseen) - np.interp(start, self.t, self._unseen)),
        )
        if not scale:
            return turned
        by = [to_end @ self._moments(i, s, begun, v) for v in (self._rate, self._drivers) if v is not None]
        return replace(turned, scale_jacobian=by[0], driver_jacobian=by[1] if len(by) == 2 else None)

    def _moments(self, i: NDArray[np.intp], s: Array, begun: Array, vector: Array) -> Array:
        """Integral over windows of the attitude matrix times each component of a vector, (n, 3, 3 d): [i, d a + b].

        Within a sample interval the attitude's integral is taken with the vector's mean, which leaves out a twelfth of
        how both change in it. Column by column: all at once would take 27 times the stream's memory.

        Args:
            i, s: (2 n,), (2 n, 1) the samples before the windows' starts, then before their ends, and the times since.
            begun: (2 n, 3, 3) integral of the attitude matrix from the sample before each end.
            vector: (N, d) at the stamps, linear in between.
        """
        d = vector.shape[1]
        slope = (vector[i + 1] - vector[i]) / (self.t[i + 1] - self.t[i])[:, None]
        at_ends = np.einsum("nia,nb->niab", begun, vector[i] + 0.5 * s * slope).reshape(-1, 3, 3 * d)
        start, stop = np.split(i, 2)
        mean = np.ascontiguousarray(0.5 * (vector[1:] + vector[:-1]).T)
        out = at_ends[len(start) :] - at_ends[: len(start)]
        until = np.zeros(len(self.t))
        for row in range(9):
            attitude = np.diff(self._integral[:, row // 3, row % 3])
            for column in range(d):
                np.cumsum(attitude * mean[column], out=until[1:])
                out[:, row // 3, d * (row % 3) + column] += until[stop] - until[start]
        return out

    def _place(self, at: Array) -> tuple[NDArray[np.intp], Array]:
        """The sample intervals that hold the times, (n,), and the time since their start, (n, 1), s."""
        i = np.clip(np.searchsorted(self.t, at, side="right") - 1, 0, len(self.t) - 2)
        return i, (at - self.t[i])[:, None]


def trapezoid_excess(t: Array, mean: Array) -> Array:
    """What trapezoids on interval means count too much, as a rate: an eighth of the second difference.

    Zero at the ends and where the stamps are not even, as beside a gap.
    """
    excess = np.zeros_like(mean)
    before, after = np.diff(t)[:-1, None], np.diff(t)[1:, None]
    even = np.abs(after - before) < _UNEVEN * np.minimum(before, after)
    excess[1:-1] = np.where(even, (mean[2:] - 2.0 * mean[1:-1] + mean[:-2]) / 8.0, 0.0)
    return excess


def _gap_variance(t: Array, mean: Array) -> Array:
    """(N - 1,) rad^2 per axis that a straight line across each interval may be off: zero where it is no gap.

    A line over T is off by T^3 w'' / 12, w'' as bent as between samples; but never by more than T times the spread of
    the rates.
    """
    step = np.diff(t)
    usual = float(np.median(step))
    gap = step > _GAP * usual
    if not gap.any():
        return np.zeros(len(step))
    even = ~(gap[1:] | gap[:-1])
    bends = (mean[2:] - 2.0 * mean[1:-1] + mean[:-2])[even] / usual**2
    bent = float(np.sqrt((bends**2).mean())) if len(bends) else np.inf
    spread = float(np.sqrt(mean.var(axis=0).mean()))
    sigma = np.minimum(step * spread, step**3 * bent / 12.0)
    return np.where(gap, sigma**2, 0.0)


def _arc(w0: Array, a: Array, s: Array) -> Array:
    """Rotation vectors after the times s of rates w0 + a s."""
    return w0 * s + a * (0.5 * s**2) + so3.cross(w0, a) * (s**3 / 12.0)


def _rate(w0: Array, a: Array, s: Array, arc: Array) -> Array:
    """Rates of the attitude Exp(arc) after the times s, in the turned frame."""
    speed = w0 + a * s + so3.cross(w0, a) * s**2 / 4.0
    return np.einsum("nij,nj->ni", so3.right_jacobian(arc), speed)


def _running_product(q: Array) -> Array:
    """q0, q0 q1, q0 q1 q2, ...: in blocks, vectorised over the blocks, so that the loop is as long as one block.

    Few are multiplied over twice the distance each time, which are far fewer calls.
    """
    n = len(q)
    if n <= 500:
        out, distance = q, 1
        while distance < n:
            out = np.concatenate([out[:distance], so3.multiply(out[:-distance], out[distance:])])
            distance *= 2
        return so3.normalize(out)
    length = int(np.sqrt(n))
    blocks = -(-n // length)
    grid = so3.identity((blocks, length))
    grid.reshape(-1, 4)[:n] = q
    for i in range(1, length):
        grid[:, i] = so3.multiply(grid[:, i - 1], grid[:, i])
    before = np.concatenate([so3.identity(1), _running_product(grid[:-1, -1])])
    return so3.normalize(so3.multiply(before[:, None], grid).reshape(-1, 4)[:n])
