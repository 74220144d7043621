"""Plausibility of readings: units, removed gravity, wrapped counts, and placeholders that drivers write.

A sensor that is not there reads zero, one value, or NaN, whatever its covariance states; one that reads something
plausible is there, though a driver wrote -1 over it. A covariance that no sensor has states nothing: zero, -1, too
small for any, or so large that the reading would be none (1e6, 1e9, the largest number). A value repeated until there
is a new one was measured once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.recording.checks import count

SI = {"accel": "m/s^2", "gyro": "rad/s", "mag": "T"}
# Median norms that an accelerometer in m/s^2 and a magnetometer in T show, and in which unit others are likely to be.
PLAUSIBLE = {"accel": (3.0, 30.0), "mag": (1e-6, 1e-3)}
_ACCEL_UNITS = {"g": (0.5, 2.0), "mg": (500.0, 2000.0), "raw counts": (2000.0, np.inf)}
_MAG_UNITS = {"gauss": (0.05, 5.0), "uT": (5.0, 1000.0), "mG or raw counts": (1000.0, 2e4), "nT": (2e4, np.inf)}
_LIKELY = {"accel": _ACCEL_UNITS, "mag": _MAG_UNITS}
# With gravity in it the norm of a specific force is seldom below half its median, which a vector of noise and motion
# alone is in 13 of 100 readings (the share for a normal one in three axes: median 1.54, chi(3) below 0.77 is 0.13).
_LOW, _LOW_SHARE = 0.5, 0.08
# Gravity in m/s^2, with the largest offset of a sensor, and in g: norms that are those of gravity.
_WITH_GRAVITY = ((8.0, np.inf), (0.8, 1.25))
GRAVITY_REMOVED = (
    "gravity has been taken off (linear acceleration, user acceleration): record the accelerometer with gravity in it"
)
# A gyro at rest reads its bias: in rad/s below 0.2, in deg/s often above; a magnetometer reads the field.
_FEWEST = 50
# Unsigned counts that are signed ones: taken as such they vary by less than so much of what they do as they are.
_LESS = 0.5
# Largest plausible sigmas of a sample, SI: of a gyro, of an accelerometer (gravity), of a
# magnetometer (twice the earth's field) and of an attitude (a radian).
MOST_SIGMA = {"gyro": 0.5, "accel": 9.8, "mag": 1e-4, "attitude": 1.0}
DEAD_BAND = (
    "The gyro has a dead band: at small rates it reads one value. Its offset is known from the turns alone, and "
    "gyro_dead_band is what it subtracts from larger rates: add it to the size of readings before the formula, or "
    "switch the dead band off in the device and record again."
)
HELD = ": repeats the reading before, used once"
_MAX_NUMBER = 1e100
# A topic holds readings where more than this share of the rows repeats the row before; least number of rows tested.
_HELD, _MIN_HELD = 0.4, 100
# The half width of a dead band is more than so many of the device's steps: those between neighbouring values where
# readings are dense.
_FEWEST_STEPS, _DENSE = 2.0, 0.1
# It has at least so many samples at its value, and so many times those at both values next to it: passed evenly, a half
# width of n steps has 2 n + 1 times those at one of them. Without one noise of half a step makes it twice them.
_LEAST_WITHIN, _ALONE = 20, _FEWEST_STEPS + 0.5
# Readings pass through a dead band in less than this, s, as fast as so many samples before and after.
_PASSING_S, _ASIDE = 0.25, 5


def implausible(kind: str, values: Array) -> str:
    """Return a phrase about readings (N, 3) that are implausible in their unit; empty if plausible, and for a gyro.

    `kind` is accel, gyro or mag, the unit m/s^2, rad/s or T; rows with NaN do not count.
    """
    if kind not in PLAUSIBLE:
        return ""
    norms = np.linalg.norm(values[np.isfinite(values).all(axis=1)], axis=1)
    if not len(norms):
        return ""
    norm = float(np.median(norms))
    what = {"accel": "acceleration", "mag": "field"}[kind]
    problem = f"{what} has a norm of {norm:.4g} (median), implausible in {SI[kind]}"
    if kind == "accel" and lacks_gravity(norms):
        return f"{problem}; {GRAVITY_REMOVED}"
    low, high = PLAUSIBLE[kind]
    if low <= norm <= high:
        return ""
    likely = likely_unit(kind, norm)
    return f"{problem}{f'; is it in {likely}?' if likely else ''}"


def likely_unit(kind: str, norm: float) -> str:
    """The unit other than SI in which an accelerometer or a magnetometer has a median norm; empty where none has it."""
    return next((unit for unit, (low, high) in _LIKELY[kind].items() if low <= norm < high), "")


def lacks_gravity(norms: Array, is_si: bool = False) -> bool:
    """Whether accelerometer norms (N,) are those of motion with gravity removed.

    In m/s^2 if `is_si`, else in that or in g, of which both have to say so.
    """
    norm, with_gravity = float(np.median(norms)), _WITH_GRAVITY[: 1 if is_si else 2]
    if len(norms) < _FEWEST or norm > PLAUSIBLE["accel"][1] or any(low < norm < high for low, high in with_gravity):
        return False
    return bool(np.mean(norms < _LOW * norm) > _LOW_SHARE)


def wrapped_bits(values: Array) -> int:
    """Return the bits of signed counts (N, 3) that were recorded as unsigned; 0 where they were not."""
    first = values[:_FEWEST]
    if not len(first) or not (np.isfinite(first).all() and (first >= 0).all() and (first == np.rint(first)).all()):
        return 0
    if not (np.isfinite(values).all() and (values >= 0).all() and (values == np.rint(values)).all()):
        return 0
    bits = int(values.max()).bit_length()
    if bits not in (8, 10, 12, 14, 16, 20, 24, 32):
        return 0
    signed = to_signed(values, bits)
    before, after = (np.abs(np.diff(one, axis=0)).sum() for one in (values, signed))
    return bits if after < _LESS * before else 0


def to_signed(values: Array, bits: int) -> Array:
    """Convert unsigned counts of so many bits to signed numbers, by two's complement."""
    return np.where(values >= 1 << (bits - 1), values - (1 << bits), values)


def is_there(kind: str, values: Array, covariance: Array) -> bool:
    """Whether values (N, 3) in messages are measurements of a sensor, not filled in by a driver.

    `kind` is accel or gyro; a covariance (N, 3, 3) that begins with -1 says that there is no such sensor.
    """
    finite = values[np.isfinite(values).all(axis=1)]
    if not finite.any():
        return False
    if not (covariance[:, 0, 0] == -1.0).any():
        return True
    # Stated to be absent, at least in some rows, as in the first: accepted of what never moves or cannot be.
    return bool(np.ptp(finite, axis=0).all()) and not (kind == "accel" and implausible(kind, finite))


def plausible_covariance(topic: str, kind: str, covariance: Array, least: float, dropped: dict[str, int]) -> Array:
    """Return covariances (N, 3, 3) with zero in place of implausible ones, which are counted in `dropped`.

    `kind` is a key of MOST_SIGMA, `least` the variance below which no sensor is.
    """
    # Those that never change are one in memory.
    alike = len(covariance) if len(covariance) and covariance.strides[0] == 0 else 1
    own = covariance[:1] if alike > 1 else covariance
    # Some write the largest number there is.
    diagonal = np.clip(np.diagonal(own, axis1=1, axis2=2), -_MAX_NUMBER, _MAX_NUMBER)
    absent = own[:, 0, 0] == -1.0
    variance = diagonal.sum(axis=1) / 3.0
    tiny = ~absent & (variance > 0.0) & (variance < least)
    huge = ~absent & ~(np.abs(diagonal) < MOST_SIGMA[kind] ** 2).all(axis=1)
    for mask, what in ((absent, "of -1"), (tiny, "too small for any sensor"), (huge, "too large for any sensor")):
        count(dropped, f"{topic}: covariance {what}, not used (reading kept)", alike * int(np.count_nonzero(mask)))
    unknown = absent | tiny | huge
    if not unknown.any():
        return covariance
    return np.broadcast_to(np.where(unknown[:, None, None], 0.0, own), covariance.shape)


def density(topic: str, kind: str, t: Array, covariance: Array, least: float, dropped: dict[str, int]) -> float | None:
    """Return the noise density, per sqrt(Hz), that covariances (N, 3, 3) of samples state; None if they state none.

    The samples are at times t (N,), s; `kind` is a key of MOST_SIGMA, `least` the density below which no sensor is.
    `dropped` counts what `plausible_covariance` leaves out.
    """
    step = float(np.median(np.diff(t)))
    covariance = plausible_covariance(topic, kind, covariance, least**2 / step, dropped)
    variances = np.trace(covariance[:1] if covariance.strides[0] == 0 else covariance, axis1=1, axis2=2) / 3.0
    known = variances[variances > 0.0]
    return float(np.sqrt(np.mean(known) * step)) if len(known) else None


def measured_once(topic: str, values: Array, dropped: dict[str, int]) -> NDArray[np.intp]:
    """Return the rows of values (N, k), sorted by time, without repeats, if the driver repeats readings regularly."""
    everything = np.arange(len(values))
    if len(values) < _MIN_HELD:
        return everything
    repeats = np.append(False, (np.diff(values, axis=0) == 0.0).all(axis=1))
    # At rest a coarse sensor repeats itself as well, one value throughout, or not each as often as the others.
    runs = np.diff(np.flatnonzero(np.append(~repeats, True)))
    regular = np.abs(runs - np.median(runs)) <= 1
    if repeats.mean() < _HELD or len(runs) < 2 or np.average(regular, weights=runs) < 0.9:
        return everything
    count(dropped, f"{topic}{HELD}", int(repeats.sum()))
    return np.flatnonzero(~repeats)


def without_rounding(values: Array) -> Array:
    """Round readings to twelve digits of the largest: conversions of units make many values of one."""
    largest = max(float(np.abs(values).max(initial=0.0)), np.finfo(float).tiny)
    return np.asarray(largest * np.round(values / largest, 12))


def quantum(values: Array) -> float:
    """Step of readings in steps, in their unit: a tenth of the values are nearer to the next one; 0 of one value."""
    steps = np.diff(np.unique(values))
    return float(np.quantile(steps, _DENSE)) if len(steps) else 0.0


def dead_band(t: Array, values: Array) -> tuple[float, Array]:
    """Return the half width of a device's dead band, 0 without one, and the side of it (-1, 0, 1) of readings (N, k).

    Within a dead band a device reports one value. That is the value of far more samples of an axis than the values next
    to it. The half width is half of what readings change by while they pass through, on average. Beyond it a device
    reports the rate or what is left of it: sides are -1 and 1 there, 0 within and without a dead band. Times t (N,) are
    in s, readings in any unit.
    """
    values = without_rounding(values)
    found = [value for column in values.T if (value := _one_value(column)) is not None]
    side = np.sign(values - np.median(found)) if found else np.zeros_like(values)
    passed = np.concatenate([_passed(t, *columns) for columns in zip(values.T, side.T, strict=True)])
    half_width = 0.5 * float(passed.mean()) if len(passed) else 0.0
    # Held readings are not passed through, and those in coarse steps within half a step.
    if not found or half_width <= _FEWEST_STEPS * quantum(values):
        return 0.0, np.zeros_like(values)
    return half_width, side


def hidden(t: Array, half_width: float, side: Array) -> Array | None:
    """Density (N,) of what a gyro does not show within its dead band, rad/s/sqrt(Hz); None without one.

    The rate there, with the bias that rests hide, is uniform in the band and may be the same all the time. Over all the
    time in it, T, white noise of the density half_width sqrt(T / 3) leaves its mean as uncertain as that. Times t (N,)
    are in s, `half_width` and `side` as `dead_band` has them.
    """
    if not half_width:
        return None
    within = (side == 0.0).any(axis=1)
    lasting = float(within.mean() * (t[-1] - t[0]))
    return np.where(within, half_width * np.sqrt(lasting / 3.0), 0.0)


def _one_value(values: Array) -> float | None:
    """Return the one value that readings (N,) have within a dead band; None without a dead band."""
    found, counts = np.unique(values, return_counts=True)
    within, beside = counts[1:-1], counts[:-2] + counts[2:]
    alone = np.flatnonzero((within >= _LEAST_WITHIN) & (within > _ALONE * beside))
    return float(found[1 + alone[np.argmax(within[alone])]]) if len(alone) else None


def _passed(t: Array, values: Array, side: Array) -> Array:
    """Return how far readings (N,) change in each passage through a dead band from one side to the other."""
    beyond = np.flatnonzero(side)
    beyond = beyond[(beyond >= _ASIDE) & (beyond < len(t) - _ASIDE)]
    first, last = beyond[:-1], beyond[1:]
    passing = (side[first] != side[last]) & (t[last] - t[first] < _PASSING_S)
    first, last = first[passing], last[passing]
    change = values[last + _ASIDE] - values[last] + values[first] - values[first - _ASIDE]
    slope = np.abs(change) / (t[last + _ASIDE] - t[last] + t[first] - t[first - _ASIDE])
    return np.asarray(slope * (t[last] - t[first]) * (last - first - 1) / (last - first))
