"""How a tumble result is applied. Frame b: the axes in which the first of these is symmetric that there is: the gyro's
errors, the K of the accelerometer, the magnetometer's."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from alidade.pipelines.methods.formula import (
    Formula,
    gyro_rate,
    temperature_text,
    vector_text,
)
from alidade.pipelines.methods.triads import triad_formula
from alidade.pipelines.methods.tumble.recording import ACCEL_SLOPE, ACCEL_SQUARE, GYRO_SLOPE
from alidade.pipelines.methods.tumble.turning import BIAS, SCALE, SENSITIVITY
from alidade.pipelines.settings import Config


def formulas(parameters: Collection[str], _config: Config | None = None) -> list[Formula]:
    """Of the sensors that there are; raw numbers are as recorded, and results in the unit of the strength."""
    found = []
    if "accel_k11" in parameters:
        formula = triad_formula("accel", parameters, "accel", ("accel",), "body's")
        if any(name in parameters for name in ACCEL_SQUARE.names):
            found.append(replace(formula, description=f"{formula.description}, its square term in it", name="f_read"))
            formula = _less_square(formula, parameters)
        found.append(_less_drift(formula, parameters))
    if "mag_k11" in parameters:
        unit = "the unit of field_strength"
        found.append(triad_formula("mag", parameters, "mag", ("mag",), "body's", unit))
    if BIAS[0] in parameters:
        names = tuple(name for each in SCALE for name in each.names)
        found.append(
            Formula(
                "rate, rad/s along the body's axes",
                "w_b",
                *gyro_rate(parameters, names, SENSITIVITY.names, GYRO_SLOPE.names),
            )
        )
    return found


def _less_square(formula: Formula, parameters: Collection[str]) -> Formula:
    """The accelerometer's reading without its square term."""
    square = vector_text(ACCEL_SQUARE.names, parameters)
    return replace(formula, expression=f"f_read - {square} * f_read**2", inputs=("accel",))


def _less_drift(formula: Formula, parameters: Collection[str]) -> Formula:
    """The accelerometer's formula without the drift of b along the body's axes, where its slopes are known."""
    if not any(name in parameters for name in ACCEL_SLOPE.names):
        return formula
    return replace(
        formula,
        expression=f"{formula.expression} - {temperature_text(ACCEL_SLOPE.names, parameters)}",
        inputs=(*formula.inputs, "temperature"),
    )
