"""When pictures were taken, by their stamps, and a first guess of it, linear in time: offset and skew alone.

Two ordinary clocks drift apart by 1e-4: 60 ms in ten minutes, 0.36 s in an hour, further than motion around a stamp can
be carried. So a clock is guessed before the graph is made, and keyframes stand where pictures were taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, interpolated
from alidade.factors.preintegration import GyroPath, Increments
from alidade.pipelines.estimation.robust import fitted

# A clock is guessed first from as much of a recording as takes it to go wrong by so much, s (sigma), far less than a
# swing takes, then from so many times as much each time.
_WRONG_AT_FIRST, _THEN, _PASSES = 0.06, 4.0, 3
# It is another clock than the stamps' beyond so many sigmas.
_SIGNIFICANT = 5.0

# Where the clock's offset and skew stand among the numbers of a guess.
_CLOCK = slice(-2, None)
# What misses (n, d) at numbers near some, the last two of which are a clock's offset and skew.
Miss = Callable[[Array], Array]


@dataclass(frozen=True)
class Clock:
    """Camera clock: a picture with a stamp was exposed at stamp + offset - skew * (stamp - begun), s.

    Attributes:
        begun: the recording's first stamp, s.
        offset: s.
        skew: s/s.
    """

    begun: float
    offset: float = 0.0
    skew: float = 0.0

    def late(self, elapsed: Array) -> Array:
        """Delay (n,), s, of exposures after their stamps, at times (n,), s, since the first stamp."""
        return np.asarray(self.offset - self.skew * elapsed)

    def taken(self, elapsed: Array) -> Array:
        """Exposure times (n,), s, of pictures, from their stamps (n,) since the first stamp, s."""
        return np.asarray(self.begun + elapsed + self.late(elapsed))

    def exposed(self, stamps: Array) -> Array:
        """Exposure times (n,), s, of pictures with stamps (n,), s."""
        return np.asarray(stamps + self.offset - self.skew * (stamps - self.begun))

    def elapsed(self, taken: Array) -> Array:
        """Stamps (n,), s, since the first one, of pictures exposed at times (n,), s."""
        return np.asarray((taken - self.begun - self.offset) / (1.0 - self.skew))


@dataclass(frozen=True)
class Keyframes:
    """Keyframe times of a graph: the exposures by the initial guess of the camera's clock.

    Attributes:
        clock: that clock.
        near: so far off, s, motion around a keyframe still gives what sensors measured at its exposure.
    """

    clock: Clock
    near: float

    def are_far(self, clock: Clock, time: float, covariance: Array | None = None) -> bool:
        """Whether another clock moves exposures at the beginning or at a time, s, by more than `near`.

        With a covariance (2, 2) of that clock's offset and skew: whether it certainly does.
        """
        elapsed = np.array([0.0, time - self.clock.begun])
        sigmas = np.zeros(2) if covariance is None else _sigmas_at(elapsed, covariance)
        return bool((np.abs(clock.late(elapsed) - self.clock.late(elapsed)) > self.near + _SIGNIFICANT * sigmas).any())


def first_span(skew_sigma: float) -> float:
    """Length, s, of the first span of a recording, over which the clock's drift is negligible."""
    return _WRONG_AT_FIRST / skew_sigma


def turns_near(gyro: GyroPath, start: Array, stop: Array) -> Callable[[Array, Array], Increments]:
    """Return a function that integrates a gyro over windows whose ends (n,), s, are near given ones.

    A stream longer than what is kept of it is integrated anew for every look.
    """
    turns = gyro.increments(start, stop)
    rates = [interpolated(t, gyro.t, gyro.read) for t in (start, stop)]

    def near(*ends: Array) -> Increments:
        moves = zip(rates, ends, (start, stop), strict=True)
        back, on = (so3.exp(rate * (end - was)[:, None]) for rate, end, was in moves)
        return replace(turns, wxyz=so3.compose(so3.inverse(back), turns.wxyz, on))

    return near


def guess_clock(
    begun: float,
    last: float,
    x: Array,
    prior: Array,
    sigma: float,
    missing: Callable[[float], Callable[[Array], Miss] | None],
    repeated: float = 1.0,
) -> tuple[Clock, Array]:
    """Find the clock that explains a recording's pictures best, and the other numbers (d,) that go with the clock.

    It is that of the stamps unless pictures at one end of the recording were certainly taken at another time.

    Args:
        begun: the recording's first stamp, s.
        last: stamp of the last picture since then, s.
        x: (d,) numbers to begin with, offset and skew the last two.
        prior: (d,) their inverse sigmas about zero.
        sigma: of what misses, where nothing is wrong.
        missing: of the recording's first so many seconds, what misses near some numbers; None: too little is there.
        repeated: misses that show the same errors of the sensors, which are no noise.
    """
    until, covariance = first_span(1.0 / prior[-1]), np.diag(prior**-2.0)
    while True:
        near = missing(until)
        if near is not None:
            x, covariance = fitted(near, x, prior, sigma, _PASSES)
        if until >= last:
            break
        until *= _THEN
    clock, ends = Clock(begun, *x[_CLOCK].tolist()), np.array([0.0, last])
    sigmas = _sigmas_at(ends, repeated * covariance[_CLOCK, _CLOCK])
    significant = (np.abs(clock.late(ends)) > _SIGNIFICANT * sigmas).any()
    return clock if significant else Clock(begun), x


def _sigmas_at(elapsed: Array, covariance: Array) -> Array:
    """Sigmas (n,), s, of the exposure delay at times since the first stamp, by (2, 2) of offset and skew."""
    rows = np.stack([np.ones_like(elapsed), -elapsed], axis=1)
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", rows, covariance, rows)))
