"""A tumbled device's gyro: how it is mounted to the magnetometer, and the attitudes that it chains.

Frames as in alidade.factors.turned: a inertial, n level along the field, b the body, whose axes are those in which the
gyro's own errors are symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.earth import earth_rate
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.assumptions import (
    Assumption,
    acting,
    gyro_errors,
    quantities,
    scale_assumptions,
    sensitivity_assumption,
)
from alidade.pipelines.estimation.gyro_chain import GyroChain, shared_keyframes
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Array, Parameter, Quantity
from alidade.pipelines.estimation.walking_bias import FIRST
from alidade.pipelines.methods.noise import sampled, stated, walking
from alidade.pipelines.methods.tumble.recording import GYRO_SLOPE, TumbleData
from alidade.pipelines.settings import Config

Index = NDArray[np.intp]

BIAS = tuple(f"gyro_bias_{axis}" for axis in "xyz")
# The usual grade of consumer gyros, one sigma; and how far from their stamps readings of a magnetometer
# are taken that is read by itself.
SCALE = scale_assumptions("gyro", "gyro", 1e-2)
SENSITIVITY = sensitivity_assumption("gyro", "gyro", 2e-4)
DELAY = Assumption(("mag_delay",), "s", "mag", "delay", 1e-2)
ARM = tuple(f"accel_arm_{axis}" for axis in "xyz")
DELAY_KEY, ARM_KEY, _ERRORS_KEY = (int(gtsam.symbol(letter, 0)) for letter in "drG")
# m; of the hand that turns a device.
_ARM_PRIOR = 0.3
_BIAS_PRIOR, _BIAS_REQUIRE = 0.05, 2e-3

# Readings share a keyframe within this time, s, and keyframes are never farther apart than this, s.
_SHARED, _APART = 0.1, 0.2
# For the first guess attitudes are compared over this time, s, where they turned by at least this, rad.
_SPAN, _TURNED = 0.3, 0.05
# The second-best mounting has to fit this many times worse, with so many windows.
_CLEAR, _FEWEST = 2.0, 30
_ROUNDS = 3
# What part of the field's direction the first guess of attitudes takes at each keyframe.
_GAIN = 0.2


@dataclass(frozen=True, eq=False)
class Seen:
    """What a sensor measured: time (n,) s, direction (n, 3) in b, and, of all its samples, `whole` (m, 3) in b, SI.

    swung: whether it is used while it moves.
    """

    time: Array
    direction: Array
    whole: Array
    swung: bool


@dataclass(frozen=True, eq=False)
class Rows:
    """Readings: row (n,) of each, and keyframe (n,) that is nearest to it, in time order."""

    row: Index
    keyframe: Index

    @classmethod
    def near(cls, time: Array, stamps: Array, rows: Index) -> Rows:
        """Those of the rows that a keyframe is near."""
        after = np.clip(np.searchsorted(time, stamps[rows]), 1, len(time) - 1)
        nearest = np.where(stamps[rows] - time[after - 1] < time[after] - stamps[rows], after - 1, after)
        close = np.abs(time[nearest] - stamps[rows]) <= _APART
        return cls(rows[close], nearest[close])

    def of(self, keyframes: range) -> Rows:
        """Those of some keyframes."""
        chosen = slice(*np.searchsorted(self.keyframe, [keyframes.start, keyframes.stop]))
        return Rows(self.row[chosen], self.keyframe[chosen])


@dataclass(frozen=True, eq=False)
class Mounted:
    """First guesses: Q (3, 3) with field in b = Q field in the magnetometer's axes, and the gyro's bias (3,), rad/s."""

    Q: Array
    bias: Array


@dataclass(frozen=True, eq=False)
class Turning:
    """Attitudes aRb at keyframes.

    Attributes:
        chain: the keyframes, joined by the gyro.
        earth: (3,) rate of n in a, rad/s.
        mag, accel: rows of the sensors' readings that are used, and the keyframe of each, in time order.
        bias, delay: parameters; the delay may be fixed.
        arm: that of an accelerometer which is used while it moves: m, in b, to it from the point about which the
            device is turned; None at rest.
        levels: of the gyro's noises.
    """

    chain: GyroChain
    earth: Array
    mag: Rows
    accel: Rows
    bias: Parameter
    delay: Parameter
    arm: Parameter | None
    levels: tuple[Level, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """In reporting order."""
        return tuple(each for each in (self.bias, self.chain.errors, self.delay, self.arm) if each is not None)

    @property
    def errors(self) -> int:
        """Numbers of the gyro's errors."""
        return 0 if self.chain.errors is None else len(self.chain.errors.quantities)

    def aRn(self, time: Array) -> Array:
        """(n, 4) how the earth has turned."""
        return so3.exp((time - self.chain.time[0])[:, None] * self.earth)


def mounted(data: TumbleData, time: Array, field: Array) -> Mounted | None:
    """The gyro against the magnetometer, from how the field turns in the axes of both; None where motion does not tell.

    Of a field that stays, field_i = dR_ij field_j: linear in the entries of Q, and for small ones in the bias.

    Args:
        data: with a gyro.
        time: (n,) s.
        field: (n, 3) its direction then, in axes at right angles.
    """
    assert data.gyro_t is not None
    assert data.gyro is not None
    inside = np.flatnonzero((time >= data.gyro_t[0]) & (time <= data.gyro_t[-1]))
    stride = max(1, round(_SPAN / max(float(np.median(np.diff(time))), 1e-3)))
    first, last = inside[:-stride], inside[stride:]
    near = time[last] - time[first] < 2.0 * max(_SPAN, float(np.median(np.diff(time))))
    first, last = first[near], last[near]
    bias = np.zeros(3)
    for _ in range(_ROUNDS):
        dR = GyroPath(data.gyro_t, data.gyro, bias).increments(time[first], time[last])
        turned = np.linalg.norm(so3.log(dR.wxyz), axis=1) > _TURNED
        if turned.sum() < _FEWEST:
            return None
        R, before, after = so3.matrix(dR.wxyz[turned]), field[first[turned]], field[last[turned]]
        rows = np.einsum("ac,nb->nacb", np.eye(3), before) - np.einsum("nac,nb->nacb", R, after)
        _, sizes, axes = np.linalg.svd(rows.reshape(-1, 9), full_matrices=False)
        if sizes[-2] < _CLEAR * sizes[-1]:
            return None
        M = axes[-1].reshape(3, 3)
        u, _, vt = np.linalg.svd(M if np.linalg.det(M) > 0.0 else -M)
        Q = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        # dR Exp(J db) Q field: what is left is linear in db.
        left = before @ Q.T - np.einsum("nij,nj->ni", R, after @ Q.T)
        by_bias = -R @ so3.hat(after @ Q.T) @ dR.bias_jacobian[turned]
        bias = bias + np.linalg.lstsq(by_bias.reshape(-1, 3), left.ravel())[0]
    return Mounted(Q, bias)


def turning(
    data: TumbleData, config: Config, guess: Mounted, mag: Seen, accel: Seen | None, declination: float, dip: float
) -> Turning:
    """The chain of attitudes.

    Args:
        data: with gyro and latitude.
        config: in force.
        guess: of mounting and bias.
        mag, accel: what the sensors measured.
        declination: of the field, rad east.
        dip: first guess, rad.
    """
    assert data.gyro_t is not None
    assert data.gyro is not None
    assert data.latitude is not None
    density = sampled(stated("gyro_density", config, data.gyro_density, ("gyro",)), data.gyro_t, data.gyro)
    walk = walking(config)
    drivers: dict[Assumption, Array] = {}
    if accel is not None and data.accel_t is not None:
        force = [np.interp(data.gyro_t, data.accel_t, axis) for axis in accel.whole.T]
        drivers[SENSITIVITY] = np.stack(force, axis=1)
    if data.temperature is not None:
        drivers[GYRO_SLOPE] = data.temperature.above(data.temperature.first, data.gyro_t)
    errors = gyro_errors(_ERRORS_KEY, SCALE, list(drivers), config)
    path = GyroPath(data.gyro_t, data.gyro, guess.bias, acting(errors, drivers))
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
    known = tuple(
        Quantity(name, "rad/s", config.prior(name, _BIAS_PRIOR), _BIAS_PRIOR, config.require.get(name, _BIAS_REQUIRE))
        for name in BIAS
    )
    return Turning(
        chain=chain,
        earth=so3.rotate(so3.exp(np.array([0.0, 0.0, declination])), earth_rate(data.latitude)),
        mag=Rows(inside, np.repeat(np.arange(len(time)), np.diff(begins))),
        accel=rested or Rows(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)),
        bias=Parameter(FIRST, known),
        delay=Parameter(DELAY_KEY, quantities(DELAY, config)),
        arm=_arm(config) if accel is not None and accel.swung else None,
        levels=(density, walk),
    )


def _arm(config: Config) -> Parameter:
    known = (Quantity(name, "m", config.prior(name, _ARM_PRIOR), _ARM_PRIOR, np.inf, nuisance=True) for name in ARM)
    return Parameter(ARM_KEY, tuple(known))


def _inside(stamps: Array, gyro: Array) -> Index:
    """Which stamps are within the gyro's record."""
    return np.flatnonzero((stamps >= gyro[0]) & (stamps <= gyro[-1]))


def _attitudes(time: Array, path: GyroPath, mag: Seen, beside: tuple[Seen, Rows] | None, dip: float) -> Array:
    """First guess (k, 4) of aRb: carried by the gyro, drawn to the directions of the field, turned about it to up."""
    turns = path.increments(time[:-1], time[1:]).wxyz
    along = np.array([0.0, np.cos(dip), -np.sin(dip)])
    field = np.stack([np.interp(time, mag.time, axis) for axis in mag.direction.T], axis=1)
    out = np.empty((len(time), 4))
    # Any attitude in which the field is along itself.
    out[0] = _between(field[0], along)
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


def _between(b: Array, a: Array) -> Array:
    """The shortest rotation (4,) that takes a unit vector b to a."""
    axis, cosine = np.cross(b, a), float(b @ a)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return so3.identity() if cosine > 0.0 else so3.exp(np.pi * np.eye(3)[int(np.argmin(np.abs(b)))])
    return so3.exp(axis / sine * np.arctan2(sine, cosine))
