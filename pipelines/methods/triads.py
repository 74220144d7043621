"""Triads, sensors of three axes with nominal = K raw + b, as several methods report them.

Rows of K are named NAME_k11 to NAME_k33 and b is NAME_b1 to NAME_b3. Of a K that is symmetric by
definition of the body's axes there are only the six on and above the diagonal.

Their uses are the same whatever the method: the applied side of every error is the method's own formulas, the reading
of a sensor with true parameters is a function of the method, `Sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gyro import symmetric
from alidade.pipelines.diagnostics.use import Applied, Coefficients, Line, Truth, Use
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.estimation.parameters import SENSOR_NAMES, ParameterSpec
from alidade.pipelines.estimation.problem import CommonFactor, Quantity
from alidade.pipelines.methods import Correction
from alidade.pipelines.methods.formula import Formula
from alidade.pipelines.recording.topics import IMU, MAG
from alidade.pipelines.settings import Config

TRIADS = ("accel", "gyro", "mag")
# What may be required of a magnetometer in place of its numbers.
MAG_SHAPE = CommonFactor("mag", 0.0).shape
# Of S of a gyro, in the order that `symmetric` takes.
_ELEMENTS = ("x", "y", "z", "xy", "xz", "yz")
# Sensor -> name of the calibrated vector in formulas; its description and SI unit.
RESULTS = {"accel": "f_b", "gyro": "w_b", "mag": "m_b"}
_DESCRIPTIONS = {
    "accel": ("specific force along the {body} axes, {unit}", "m/s^2"),
    "gyro": ("rate along the {body} axes, {unit}", "rad/s"),
    "mag": ("field along the {body} axes, {unit}", "T"),
}
_IMU_INPUTS = {"gyro": "gyro", "accel": "accel"}
# Topics of the sensors, and the results that correct them.
CORRECTIONS = (
    Correction(topic=IMU, inputs=_IMU_INPUTS, results={"gyro": "w_b", "accel": "f_b"}),
    Correction(topic=MAG, inputs={"field": "mag"}, results={"field": "m_b"}, frame_of=IMU),
)
# Of K's entries, for the derivatives of its parts.
_STEP = 1e-6


def rotated_imu(body: str, rate: str, rotation: str) -> tuple[Correction]:
    """Correction of an IMU mounted on a body, by the formula of its rate and the rotation of its axes to the body."""
    force = Formula(f"specific force along the {body}'s axes, m/s^2", "force", f"{rotation} * accel", ("accel",))
    results = {"gyro": rate, "accel": "force"}
    return (Correction(topic=IMU, inputs=_IMU_INPUTS, results=results, formulas=(force,), frame=body),)


def triad_specs(
    name: str, unit: str, gain: tuple[float, float], bias: tuple[float, float], per_recording: bool = False
) -> tuple[ParameterSpec, ...]:
    """Declare the parameters of a triad: diagonal and off-diagonal entries of K, and offset b.

    Args:
        unit: of b.
        gain, bias: prior sigma and accuracy wanted, of entries of K and of b.
        per_recording: whether b belongs to a recording.
    """
    sensor = SENSOR_NAMES[name].capitalize()
    diagonal, others = (tuple(f"{i}{j}" for i in "123" for j in "123" if (i == j) is own) for own in (True, False))
    gains = ((diagonal, "gain, {first}"), (others, "cross-axis term ({last} into {first})"))
    K = (
        ParameterSpec(f"{name}_k{{}}", "1", gain[0], f"{sensor} {text}.", axes=axes, require=gain[1])
        for axes, text in gains
    )
    b = ParameterSpec(
        f"{name}_b{{}}", unit, bias[0], f"{sensor} offset, {{axis}} (after K).", axes="123", require=bias[1]
    )
    return (*K, replace(b, per_recording=per_recording))


def with_factor(sensor: str, quantities: Sequence[Quantity], config: Config, require: float) -> tuple[Quantity, ...]:
    """Attach to K, b and the strength the scale factor that they share, see `CommonFactor`.

    Where the config requires the shape, those that it does not name are judged by it.

    Args:
        quantities: K and b, and the strength.
        require: accuracy of K, which they are declared with.
    """
    shape = CommonFactor(sensor, require).shape
    factor = CommonFactor(sensor, config.require.get(shape, require))

    def of(q: Quantity) -> Quantity:
        relative = shape in config.require and q.name not in config.require
        tighter = factor.require / require if relative and q.name.startswith(f"{sensor}_k") else 1.0
        return replace(q, require=tighter * q.require, factor=factor, relative=relative)

    return tuple(map(of, quantities))


def triad_names(name: str, symmetric: bool = False) -> tuple[str, ...]:
    """Names of a triad's parameters: K by rows (upper half of a symmetric K), then b."""
    gains = tuple(f"{name}_k{i}{j}" for i in "123" for j in "123" if i <= j or not symmetric)
    return (*gains, *(f"{name}_b{i}" for i in "123"))


def gain_names(name: str, known: Collection[str]) -> list[list[str]]:
    """Parameter names of the entries of K, in a 3 x 3 list."""
    return [[own if (own := f"{name}_k{i}{j}") in known or i <= j else f"{name}_k{j}{i}" for j in "123"] for i in "123"]


def triad_of(name: str, values: Mapping[str, float]) -> tuple[Array, Array]:
    """Matrix K (3, 3) and offset b (3,) of a triad from parameters by name."""
    K = np.array([[values[entry] for entry in row] for row in gain_names(name, values)])
    return K, np.array([values[f"{name}_b{i}"] for i in "123"])


def sensor_model(name: str, values: Mapping[str, float]) -> tuple[Array, Array]:
    """Matrix K (3, 3) and bias (3,) of a sensor: nominal = K (raw - bias).

    From the rows of K and b of nominal = K raw + b, bias = -K^-1 b, or of a gyro from its bias, scale and skew, (I + S)
    rate + bias = raw; what is not among the values is 0. Raises KeyError when they have neither.
    """
    if f"{name}_k11" in values:
        K, b = triad_of(name, values)
        return K, np.asarray(-np.linalg.solve(K, b))
    bias = np.array([values[f"{name}_bias_{axis}"] for axis in "xyz"])
    s = [values.get(f"{name}_{'scale' if len(axes) == 1 else 'skew'}_{axes}", 0.0) for axes in _ELEMENTS]
    return np.asarray(np.linalg.inv(np.eye(3) + symmetric(np.array(s)))), bias


def triad_formula(
    name: str,
    parameters: Collection[str],
    reading: str,
    inputs: tuple[str, ...],
    body: str = "cube's",
    unit: str | None = None,
) -> Formula:
    """Formula that applies K and b to a sensor's reading.

    Args:
        reading: the sensor's reading as an expression.
        body: whose axes the result is along.
        unit: of the result, where it is not the SI one.
    """
    description, si = _DESCRIPTIONS[name]
    rows = ", ".join(f"[{', '.join(row)}]" for row in gain_names(name, parameters))
    bias = f"[{', '.join(f'{name}_b{i}' for i in '123')}]"
    return Formula(
        description.format(body=body, unit=unit or si), RESULTS[name], f"[{rows}] * {reading} + {bias}", inputs
    )


def parts_of(K: Array) -> Array:
    """Decompose K of nominal = K raw + b into scales, nonorthogonalities and mounting angles, (9,).

    The rows of K^-1 are the sensitive axes in the body, as long as their scales; the mounting is the rotation nearest
    to the unit axes. Raises ValueError when K is singular or its axes are left-handed.
    """
    if not np.linalg.det(K) > 0.0:
        raise ValueError("K is singular or left-handed")
    axes = np.linalg.inv(K)
    scale = np.linalg.norm(axes, axis=1)
    axes /= scale[:, None]
    across = (axes @ axes.T)[[0, 0, 1], [1, 2, 2]]
    mounting = so3.log(so3.align(axes, np.eye(3)))
    return np.concatenate([scale, np.arcsin(np.clip(across, -1.0, 1.0)), mounting])


def numeric_jacobian(function: Callable[[Array], Array], x: Array, step: Array) -> Array:
    """Jacobian (m, n) of a function (n,) -> (m,) by central differences of `step` (n,), 0 where the step is 0."""
    J = np.zeros((len(function(x)), len(x)))
    for j in np.flatnonzero(step):
        h = step[j] * np.eye(len(x))[j]
        J[:, j] = (function(x + h) - function(x - h)) / (2.0 * step[j])
    return J


def parts_with_sigmas(K: Array, covariance: Array) -> tuple[Array, Array] | None:
    """Parts of K as `parts_of` and their sigmas, from covariance (9, 9) of K by rows; None if K is invalid."""
    try:
        J = numeric_jacobian(lambda rows: parts_of(rows.reshape(3, 3)), K.ravel(), np.full(9, _STEP))
    except ValueError:
        return None
    return parts_of(K), np.sqrt(np.maximum(np.diag(J @ covariance @ J.T), 0.0))


def parts_row(name: str, parts: Array, sigmas: Array) -> dict[str, object]:
    """Findings row of a sensor's scales, nonorthogonalities and mounting with their sigmas."""
    row: dict[str, object] = {"sensor": name}
    for i, kind in enumerate(("scale", "nonorthogonality", "mounting")):
        part = slice(3 * i, 3 * i + 3)
        row |= {kind: parts[part].tolist(), f"{kind}_sigma": sigmas[part].tolist()}
    return row


G = 9.80665
# Readings (..., U, 3) by sensor of nominal vectors (U, 3) by sensor.
Sensors = Callable[[Truth, Mapping[str, Array]], dict[str, Array]]
_EZ = np.array([0.0, 0.0, 1.0])
# Dip that is assumed where nothing says it, rad.
_DIP = 1.0
_DEVIATION = "deviation = magnetic heading − compass heading = −e = A + B sin h + C cos h + D sin 2h + E cos 2h"


def raw_of(true: Truth, sensor: str, nominal: Array) -> Array:
    """Raw reading (..., U, 3) of a triad with nominal = K raw + b, for nominal vectors."""
    K = true.matrix(gain_names(sensor, true.index), 1.0)
    b = true.vector(*(f"{sensor}_b{i}" for i in "123"))
    return along(np.asarray(np.linalg.inv(K)), nominal - b[..., None, :])


def along(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices (..., 3, 3) by vectors (..., U, 3)."""
    return np.asarray(vectors @ np.swapaxes(matrices, -1, -2))


def gyro_reading(true: Truth, rate: Array, force: Array) -> Array:
    """Gyro reading (I + S) w + G f + bias, (..., U, 3); missing parameters are 0."""
    S = true.matrix(
        [[f"gyro_scale_{i}" if i == j else f"gyro_skew_{min(i, j)}{max(i, j)}" for j in "xyz"] for i in "xyz"]
    )
    sensitivity = true.matrix([[f"gyro_g_{i}{j}" for j in "xyz"] for i in "xyz"])
    return rate + along(S, rate) + along(sensitivity, force) + true.xyz("gyro_bias")[..., None, :]


def triad_uses(true: Truth, sensors: Sensors) -> list[Use]:
    """Return errors of heading, rate and specific force in use, as far as a device's sensors are calibrated."""
    found = [_heading(true, sensors)] if "mag_k11" in true else []
    found += [_rate(sensors)] if "gyro_k11" in true or "gyro_bias_x" in true else []
    return found + ([_force(sensors)] if "accel_k11" in true else [])


def _heading(true: Truth, sensors: Sensors) -> Use:
    psi = np.arange(0.0, 361.0, 5.0)
    tilted = "accel_k11" in true
    usual = float(true.get("field_dip", _DIP))

    def error(roll_deg: float) -> Callable[[Applied, Truth], Array]:
        nRb = so3.multiply(so3.exp(-np.deg2rad(psi)[:, None] * _EZ), so3.exp(np.deg2rad([roll_deg, 0.0, 0.0])))
        up = so3.rotate(so3.inverse(nRb), G * _EZ)
        ahead = so3.rotate(nRb, np.array([1.0, 0.0, 0.0]))
        truth = np.arctan2(-ahead[:, 1], ahead[:, 0])

        def compute(applied: Applied, true: Truth) -> Array:
            field = so3.rotate(so3.inverse(nRb), _field(true, usual)[..., None, :])
            found = applied(**sensors(true, {"mag": field, "accel": up}))
            m = found["m_b"]
            zenith = found["f_b"] / np.linalg.norm(found["f_b"], axis=-1, keepdims=True) if tilted else _EZ
            west = np.cross(zenith, m)
            north = np.cross(west, zenith)
            e = np.arctan2(-west[..., 0], north[..., 0]) - truth
            return np.asarray((e + np.pi) % (2.0 * np.pi) - np.pi)

        return compute

    lines = [Line("level", error(0.0))] + ([Line("rolled 30 deg", error(30.0), "series1")] if tilted else [])
    north, _, up = _field(true, usual)
    dip = np.degrees(np.arctan2(-up, north))
    return Use(
        "heading",
        "Heading from the magnetometer",
        psi,
        "heading, deg",
        "heading error, deg",
        "deg",
        float(np.degrees(1.0)),
        tuple(lines),
        "e = ψ(f, m) − ψ_true, ψ = atan2(−w_x, n_x), w = f/|f| × m, n = w × f/|f|; m = m_b, f = f_b of the formulas",
        f"dip {dip:.1f} deg, {'tilt from the accelerometer' if tilted else 'level'}",
        "heading, any direction",
        signed=True,
        coefficients=Coefficients(tuple("ABCDE"), deviation_coefficients, _DEVIATION),
    )


def _field(true: Truth, dip: float) -> Array:
    """Field (..., 3) to magnetic north, west and up, in the strength's unit; `dip`, rad, if not a parameter."""
    if "field_n" in true:
        north, up = np.hypot(true.get("field_e"), true.get("field_n")), true.get("field_u")
    else:
        strength, dips = true.get("field_strength", 1.0), true.get("field_dip", dip)
        north, up = strength * np.cos(dips), -strength * np.sin(dips)
    return np.stack([north, 0.0 * north, up], axis=-1)


def deviation_coefficients(e: Array) -> Array:
    """Deviation coefficients A to E (..., 5), rad, of heading errors (..., U), rad: first and second harmonic of -e.

    The first and the last error are of one heading. nan where the hard iron is stronger than the horizontal field,
    so that the compass does not turn once with the heading. Formula: Archibald Smith, in the Admiralty Manual for
    Ascertaining and Applying the Deviations of the Compass.
    """
    turned = np.unwrap(e, axis=-1)
    closed = np.abs(turned[..., -1] - turned[..., 0]) < np.pi
    h = np.linspace(0.0, 2.0 * np.pi, e.shape[-1])[:-1]
    waves = np.stack([0.5 * np.ones_like(h), np.sin(h), np.cos(h), np.sin(2.0 * h), np.cos(2.0 * h)], axis=1)
    return np.where(closed[..., None], -2.0 / len(h) * turned[..., :-1] @ waves, np.nan)


def _rate(sensors: Sensors) -> Use:
    rate = np.linspace(-200.0, 200.0, 41)
    force = np.tile(G * _EZ, (len(rate), 1))

    def error(axis: int) -> Callable[[Applied, Truth], Array]:
        w = np.deg2rad(rate)[:, None] * np.eye(3)[axis]
        return lambda applied, true: applied(**sensors(true, {"gyro": w, "accel": force}))["w_b"] - w

    return Use(
        "rate",
        "Rate from the gyro",
        rate,
        "rate, deg/s",
        "length of the rate error, deg/s",
        "deg/s",
        float(np.degrees(1.0)),
        tuple(Line(f"about {axis}", error(i), axis) for i, axis in enumerate(AXES)),
        "e = w_b(gyro, accel) − ω; f = 1 g along z",
        "turning about one body axis, z up, at the first temperature",
        "rate, at 100 deg/s",
        at=30,
    )


def _force(sensors: Sensors) -> Use:
    angle = np.arange(0.0, 361.0, 5.0)
    cosine, sine = (G * wave(np.deg2rad(angle)) for wave in (np.cos, np.sin))

    def error(axis: int) -> Callable[[Applied, Truth], Array]:
        f = np.zeros((len(angle), 3))
        f[:, (axis + 1) % 3], f[:, (axis + 2) % 3] = cosine, sine
        return lambda applied, true: applied(**sensors(true, {"accel": f}))["f_b"] - f

    return Use(
        "force",
        "Specific force from the accelerometer",
        angle,
        "direction of gravity in the plane, deg",
        "length of the error, mg",
        "mg",
        1e3 / G,
        tuple(
            Line(f"{plane} plane", error(i), axis) for i, (axis, plane) in enumerate(zip(AXES, _PLANES, strict=True))
        ),
        "e = f_b(accel) − f, |f| = 1 g",
        "at rest, gravity turned through the planes of the body, each in the colour of its normal",
        "specific force, at 1 g",
    )


_PLANES = ("yz", "zx", "xy")
