"""Formulas as Python and C compute what the methods' own code computes."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.methods import method
from alidade.pipelines.methods.formula import Formula, apply
from alidade.pipelines.reports.snippets import c_code, python_code
from alidade.pipelines.settings import Config
from tests.support.formulas import CASES

COMPILER = shutil.which("cc")


def case(name: str) -> tuple[list[Formula], dict[str, float], dict[str, Array]]:
    """Formulas of a method with all it may calibrate, values of the parameters, and something measured."""
    rng = np.random.default_rng(3)
    chosen, names = CASES[name]
    values = {each: float(value) for each, value in zip(names, rng.normal(0.0, 0.05, len(names)), strict=True)}
    values |= {each: 1.0 + values[each] for each in names if each.endswith(("k11", "k22", "k33"))}
    formulas = list(method(chosen).report.formulas(names, Config()))
    measured = {each: measurement(each, rng) for formula in formulas for each in formula.inputs}
    return formulas, values, measured


def measurement(name: str, rng: np.random.Generator) -> Array:
    if "R" in name or "rotation" in name:
        return np.asarray(so3.exp(rng.normal(0.0, 1.0, 3)))
    if name in ("gyro", "accel", "mag", "platform_gyro", "d_b"):
        return np.asarray(rng.normal(0.0, 1.0, 3))
    return np.asarray(rng.normal())


def as_matrices(results: Mapping[str, Array]) -> dict[str, Array]:
    return {name: so3.matrix(value) if value.shape == (4,) else value for name, value in results.items()}


@pytest.mark.parametrize("name", CASES)
def test_python_code_computes_what_apply_does(name: str) -> None:
    formulas, values, measured = case(name)
    space: dict[str, Any] = {}
    exec(python_code(formulas, values), space)
    given = as_matrices(measured)
    for formula in formulas:
        made = space[formula.name]
        found = made(*(given[each] for each in formula.inputs)) if callable(made) else made
        expected = as_matrices(apply(formulas, values, measured))[formula.name]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8, err_msg=formula.text)


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
@pytest.mark.parametrize("name", CASES)
def test_c_code_computes_what_apply_does(name: str, tmp_path: Path) -> None:
    formulas, values, measured = case(name)
    given, expected = as_matrices(measured), as_matrices(apply(formulas, values, measured))
    lines = [c_code(formulas, values), "#include <stdio.h>", "int main(void) {"]
    for each, value in given.items():
        kind, text = ("double", "vec", "mat")[value.ndim], str(value.tolist()).replace("[", "{").replace("]", "}")
        lines.append(f"{kind} {each} = {text if value.ndim == 0 else '{' + text + '}'};")
    for formula in formulas:
        call = f"{formula.name}({', '.join(formula.inputs)})" if formula.inputs else formula.name
        kind, size = ("double", "vec", "mat")[expected[formula.name].ndim], expected[formula.name].size
        lines += [f"{{ {kind} r = {call}; const double *p = (const double *)&r;"]
        lines += [f'for (int i = 0; i < {size}; i++) printf("%.12g ", p[i]);', 'printf("\\n"); }']
    (tmp_path / "a.c").write_text("\n".join([*lines, "return 0; }"]))
    quiet = ("-Wall", "-Wextra", "-Werror", "-Wno-unused", "-std=c99", "-lm")
    subprocess.run([str(COMPILER), "a.c", "-o", "a", *quiet], cwd=tmp_path, check=True)
    out = subprocess.run(["./a"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.splitlines()
    for line, formula in zip(out, formulas, strict=True):
        found = np.array(line.split(), dtype=float)
        np.testing.assert_allclose(found, expected[formula.name].ravel(), rtol=1e-7, atol=1e-8, err_msg=formula.text)
