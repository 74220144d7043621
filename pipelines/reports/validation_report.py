"""validation.html and what `validate` prints: whether a calibration holds, errors before and after compensation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import Validation, peak, rms
from alidade.pipelines.display.figure import BEFORE, COLORS, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Interval, Table
from alidade.pipelines.display.units import human_unit, minute, shown_unit, significant, to_digits_of
from alidade.pipelines.files import plain_json
from alidade.pipelines.methods import method
from alidade.pipelines.reports.report import Block, Plots, Report, Section, Summary, Tone
from alidade.pipelines.reports.sentences import capital

if TYPE_CHECKING:
    from alidade.pipelines.applications.validate import Validated

# Verdict, or "within" for a change within the required accuracy -> answer, tone and next steps.
_ANSWERS: Mapping[str, tuple[str, Tone, tuple[str, ...]]] = {
    "holds": ("yes", "good", ("Continue to use it.",)),
    "changed": (
        "no",
        "bad",
        (
            "Do not use it any longer: run `alidade calibrate` on this recording, and apply the result.",
            "If the change is larger than wear explains, look at mounts and screws first.",
        ),
    ),
    "within": (
        "no, but it serves",
        "warn",
        (
            "It may be used: the change is within the required accuracy. `alidade calibrate` on this recording has the "
            "values of today.",
        ),
    ),
    "unknown": ("cannot say", "warn", ("Record a motion as for a calibration, so that the parameters can be seen.",)),
    "same": ("cannot say", "fixed", ("Validate on another recording of the device.",)),
}


def validation_json(validated: Validated) -> str:
    """JSON of `validate`: the verdict, what changed, and RMS and peak of every kind of error, before and after."""
    others = {"device": {v.name: v for v in validated.device}, "expected": {v.name: v for v in validated.best}}
    found = validated.held.changes.found if validated.held else ()
    return plain_json(
        "validation",
        {
            "recording": validated.recording,
            "method": validated.calibration.method,
            "verdict": validated.verdict,
            "headline": validated.sentence,
            "parameters": [
                {"name": s.name, "change": s.size, "sigma": s.sigma, "changed": s in found}
                for s in (validated.held.steps if validated.held else ())
            ],
            "validations": [
                {"name": v.name, "unit": v.unit}
                | {
                    size.__name__: {"before": size(v.before), "after": size(v.after)}  # both of lengths of errors
                    | {what: size(each[v.name].after) for what, each in others.items() if v.name in each}
                    for size in (rms, peak)
                }
                for v in validated.validations
            ],
            "notes": validated.notes,
        },
    )


def validation_report(validated: Validated) -> Report:
    """The report of a validation."""
    calibration = validated.calibration
    source, title = calibration.recording, method(calibration.method).title
    answer, tone, steps = _ANSWERS["within" if validated.serves else validated.verdict]
    notes = tuple(note.removesuffix(".") for note in validated.notes)
    return Report(
        title=f"{title} validation ({validated.recording})",
        heading=f"{title}: an earlier calibration on a new recording",
        about=(
            f"{validated.recording}, with the calibration from {source.file} of {minute(source.start)} "
            f"UTC ({calibration.solver} solver, {calibration.status}; SHA-256 of its recording {source.sha256[:16]}…)"
        ),
        summary=Summary("Is the calibration still valid?", answer, tone, validated.sentence, notes, steps),
        sections=(
            Section("Change since the calibration", _changes(validated)),
            Section("Errors before and after compensation", (_error_table(validated),)),
            Section("Errors over time", (Plots(tuple(map(_plot, validated.applied))),)),
        ),
    )


def _changes(validated: Validated) -> tuple[Block, ...]:
    """Return a table of the change of each compared parameter, and the smallest change that would be significant."""
    if validated.held is None:
        return ()
    rows = []
    for step in validated.held.steps:
        unit, factor = human_unit(validated.held.quantities[step.name])
        numbers = (step.size, step.sigma, validated.held.changes.limit * step.sigma)
        change, sigma, threshold = (to_digits_of(factor * x, factor * step.sigma) for x in numbers)
        name = Cell(step.name, hint=method(validated.calibration.method).describe(step.name))
        beyond = abs(step.size) > validated.held.changes.limit * step.sigma
        drawn = Interval(step.sigma, 0.5 * validated.held.changes.limit * step.sigma, offset=step.size)
        bar = Cell("", interval=drawn, tone="bad" if beyond else "good")
        rows.append((name, change, sigma, threshold, unit, bar))
    caption = (
        "Change: this recording's estimate less the calibration's. Threshold: beyond it a change is significant "
        "(p = 0.05 for all parameters together). Bar: change ± 2 sigma, dark, between the thresholds, light."
    )
    columns = ("parameter", "change", "sigma", "threshold", Column("unit", "text"), Column("", "drawing"))
    return (Table("", caption, columns, tuple(rows), "changes", most_rows=None),) if rows else ()


def _error_table(validated: Validated) -> Table:
    """Return a table with RMS and peak of each kind of error, before and after compensation."""
    others = [{v.name: rms(v.after) for v in each} for each in (validated.best, validated.validations)]
    rows = []
    for v in validated.applied:
        unit, factor = _unit(v)
        more = (each.get(v.name) for each in (others if validated.device else others[:0]))
        sizes = (rms(v.before), rms(v.after), peak(v.before), peak(v.after), *more)
        rows.append((v.name, *("" if size is None else significant(factor * size, 3) for size in sizes), unit))
    heads = ["RMS before", "RMS after", "peak before", "peak after"]
    caption = "RMS is the root mean square. Before: nothing compensated. After: with the calibration."
    if validated.device:
        heads += ["RMS expected", "RMS as stored"]
        caption = (
            f"{caption.removesuffix('.')}, its turn-on bias and the like re-estimated from this recording. "
            "Expected: with this recording's own calibration. As stored: with the bias of the calibration too."
        )
    columns = (Column(head, group=head[:4]) for head in heads)
    return Table("", caption, ("error", *columns, Column("unit", "text")), tuple(rows), "errors", most_rows=None)


def _plot(validation: Validation) -> Plot:
    unit, factor = _unit(validation)
    out = Figure(f"error, {unit}")
    for name, errors, color in (("before", validation.before, BEFORE), ("after", validation.after, COLORS[0])):
        out.points(validation.time, factor * np.linalg.norm(errors, axis=1), name, color, 3)
    caption = "Length of the error over time, before and after compensation."
    return Plot(capital(validation.name), caption, out)


def _unit(validation: Validation) -> tuple[str, float]:
    """Return the unit to show errors in, and its factor from SI, the same before and after compensation."""
    if validation.unit != "rad":
        return validation.unit, 1.0
    return ("µrad", 1e6) if validation.micro else shown_unit("rad", rms(validation.after))
