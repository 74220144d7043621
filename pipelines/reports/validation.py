"""The validation of a calibration as people read it: a table, and validation.html, which opens offline."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import Validation, peak, rms
from alidade.pipelines.display.figure import BEFORE, COLORS, Figure
from alidade.pipelines.methods import method
from alidade.pipelines.methods.meanings import meaning
from alidade.pipelines.reports.answer import Answer, Tone
from alidade.pipelines.reports.calibration import SavedCalibration
from alidade.pipelines.reports.result import Plot
from alidade.pipelines.reports.templating import page

# Angles of less than this, rad, are read in arc seconds.
_FINE = 2e-4


def validation_rows(
    validations: Sequence[Validation], device: Sequence[Validation] = (), best: Sequence[Validation] = ()
) -> list[tuple[str, str, str, str, str, str, str, str]]:
    """For each: its name, RMS before, after, of the device, expected; peak before, after; the unit of the six.

    Args:
        validations: with the calibration.
        device: with the calibration's device and the recording's own bias; none where that is not known.
        best: with the recording's own calibration, which tells what is to be expected; likewise.
    """
    others = [{v.name: rms(v.after) for v in each} for each in (device, best)]
    rows = []
    for v in validations:
        unit, factor = _readable(v)
        sizes = (rms(v.before), rms(v.after), *(each.get(v.name) for each in others), peak(v.before), peak(v.after))
        a, b, c, d, e, f = ("" if size is None else _three(factor * size) for size in sizes)
        rows.append((v.name, a, b, c, d, e, f, unit))
    return rows


def _three(number: float) -> str:
    """To three digits."""
    return np.format_float_positional(number, precision=3, fractional=False, trim="-")


def validation_html(
    rows: Sequence[Sequence[str]],
    validations: Sequence[Validation],
    calibration: SavedCalibration,
    recording: str,
    verdict: str,
    sentence: str,
    parameters: Sequence[tuple[str, str, str, str, str]],
) -> str:
    """The page as one HTML text.

    Args:
        rows: of errors, see `validation_rows`.
        validations: what the method says.
        calibration: the one validated.
        recording: name of the file it was validated on.
        verdict: holds, changed, unknown or same.
        sentence: that in words.
        parameters: name, change, sigma, from what on it would be noticed, unit.
    """
    made_by = method(calibration.method)
    return page(
        "alidade.pipelines.reports",
        "validation.html",
        [_plot(v) for v in validations],
        c=calibration,
        method=made_by.title,
        meanings={row[0]: meaning(made_by, row[0]) for row in parameters},
        recording=recording,
        answer=_answer(verdict, sentence),
        parameters=parameters,
        rows=rows,
    )


_WORDS: dict[str, tuple[str, Tone, tuple[str, ...]]] = {
    "holds": ("yes", "good", ("Continue to use it.",)),
    "changed": (
        "no",
        "bad",
        (
            "Do not use it any longer: run `alidade calibrate` on this recording, and apply the result.",
            "If the change is larger than wear explains, look at mounts and screws first.",
        ),
    ),
    "unknown": ("cannot say", "warn", ("Record a motion as for a calibration, so that the parameters can be seen.",)),
    "same": ("cannot say", "fixed", ("Validate on a recording that the calibration was not made from.",)),
}


def _answer(verdict: str, sentence: str) -> Answer:
    word, tone, steps = _WORDS[verdict]
    return Answer("Is the calibration still valid?", word, tone, sentence, (), steps)


def _plot(validation: Validation) -> Plot:
    unit, factor = _readable(validation)
    out = Figure(f"error, {unit}")
    for name, errors, color in (
        ("before", validation.before, BEFORE),
        ("after", validation.after, COLORS[0]),
    ):
        out.points(validation.time, factor * np.linalg.norm(errors, axis=1), name, color, 3)
    said = "Length of the error over time, before and after compensation."
    note = f" {validation.note[:1].upper()}{validation.note[1:]}." if validation.note else ""
    return Plot(f"{validation.name[:1].upper()}{validation.name[1:]}", said + note, out)


def _readable(validation: Validation) -> tuple[str, float]:
    """The unit to show, and what to multiply SI by; the same before and after."""
    if validation.unit != "rad":
        return validation.unit, 1.0
    if validation.micro:
        return "µrad", 1e6
    fine = rms(validation.after) < _FINE
    return ("arcsec", math.degrees(3600.0)) if fine else ("deg", math.degrees(1.0))
