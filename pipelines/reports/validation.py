"""The validation of a calibration as people read it: a table, and validation.html, which opens offline."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipelines.judgement.validation import Validation, peak, rms
from pipelines.reports.calibration import SavedCalibration
from pipelines.reports.plots import COLORS, add_points, figure
from pipelines.reports.templating import environment

# Angles of less than this, rad, are read in arc seconds.
_FINE = 2e-4


def validation_rows(validations: Sequence[Validation]) -> list[tuple[str, str, str, str, str, str]]:
    """For each: its name, RMS before and after, peak before and after, and the unit of the four."""
    rows = []
    for v in validations:
        unit, factor = _readable(v)
        sizes = (factor * size(errors) for size in (rms, peak) for errors in (v.before, v.after))
        numbers = [np.format_float_positional(size, precision=3, fractional=False, trim="-") for size in sizes]
        rows.append((v.name, numbers[0], numbers[1], numbers[2], numbers[3], unit))
    return rows


def validation_html(validations: Sequence[Validation], calibration: SavedCalibration, recording: str) -> str:
    """The page as one HTML text.

    Args:
        validations: what the method says.
        calibration: the one validated.
        recording: name of the file it was validated on.
    """

    return (
        environment("pipelines.reports")
        .get_template("validation.html")
        .render(
            c=calibration,
            recording=recording,
            rows=validation_rows(validations),
            plots=[(v.name, v.note, _plot(v, first=i == 0)) for i, v in enumerate(validations)],
        )
    )


def _plot(validation: Validation, first: bool) -> str:
    unit, factor = _readable(validation)
    out = figure(f"error, {unit}")
    for name, errors, color in (
        ("before", validation.before, COLORS[1]),
        ("after", validation.after, COLORS[0]),
    ):
        add_points(out, validation.time, factor * np.linalg.norm(errors, axis=1), name, color, 3)
    return str(out.to_html(full_html=False, include_plotlyjs=first, config={"responsive": True, "displaylogo": False}))


def _readable(validation: Validation) -> tuple[str, float]:
    """The unit to show, and what to multiply SI by; the same before and after."""
    if validation.unit != "rad":
        return validation.unit, 1.0
    if validation.micro:
        return "urad", 1e6
    fine = rms(validation.after) < _FINE
    return ("arcsec", math.degrees(3600.0)) if fine else ("deg", math.degrees(1.0))
