"""Constant vectors of the level frame as a triad measures them at attitudes that a gyro carries.

Frames: a inertial, n level (x to the east of the field, y along its horizontal part, z up), which turns with the earth
and coincides with a at the first keyframe, b the body. A triad has nominal = K raw + b, by rows of K and b (12
numbers), as in alidade.factors.ellipsoid; what is predicted is raw, whose noise is white. The gyro's own samples carry
the attitude from the time of its variable to that of the measurement. What a gyro reads is smoothed, more or less than
the means over its sample intervals that it is integrated as: as half the second moment of that impulse response, its
filter, s^2, the attitude is ahead of the one carried by Exp(filter w').
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, interpolated
from alidade.factors.ellipsoid import by_slope, drifted
from alidade.factors.gyro import SCALE, Derivatives, carried, needed, rate_error
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.factors.preintegration import GyroPath, Increments

# Half width of the cubic fit for the angular acceleration, s. Differences over 10 ms have noise at 400 Hz that makes a
# lever arm 2 % too short, those over 30 ms an error that makes it .5 % too long.
_SPAN = 0.08
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class FieldFactor(Model):
    """Earth's magnetic field in motion: raw = K^-1 (bRa(time + delay) aRn s (0, cos dip, -sin dip) - b).

    Blocks: attitude aRb at the anchor (rotations), gyro bias (3), gyro filter (1), triad (12), strength s (1), dip (1;
    rad, the field's inclination, positive down), delay (1; s by which a reading was taken later than its stamp says),
    unless the gyro is perfect its errors (6 to 19), see alidade.factors.gyro, and, where it is unknown, the earth's
    rate (3).

    Attributes:
        time: (n,) stamps, s.
        anchor: (n,) s, times of the attitudes.
        raw: (n, 3).
        sigma: (n,) per axis.
        elapsed: (n,) s since a and n coincided.
        gyro: whose bias_hat was taken off.
        errors: numbers of the gyro's errors, 0 for a perfect one.
        earth: (3,) rate of n in a, rad/s; None: a block.
    """

    time: Array
    anchor: Array
    raw: Array
    sigma: Array
    elapsed: Array
    gyro: GyroPath
    errors: int = 0
    earth: Array | None = None
    shapes: ClassVar = {"raw": (3,), "sigma": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "anchor", "raw", "sigma", "elapsed")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitude, bias, filter, triad, strength, dip, delay, gyro errors, earth rate."""
        earth = [] if self.earth is not None else [3]
        return ROT3, 3, 1, 12, 1, 1, 1, *([self.errors] if self.errors else []), *earth

    def __call__(
        self,
        aRb: Array,
        bias: Array,
        filter_: Array,
        triads: Array,
        strength: Array,
        dip: Array,
        delay: Array,
        *others: Array,
    ) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        own = others[0] if self.errors else None
        aRn, by_earth = _earth_rotation(self.elapsed, self.earth, others)
        at = self.time + delay[:, 0]
        ahead, rate, by_gyro = _carried(self.gyro, self.anchor, self.time, at, bias, filter_, own)
        bRn = so3.multiply(so3.inverse(so3.multiply(aRb, ahead)), aRn)
        cosine, sine, none = np.cos(dip), np.sin(dip), np.zeros_like(dip)
        level = np.concatenate([none, cosine, -sine], axis=1)
        unit = so3.rotate(bRn, level)
        lower = so3.rotate(bRn, np.concatenate([none, -sine, -cosine], axis=1))
        error, across, by_triad = _predicted(self.raw, self.sigma, triads, strength * unit)

        def jacobians() -> tuple[Array, ...]:
            by_attitude = across @ so3.hat(strength * unit)
            by_filter, by_bias, *by_errors = (by_attitude @ each for each in by_gyro())
            return (
                by_attitude @ so3.matrix(so3.inverse(ahead)),
                by_bias,
                by_filter,
                by_triad(),
                across @ unit[..., None],
                across @ (strength * lower)[..., None],
                by_attitude @ rate[..., None],
                *by_errors,
                *by_earth(across, bRn, strength * level),
            )

        return error, jacobians


@dataclass(frozen=True)
class UpFactor(Model):
    """Specific force in motion: raw = K^-1 (bRa(time) aRn (0, 0, s) + (w' x arm + w x (w x arm)) / unit - b + drift).

    Blocks: attitude aRb at the anchor (rotations), gyro bias (3), gyro filter (1), triad (12), strength s (1), unless
    the gyro is perfect its errors (6 to 19), of a sensor that is swung about a point arm (3; in b, from there to the
    sensor), what drivers of its offset do (m; see `ellipsoid.drifted`) and, where it is unknown, the earth's rate (3).

    Attributes:
        time, anchor, raw, sigma, elapsed, gyro, errors, earth: as of the field.
        unit: m/s^2, of the strength, of a sensor that is swung; None: it is at rest.
        drivers: (n, m) of the offset; None: there are none.
    """

    time: Array
    anchor: Array
    raw: Array
    sigma: Array
    elapsed: Array
    gyro: GyroPath
    errors: int = 0
    earth: Array | None = None
    unit: float | None = None
    drivers: Array | None = None
    shapes: ClassVar = {"raw": (3,), "sigma": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "anchor", "raw", "sigma", "elapsed", "drivers")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitude, bias, filter, triad, strength, gyro errors, arm, drivers, earth rate."""
        arm, slope = [] if self.unit is None else [3], [] if self.drivers is None else [self.drivers.shape[1]]
        earth = [] if self.earth is not None else [3]
        return ROT3, 3, 1, 12, 1, *([self.errors] if self.errors else []), *arm, *slope, *earth

    def __call__(
        self, aRb: Array, bias: Array, filter_: Array, triads: Array, strength: Array, *others: Array
    ) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        own = others[0] if self.errors else None
        slopes = others if self.earth is not None else others[:-1]
        triads = drifted(triads, self.drivers, slopes)
        ahead, _, by_gyro = _carried(self.gyro, self.anchor, self.time, self.time, bias, filter_, own, self._turns)
        aRn, by_earth = _earth_rotation(self.elapsed, self.earth, others)
        bRn = so3.multiply(so3.inverse(so3.multiply(aRb, ahead)), aRn)
        up = strength * so3.rotate(bRn, _UP)
        swung, by_swing = (
            self._swung(bias, own, others[1 if self.errors else 0]) if self.unit else (np.zeros_like(up), None)
        )
        error, across, by_triad = _predicted(self.raw, self.sigma, triads, up + swung)

        def jacobians() -> tuple[Array, ...]:
            by_attitude = across @ so3.hat(up)
            by_filter, by_bias, *by_errors = (by_attitude @ each for each in by_gyro())
            by_strength = across @ (up / strength)[..., None]
            by_arm = []
            if by_swing is not None:
                arm, *more = (across @ each for each in by_swing())
                by_arm = [arm]
                by_bias, *by_errors = (a + b for a, b in zip((by_bias, *by_errors), more, strict=True))
            numbers = by_triad()
            shared = by_bias, by_filter, numbers, by_strength, *by_errors, *by_arm, *by_slope(numbers, self.drivers)
            return by_attitude @ so3.matrix(so3.inverse(ahead)), *shared, *by_earth(across, bRn, strength * _UP)

        return error, jacobians

    def _swung(self, bias: Array, errors: Array | None, arm: Array) -> tuple[Array, Derivatives]:
        """Lever-arm acceleration (w' x arm + w x (w x arm)) / unit, (n, 3); derivatives by arm, bias, errors."""
        per_unit = 1.0 / (self.unit or 1.0)
        read, slope, drivers, drivers_slope = self._read
        excess, by_excess = rate_error(bias - self.gyro.bias_hat, errors, read, drivers)
        growth, by_growth = rate_error(np.zeros_like(bias), errors, slope, drivers_slope)
        rate, change = read - excess, slope - growth
        around = so3.cross(rate, arm)

        def derivatives() -> tuple[Array, ...]:
            lever = so3.hat(arm)
            by_rate = -so3.hat(around) - so3.hat(rate) @ lever
            by_bias, *by_errors = by_excess()
            out = [so3.hat(change) + so3.hat(rate) @ so3.hat(rate), -by_rate @ by_bias]
            out += [lever @ ahead - by_rate @ now for now, ahead in zip(by_errors, by_growth()[1:], strict=True)]
            return tuple(per_unit * each for each in out)

        return per_unit * (so3.cross(change, arm) + so3.cross(rate, around)), derivatives

    @cached_property
    def _turns(self) -> Increments:
        """Increments from anchors to stamps, independent of the variables."""
        return self.gyro.increments(self.anchor, self.time)

    @cached_property
    def _read(self) -> tuple[Array, Array, Array | None, Array | None]:
        """Rates and drivers at the stamps with time derivatives, by cubics (Savitzky, Golay, Anal. Chem. 36, 1964).

        Rates as read: those between which `GyroPath` draws lines make these lines' integral right, and are too sharp.
        """
        gyro = self.gyro

        def rate(t: Array) -> Array:
            return interpolated(t, gyro.t, gyro.read) - gyro.bias_hat

        read = rate(self.time), self._slope(rate)
        return (
            (*read, None, None) if self.errors <= SCALE else (*read, gyro.drivers(self.time), self._slope(gyro.drivers))
        )

    def _slope(self, of: Callable[[Array], Array | None]) -> Array:
        """Time derivative of a function at the stamps, by a local cubic."""
        step = self.gyro.interval
        m = max(2, round(_SPAN / step))
        points = np.arange(-m, m + 1)
        weights = np.linalg.pinv(np.vander(points, 4, increasing=True))[1] / step
        return np.asarray(sum(w * needed(of(self.time + step * k)) for k, w in zip(points, weights, strict=True)))


def _carried(
    gyro: GyroPath,
    anchor: Array,
    stamps: Array,
    at: Array,
    bias: Array,
    filter_: Array,
    errors: Array | None,
    turns: Increments | None = None,
) -> tuple[Array, Array, Derivatives]:
    """Increments (n, 4) from anchors to times `at` near the stamps, with the gyro's filter (n, 1) inverted.

    Returns:
        The increments, the rate at their ends (n, 3) in the turned frame, and how filter, bias and errors turn them
        further (on the right).
    """
    dV, rate, by_gyro = carried(gyro, anchor, 0.5 * (anchor + stamps), at, bias, errors, turns)
    acceleration, jerk = gyro.acceleration(at)
    turned = filter_ * acceleration
    lag, to_end = so3.exp(turned), so3.right_jacobian(turned)
    rate = so3.rotate(so3.inverse(lag), rate) + np.einsum("nij,nj->ni", to_end, filter_ * jerk)

    def derivatives() -> tuple[Array, ...]:
        return to_end @ acceleration[..., None], *(so3.matrix(so3.inverse(lag)) @ each for each in by_gyro())

    return so3.multiply(dV, lag), rate, derivatives


def _earth_rotation(
    elapsed: Array, earth: Array | None, others: tuple[Array, ...]
) -> tuple[Array, Callable[[Array, Array, Array], tuple[Array, ...]]]:
    """Earth rotation aRn (n, 4) after `elapsed` s, and a function for its Jacobian by the earth rate, if variable.

    A vector v of n is aRn v in a; with phi = elapsed w it moves by -aRn [v]x J_r(phi) elapsed dw (J_r: right Jacobian).
    """
    phi = elapsed[:, None] * (others[-1] if earth is None else earth)

    def by_rate(across: Array, bRn: Array, level: Array) -> tuple[Array, ...]:
        if earth is not None:
            return ()
        return (-elapsed[:, None, None] * (across @ so3.matrix(bRn) @ so3.hat(level) @ so3.right_jacobian(phi)),)

    return so3.exp(phi), by_rate


def _predicted(raw: Array, sigma: Array, triads: Array, nominal: Array) -> tuple[Array, Array, Callable[[], Array]]:
    """Whitened error (n, 3), Jacobian (n, 3, 3) by the nominal vector, function for the Jacobian by the triad."""
    inverse = np.linalg.inv(triads[:, :9].reshape(-1, 3, 3))
    weight = 1.0 / sigma[:, None]
    predicted = np.einsum("nij,nj->ni", inverse, nominal - triads[:, 9:])
    across = inverse * weight[..., None]

    def by_triad() -> Array:
        # dK and db change what is predicted by -K^-1 (dK predicted + db).
        by_K = -np.einsum("nij,nk->nijk", across, predicted).reshape(len(raw), 3, 9)
        return np.concatenate([by_K, -across], axis=2)

    return (predicted - raw) * weight, across, by_triad
