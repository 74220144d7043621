"""Triads, sensors of three axes with nominal = K raw + b, as several methods report them.

Rows of K are named NAME_k11 to NAME_k33 and b is NAME_b1 to NAME_b3. Of a K that is symmetric by
definition of the body's axes there are only the six on and above the diagonal.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gyro import symmetric
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
# Topics of the sensors, and the results that correct them.
CORRECTIONS = (
    Correction(topic=IMU, inputs={"gyro": "gyro", "accel": "accel"}, results={"gyro": "w_b", "accel": "f_b"}),
    Correction(topic=MAG, inputs={"field": "mag"}, results={"field": "m_b"}, frame_of=IMU),
)
# Of K's entries, for the derivatives of its parts.
_STEP = 1e-6


def triad_specs(
    name: str, unit: str, gain: tuple[float, float], bias: tuple[float, float], per_recording: bool = False
) -> tuple[ParameterSpec, ...]:
    """Declare the parameters of a triad: diagonal and off-diagonal entries of K, and offset b.

    Args:
        name: of the sensor.
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
        sensor: its name.
        quantities: K and b, and the strength.
        config: what is required.
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
        name: of the sensor.
        parameters: that there are.
        reading: the sensor's reading as an expression.
        inputs: of that expression.
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
