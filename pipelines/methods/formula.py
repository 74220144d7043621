"""How a result is applied: formulas as text for people and as code.

    Formula("rate of the helmet, rad/s in v", "w_iv", "gyro - gyro_bias", ("gyro",), lambda v: v.gyro - v.gyro_bias)

The text is written in the names of the parameters and of what is measured, with * for the product of rotations and for
a rotation applied to a vector, Exp the rotation of a rotation vector, and Rx(a) = transpose(Exp(a ex)), Ry and Rz
likewise.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.factors.gyro import symmetric
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array


@dataclass(frozen=True)
class Formula:
    """One quantity that follows from a calibration and, maybe, from measurements.

    Attributes:
        meaning: what it is, with unit and frame.
        name: what later formulas call it.
        expression: the formula's right-hand side.
        measured: what it needs beside parameters and formulas before it.
        compute: the same as code: from a namespace of parameters (numbers; three of them name_x, name_y, name_z also as
            the vector `name`), measurements and earlier results. Rotations are quaternions w, x, y, z.
    """

    meaning: str
    name: str
    expression: str
    measured: tuple[str, ...]
    compute: Callable[[Any], Array]

    @property
    def text(self) -> str:
        """As calibration.yaml has it."""
        return f"{self.meaning}: {self.name} = {self.expression}"


def passive(axis: int, angle: Any) -> Array:
    """Rx, Ry or Rz (axis 0, 1, 2) of angles in rad, (..., 4): transpose(Exp(angle e_axis))."""
    return so3.exp(-np.asarray(angle, dtype=float)[..., None] * np.eye(3)[axis])


def matrix_text(rows: Sequence[Sequence[str]], known: Collection[str]) -> str:
    """A matrix of parameters as formulas write it, those that are not among the known ones as 0."""
    return f"[{', '.join(vector_text(row, known) for row in rows)}]"


def vector_text(names: Sequence[str], known: Collection[str]) -> str:
    """A vector of parameters, likewise."""
    return f"[{', '.join(name if name in known else '0' for name in names)}]"


def symmetric_text(names: Sequence[str], known: Collection[str]) -> str:
    """I + S, S of the numbers xx yy zz xy xz yz."""
    xx, yy, zz, xy, xz, yz = (name if name in known else "0" for name in names)
    return f"[[1 + {xx}, {xy}, {xz}], [{xy}, 1 + {yy}, {yz}], [{xz}, {yz}, 1 + {zz}]]"


def numbers_of(space: Any, names: Sequence[str]) -> Array:
    """Values of parameters, 0 for those that are not there."""
    return np.array([getattr(space, name, 0.0) for name in names])


def gyro_rate(
    known: Collection[str], s: Sequence[str], g: Sequence[str], c: Sequence[str] = ()
) -> tuple[str, tuple[str, ...], Callable[[Any], Array]]:
    """The true rate w from what a gyro reads, (I + S) w + G f + c (temperature - first_temperature) + gyro_bias.

    Text, what it measures, and the same as code.

    Args:
        known: parameters that are applied.
        s, g, c: names of the numbers of S, xx yy zz xy xz yz, of those of G by rows, and of c.
    """
    scaled, feels, drifts = (any(name in known for name in names) for names in (s, g, c))

    def compute(v: Any) -> Array:
        rate = v.gyro - v.gyro_bias
        if feels:
            rate = rate - v.accel @ numbers_of(v, g).reshape(3, 3).T
        if drifts:
            rate = rate - over_temperature(v, c)
        return np.asarray(rate @ np.linalg.inv(np.eye(3) + symmetric(numbers_of(v, s))))

    force = f" - {matrix_text([g[:3], g[3:6], g[6:]], known)} * accel" if feels else ""
    text = f"gyro{force}{f' - {temperature_text(c, known)}' if drifts else ''} - gyro_bias"
    return (
        f"inverse({symmetric_text(s, known)}) * ({text})" if scaled else text,
        ("gyro", *(["accel"] if feels else []), *(["temperature"] if drifts else [])),
        compute,
    )


def temperature_text(names: Sequence[str], known: Collection[str]) -> str:
    """What a sensor reads too much at a temperature, by its slopes."""
    return f"{vector_text(names, known)} * (temperature - first_temperature)"


def over_temperature(v: Any, names: Sequence[str]) -> Array:
    """The same as code, (..., 3)."""
    return np.asarray((v.temperature - v.first_temperature)[..., None] * numbers_of(v, names))


def axis_angles(axes: Sequence[str], once_per_turn: Sequence[str], delay: str, known: Collection[str]) -> list[Formula]:
    """The axes' angles from what their encoders read; none where no error of theirs is applied.

    Args:
        axes: names of the readings; the results have `_angle` added.
        once_per_turn: sine and cosine of each axis' error, rad.
        delay: name of the time that readings are later than their stamps.
        known: parameters that are applied.
    """
    if not any(name in known for name in (*once_per_turn, delay)):
        return []
    late = f", {delay} s after the stamp of the reading" if delay in known else ""

    def angle(axis: str, names: Sequence[str]) -> Formula:
        def compute(v: Any) -> Array:
            (sine, cosine), read = numbers_of(v, names), np.asarray(getattr(v, axis))
            return np.asarray(read - sine * np.sin(read) - cosine * np.cos(read))

        waves = [
            f" - {name} * {wave}({axis})" for name, wave in zip(names, ("sin", "cos"), strict=True) if name in known
        ]
        return Formula(f"angle of the {axis} axis, rad{late}", f"{axis}_angle", axis + "".join(waves), (axis,), compute)

    return [angle(axis, once_per_turn[2 * i : 2 * i + 2]) for i, axis in enumerate(axes)]


def apply(formulas: Sequence[Formula], values: Mapping[str, float], measured: Mapping[str, Any]) -> dict[str, Array]:
    """Everything that follows from a calibration's values and what is measured.

    Args:
        formulas: of the method, in order.
        values: parameter -> value, SI.
        measured: name -> numbers, vectors (..., 3) or quaternions w, x, y, z (..., 4).

    Returns:
        Name -> result, for each formula whose measurements are given.

    Raises:
        InputError: something is given that no formula measures, or that only serves with what is not given.
    """
    known = dict.fromkeys(name for formula in formulas for name in formula.measured)
    for name in measured:
        if name not in known:
            raise InputError(f"apply: nothing is computed from {name}; measurements are {', '.join(known)}")
    for name in measured:
        beside = [set(formula.measured) for formula in formulas if name in formula.measured]
        if all(needed - measured.keys() for needed in beside):
            fewest = min((needed - measured.keys() for needed in beside), key=len)
            raise InputError(f"apply: {name} serves only together with {', '.join(sorted(fewest))}")
    space = SimpleNamespace(**values, **_vectors(values), **{k: np.asarray(v, float) for k, v in measured.items()})
    results: dict[str, Array] = {}
    for formula in formulas:
        if all(name in measured for name in formula.measured):
            results[formula.name] = formula.compute(space)
            setattr(space, formula.name, results[formula.name])
    return results


def _vectors(values: Mapping[str, float]) -> dict[str, Array]:
    stems = dict.fromkeys(name[:-2] for name in values if name.endswith(("_x", "_y", "_z")))
    return {
        stem: np.array([values[f"{stem}_{axis}"] for axis in "xyz"])
        for stem in stems
        if all(f"{stem}_{axis}" in values for axis in "xyz")
    }
