"""How a tumble result is applied. Frame b: the axes in which the K of the accelerometer, or else the magnetometer's, is
symmetric."""

from __future__ import annotations

from collections.abc import Collection

from pipelines.methods.formula import Formula
from pipelines.methods.triads import triad_formula


def formulas(parameters: Collection[str]) -> list[Formula]:
    """Of the sensors that there are; raw numbers are as recorded, and results in the unit of the strength."""
    found = []
    if "accel_k11" in parameters:
        found.append(triad_formula("accel", parameters, "accel", ("accel",), lambda v: v.accel, "body's"))
    if "mag_k11" in parameters:
        unit = "the unit of field_strength"
        found.append(triad_formula("mag", parameters, "mag", ("mag",), lambda v: v.mag, "body's", unit))
    return found
