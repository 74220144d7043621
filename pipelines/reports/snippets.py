"""Formulas with a calibration's numbers in them, as Python and as C, to be copied.

What depends on no input is computed by `alidade.pipelines.methods.formula`, so that the code holds numbers.
Rotations are matrices, 3x3, in the code.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.methods.formula import (
    AXES,
    Formula,
    Kind,
    Value,
    input_kind,
    operate,
    result_kind,
    walk,
    with_vectors,
)

_RANKS: tuple[Kind, ...] = ("scalar", "vector", "matrix")


@dataclass(frozen=True)
class _Node:
    """Part of an expression: a constant with its value, an operation of `operate` on other parts, or a leaf.

    A leaf is an input or an earlier formula: `op` is its name or its call, as Python and C write them.
    """

    kind: Kind
    value: Value | None = None
    op: str = ""
    parts: tuple[_Node, ...] = ()

    @property
    def array(self) -> Array | None:
        """Return the constant as an array, a rotation as a matrix; None for an operation."""
        if self.value is None:
            return None
        return so3.matrix(self.value.array) if self.value.kind == "rotation" else self.value.array


def _read(formulas: Sequence[Formula], values: Mapping[str, float]) -> Iterator[tuple[Formula, _Node]]:
    """Yield each formula with its expression; a later one calls an earlier one, or has its value."""
    known, earlier = with_vectors(values) | AXES, dict[str, _Node]()

    def of_name(inputs: Sequence[str], name: str) -> _Node:
        if name in earlier:
            return earlier[name]
        if name in inputs:
            return _Node(_kind_in_code(input_kind(name)), None, name)
        return _constant(Value.constant(known.get(name, np.array(0.0))))

    for formula in formulas:
        node = walk(formula.tree, partial(of_name, formula.inputs), _constant, _operation)
        call = f"{formula.name}({', '.join(formula.inputs)})"
        earlier[formula.name] = node if node.value is not None else _Node(node.kind, None, call)
        yield formula, node


def _kind_in_code(kind: Kind) -> Kind:
    """Return the kind that a value has in generated code, where rotations are matrices."""
    return "matrix" if kind == "rotation" else kind


def _constant(value: Value) -> _Node:
    return _Node(_kind_in_code(value.kind), value)


def _operation(op: str, *parts: _Node) -> _Node:
    """Make an operation: computed if its parts are constants, simplified if one of them is 0."""
    kind = _kind_in_code(result_kind(op, [part.kind for part in parts]))
    if op in ("add", "sub", "mul"):
        a, b = parts
        zero_a, zero_b = (part.value is not None and not part.value.array.any() for part in parts)
        if op == "mul" and (zero_a or zero_b):
            return _constant(Value(kind, np.zeros((3,) * _RANKS.index(kind))))
        if zero_b and _RANKS.index(b.kind) <= _RANKS.index(a.kind):
            return a
        if op == "add" and zero_a and _RANKS.index(a.kind) <= _RANKS.index(b.kind):
            return b
    values = [part.value for part in parts if part.value is not None]
    if len(values) == len(parts):
        return _constant(operate(op, *values))
    return _Node(kind, None, op, parts)


def python_code(formulas: Sequence[Formula], values: Mapping[str, float]) -> str:
    """A module with a function, or a constant, for each formula; it needs numpy alone. SI."""
    lines = []
    for formula, node in _read(formulas, values):
        text = ast.unparse(ast.parse(_code(node, _PYTHON, _python_numbers), mode="eval"))
        lines += ["", "", f"# {formula.description}"]
        if node.value is not None:
            lines.append(f"{formula.name} = {text}")
        else:
            lines += [f"def {formula.name}({', '.join(formula.inputs)}):", f"    return {text}"]
    body = "\n".join(lines)
    helpers = [text for name, text in _PYTHON_HELPERS.items() if re.search(rf"\b{name}\(", body)]
    return "\n".join(["import numpy as np", *helpers]) + body + "\n"


_PYTHON_TURN = """

def {name}(a):
    c, s = np.cos(a), np.sin(a)
    return np.array({rows})"""
_PYTHON_HELPERS = {
    "Rx": _PYTHON_TURN.format(name="Rx", rows="[[1, 0, 0], [0, c, s], [0, -s, c]]"),
    "Ry": _PYTHON_TURN.format(name="Ry", rows="[[c, 0, -s], [0, 1, 0], [s, 0, c]]"),
    "Rz": _PYTHON_TURN.format(name="Rz", rows="[[c, s, 0], [-s, c, 0], [0, 0, 1]]"),
}


# Operation, and for some the kinds of its parts -> code, for Python with more brackets than it needs.
_PYTHON = {
    "add": "({}) + ({})",
    "sub": "({}) - ({})",
    "mul": "({}) * ({})",
    ("mul", "matrix", "vector"): "({}) @ ({})",
    ("mul", "matrix", "matrix"): "({}) @ ({})",
    "div": "({}) / ({})",
    "pow": "({}) ** ({})",
    "minus": "-({})",
    "inverse": "({}).T",
    "sin": "np.sin({})",
    "cos": "np.cos({})",
}


def _python_numbers(value: Array) -> str:
    text = repr(np.vectorize(_digits, otypes=[float])(value).tolist())
    return text if value.ndim == 0 else f"np.array({text})"


def _code(node: _Node, operations: Mapping[Any, str], numbers: Callable[[Array], str]) -> str:
    """Return a node as code; an operation that is not in the table is a call of a function of its name."""
    if node.array is not None:
        return numbers(node.array)
    if turned := _axis_turn(node):
        return f"{turned[0]}({_code(turned[1], operations, numbers)})"
    if not node.parts:
        return node.op
    parts = [_code(part, operations, numbers) for part in node.parts]
    kinds = (part.kind for part in node.parts)
    form = operations.get((node.op, *kinds)) or operations.get(node.op) or f"{node.op}({{}})"
    return form.format(*parts)


def _axis_turn(node: _Node) -> tuple[str, _Node] | None:
    """Return Exp(angle ez) as Rz and -angle, likewise about x and y; None for any other node."""
    if node.op == "Exp" and node.parts[0].op == "mul":
        angle, axis = node.parts[0].parts
        for name, unit in AXES.items():
            if axis.array is not None and np.array_equal(axis.array, unit):
                return f"R{name[1]}", _operation("minus", angle)
    return None


# -- C


def c_code(formulas: Sequence[Formula], values: Mapping[str, float]) -> str:
    """A header of C99 with a function, or a constant, for each formula; it needs math.h alone. SI."""
    lines = []
    for formula, node in _read(formulas, values):
        kind = _C_TYPES[node.kind]
        lines += ["", f"/* {formula.description} */"]
        if node.array is not None:
            lines.append(f"static const {kind} {formula.name} = {_c_numbers(node.array)};")
        else:
            needed = ", ".join(f"{_C_TYPES[_kind_in_code(input_kind(name))]} {name}" for name in formula.inputs)
            lines.append(f"static {kind} {formula.name}({needed}) {{ return {_code(node, _C, _c_part)}; }}")
    body = "\n".join(lines)
    needed_helpers: list[str] = []
    for name, text in reversed(_C_HELPERS.items()):
        if any(re.search(rf"\b{name}\(", each) for each in (body, *needed_helpers)):
            needed_helpers.insert(0, text)
    return "\n".join([_C_HEAD, *needed_helpers, body, ""])


_C_TYPES = {"scalar": "double", "vector": "vec", "matrix": "mat"}
_C_HEAD = """#include <math.h>

typedef struct { double v[3]; } vec;
typedef struct { double m[3][3]; } mat;
"""
_EACH = "for (int i = 0; i < 3; i++)"


def _by_element(name: str, expression: str, second: str = "vec b") -> str:
    return f"static vec {name}(vec a, {second}) {{ vec r; {_EACH} r.v[i] = {expression}; return r; }}"


def _c_turn(name: str, rows: str) -> str:
    return f"static mat {name}(double a) {{ double c = cos(a), s = sin(a); mat r = {{{rows}}}; return r; }}"


# Those that use others come after them.
_C_HELPERS = {
    "add": _by_element("add", "a.v[i] + b.v[i]"),
    "sub": _by_element("sub", "a.v[i] - b.v[i]"),
    "each": _by_element("each", "a.v[i] * b.v[i]"),
    "power": _by_element("power", "pow(a.v[i], n)", "double n"),
    "scaled": _by_element("scaled", "a.v[i] * f", "double f"),
    "shifted": _by_element("shifted", "a.v[i] + f", "double f"),
    "turned": "static vec turned(mat a, vec b) { vec r = {{0, 0, 0}}; " + _EACH + " for (int j = 0; j < 3; j++) "
    "r.v[i] += a.m[i][j] * b.v[j]; return r; }",
    "product": "static mat product(mat a, mat b) { mat r = {{{0}}}; " + _EACH + " for (int j = 0; j < 3; j++) "
    "for (int k = 0; k < 3; k++) r.m[i][j] += a.m[i][k] * b.m[k][j]; return r; }",
    "transposed": "static mat transposed(mat a) { mat r; " + _EACH + " for (int j = 0; j < 3; j++) "
    "r.m[i][j] = a.m[j][i]; return r; }",
    "Rx": _c_turn("Rx", "{{1, 0, 0}, {0, c, s}, {0, -s, c}}"),
    "Ry": _c_turn("Ry", "{{c, 0, -s}, {0, 1, 0}, {s, 0, c}}"),
    "Rz": _c_turn("Rz", "{{c, s, 0}, {-s, c, 0}, {0, 0, 1}}"),
}


_C = {
    ("mul", "matrix", "matrix"): "product({}, {})",
    ("mul", "matrix", "vector"): "turned({}, {})",
    ("mul", "vector", "vector"): "each({}, {})",
    ("mul", "scalar", "vector"): "scaled({1}, {0})",
    ("mul", "vector", "scalar"): "scaled({}, {})",
    ("mul", "scalar", "scalar"): "({} * {})",
    ("add", "vector", "vector"): "add({}, {})",
    ("add", "vector", "scalar"): "shifted({}, ({}))",
    ("add", "scalar", "scalar"): "({} + {})",
    ("sub", "vector", "vector"): "sub({}, {})",
    ("sub", "vector", "scalar"): "shifted({}, -({}))",
    ("sub", "scalar", "scalar"): "({} - {})",
    ("div", "vector", "scalar"): "scaled({}, 1.0 / ({}))",
    ("div", "scalar", "scalar"): "({} / {})",
    ("pow", "vector", "scalar"): "power({}, {})",
    ("pow", "scalar", "scalar"): "pow({}, {})",
    ("minus", "scalar"): "-({})",
    "inverse": "transposed({})",
}


def _c_numbers(value: Array) -> str:
    """Return numbers as C initialises a variable with them: a struct around its array."""
    text = _c_list(value.tolist())
    return text if value.ndim == 0 else f"{{{text}}}"


def _c_part(value: Array) -> str:
    return f"({('', 'vec', 'mat')[value.ndim]}){_c_numbers(value)}" if value.ndim else _c_numbers(value)


def _c_list(value: Any) -> str:
    return f"{{{', '.join(map(_c_list, value))}}}" if isinstance(value, list) else repr(_digits(value))


def _digits(value: float) -> float:
    return float(f"{value:.10g}") + 0.0
