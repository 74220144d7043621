"""A tumbled device's gyro: how it is mounted to the magnetometer, and the attitudes that it chains.

Frames as in alidade.factors.turned: a inertial, n level along the field, b the body, whose axes are those in which the
gyro's own errors are symmetric.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, interpolated
from alidade.factors.earth import EARTH_RATE, earth_rate
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.gyro_chain import GyroChain, shared_keyframes
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import (
    DEAD_BAND,
    ParameterSpec,
    acting,
    g_sensitivity,
    gyro_bias,
    gyro_errors,
    gyro_scale,
    quantities,
    scalar,
)
from alidade.pipelines.estimation.problem import Parameter, Quantity
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.estimation.walking_bias import FIRST
from alidade.pipelines.methods.noise import sampled, stated, walking
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.recording.plausibility import dead_band, hidden
from alidade.pipelines.settings import Config

BIAS = gyro_bias(0.05, 2e-3)
# The usual grade of consumer gyros, one sigma; and how far from their stamps readings of a magnetometer are taken that
# is read by itself, beside a gyro whose samples are means over an interval that may end at their stamps.
SCALE = gyro_scale("gyro", "gyro", 1e-2)
SENSITIVITY = g_sensitivity(2e-4)
DELAY = scalar("mag_delay", "s", 1e-2, "Magnetometer time delay (true time minus stamp).", "mag.delay")
# A low-pass of 10 ms, beyond a mean over the sample interval.
FILTER = scalar("gyro_filter", "s^2", 5e-5, "Low-pass of the gyro (half its response's second moment).", "gyro.filter")
# Of the hand that turns a device.
ARM = ParameterSpec("accel_arm", "m", 0.3, "Lever arm from the point of rotation to the accelerometer, {axis}.")
EARTH = tuple(f"earth_rate_{axis}" for axis in "xyz")
DELAY_KEY, FILTER_KEY, ARM_KEY, _ERRORS_KEY, _EARTH_KEY = (int(gtsam.symbol(letter, 0)) for letter in "dlrGe")

# Readings share a keyframe within this time, s, and keyframes are never farther apart than this, s.
_SHARED, _APART = 0.1, 0.2
# For the first guess attitudes are compared over these times, s, where they turned by at least this, rad: short ones
# keep errors of the gyro small, long ones those of the magnetometer.
_SPANS, _TURNED = (0.3, 1.0, 3.0, 10.0), 0.05
# Windows needed; sigmas by which the misfit of the second-best guess exceeds that of the best (relative sampling error
# of a mean square of n: sqrt(2 / n)); share of the field's change that the gyro may leave unexplained.
_FEWEST, _CHANCE, _UNEXPLAINED = 30, 3.0, 0.25
_ROUNDS = 3
# Share of its square by which a gain with axes named alike may be farther from those that fit than one with others:
# soft iron of .1, and a mount off by 10 deg.
_AS_NEAR = 0.1
_SIGNS = tuple(product((1.0, -1.0), repeat=3))
# Pairs of an accelerometer's samples from which it is calibrated roughly.
_FORCE_PAIRS = 5000
# What part of the field's direction the first guess of attitudes takes at each keyframe.
_GAIN = 0.2


@dataclass(frozen=True, eq=False)
class Seen:
    """Measured directions of a sensor: time (n,) s, unit direction (n, 3) in b, and all samples `whole` (m, 3), SI.

    strength: of what it measures; swung: whether it is used while it moves.
    """

    time: Array
    direction: Array
    whole: Array
    strength: float
    swung: bool


@dataclass(frozen=True, eq=False)
class Rows:
    """Indices of readings (n,) and of their nearest keyframes (n,), in time order."""

    row: Index
    keyframe: Index

    @classmethod
    def near(cls, time: Array, stamps: Array, rows: Index) -> Rows:
        """Select the rows close in time to a keyframe."""
        after = np.clip(np.searchsorted(time, stamps[rows]), 1, len(time) - 1)
        nearest = np.where(stamps[rows] - time[after - 1] < time[after] - stamps[rows], after - 1, after)
        close = np.abs(time[nearest] - stamps[rows]) <= _APART
        return cls(rows[close], nearest[close])

    def of(self, keyframes: range) -> Rows:
        """Select the rows of some keyframes."""
        chosen = slice(*np.searchsorted(self.keyframe, [keyframes.start, keyframes.stop]))
        return Rows(self.row[chosen], self.keyframe[chosen])


@dataclass(frozen=True, eq=False)
class FieldGuess:
    """First guess by field and gyro: K (3, 3), b (3,) of a unit field K raw + b, gyro bias (3,), rad/s.

    sigma: noise of K raw per axis, robust, that of the gyro over the windows included.
    assumed: whether the motion leaves several K, of which this is that of a magnetometer mounted straight.
    """

    K: Array
    b: Array
    bias: Array
    sigma: float
    assumed: bool

    @property
    def mount(self) -> Array:
        """Orthogonal factor (3, 3) of K's polar decomposition, a reflection where K is left-handed."""
        u, _, vt = np.linalg.svd(self.K)
        return np.asarray(u @ vt)


@dataclass(frozen=True, eq=False)
class Turning:
    """Chain of attitudes aRb at keyframes.

    Attributes:
        chain: the keyframes, joined by the gyro.
        earth: (3,) rate of n in a, rad/s; None: unknown, as without a place, or without an accelerometer that says
            where up is: a parameter.
        mag, accel: rows of the sensors' readings that are used, and the keyframe of each, in time order.
        parameters: of the chain, in reporting order, the bias first.
        arm: that of an accelerometer which is used while it moves: m, in b, to it from the point about which the
            device is turned; None at rest.
        earth_rate: parameter, rad/s, in the axes of n at the first keyframe; None where it is known.
        levels: of the gyro's noises.
    """

    chain: GyroChain
    earth: Array | None
    mag: Rows
    accel: Rows
    parameters: tuple[Parameter, ...]
    arm: Parameter | None
    earth_rate: Parameter | None
    levels: tuple[Level, ...]

    @property
    def errors(self) -> int:
        """Number of parameters of the gyro's errors."""
        return 0 if self.chain.errors is None else len(self.chain.errors.quantities)

    def elapsed(self, time: Array) -> Array:
        """Convert times (n,) to s since the first keyframe, where the frames a (inertial) and n (level) coincide."""
        return np.asarray(time - self.chain.time[0])


def field_guess(data: TumbleData, time: Array, raw: Array) -> FieldGuess | None:
    """Solve K, b and the gyro's bias from magnetometer and gyro by linear least squares, without ellipsoid.

    The field stays while the device turns by dR from time i to time j: K raw_i + b = dR (K raw_j + b), linear and
    homogeneous in K and b. b is eliminated; K is the smallest right singular vector of the rest, which is total least
    squares for white noise of the readings (integrated form of m' = -w x m: Rodriguez-Martinez and Troni, "Full
    magnetometer and gyroscope bias estimation using angular rates", IEEE J. Oceanic Eng. 2024). Of motion about one
    axis, as on a deck, several K are as small: of these it is that of a magnetometer mounted straight.

    Args:
        data: with a gyro.
        time: (n,) s, of the readings.
        raw: (n, 3) readings.

    Returns:
        None where the gyro does not turn as the field does, or too few windows turn.
    """
    guesses = (_guess_over(data, time, raw, span) for span in _SPANS)
    return max(filter(None, guesses), key=lambda each: each[0], default=(0.0, None))[1]


def _guess_over(data: TumbleData, time: Array, raw: Array, span: float) -> tuple[float, FieldGuess] | None:
    """First guess from pairs of readings `span` s apart, and the misfit ratio of the next solution."""
    assert data.gyro_t is not None
    assert data.gyro is not None
    first, last = _pairs(time, span, data.gyro_t)
    centre, radius = raw.mean(axis=0), max(float(raw.std()), np.finfo(float).tiny)
    x, bias = (raw - centre) / radius, np.zeros(3)
    for _ in range(_ROUNDS):
        dR = GyroPath(data.gyro_t, data.gyro, bias).increments(time[first], time[last])
        turned = np.linalg.norm(so3.log(dR.wxyz), axis=1) > _TURNED
        if turned.sum() < _FEWEST:
            return None
        R, before, after = so3.matrix(dR.wxyz[turned]), x[first[turned]], x[last[turned]]
        K, b, assumed, determined = _homogeneous(R, before, after, _alike(time, int(turned.sum()), span))
        at_first, at_last = before @ K.T + b, after @ K.T + b
        left = at_first - np.einsum("nij,nj->ni", R, at_last)
        by_bias = -R @ so3.hat(at_last) @ dR.bias_jacobian[turned]
        bias = bias + np.linalg.lstsq(by_bias.reshape(-1, 3), left.ravel())[0]
    if (left**2).sum() > _UNEXPLAINED * ((at_first - at_last) ** 2).sum():
        return None
    size = float(np.linalg.norm(at_first, axis=1).mean()) * (1.0 if np.linalg.det(K) > 0.0 else -1.0)
    sigma = robust_sigma(left) / abs(size) / 2.0**0.5
    return determined, FieldGuess(K / (size * radius), (b - K @ centre / radius) / size, bias, sigma, assumed)


def _pairs(time: Array, span: float, gyro: Array, most: int | None = None) -> tuple[Index, Index]:
    """Indices of reading pairs about `span` s apart, within the gyro's record and without gaps between.

    `most`: about how many at most; None: all.
    """
    inside, interval = _inside(time, gyro), float(np.median(np.diff(time)))
    stride = max(1, round(span / max(interval, 1e-3)))
    first, last = inside[:-stride], inside[stride:]
    near = np.flatnonzero(time[last] - time[first] < 2.0 * max(span, interval))
    near = near[:: 1 if most is None else -(-len(near) // most) or 1]
    return first[near], last[near]


def _alike(time: Array, pairs: int, span: float) -> float:
    """Ratio of RMS misfits up to which two solutions fit equally well, from `pairs` of readings (n,) `span` s apart."""
    independent = 3.0 * pairs * min(1.0, float(np.median(np.diff(time))) / span)
    return float(1.0 + _CHANCE * np.sqrt(2.0 / independent))


def _homogeneous(
    R: Array, before: Array, after: Array, alike: float, beside: Array | None = None
) -> tuple[Array, Array, bool, float]:
    """Solve K before + b = R (K after + b) + beside a for K (3, 3) of unit norm, b (3,) and any a.

    Of several K whose misfits are less than `alike` times the smallest it is that of a sensor mounted straight.

    Also returns whether there are several, and by what factor the next one fits worse, over what counts as alike.
    """
    gains = np.einsum("ac,nb->nacb", np.eye(3), before) - np.einsum("nac,nb->nacb", R, after)
    gains, offsets = gains.reshape(-1, 9), (np.eye(3) - R).reshape(-1, 3)
    if beside is not None:
        offsets = np.column_stack([offsets, -beside.reshape(len(offsets), -1)])
    by_gain = np.linalg.lstsq(offsets, gains)[0]
    left = gains - offsets @ by_gain
    squares, axes = np.linalg.eigh(left.T @ left)
    sizes = np.sqrt(np.maximum(squares, np.finfo(float).tiny))
    count = int(np.searchsorted(sizes, alike * sizes[0]))
    K = axes[:, 0] if count == 1 else _mounted_straight(axes[:, :count])
    return K.reshape(3, 3), -(by_gain @ K)[:3], count > 1, float(sizes[min(count, 8)] / (alike * sizes[0]))


def _mounted_straight(axes: Array) -> Array:
    """K (9,) in the span of orthonormal axes (9, k), nearest to identical or permuted axes."""
    ways = _right_angles().reshape(-1, 9)
    parts = ways @ axes
    share = np.square(parts).sum(axis=1) / 3.0
    best = 0 if share[0] > share.max() - _AS_NEAR else int(share.argmax())
    return np.asarray(axes @ parts[best] / np.linalg.norm(parts[best]))


@cache
def _right_angles() -> Array:
    """Rotations (24, 3, 3) that permute the axes, the identity first."""
    signed = (np.eye(3)[list(order)] * np.array(signs) for order in permutations(range(3)) for signs in _SIGNS)
    return np.array([each for each in signed if np.linalg.det(each) > 0.0])


def calibrated_force(time: Array, accel: Seen, path: GyroPath) -> Array:
    """Calibrate the samples of a moving accelerometer roughly: specific force (m, 3), m/s^2, in the body's axes b.

    Without its lever arm's part it is constant in space: K and b as of the magnetometer, from samples so far apart that
    motion is small beside what gravity changes. An offset b left in it would be G b in the gyro's bias. It stays as it
    is where the motion leaves several K, or none whose force is more even in size.

    Args:
        time: (m,) s, of all samples.
        accel: with all samples at the first guess, nearly along the axes of b.
        path: of the gyro.
    """
    span, size = _SPANS[-2], accel.strength
    first, last = _pairs(time, span, path.t, _FORCE_PAIRS)
    if len(first) < _FEWEST:
        return accel.whole
    dR, x = so3.matrix(path.increments(time[first], time[last]).wxyz), accel.whole / size

    def by_arm(t: Array) -> Array:
        rate = so3.hat(path.rate(t))
        return so3.hat(path.acceleration(t)[0]) + rate @ rate

    arm = by_arm(time[first]) - dR @ by_arm(time[last])
    K, b, several, _ = _homogeneous(dR, x[first], x[last], _alike(time, len(first), span), arm)
    force = np.sign(np.trace(K)) * (x @ K.T + b)
    lengths, before = (np.linalg.norm(each, axis=1) for each in (force, x))
    if several or lengths.std() / lengths.mean() > before.std() / before.mean():
        return accel.whole
    return np.asarray(force * size / lengths.mean())


def specific_force(data: TumbleData, accel: Seen, guess: FieldGuess) -> Array:
    """Specific force (m, 3), m/s^2, in the body's axes b, of all samples of an accelerometer, roughly calibrated."""
    if not accel.swung or data.accel_t is None or data.gyro_t is None or data.gyro is None:
        return accel.whole
    return calibrated_force(data.accel_t, accel, GyroPath(data.gyro_t, data.gyro, guess.bias))


def turning(
    data: TumbleData,
    config: Config,
    guess: FieldGuess,
    seen: Mapping[str, Seen],
    force: Array | None,
    declination: float,
    dip: float,
) -> Turning:
    """Build the chain of attitudes of a tumble recording.

    Args:
        data: with a gyro.
        guess: of mounting and bias.
        seen: what magnetometer ("mag") and accelerometer ("accel"), if there is one, measured.
        force: (m, 3) of the accelerometer's samples, see `specific_force`.
        declination: of the field, rad east.
        dip: first guess, rad.
    """
    assert data.gyro_t is not None
    assert data.gyro is not None
    density = sampled(stated("gyro_density", config, data.gyro_density, ("gyro",)), data.gyro_t, data.gyro)
    walk = walking(config)
    drivers: dict[ParameterSpec, Array] = {}
    mag, accel = seen["mag"], seen.get("accel")
    if force is not None and data.accel_t is not None:
        drivers[SENSITIVITY] = interpolated(data.gyro_t, data.accel_t, force)
    if data.temperature is not None:
        drivers[GYRO_SLOPE] = data.temperature.above(data.temperature.first, data.gyro_t)
    half_width, beyond = dead_band(data.gyro_t, data.gyro)
    if half_width:
        drivers[DEAD_BAND] = beyond
    errors = gyro_errors(_ERRORS_KEY, SCALE, list(drivers), config)
    path = GyroPath(
        data.gyro_t,
        data.gyro,
        guess.bias,
        acting(errors, drivers),
        density.used,
        hidden(data.gyro_t, half_width, beyond),
    )
    inside = _inside(mag.time, data.gyro_t)
    time, begins = shared_keyframes(mag.time[inside], mag.time[inside[0]], _SHARED, _APART)
    rested = None if accel is None else Rows.near(time, accel.time, _inside(accel.time, data.gyro_t))
    chain = GyroChain.over(
        time,
        np.arange(len(time)) == 0,
        _attitudes(time, path, mag, None if accel is None or rested is None else (accel, rested), dip),
        path,
        density=density.used,
        walk=walk.used,
        errors=errors,
    )
    arm = None
    if accel is not None and accel.swung:
        arm = Parameter(ARM_KEY, tuple(replace(q, nuisance=True) for q in quantities(ARM, config)))
    earth = rate_of_earth = None
    if accel is not None and data.latitude is not None:
        # In the level frame n, with y along the horizontal field.
        earth = so3.rotate(so3.exp(np.array([0.0, 0.0, declination])), earth_rate(data.latitude))
    else:
        # Of unknown direction: each component is as large as the whole, one sigma.
        known = (
            Quantity(name, "rad/s", config.prior(name, EARTH_RATE), EARTH_RATE, np.inf, group="assumption")
            for name in EARTH
        )
        rate_of_earth = Parameter(_EARTH_KEY, tuple(known))
    # A mean up to its stamp is late by half an interval, and has h^2 / 24 more of a filter than a point.
    lag = 0.5 * float(np.median(np.diff(data.gyro_t)))
    delay = replace(DELAY, prior=float(np.hypot(DELAY.prior, lag)))
    low_pass = replace(FILTER, prior=float(np.hypot(FILTER.prior, lag**2 / 6.0)))
    parameters = (
        Parameter(FIRST, quantities(BIAS, config)),
        errors,
        Parameter(DELAY_KEY, quantities(delay, config)),
        Parameter(FILTER_KEY, quantities(low_pass, config)),
        arm,
        rate_of_earth,
    )
    return Turning(
        chain=chain,
        earth=earth,
        mag=Rows(inside, np.repeat(np.arange(len(time)), np.diff(begins))),
        accel=rested or Rows(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)),
        parameters=tuple(each for each in parameters if each is not None),
        arm=arm,
        earth_rate=rate_of_earth,
        levels=(density, walk),
    )


def _inside(stamps: Array, gyro: Array) -> Index:
    """Indices of the stamps within the gyro's record."""
    return np.flatnonzero((stamps >= gyro[0]) & (stamps <= gyro[-1]))


def _attitudes(time: Array, path: GyroPath, mag: Seen, beside: tuple[Seen, Rows] | None, dip: float) -> Array:
    """Initial attitudes aRb (k, 4): gyro propagation, corrected to the field's direction, then to up."""
    turns = path.increments(time[:-1], time[1:]).wxyz
    along = np.array([0.0, np.cos(dip), -np.sin(dip)])
    field = interpolated(time, mag.time, mag.direction)
    out = np.empty((len(time), 4))
    # Any attitude in which the field is along itself.
    out[0] = so3.shortest(field[0] / np.linalg.norm(field[0]), along)
    for k in range(1, len(time)):
        carried = so3.multiply(out[k - 1], turns[k - 1])
        expected = so3.rotate(so3.inverse(carried), along)
        out[k] = so3.multiply(carried, so3.exp(_GAIN * so3.cross(field[k], expected)))
    if beside is None:
        return out
    accel, rows = beside
    where = so3.rotate(out[rows.keyframe], accel.direction[rows.row])
    across = np.array([0.0, np.sin(dip), np.cos(dip)])  # of up, what is across the field, and what is across both
    angle = np.arctan2((where @ so3.cross(across, along)).sum(), (where @ across).sum())
    return so3.multiply(so3.exp(angle * along), out)
