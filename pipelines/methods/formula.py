"""Formulas that apply a result: text, and evaluation.

    Formula("rate of the helmet, rad/s in v", "w_iv", "gyro - gyro_bias", ("gyro",))

An expression is written in the names of parameters, inputs and earlier formulas, as Python writes it: + - * / **, sin,
cos, lists as vectors and matrices. * composes rotations, applies a rotation or a matrix to a vector, and multiplies
vectors element by element. Exp is the rotation of a rotation vector, Exp(angle ez) that about an axis; Rx(a) =
transpose(Exp(a ex)), Ry and Rz likewise; inverse is that of a rotation or a matrix. Three parameters name_x, name_y,
name_z are also the vector `name`. A parameter that has no value is 0.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import DEAD_BAND, g_sensitivity, gyro_scale
from alidade.pipelines.estimation.problem import Parameter
from alidade.pipelines.methods.temperature import FIRST, GYRO_SLOPE
from alidade.pipelines.recording.plausibility import dead_band
from alidade.pipelines.recording.streams import Temperature

# A vector has shape (..., 3), a rotation is a quaternion w, x, y, z (..., 4), a matrix is constant, (3, 3).
Kind = Literal["scalar", "vector", "matrix", "rotation"]
_CONSTANTS: tuple[Kind, ...] = ("scalar", "vector", "matrix")
# Inputs: a name with an R between two frames is a rotation.
_ROTATION, _VECTOR = (
    re.compile(r"\w*[a-zA-Z]R[a-zA-Z]\w*|\w*rotation\w*"),
    re.compile(r"(\w+_)?(gyro|accel|mag)(_\w+)?|d_b"),
)
# Samples of a gyro that are corrected at a time.
_BLOCK = 100_000
# `Exp(angle ez)`: a number before the name of an axis.
_AXIS = re.compile(r"(\w+) (e[xyz])\b")
# Of a gyro's S, xx yy zz xy xz yz, and of its G by rows.
_SCALE = tuple(name for each in gyro_scale("gyro", "gyro", 0.0) for name in each.names)
_SENSITIVITY = g_sensitivity(0.0).names
AXES = {"ex": np.eye(3)[0], "ey": np.eye(3)[1], "ez": np.eye(3)[2]}


@dataclass(frozen=True)
class Formula:
    """Formula of one quantity, from a calibration and optionally from measurements.

    Attributes:
        description: what it is, with unit and frame.
        name: what later formulas call it.
        expression: the right-hand side, see the module.
        inputs: names of the measurements that it needs, through earlier formulas too.
    """

    description: str
    name: str
    expression: str
    inputs: tuple[str, ...]

    @property
    def text(self) -> str:
        """The formula as one line of calibration.yaml."""
        return f"{self.description}: {self.name} = {self.expression}"

    @property
    def tree(self) -> ast.expr:
        """The parsed expression of the formula."""
        return ast.parse(_AXIS.sub(r"\1*\2", self.expression), mode="eval").body


@dataclass(frozen=True, eq=False)
class Value:
    """Value or values of an expression, with their kind."""

    kind: Kind
    array: Array

    @classmethod
    def constant(cls, array: Array) -> Value:
        """Wrap a number, a vector (3,) or a matrix (3, 3) as a constant value."""
        return cls(_CONSTANTS[array.ndim], array)


class _HasArray(Protocol):
    @property
    def array(self) -> Array | None: ...


Part = TypeVar("Part", bound=_HasArray)


def input_kind(name: str) -> Kind:
    """Kind of a formula's input by its name: rotation, vector or scalar."""
    return "rotation" if _ROTATION.fullmatch(name) else "vector" if _VECTOR.fullmatch(name) else "scalar"


def with_vectors(values: Mapping[str, float]) -> dict[str, Array]:
    """Parameters by name; three named stem_x, stem_y, stem_z are also the vector `stem`."""
    known = {name: np.array(value, dtype=float) for name, value in values.items()}
    for stem in {name[:-2] for name in values if name.endswith("_x")}:
        if all(f"{stem}_{axis}" in values for axis in "xyz"):
            known[stem] = np.array([values[f"{stem}_{axis}"] for axis in "xyz"], dtype=float)
    return known


def apply(formulas: Sequence[Formula], values: Mapping[str, float], measured: Mapping[str, Any]) -> dict[str, Array]:
    """Evaluate all formulas that the given measurements suffice for, with a calibration's values.

    Args:
        formulas: of the method, in order.
        values: parameter -> value, SI.
        measured: input -> numbers, vectors (..., 3) or quaternions w, x, y, z (..., 4).

    Returns:
        Name -> result, for each formula whose inputs are given.

    Raises:
        InputError: an input of no formula or of another shape, or one that is useless without others not given.
    """
    known = dict.fromkeys(name for formula in formulas for name in formula.inputs)
    for name in measured:
        if name not in known:
            raise InputError(f"apply: nothing is computed from {name}; measurements are {', '.join(known)}")
    for name, given in measured.items():
        length = {"vector": 3, "rotation": 4}.get(input_kind(name))
        if length and np.shape(given)[-1:] != (length,):
            raise InputError(f"apply: {name} has the shape {np.shape(given)}; (..., {length}) is needed")
        beside = [set(formula.inputs) for formula in formulas if name in formula.inputs]
        if all(needed - measured.keys() for needed in beside):
            fewest = min((needed - measured.keys() for needed in beside), key=len)
            raise InputError(f"apply: {name} serves only together with {', '.join(sorted(fewest))}")
    return {name: value.array for name, value in results(formulas, values, measured).items()}


def results(formulas: Sequence[Formula], values: Mapping[str, float], measured: Mapping[str, Any]) -> dict[str, Value]:
    """Evaluate formulas as `apply` does and return the results with their kinds; unused measurements are ignored."""
    space = {name: Value.constant(array) for name, array in (with_vectors(values) | AXES).items()}
    space |= {name: Value(input_kind(name), np.asarray(given, dtype=float)) for name, given in measured.items()}
    found: dict[str, Value] = {}

    def of_name(name: str) -> Value:
        return space.get(name) or Value.constant(np.array(0.0))

    for formula in formulas:
        if all(name in measured for name in formula.inputs):
            space[formula.name] = found[formula.name] = walk(formula.tree, of_name, lambda x: x, operate)
    return found


def walk(
    tree: ast.expr, of_name: Callable[[str], Part], of_value: Callable[[Value], Part], operation: Callable[..., Part]
) -> Part:
    """Build what an expression stands for from its leaves. Raises ValueError for unsupported syntax.

    Args:
        of_name, of_value: leaves: a name, a number or a matrix.
        operation: of a name that `operate` knows, and of its parts.
    """
    part = partial(walk, of_name=of_name, of_value=of_value, operation=operation)
    match tree:
        case ast.Constant(value=int() | float() as number):
            return of_value(Value.constant(np.array(float(number))))
        case ast.Name(id=name):
            return of_name(name)
        case ast.List(elts=elements):
            rows: list[Array | None] = [part(element).array for element in elements]
            if any(row is None for row in rows):
                raise ValueError("a matrix with something measured in it")
            return of_value(Value.constant(np.array(rows)))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return operation("minus", part(operand))
        case ast.BinOp(left=left, op=op, right=right):
            return operation(OPERATORS[type(op)], part(left), part(right))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return operation(name, part(argument))
    raise ValueError(f"not an expression of a formula: {ast.unparse(tree)}")


OPERATORS: Mapping[type[ast.operator], str] = {
    ast.Add: "add",
    ast.Sub: "sub",
    ast.Mult: "mul",
    ast.Div: "div",
    ast.Pow: "pow",
}


def operate(op: str, *parts: Value) -> Value:
    """Evaluate an operation of OPERATORS, "minus", or a function that expressions may call."""
    kind, arrays = result_kind(op, [part.kind for part in parts]), [part.array for part in parts]
    if op == "inverse" and kind == "rotation":
        return Value(kind, so3.inverse(*arrays))
    if op == "mul" and parts[0].kind == "matrix":
        return Value(kind, np.asarray(arrays[1] @ arrays[0].T))
    if op == "mul" and parts[0].kind == "rotation":
        return Value(kind, (so3.rotate if parts[1].kind == "vector" else so3.multiply)(*arrays))
    if len(parts) == 2 and kind == "vector":
        arrays = [part.array[..., None] if part.kind == "scalar" else part.array for part in parts]
    return Value(kind, np.asarray(_COMPUTED[op](*arrays)))


def result_kind(op: str, kinds: Sequence[Kind]) -> Kind:
    """Kind of an operation's result."""
    if op in ("Exp", "Rx", "Ry", "Rz"):
        return "rotation"
    if op == "mul" and kinds[0] in ("matrix", "rotation"):
        return kinds[1]
    return "vector" if "vector" in kinds else kinds[0]


def passive(axis: int, angle: Any) -> Array:
    """Passive rotations Rx, Ry or Rz (axis 0, 1, 2) by angles in rad, (..., 4): transpose(Exp(angle e_axis))."""
    return so3.exp(-np.asarray(angle, dtype=float)[..., None] * np.eye(3)[axis])


_COMPUTED: Mapping[str, Callable[..., Array]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": np.power,
    "minus": np.negative,
    "sin": np.sin,
    "cos": np.cos,
    "inverse": np.linalg.inv,
    "Exp": so3.exp,
    "Rx": partial(passive, 0),
    "Ry": partial(passive, 1),
    "Rz": partial(passive, 2),
}


def matrix_text(rows: Sequence[Sequence[str]], known: Collection[str]) -> str:
    """Expression of a matrix of parameters, with 0 for unknown names."""
    return f"[{', '.join(vector_text(row, known) for row in rows)}]"


def vector_text(names: Sequence[str], known: Collection[str]) -> str:
    """Expression of a vector of parameters, with 0 for unknown names."""
    return f"[{', '.join(name if name in known else '0' for name in names)}]"


def symmetric_text(names: Sequence[str], known: Collection[str]) -> str:
    """Expression of I + S, with S of the numbers xx yy zz xy xz yz, and 0 for unknown names."""
    xx, yy, zz, xy, xz, yz = (name if name in known else "0" for name in names)
    return f"[[1 + {xx}, {xy}, {xz}], [{xy}, 1 + {yy}, {yz}], [{xz}, {yz}, 1 + {zz}]]"


def temperature_text(names: Sequence[str], known: Collection[str]) -> str:
    """Expression of a bias drift with temperature, by its slopes."""
    return f"{vector_text(names, known)} * (temperature - first_temperature)"


def gyro_rate(known: Collection[str], force: str = "accel") -> tuple[str, tuple[str, ...]]:
    """Expression of the rate w, from a gyro reading (I + S) w + G f + c (temperature - first_temperature) + gyro_bias.

    Args:
        known: parameters that are applied.
        force: name of f: the accelerometer's reading, or an earlier formula's result from it.

    Returns:
        Expression and inputs.
    """
    scaled, feels, drifts = (any(name in known for name in names) for names in (_SCALE, _SENSITIVITY, GYRO_SLOPE.names))
    rows = [_SENSITIVITY[i : i + 3] for i in (0, 3, 6)]
    felt = f" - {matrix_text(rows, known)} * {force}" if feels else ""
    text = f"gyro{felt}{f' - {temperature_text(GYRO_SLOPE.names, known)}' if drifts else ''} - gyro_bias"
    return (
        f"inverse({symmetric_text(_SCALE, known)}) * ({text})" if scaled else text,
        ("gyro", *(["accel"] if feels else []), *(["temperature"] if drifts else [])),
    )


def corrected_rates(
    t: Array, gyro: Array, force: Array | None, temperature: Temperature | None, values: Mapping[str, float]
) -> Array:
    """Rates (N, 3), rad/s, of a gyro's samples, corrected by `gyro_rate`; errors with unmeasured causes remain.

    Args:
        t: (N,) s.
        gyro: (N, 3) as recorded, rad/s, the dead band included.
        force: (N, 3) m/s^2 by the accelerometer beside it; None: not measured.
        temperature: of the gyro; None: not measured.
        values: parameters by name; those not there are zero.
    """
    warm = None if temperature is None else temperature.above(0.0, t)
    known = {**({} if temperature is None else {FIRST: temperature.first}), **values}
    for causes, cause in ((_SENSITIVITY, force), (GYRO_SLOPE.names, warm)):
        if cause is None:
            known = {name: value for name, value in known.items() if name not in causes}
    if DEAD_BAND.name in values:
        gyro = gyro + values[DEAD_BAND.name] * dead_band(t, gyro)[1]
    inputs = {"gyro": gyro, "accel": force, "temperature": warm}
    formula, out = Formula("rate, rad/s", "w", *gyro_rate(known)), np.empty_like(gyro)
    for begin in range(0, len(out), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        measured = {name: given[some] for name in formula.inputs if (given := inputs[name]) is not None}
        out[some] = apply([formula], known, measured)["w"]
    return out


def axis_angles(axes: Sequence[str], once_per_turn: Sequence[str], delay: str, known: Collection[str]) -> list[Formula]:
    """Formulas of axis angles from encoder readings; none if no encoder error is applied.

    Args:
        axes: names of the readings; the results have `_angle` added.
        once_per_turn: sine and cosine of each axis' error, rad.
        delay: name of the time that readings are later than their stamps.
        known: parameters that are applied.
    """
    if not any(name in known for name in (*once_per_turn, delay)):
        return []
    late = f", {delay} s after the stamp of the reading" if delay in known else ""
    waves = list(zip(once_per_turn[::2], once_per_turn[1::2], strict=True))
    return [
        Formula(
            f"angle of the {axis} axis, rad{late}",
            f"{axis}_angle",
            axis
            + "".join(f" - {n} * {wave}({axis})" for n, wave in zip(names, ("sin", "cos"), strict=True) if n in known),
            (axis,),
        )
        for axis, names in zip(axes, waves, strict=True)
    ]


def picture_time(known: Collection[str]) -> str:
    """Expression of a picture's time on the gyro's clock, from its stamp, time_offset and clock_skew."""
    offset, skew = "time_offset" in known, "clock_skew" in known
    return f"stamp{' + time_offset' * offset}{' - clock_skew * (stamp - first_stamp)' * skew}"


def clock_constants(clock: Parameter | None, first_stamp: float) -> dict[str, float]:
    """First stamp, s, as a constant of the formulas if the clock's skew is a parameter."""
    skewed = clock is not None and any(q.name == "clock_skew" for q in clock.quantities)
    return {"first_stamp": first_stamp} if skewed else {}
