"""Rotation of a gyro over any window, with its derivatives with respect to the gyro's errors and the window's end.

A gyro sample is the mean rate over an interval centred on its stamp. The rate is taken as linear between stamps
(trapezoid), through points a little off the means: a mean m is w + h^2 w''/24 of the point rate w, the trapezoid's own
error is h^2 w''/12, so trapezoids on m - (second difference of m) / 8 integrate the true rate to fourth order, and with
the next term, 3/128 of the fourth difference, to sixth. Inside a sample interval of rates w0, w1 = w0 + a T the
rotation vector is w0 s + a s^2 / 2 + (w0 x a) s^3 / 12, the Magnus expansion of a linear rate (Iserles et al., Acta
Numerica 2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from operator import attrgetter
from typing import ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.model import Stacked

# Neighbouring intervals that differ by more than this share are not taken as even.
_UNEVEN = 0.05
# A pause between samples longer than this many intervals is a gap.
_GAP = 1.5
# Error of the rotation over a sample interval h over h^5 w'''': of a cubic through points (measured between samples of
# 5 to 25 Hz over motions by hand: .013 to .019).
_ERROR = 11.0 / 720.0
# A fourth difference whose square is this many times that of noise is motion.
_NOISE = 3.0
# Sample intervals integrated together, and how many such blocks are kept.
_BLOCK, _KEPT = 1 << 16, 48
# s, half of what accelerations are differenced over: short against motion, long against the noise of a sample; and no
# shorter than half an interval between samples.
_HALF = 0.007
# Windows looked up together.
_TOGETHER = 20_000


@dataclass(frozen=True)
class Increments(Stacked):
    """Rotations aRb over n windows; a: sensor frame at a window's start, b: at its end.

    Attributes:
        duration: (n,), s.
        wxyz: (n, 4), with `bias_hat` taken off the rates.
        bias_jacobian: (n, 3, 3); for a bias near bias_hat the rotation is wxyz * Exp(J (bias - bias_hat)).
        rate: (n, 3), rate at the window's end with bias_hat taken off, rad/s.
        unseen: (n,) rad^2 per axis, variance of what the sensor may have turned between its samples, in gaps of its
            record beyond the straight line between the rates on either side.
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


class GyroPath:
    """Integrated gyro stream, which gives the rotation over any window by look-up.

    It is integrated block by block. The first blocks looked at are kept, three million samples, and the others of a
    longer stream are integrated anew when they are needed. Stamps and rates as given stay at hand as `t` and `read`,
    the median interval between stamps, s, as `interval`.

    Args:
        t: (N,) stamps, s, increasing, N >= 2.
        rate: (N, 3) angular rate, rad/s.
        bias_hat: (3,) taken off all rates.
        drivers: (N, d) what else than the rate moves what it reads, at the same stamps: the specific force by the
            accelerometer of the same IMU, in the same frame, m/s^2, its temperature above some other, K, or both.
        density: of the rates' white noise, rad/s/sqrt(Hz): changes of the rate beyond it add to `Increments.unseen`
            what a slow gyro misses; None: gaps alone do.
        hidden: (N,) density of what each sample does not show, as within a dead band, rad/s/sqrt(Hz): adds to
            `Increments.unseen`; None: nothing.
    """

    def __init__(
        self,
        t: ArrayLike,
        rate: ArrayLike,
        bias_hat: ArrayLike = (0.0, 0.0, 0.0),
        drivers: ArrayLike | None = None,
        density: float | None = None,
        hidden: Array | None = None,
    ) -> None:
        self.t = np.asarray(t, dtype=float)
        self.bias_hat = np.asarray(bias_hat, dtype=float)
        self.read = np.asarray(rate, dtype=float)
        if len(self.t) < 2 or self.read.shape != (len(self.t), 3):
            raise ValueError(f"needs stamps (N,) and rates (N, 3), N >= 2; got {self.t.shape} and {self.read.shape}")
        self._driving = np.empty((len(self.t), 0)) if drivers is None else np.asarray(drivers, dtype=float)
        if self._driving.ndim != 2 or len(self._driving) != len(self.read):
            raise ValueError(f"needs drivers for each rate; got {self._driving.shape} and {self.read.shape}")
        self._density = density
        self._hidden = hidden
        self._unseen = _unseen_variance(self.t, self.read, density, hidden)
        self.interval = float(np.median(np.diff(self.t)))
        self._last = (len(self.t) - 2) // _BLOCK
        self._kept: dict[int, _Block] = {}
        # Attitudes at the blocks' starts.
        self._starts = [so3.identity(1)]
        for number in range(self._last + 1):
            self._starts.append(self._block(number).attitude[-1:].copy())

    def with_rate(self, rate: Array) -> GyroPath:
        """Return the same stream with other rates (N, 3), rad/s."""
        return GyroPath(self.t, rate, self.bias_hat, self._driving, self._density, self._hidden)

    def forget_blocks(self) -> None:
        """Free the memory of the integrated blocks of the gyro's samples; they are integrated anew when needed."""
        self._kept.clear()

    def _block(self, number: int) -> _Block:
        """Return one integrated block of sample intervals, by its number."""
        if number not in self._kept:
            begin = number * _BLOCK
            end = min(begin + _BLOCK, len(self.t) - 1)
            # The trapezoids' excess needs two samples more on either side.
            some = slice(max(begin - 2, 0), end + 3)
            inner = slice(begin - some.start, end + 1 - some.start)
            t, mean = self.t[some], self.read[some]
            driving = self._driving[some]
            rate = (mean - self.bias_hat - trapezoid_excess(t, mean))[inner]
            drivers = (driving - trapezoid_excess(t, driving))[inner]
            if len(self._kept) == _KEPT:
                # Streams are read from start to end repeatedly: the oldest block is needed next, the newest third now.
                del self._kept[list(self._kept)[-max(_KEPT // 3, 2)]]
            self._kept[number] = _Block(t[inner], rate, drivers, self._starts[number])
        return self._kept[number]

    def _found(self, i: Index, of: Callable[[_Block], Array], adds: bool = False) -> Array:
        """Gather per-sample values (n, ...) from the blocks that hold the samples (n,).

        Args:
            i: the samples.
            of: a block's answer, a row for each of its samples.
            adds: what it says is a running sum from its start on; from the first of the blocks looked at then.
        """
        block = np.minimum(i // _BLOCK, self._last)
        first, last = int(block.min(initial=self._last)), int(block.max(initial=0))
        if first >= last:
            return of(self._block(first))[i - first * _BLOCK]
        order = np.argsort(block, kind="stable")
        cuts = np.searchsorted(block[order], np.arange(first, last + 2))
        out, before = np.empty(0), np.zeros(())
        for number, (begin, end) in enumerate(pairwise(cuts), start=first):
            if not adds and begin == end:
                continue
            rows, own = order[begin:end], of(self._block(number))
            if not len(out):
                out = np.empty((len(i), *own.shape[1:]))
            out[rows] = own[i[rows] - number * _BLOCK]
            if adds:
                out[rows] += before
                before = before + own[-1]
        return out

    def attitude(self, at: ArrayLike) -> Array:
        """Attitude (n, 4) at the times, relative to the sensor frame at the first stamp."""
        i, s = self._place(np.asarray(at, dtype=float))
        rate, slope = self._line(i, _rates)
        return so3.multiply(self._found(i, _attitudes), so3.exp(_arc(rate, slope, s)))

    def rate(self, at: ArrayLike) -> Array:
        """Rate (n, 3), rad/s, at the times, interpolated linearly, minus bias_hat."""
        return self.rate_and_slope(at)[0]

    def rate_and_slope(self, at: ArrayLike) -> tuple[Array, Array]:
        """Rate (n, 3), as `rate` gives it, and its derivative by time, rad/s^2."""
        i, s = self._place(np.asarray(at, dtype=float))
        rate, slope = self._line(i, _rates)
        return np.asarray(rate + slope * s), slope

    def acceleration(self, at: ArrayLike) -> tuple[Array, Array]:
        """Angular acceleration (n, 3), rad/s^2, and its derivative by time, from differences of rates around times."""
        at, half = np.asarray(at, dtype=float), max(_HALF, 0.5 * self.interval)
        i, s = self._place(np.concatenate([at - half, at + half]))
        rate, slope = self._line(i, _rates)
        rate = rate + slope * s
        n = len(at)
        return (rate[n:] - rate[:n]) / (2.0 * half), (slope[n:] - slope[:n]) / (2.0 * half)

    def drivers(self, at: ArrayLike) -> Array | None:
        """Interpolated drivers (n, d) at the times; None without drivers."""
        if not self._driving.shape[1]:
            return None
        i, s = self._place(np.asarray(at, dtype=float))
        before, slope = self._line(i, _drivers)
        return np.asarray(before + slope * s)

    def unseen(self, start: Array, stop: Array) -> Array:
        """Variance (n,) of `Increments.unseen` over windows, rad^2 per axis."""
        return np.abs(np.interp(stop, *self._unseen) - np.interp(start, *self._unseen))

    def increments(self, start: ArrayLike, stop: ArrayLike, scale: bool = False) -> Increments:
        """Rotations over the windows [start, stop], (n,) each, s; windows may be empty or run backwards.

        Beyond the first and the last stamp the outermost rates are continued; callers keep windows inside.

        Args:
            start, stop: the windows' ends.
            scale: also the derivatives by the gyro's scale and, with drivers, by what they add to it. They cost as much
                as the rest and one pass over the stream.
        """
        start, stop = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)
        if len(start) <= _TOGETHER:
            return self._increments(start, stop, scale)
        parts: dict[str, Array] = {}
        for begin in range(0, len(start), _TOGETHER):
            some = slice(begin, begin + _TOGETHER)
            piece = self._increments(start[some], stop[some], scale)
            for name in Increments.stacked:
                if (part := getattr(piece, name)) is not None:
                    parts.setdefault(name, np.empty((len(start), *part.shape[1:])))[some] = part
        return Increments(**parts)

    def _increments(self, start: Array, stop: Array, scale: bool) -> Increments:
        # Both ends in one call: what a few windows cost is calls.
        ends = np.concatenate([start, stop])
        i, s = self._place(ends)
        w0, a = self._line(i, _rates)
        arc = _arc(w0, a, s)
        before = self._found(i, _attitudes)
        attitude = so3.multiply(before, so3.exp(arc))
        # The attitude matrix's integral since the samples before the ends.
        begun = so3.matrix(before) @ (s[..., None] * so3.right_jacobian(-arc))
        integral = self._found(i, _integrals, adds=True)
        (q0, q1), (c0, c1), (p0, p1) = (np.split(each, 2) for each in (attitude, integral, begun))
        to_end = -so3.matrix(so3.inverse(q1))
        n = len(start)
        turned = Increments(
            duration=stop - start,
            wxyz=so3.multiply(so3.inverse(q0), q1),
            bias_jacobian=to_end @ ((c1 - c0) + (p1 - p0)),
            rate=_rate(w0[n:], a[n:], s[n:], arc[n:]),
            unseen=self.unseen(start, stop),
        )
        if not scale:
            return turned
        vectors = [_rates, _drivers] if self._driving.shape[1] else [_rates]
        by = [to_end @ self._moments(i, s, begun, vector) for vector in vectors]
        return replace(turned, scale_jacobian=by[0], driver_jacobian=by[1] if len(by) == 2 else None)

    def _moments(self, i: Index, s: Array, begun: Array, vector: Callable[[_Block], Array]) -> Array:
        """Integral of attitude matrix times vector components over windows, (n, 3, 3 d): [i, d a + b].

        Within a sample interval the attitude's integral is taken with the vector's mean, which leaves out a twelfth of
        how both change in it.

        Args:
            i, s: (2 n,), (2 n, 1) the samples before the windows' starts, then before their ends, and the times since.
            begun: (2 n, 3, 3) integral of the attitude matrix from the sample before each end.
            vector: which of a block's, linear between samples.
        """
        before, slope = self._line(i, vector)
        since = np.einsum("nia,nb->niab", begun, before + 0.5 * s * slope)
        until = self._found(i, lambda block: block.moments(vector), adds=True) + since
        start, stop = np.split(until.reshape(len(i), 3, -1), 2)
        return np.asarray(stop - start)

    def _line(self, i: Index, vector: Callable[[_Block], Array]) -> tuple[Array, Array]:
        """Vector values (n, d) at samples, and the slopes to the next samples."""
        before = self._found(i, vector)
        return before, (self._found(i + 1, vector) - before) / (self.t[i + 1] - self.t[i])[:, None]

    def _place(self, at: Array) -> tuple[Index, Array]:
        """Index (n,) of the sample interval at each time, and time since its start (n, 1), s."""
        i = np.clip(np.searchsorted(self.t, at, side="right") - 1, 0, len(self.t) - 2)
        return i, (at - self.t[i])[:, None]


@dataclass(frozen=True, eq=False)
class _Block:
    """Consecutive gyro samples, integrated together.

    Attributes:
        t: (n,) s.
        rate: (n, 3) point rates between which lines integrate to what was measured, rad/s.
        drivers: (n, d) likewise.
        start: (1, 4) attitude at the first.
    """

    t: Array
    rate: Array
    drivers: Array
    start: Array

    @property
    def arc(self) -> Array:
        """Rotation vectors (n - 1, 3), rad, over the sample intervals."""
        step = np.diff(self.t)[:, None]
        return _arc(self.rate[:-1], np.diff(self.rate, axis=0) / step, step)

    @cached_property
    def attitude(self) -> Array:
        """Attitudes (n, 4) at the samples, relative to the sensor frame at the stream's first sample."""
        turned = so3.multiply(self.start, running_product(so3.exp(self.arc)))
        return np.concatenate([self.start, so3.normalize(turned)])

    @cached_property
    def integral(self) -> Array:
        """Cumulative integral (n, 3, 3) of the attitude matrix at each sample, for bias Jacobians of windows."""
        integral = np.zeros((len(self.t), 3, 3))
        pieces = np.diff(self.t)[:, None, None] * so3.right_jacobian(-self.arc)
        np.cumsum(so3.matrix(self.attitude[:-1]) @ pieces, axis=0, out=integral[1:])
        return integral

    def moments(self, vector: Callable[[_Block], Array]) -> Array:
        """Cumulative integral (n, 3, 3, d) of the attitude matrix times each component of a vector, at each sample."""
        values = vector(self)
        mean = np.ascontiguousarray(0.5 * (values[1:] + values[:-1]).T)
        turned = np.ascontiguousarray(np.diff(self.integral, axis=0).reshape(-1, 9).T)
        until = np.zeros((9, len(mean), len(self.t)))
        np.cumsum(turned[:, None] * mean, axis=2, out=until[..., 1:])
        return until.reshape(3, 3, -1, len(self.t)).transpose(3, 0, 1, 2)


# What blocks are asked for.
_rates, _drivers, _attitudes, _integrals = map(attrgetter, ("rate", "drivers", "attitude", "integral"))


def trapezoid_excess(t: Array, mean: Array) -> Array:
    """Rate error (N, 3) of trapezoids on interval means: d2 / 8 - 3 d4 / 128, by central differences.

    Zero at the ends and where the stamps are not even, as beside a gap; next to such places the second alone.
    """
    excess = np.zeros_like(mean)
    before, after = np.diff(t)[:-1, None], np.diff(t)[1:, None]
    even = np.abs(after - before) < _UNEVEN * np.minimum(before, after)
    second = np.where(even, np.diff(mean, 2, axis=0), 0.0)
    excess[1:-1] = second / 8.0
    inner = even[2:] & even[1:-1] & even[:-2]
    excess[2:-2] -= np.where(inner, np.diff(second, 2, axis=0), 0.0) * (3.0 / 128.0)
    return excess


def _unseen_variance(t: Array, mean: Array, density: float | None, hidden: Array | None) -> tuple[Array, Array]:
    """Times (m,), s, and cumulative variance (m,), rad^2 per axis, of rotation that samples miss.

    Between these times it grows in proportion to time; there are none but the ends of intervals that have any. In gaps
    a line over T is off by T^3 w'' / 12, w'' as large as between samples; but never by more than T times the spread of
    the rates.
    """
    step = np.diff(t)
    usual = float(np.median(step))
    gap = step > _GAP * usual
    variance = np.zeros(len(step)) if density is None else _interpolation_variance(t, mean, density)
    if gap.any():
        square, count = 0.0, 0
        for begin in range(0, len(t) - 2, _BLOCK):
            values, beside = mean[begin : begin + _BLOCK + 2], gap[begin : begin + _BLOCK + 1]
            curvature = (values[2:] - 2.0 * values[1:-1] + values[:-2])[~(beside[1:] | beside[:-1])] / usual**2
            square, count = square + float((curvature**2).sum()), count + curvature.size
        rms = float(np.sqrt(square / count)) if count else np.inf
        spread = float(np.sqrt(mean.var(axis=0).mean()))
        variance[gap] = np.minimum(step[gap] * spread, step[gap] ** 3 * rms / 12.0) ** 2
    if hidden is not None:
        variance = variance + 0.5 * step * (hidden[1:] ** 2 + hidden[:-1] ** 2)
    found = np.flatnonzero(variance)
    if not len(found):
        return t[:1], np.zeros(1)
    variance = variance[found]
    until = np.cumsum(variance)
    ends = np.stack([t[found], t[found + 1]], axis=1).ravel()
    return ends, np.stack([until - variance, until], axis=1).ravel()


def _interpolation_variance(t: Array, mean: Array, density: float) -> Array:
    """Interpolation error over each sample interval h: variance (N - 1,), rad^2 per axis: (_ERROR h^5 w'''')^2.

    w'''' is 24 times the divided difference of five samples, of which white noise is taken off, squares averaged
    over the four samples around the interval.
    """
    step = np.diff(t)
    excess = np.zeros(len(t))
    for begin in range(0, len(t) - 4, _BLOCK):
        stamps, read = (sliding_window_view(x[begin : begin + _BLOCK + 4], 5, axis=0) for x in (t, mean))
        apart = stamps[:, :, None] - stamps[:, None] + np.eye(5)
        weights = 24.0 / apart.prod(axis=2)
        square = (np.einsum("nj,naj->na", weights, read) ** 2).mean(axis=1)
        noise = (weights**2).sum(axis=1) * density**2 / np.median(step)
        excess[begin + 2 : begin + 2 + len(square)] = np.where(square > _NOISE * noise, square - noise, 0.0)
    return (_ERROR * step**5) ** 2 * np.convolve(excess, np.full(4, 0.25))[2 : len(t) + 1]


def _arc(w0: Array, a: Array, s: Array) -> Array:
    """Rotation vectors (n, 3), rad, after times s under rates w0 + a s."""
    return w0 * s + a * (0.5 * s**2) + so3.cross(w0, a) * (s**3 / 12.0)


def _rate(w0: Array, a: Array, s: Array, arc: Array) -> Array:
    """Rates, in the rotated frame, of the attitude Exp(arc) after times s under rates w0 + a s."""
    speed = w0 + a * s + so3.cross(w0, a) * s**2 / 4.0
    return np.einsum("nij,nj->ni", so3.right_jacobian(arc), speed)


def running_product(q: Array) -> Array:
    """Cumulative products q0, q0 q1, q0 q1 q2, ... of quaternions (n, 4), vectorised over blocks."""
    n = len(q)
    if n < 2:
        return so3.normalize(q)
    length = int(np.sqrt(n))
    blocks = -(-n // length)
    grid = so3.identity((blocks, length))
    grid.reshape(-1, 4)[:n] = q
    for i in range(1, length):
        grid[:, i] = so3.multiply(grid[:, i - 1], grid[:, i])
    before = np.concatenate([so3.identity(1), running_product(grid[:-1, -1])])
    return so3.normalize(so3.multiply(before[:, None], grid).reshape(-1, 4)[:n])
