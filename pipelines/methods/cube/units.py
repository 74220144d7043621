"""Whether the sensors of a cube session are in the units that they have to be in, and what would convert them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.recording import RawConversion, nominal
from alidade.pipelines.recording.checks import too_fast
from alidade.pipelines.recording.plausibility import GRAVITY_REMOVED, SI, implausible

# SI of what sensors count in: units, and the full scales of 16 bits.
_G, _DEG = 9.80665, np.pi / 180.0
_USUAL = {
    "accel": {"g": _G, "mg": 1e-3 * _G, **{f"{2**k} counts a g": _G / 2**k for k in range(8, 15)}},
    "gyro": {
        "rad/s": 1.0,
        "deg/s": _DEG,
        "mdeg/s": 1e-3 * _DEG,
        **{f"{n:g} counts a deg/s": _DEG / n for n in (131.0, 65.5, 32.8, 16.4)},
        **{f"{m:g} mdeg/s a count": 1e-3 * _DEG * m for m in (8.75, 35.0, 70.0)},
    },
    "mag": {"gauss": 1e-4, "mG": 1e-7, "uT": 1e-6, "nT": 1e-9, "0.15 uT a count": 1.5e-7},
}
# How far a guess may be from one of these: gravity is known best; iron makes a field of the wrong size.
_NEAR = {"accel": 0.06, "gyro": 0.07, "mag": 0.35}
# The earth's field is within a third of this almost everywhere, T.
_FIELD = 4.8e-5
# Rates are compared with the rotation of gravity in means over this time, s, with the force this near to its median.
_MEAN, _STEADY = 0.1, 0.15
# Norms that scatter by less than this share are those of readings without an offset.
_ROUND = 0.12


@dataclass(frozen=True)
class Readings:
    """Readings of a sensor: topic, stamps (n,), s, values (n, 3) as recorded, and the config's conversion."""

    topic: str
    t: Array
    values: Array
    conversion: RawConversion | None


def check_units(accel: Readings, gyro: Readings, mag: Readings | None = None) -> None:
    """Raise InputError for sensors not in SI; the message names all, with conversions to paste."""
    sensors = {"accel": accel, "gyro": gyro} | ({} if mag is None else {"mag": mag})
    wrong = {name: said for name, readings in sensors.items() if (said := _wrong(name, readings))}
    if not wrong:
        return
    guesses = {
        "accel": lambda: _accel(accel.values),
        "gyro": lambda: _gyro(accel, gyro),
        "mag": lambda: None if mag is None else _mag(mag.values),
    }
    found = {name: guess for name in sensors if name in wrong and (guess := guesses[name]()) is not None}
    raise InputError(" ".join([*wrong.values(), _section(found)]))


def _wrong(name: str, readings: Readings) -> str:
    """Sentence about an implausible sensor; empty if plausible."""
    values = nominal(readings.values, readings.conversion)
    if name == "gyro":
        fast = too_fast(readings.topic, readings.t, values)
        return fast and f"{fast.partition('?')[0]}?"
    said = implausible(name, values)
    if GRAVITY_REMOVED in said:
        raise InputError(f"topic {readings.topic}: {said}")
    return said and f"topic {readings.topic}: {said}{'' if said.endswith('?') else '.'}"


def _section(found: dict[str, tuple[float, float]]) -> str:
    """Guessed conversions as one line of config, with explanation."""
    if not found:
        return "State the conversion to SI in the config under cube.raw"
    entries, words = [], []
    for name, (scale, offset) in found.items():
        usual = _usual(name, scale)
        shown = f"{_USUAL[name][usual] if usual else scale:.6g}" if usual else f"{scale:.3g}"
        number = shown if "." in shown else shown.replace("e", ".0e")
        entries.append(f"{name}: {{scale: {number}{f', offset: {offset:.1f}' if offset else ''}}}")
        words.append(f"{name} {usual or f'{1.0 / scale:.4g} counts a {SI[name]}'}")
    return (
        f"Paste the conversion into the config: cube: {{raw: {{{', '.join(entries)}}}}} ({'; '.join(words)}, estimated "
        "from these data). Check it against the data sheet; calibration corrects the rest"
    )


def _usual(name: str, scale: float) -> str:
    """Usual unit or full scale nearest to a guessed scale; empty if none is near."""
    away = {unit: abs(np.log(scale / si)) for unit, si in _USUAL[name].items()}
    best = min(away, key=lambda unit: away[unit])
    return best if away[best] < _NEAR[name] else ""


def _accel(values: Array) -> tuple[float, float] | None:
    """Scale of an accelerometer count, m/s^2, by gravity, and offset in counts."""
    radius, offset = _ball(values)
    return (_G / radius, offset) if radius > 0.0 else None


def _mag(values: Array) -> tuple[float, float] | None:
    """Scale of a magnetometer count by the usual field strength; offset 0, as the offset may be hard iron."""
    low, high = np.quantile(values, [0.005, 0.995], axis=0)
    radius = 0.5 * float(np.median(high - low))
    return (_FIELD / radius, 0.0) if radius > 0.0 else None


def _ball(values: Array) -> tuple[float, float]:
    """Radius and per-axis offset of readings of a vector of constant length in many directions."""
    norms = np.linalg.norm(values, axis=1)
    middle = float(np.median(norms))
    low, high = np.quantile(values, [0.02, 0.98], axis=0)
    if np.median(np.abs(norms - middle)) < _ROUND * middle and np.median(high - low) > 0.5 * middle:
        return middle, 0.0
    offset = float(np.median(0.5 * (low + high)))
    about = np.linalg.norm(values - 0.5 * (low + high), axis=1)
    radius = float(np.median(about))
    return (radius, offset) if abs(offset) > radius else (middle, 0.0)


def _gyro(accel: Readings, gyro: Readings) -> tuple[float, float] | None:
    """Scale of a gyro count by the rotation of gravity's direction a, rate -w x a; None without rotation."""
    radius, offset = _ball(accel.values)
    size = max(2, round(_MEAN / float(np.median(np.diff(gyro.t)))))
    whole = len(gyro.t) // size * size
    if whole < 5 * size or radius <= 0.0:
        return None
    means = [values[:whole].reshape(-1, size, 3).mean(axis=1) for values in (accel.values - offset, gyro.values)]
    time = gyro.t[:whole].reshape(-1, size).mean(axis=1)
    length = np.linalg.norm(means[0], axis=1)
    a = means[0] / length[:, None]
    rest = np.median(means[1], axis=0)
    expected = -np.cross(means[1] - rest, a)[1:-1]
    turned = (a[2:] - a[:-2]) / (time[2:] - time[:-2])[:, None]
    steady = np.abs(length / np.median(length) - 1.0) < _STEADY
    kept = steady[2:] & steady[1:-1] & steady[:-2]
    square = float((expected[kept] ** 2).sum())
    scale = float((expected[kept] * turned[kept]).sum()) / square if square > 0.0 else 0.0
    offset = float(np.median(rest))
    return (scale, offset if abs(offset) * scale > 1.0 else 0.0) if scale > 0.0 else None
