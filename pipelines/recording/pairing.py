"""Which gyro turns with which attitude, from what they measured.

How fast a body turns does not depend on how a sensor sits on it: the norm of a gyro's rate is that of the attitude's
own rate, up to a delay. Where the norms agree, one constant rotation takes one rate vector into the other, if the
attitude is that of the gyro's body; of its inverse the rates are along axes of the other frame, and none does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# Delays looked for, s; steps and length of the grid they are looked for on.
_LARGEST_DELAY, _FINEST, _MOST = 2.0, 0.002, 1 << 17
# Attitudes are differenced over this long, s.
_INTERVAL = 0.1
# Rates that vary less, rad/s, or are known for less time, s, tell nothing.
_LEAST_MOTION, _SHORTEST = 0.02, 3.0
# An interval of an attitude so many times the usual one is a gap.
_GAP = 3.0


@dataclass(frozen=True)
class Pairing:
    """How well a gyro and an attitude agree.

    Attributes:
        correlation: of the norms of their rates, at the delay at which they agree best.
        offset_s: what to add to the attitude's stamps to get the gyro's times.
        inverted: whether the inverse of the attitude is that of the gyro's body.
        fit: share of the rates that one constant rotation explains; of the better of the two directions.
    """

    correlation: float
    offset_s: float
    inverted: bool
    fit: float


def pair(gyro_t: Stamps, gyro: Array, attitude_t: Stamps, wxyz: Array) -> Pairing | None:
    """Rates (N, 3) rad/s at stamps in ns, against unit quaternions (M, 4); None where there is too little motion."""
    start = int(min(gyro_t.min(initial=np.iinfo(np.int64).max), attitude_t.min(initial=np.iinfo(np.int64).max)))
    order = np.argsort(gyro_t, kind="stable")
    t = (gyro_t[order] - start) * 1e-9
    finite = np.isfinite(gyro[order]).all(axis=1) & (np.diff(t, prepend=-1.0) > 0.0)
    t, rates = t[finite], gyro[order][finite]
    order = np.argsort(attitude_t, kind="stable")
    at, quaternions = (attitude_t[order] - start) * 1e-9, wxyz[order]
    known = np.isfinite(quaternions).all(axis=1) & (np.diff(at, prepend=-1.0) > 0.0)
    at, quaternions = at[known], quaternions[known]
    if len(t) < 10 or len(at) < 10 or min(t[-1], at[-1]) - max(t[0], at[0]) < _SHORTEST:
        return None
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(t)[:, None], axis=0)])

    def mean_rate(a: Array, b: Array) -> Array:
        """Of the gyro over intervals."""
        ends = [np.stack([np.interp(x, t, column) for column in turned.T], axis=1) for x in (a, b)]
        return (ends[1] - ends[0]) / (b - a)[:, None]

    # Over several samples, for the noise of an attitude weighs by one over the interval.
    stride = max(1, round(_INTERVAL / float(np.median(np.diff(at)))))
    if len(at) < 10 * stride:
        return None
    steps = at[stride:] - at[:-stride]
    whole = steps < _GAP * np.median(steps)
    a, b = at[:-stride][whole], at[stride:][whole]
    ways = [
        _rates(one[:-stride], one[stride:], steps)[whole]
        for one in (quaternions, quaternions * [1.0, -1.0, -1.0, -1.0])
    ]
    offset, correlation = _delay(0.5 * (a + b), np.linalg.norm(ways[0], axis=1), a, b, mean_rate, (t[0], t[-1]))
    if correlation is None:
        return None

    def fits(later: float) -> list[float]:
        """Of both ways, at a delay."""
        inside = (a + later >= t[0]) & (b + later <= t[-1])
        against = mean_rate(a[inside] + later, b[inside] + later)
        return [_fit(one[inside], against) for one in ways]

    way = int(np.argmax(fits(offset)))
    # Near its greatest value the fit is a parabola of the delay.
    delays = offset + np.linspace(-_INTERVAL, _INTERVAL, 9)
    c2, c1, _ = np.polyfit(delays - offset, [fits(delay)[way] for delay in delays], 2)
    if c2 < 0.0 and abs(c1) < 2.0 * _INTERVAL * abs(c2):
        offset -= float(c1 / (2.0 * c2))
    return Pairing(correlation, offset, way == 1, fits(offset)[way])


def _delay(
    middle: Array, norm: Array, a: Array, b: Array, mean_rate: object, span: tuple[float, float]
) -> tuple[float, float | None]:
    """What to add to the attitude's times, and the correlation there; None where nothing moves."""
    assert callable(mean_rate)
    step = max(_FINEST, float(np.median(b - a)) / 2.0, (middle[-1] - middle[0]) / _MOST)
    grid = np.arange(max(middle[0], span[0]), min(middle[-1], span[1]), step)
    half = 0.5 * float(np.median(b - a))
    ours = np.interp(grid, middle, norm)
    theirs = np.linalg.norm(mean_rate(grid - half, grid + half), axis=1)
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
    """Rates in the body, rad/s, between quaternions."""
    w1, v1 = first[:, :1], -first[:, 1:]
    w2, v2 = second[:, :1], second[:, 1:]
    w = (w1 * w2)[:, 0] - np.einsum("ni,ni->n", v1, v2)
    v = w1 * v2 + w2 * v1 + np.cross(v1, v2)
    v = np.where(w[:, None] < 0.0, -v, v)
    sine = np.linalg.norm(v, axis=1)
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    scale = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return np.asarray(v * (scale / steps)[:, None])


def _fit(ours: Array, theirs: Array) -> float:
    """Share of the squared rates explained by the rotation that fits best (Wahba's problem, by SVD)."""
    u, s, vt = np.linalg.svd(ours.T @ theirs)
    s[-1] *= np.sign(np.linalg.det(u @ vt))
    total = float(np.sqrt((ours**2).sum() * (theirs**2).sum()))
    return float(s.sum()) / total if total > 0.0 else 0.0
