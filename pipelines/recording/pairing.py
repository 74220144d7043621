"""Pairing of gyros and attitudes by the rates that they measured.

How fast a body turns does not depend on how a sensor sits on it: the norm of a gyro's rate is that of the attitude's
own rate, up to a delay. Where the norms agree, one constant rotation takes one rate vector into the other, if the
attitude is that of the gyro's body; of its inverse the rates are along axes of the other frame, and none does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Stamps, interpolated

# Delays looked for, s; steps and length of the grid they are looked for on.
_LARGEST_DELAY, _FINEST, _MOST = 2.0, 0.002, 1 << 17
# Rates and attitudes belong together above this correlation of their norms.
BELONGS = 0.7
# Interval over which attitudes are differenced, s.
INTERVAL = 0.1
# Search of a delay: half range, s; half ranges of the successive refinements, s; least number of rates.
_WITHIN, _REACHES, _FEWEST = 0.1, (0.05, 0.02, 0.02), 30
# Least variation of rates, rad/s, and shortest duration, s, from which a pairing is estimated.
_LEAST_MOTION, _SHORTEST = 0.02, 3.0
# A mount beyond three sigmas of its default prior, 0.35 rad, is not what makes an inverse likely.
MAX_MOUNT = 3.0 * 0.35
# Other orders of a quaternion's components: x, y, z, w given as w, x, y, z, and the other way round; each fits as well
# as an inverse up to so much.
_ORDERS, _AS_WELL = ((3, 0, 1, 2), (1, 2, 3, 0)), 0.98
# Share of the stamps that an attitude made of the gyro has in common with it; others do by chance.
_TOGETHER = 0.99
# An interval of an attitude so many times the usual one is a gap.
_GAP = 3.0


@dataclass(frozen=True)
class Pairing:
    """Agreement between the rates of a gyro and those of an attitude.

    Attributes:
        correlation: of the norms of their rates, at the delay at which they agree best.
        offset_s: what to add to the attitude's stamps to get the gyro's times.
        inverted: whether the inverse of the attitude is that of the gyro's body.
        fit: share of the rates that one constant rotation explains; of the better of the two directions.
        angle: of that rotation, rad.
        order: of the quaternions' components, w, x, y, z, as recorded; another one where an inverse that fits is beyond
            MAX_MOUNT and another order, which fits as well, is not.
        ratio: of the gyro's rates to those of the attitude: that of their units.
        at_its_stamps: whether the attitude has the stamps of the gyro, as one that is made of it.
    """

    correlation: float
    offset_s: float
    inverted: bool
    fit: float
    angle: float = 0.0
    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    ratio: float = 1.0
    at_its_stamps: bool = False


class _Gyro:
    """Mean rates of a gyro over time intervals, from rates (N, 3), rad/s, at stamps; times in s from `start_ns`."""

    def __init__(self, t_ns: Stamps, rates: Array, start_ns: int) -> None:
        order = np.argsort(t_ns, kind="stable")
        t: Array = np.asarray((t_ns[order] - start_ns) * 1e-9, dtype=float)
        usable = np.isfinite(rates[order]).all(axis=1) & (np.diff(t, prepend=-1.0) > 0.0)
        self.t, rates = t[usable], rates[order][usable]
        turned = 0.5 * (rates[1:] + rates[:-1]) * np.diff(self.t)[:, None]
        self._turned = np.concatenate([np.zeros((min(1, len(rates)), 3)), np.cumsum(turned, axis=0)])

    def mean(self, a: Array, b: Array) -> Array:
        """Return the gyro's mean rates (n, 3), rad/s, from a to b (n,), s."""
        ends = [interpolated(x, self.t, self._turned) for x in (a, b)]
        return (ends[1] - ends[0]) / (b - a)[:, None]

    def covers(self, a: Array, b: Array) -> NDArray[np.bool_]:
        """Mask (n,) of intervals within the gyro's record."""
        return (a >= self.t[0]) & (b <= self.t[-1]) if len(self.t) else np.zeros(len(a), dtype=bool)


def pair(
    gyro_t: Stamps,
    gyro: Array,
    attitude_t: Stamps,
    wxyz: Array,
    others: Sequence[tuple[Stamps, Array]] = (),
) -> Pairing | None:
    """Compare gyro rates (N, 3), rad/s, with unit quaternions (M, 4), at stamps in ns; None with too little motion.

    `others` are further gyros, one of which may sit on what carries both and turn the reference of the attitude.
    """
    start = int(min(gyro_t.min(initial=np.iinfo(np.int64).max), attitude_t.min(initial=np.iinfo(np.int64).max)))
    ours = _Gyro(gyro_t, gyro, start)
    order = np.argsort(attitude_t, kind="stable")
    at, quaternions = (attitude_t[order] - start) * 1e-9, wxyz[order]
    known = np.isfinite(quaternions).all(axis=1) & (np.diff(at, prepend=-1.0) > 0.0)
    at, quaternions = at[known], quaternions[known]
    if len(ours.t) < 10 or len(at) < 10 or min(ours.t[-1], at[-1]) - max(ours.t[0], at[0]) < _SHORTEST:
        return None
    # Over several samples, for the noise of an attitude weighs by one over the interval.
    stride = max(1, round(INTERVAL / float(np.median(np.diff(at)))))
    if len(at) < 10 * stride:
        return None
    steps = at[stride:] - at[:-stride]
    whole = steps < _GAP * np.median(steps)
    a, b = at[:-stride][whole], at[stride:][whole]
    directions = quaternions, quaternions * [1.0, -1.0, -1.0, -1.0]
    ways = [_rates(one[:-stride], one[stride:], steps)[whole] for one in directions]
    offset, correlation = _delay(0.5 * (a + b), np.linalg.norm(ways[0], axis=1), a, b, ours)
    if correlation is None:
        return None

    def fits(later: float, of: Sequence[Array] = ways) -> list[tuple[float, float, float]]:
        """Return what `_fit` does of both directions, at a delay, s."""
        inside = ours.covers(a + later, b + later)
        against = ours.mean(a[inside] + later, b[inside] + later)
        return [_fit(one[inside], against) for one in of]

    way = int(np.argmax([share for share, _, _ in fits(offset)]))
    to_body = so3.matrix(directions[way][stride // 2 :][: len(steps)][whole]).swapaxes(1, 2)
    carriers = [_Gyro(t_ns, rates, start) for t_ns, rates in others]
    offset = _refined(offset, a, b, ways[way], to_body, ours, carriers)
    fit, angle, ratio = fits(offset)[way]
    if way == 1 and angle > MAX_MOUNT:
        # (x, y, z, w) read as (w, x, y, z) is exactly an inverse between two constant rotations.
        reordered = [quaternions[:, components] for components in _ORDERS]
        turns = [_rates(one[:-stride], one[stride:], steps)[whole] for one in reordered]
        for components, (share, turned, _) in zip(_ORDERS, fits(offset, turns), strict=True):
            if share > _AS_WELL * fit and turned < MAX_MOUNT:
                return Pairing(correlation, offset, False, share, turned, components, ratio)
    together = float(np.isin(attitude_t, gyro_t).mean()) > _TOGETHER
    return Pairing(correlation, offset, way == 1, fit, angle, ratio=ratio, at_its_stamps=together)


def _refined(
    offset: float, a: Array, b: Array, rates: Array, to_body: Array, gyro: _Gyro, others: Sequence[_Gyro]
) -> float:
    """Return the delay, s, at which the gyro's rates, less a carrier's if there is one, fit the attitude's rates best.

    The attitude has mean rates (n, 3), rad/s, from a to b (n,), s; `to_body` (n, 3, 3) turns its frame into the body's.
    Relative to a moving carrier it has the rate of the gyro less the carrier's, in the body. The fit is linear in the
    relative rotations of the sensors and in their biases.
    """

    def inside(one: _Gyro) -> NDArray[np.bool_]:
        return one.covers(a + offset - _WITHIN, b + offset + _WITHIN)

    rows = inside(gyro)
    others = [other for other in others if (inside(other) | ~rows).all()]
    if rows.sum() < _FEWEST:
        return offset
    a, b, to_body = a[rows], b[rows], to_body[rows]
    rates, ones = rates[rows].ravel(), np.tile(np.eye(3), (int(rows.sum()), 1))

    def missed(delay: float, carrier: _Gyro | None) -> float:
        """Return the sum of the attitude's squared rates that the gyros do not explain at a delay, s."""
        columns = [ones, _by_axes(gyro.mean(a + delay, b + delay), np.eye(3)[None])]
        if carrier is not None:
            columns.append(_by_axes(carrier.mean(a + delay, b + delay), to_body))
        A = np.hstack(columns)
        return float(np.sum((rates - A @ np.linalg.lstsq(A, rates)[0]) ** 2))

    carrier = min([None, *others], key=lambda one: missed(offset, one))
    start = offset
    for reach in _REACHES:
        delays = np.linspace(-reach, reach, 7)
        c2, c1, _ = np.polyfit(delays, [missed(offset + delay, carrier) for delay in delays], 2)
        if c2 > 0.0:
            offset = float(np.clip(offset - np.clip(c1 / (2.0 * c2), -reach, reach), start - _WITHIN, start + _WITHIN))
    return offset


def _by_axes(rates: Array, turned: Array) -> Array:
    """Return the matrix (3 n, 9) that maps the rows of M (3, 3) to the stacked vectors `turned` M `rates`."""
    return np.einsum("nij,nk->nijk", np.broadcast_to(turned, (len(rates), 3, 3)), rates).reshape(-1, 9)


def _delay(middle: Array, norm: Array, a: Array, b: Array, gyro: _Gyro) -> tuple[float, float | None]:
    """Return the correction of the attitude's times, s, and the correlation there; None if nothing moves."""
    step = max(_FINEST, float(np.median(b - a)) / 2.0, (middle[-1] - middle[0]) / _MOST)
    grid = np.arange(max(middle[0], gyro.t[0]), min(middle[-1], gyro.t[-1]), step)
    half = 0.5 * float(np.median(b - a))
    ours = np.interp(grid, middle, norm)
    theirs = np.linalg.norm(gyro.mean(grid - half, grid + half), axis=1)
    if min(ours.std(), theirs.std()) < _LEAST_MOTION or len(grid) < 20:
        return 0.0, None
    most = min(int(_LARGEST_DELAY / step), len(grid) // 3)
    ours, theirs = ((one - one.mean()) / one.std() for one in (ours, theirs))
    size = 1 << int(np.ceil(np.log2(2 * len(grid))))
    product = np.fft.irfft(np.conj(np.fft.rfft(ours, size)) * np.fft.rfft(theirs, size), size)
    lags = np.arange(-most, most + 1)
    found = product[lags] / (len(grid) - np.abs(lags))
    best = int(np.argmax(found))
    if not 0 < best < len(found) - 1:
        return float(lags[best] * step), float(found[best])
    before, at, after = found[best - 1 : best + 2]
    curve = before - 2.0 * at + after
    shift = 0.5 * (before - after) / curve if curve < 0.0 else 0.0
    return float((lags[best] + shift) * step), float(min(1.0, at))


def _rates(first: Array, second: Array, steps: Array) -> Array:
    """Return mean body rates (n, 3), rad/s, between pairs of quaternions (n, 4) that are `steps` (n,), s, apart."""
    return so3.local(first, second) / steps[:, None]


def _fit(ours: Array, theirs: Array) -> tuple[float, float, float]:
    """Fit of an attitude's rates (n, 3) to a gyro's by a rotation (Wahba's problem).

    Returns:
        the share of the squared rates that it explains, its angle, rad, and the ratio of the gyro's rates to the other.
    """
    rotation = so3.align(ours, theirs)
    sizes = float(np.linalg.norm(ours)), float(np.linalg.norm(theirs))
    if not all(sizes):
        return 0.0, float(np.linalg.norm(so3.log(rotation))), 1.0
    explained = float((ours * so3.rotate(rotation, theirs)).sum()) / (sizes[0] * sizes[1])
    return explained, float(np.linalg.norm(so3.log(rotation))), sizes[1] / sizes[0]
