"""compare.html: the solvers side by side, and whether the recording agrees with itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from alidade.pipelines.applications.comparison import MAX_DIFFERENCE, SIGNIFICANCE, Comparison
from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.display.figure import COLORS, Dash, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import human_unit, signed, to_digits_of
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.report import Block, Plots, Report, Section, Summary, Tone
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import TruthResult, truth_errors
from alidade.pipelines.reports.whole import write_page

FILE = "compare.html"
# Difference of the published solver from batch that is counted, in sigmas of batch.
_FAR = 3.0
# Lines of the solvers, the exact ones over the published.
_STYLES: dict[str, tuple[str, Dash]] = {
    "published": (COLORS[1], "dotted"),
    "batch": (COLORS[2], "dashed"),
    "incremental": (COLORS[0], "solid"),
}


def comparison_report(comparison: Comparison) -> Report:
    """The report of a comparison of solvers on one recording."""
    calibrations, halves = comparison.calibrations, comparison.halves
    first = calibrations[0]
    quantities = [q for q in first.problem.quantities if q.prior_sigma != 0.0]
    plots = (*_differences(calibrations, quantities), *_convergence(calibrations, quantities))
    return Report(
        title=f"{first.method.title} comparison ({first.recording})",
        heading=f"{first.method.title}: solvers compared",
        about=f"{first.recording}: {', '.join(f'{c.estimate.solver} {c.status}' for c in calibrations)}",
        summary=comparison_summary(comparison),
        sections=(
            Section("Solvers", (_comparison_table(calibrations, quantities),)),
            Section("First and second half", _halves(first, quantities, halves)),
            Section("Plots", (Plots(plots),)),
        ),
        style="wide",
    )


def write_compare(out_dir: Path, comparison: Comparison) -> Path:
    """Write compare.html; returns its path. Raises InputError when it cannot be written."""
    return write_page(out_dir, FILE, render_html(comparison_report(comparison)))


def solver_table(calibrations: Sequence[Calibration]) -> Table:
    """Required parameters: the truth where known, value and sigma of each solver, error over sigma."""
    alone = len(calibrations) == 1
    errors = [truth_errors(c) for c in calibrations]
    known = any(errors)
    columns: list[Column | str] = ["parameter", Column("unit", "text"), *(["truth"] if known else [])]
    for c in calibrations:
        solver = c.estimate.solver
        columns.append(Column("value ± sigma" if alone else solver, group=solver))
        columns += [Column("z", group=solver)] if known else []
    columns += [Column("verdict", "text")] if alone else []
    rows: list[Row] = []
    for q in calibrations[0].problem.quantities:
        if not q.judged:
            continue
        unit, factor = human_unit(q)
        row: list[Cell | str] = [q.name, unit]
        if known:
            truth = next((found[q.name].value for found in errors if q.name in found), None)
            sigmas = [p.sigma for c in calibrations if (p := c.parameters.get(q.name)) and p.sigma > 0.0]
            row.append("" if truth is None else to_digits_of(truth * factor, min(sigmas, default=0.0) * factor))
        for c, found in zip(calibrations, errors, strict=True):
            row += [_estimate(c, q), *([_z(found.get(q.name))] if known else [])]
        if alone:
            verdict = calibrations[0].verdicts.get(q.name, "")
            row.append(Cell(verdict, tone=verdict))
        rows.append(tuple(row))
    return Table("", "z: error over sigma." if known else "", tuple(columns), tuple(rows))


def _comparison_table(calibrations: Sequence[Calibration], quantities: Sequence[Quantity]) -> Table:
    """All estimated parameters by solver: difference from batch, and error where the truth is known."""
    batch = next((c for c in calibrations if c.estimate.solver == "batch"), None)
    known = calibrations[0].truth is not None
    columns: list[Column | str] = ["parameter", Column("unit", "text")]
    rows: list[list[Cell | str]] = [
        [Cell(q.name, hint=calibrations[0].method.describe(q.name)), human_unit(q)[0]] for q in quantities
    ]
    for c in calibrations:
        solver, errors = c.estimate.solver, truth_errors(c)
        compared = batch is not None and batch is not c
        columns += [solver, *([f"{solver} from batch, σ"] if compared else [])]
        columns += [f"error of {solver}, σ"] if known else []
        for row, q in zip(rows, quantities, strict=True):
            row.append(_estimate(c, q))
            if compared:
                far = _from_batch(c, calibrations, q.name)
                row.append("" if far is None else signed(far))
            if known:
                row.append(_z(errors.get(q.name)))
    caption = (
        "Each value with its sigma, the standard deviation. Batch solves the whole recording at once and is the one to "
        "go by; incremental as it would live; published is the solver of the publication that the method is from."
    )
    if len(calibrations) > 1 and batch is not None:
        caption += ' "From batch" is the difference from batch, in batch\'s sigmas.'
    if known:
        caption += ' "Error" is against the truth that came with the recording, in the solver\'s own sigmas.'
    return Table("", caption, tuple(columns), tuple(map(tuple, rows)), "solvers", "lines many", None)


def _estimate(c: Calibration, q: Quantity) -> str:
    """Value and sigma; a dash of a parameter that the solver does not know."""
    found, (_, factor) = c.parameters.get(q.name), human_unit(q)
    if found is None:
        return "-"
    return _with_sigma(factor * found.value, factor * found.sigma)


def _z(error: TruthResult | None) -> str:
    return "" if error is None or error.error_sigmas is None else signed(error.error_sigmas)


def _from_batch(calibration: Calibration, calibrations: Sequence[Calibration], name: str) -> float | None:
    """The difference of a solver's value from batch's, in batch's sigmas."""
    batch = next((c for c in calibrations if c.estimate.solver == "batch"), None)
    if batch is None or batch is calibration:
        return None
    own, reference = calibration.parameters.get(name), batch.parameters.get(name)
    if own is None or reference is None or reference.sigma == 0.0:
        return None
    return (own.value - reference.value) / reference.sigma


def comparison_summary(comparison: Comparison) -> Summary:
    """Whether batch and incremental agree, and both halves of the recording."""
    tone: Tone = {"yes": "good", "no": "bad", "cannot say": "fixed"}[comparison.answer]  # type: ignore[assignment]
    text = " ".join(filter(None, [_solvers_agree(comparison), *_halves_agree(comparison)]))
    steps = {
        "yes": ("Go by the batch solver's result, and apply it.",),
        "cannot say": ("Record about twice as long.",) if comparison.tested and not comparison.stopped else (),
        "no": (
            "Ask what happened between the halves: a knock, a cable, warming up; a gyro's bias walks, and may differ "
            "for that."
            if comparison.far
            else "Go by batch; give incremental a longer `--window`.",
        ),
    }[comparison.answer]
    notes = (comparison.stopped.removesuffix("."),) if comparison.stopped else ()
    return Summary("Do the solvers and both halves agree?", comparison.answer, tone, text, notes, steps)


def _solvers_agree(comparison: Comparison) -> str:
    online = comparison.difference("incremental")
    if online is None:
        said = "Batch and incremental cannot be compared"
    elif abs(online.z) <= MAX_DIFFERENCE:
        said = f"Batch and incremental agree within {abs(online.z):.1f} sigma"
    else:
        said = f"Batch and incremental differ by {abs(online.z):.1f} sigma ({online.parameter})"
    published, batch = comparison.of("published"), comparison.of("batch")
    if published is None or batch is None:
        return f"{said}."
    common = [name for name in published.parameters if batch.values.keys() >= {name}]
    far = [name for name in common if abs(_from_batch(published, comparison.calibrations, name) or 0.0) > _FAR]
    return f"{said}; published differs by more than {_FAR:g} sigma in {len(far)} of {len(common)} parameters."


def _halves_agree(comparison: Comparison) -> Iterator[str]:
    halves, far = comparison.halves, comparison.far
    if far:
        yield (
            f"The halves of the recording differ by more than {comparison.limit:.1f} sigma (p = {SIGNIFICANCE:g}): "
            f"{', '.join(f'{name} ({signed(z)})' for name, z in far.items())}."
        )
    elif halves:
        most = max(abs(half.z) for half in halves.values())
        yield (
            f"Both halves agree in all {len(halves)} parameters: {most:.1f} sigma at most, threshold "
            f"{comparison.limit:.1f} sigma (p = {SIGNIFICANCE:g})."
        )
    elif comparison.tested and comparison.stopped:
        yield "The time limit ended the test of the halves."
    elif comparison.tested:
        yield "Neither half determines a parameter by itself."
    if comparison.predicted:
        held_out = ", ".join(f"{size:.2f} ({family})" for family, size in comparison.predicted.items())
        yield f"Held-out measurements are predicted to {held_out} of their sigmas; 1 is expected."


def _with_sigma(value: float, sigma: float) -> str:
    return (
        f"{to_digits_of(value, sigma)} ± {to_digits_of(sigma, sigma)}" if sigma else f"{to_digits_of(value, 0.0)} fixed"
    )


def _halves(c: Calibration, quantities: Sequence[Quantity], halves: Mapping[str, SplitHalf]) -> tuple[Block, ...]:
    columns: Columns = ("parameter", Column("unit", "text"), "first half", "second half", "difference, sigmas")
    rows: list[Row] = []
    for q in quantities:
        if q.name in halves:
            half, (unit, factor) = halves[q.name], human_unit(q)
            pairs = ((half.first, half.first_sigma), (half.second, half.second_sigma))
            cells = (_with_sigma(factor * value, factor * sigma) for value, sigma in pairs)
            rows.append((Cell(q.name, hint=c.method.describe(q.name)), unit, *cells, signed(half.z)))
    caption = (
        "Each half solved by itself, as if the other had not been recorded. A difference beyond three or four sigmas "
        "means that something changed, or that the model lacks something."
    )
    return (Table("", caption, columns, tuple(rows), "halves", most_rows=None),) if rows else ()


def _differences(calibrations: Sequence[Calibration], quantities: Sequence[Quantity]) -> list[Plot]:
    """Errors, or differences from batch, in sigmas."""
    known = any(truth_errors(c) for c in calibrations)
    y_title = "error, sigmas of each solver" if known else "difference from batch, sigmas of batch"
    out = Figure(y_title, "", 380, x_labels=tuple(q.name for q in quantities))
    for k, c in enumerate(calibrations):
        errors = truth_errors(c)
        numbers = [
            (errors[q.name].error_sigmas if q.name in errors else None)
            if known
            else _from_batch(c, calibrations, q.name)
            for q in quantities
        ]
        if any(number is not None for number in numbers):
            heights = np.array([np.nan if number is None else number for number in numbers])
            out.bars(heights, c.estimate.solver, _STYLES[c.estimate.solver][0], (k, len(calibrations)))
    out.levels((-3.0, 3.0))
    what = (
        "Error of each solver in units of the sigma it states" if known else "Each solver less batch, sigmas of batch"
    )
    return [Plot("Differences", f"{what}; dotted are three.", out)]


def _convergence(calibrations: Sequence[Calibration], quantities: Sequence[Quantity]) -> list[Plot]:
    """A figure a parameter: its estimate over time by every solver that has a history."""
    plots = []
    for q in quantities:
        unit, factor = human_unit(q)
        out = Figure(unit, height=260)
        reach: list[float] = []
        for c in calibrations:
            history, names = c.estimate.history, c.estimate.names
            color, dash = _STYLES[c.estimate.solver]
            if q.name not in names:
                continue
            i = names.index(q.name)
            if history is None:
                value, sigma = (factor * float(x[i]) for x in (c.estimate.values, c.estimate.sigmas))
                out.levels(value, color, dash, c.estimate.solver)
                reach += [value - 4.0 * sigma, value + 4.0 * sigma]
                continue
            values, sigmas = factor * history.values[:, i], factor * history.sigmas[:, i]
            if c.estimate.solver == "incremental":
                out.band(history.time, values - sigmas, values + sigmas, color, c.estimate.solver)
            out.line(history.time, values, c.estimate.solver, color, dash)
            settled = history.time >= history.time[0] + 0.2 * np.ptp(history.time)
            reach += [float(values[settled].min()), float(values[settled].max())]
        truth = (calibrations[0].truth or {}).get(q.name)
        if isinstance(truth, int | float):
            out.levels(factor * truth, COLORS[6], "solid", "truth")
            reach.append(factor * truth)
        if reach and out.marks:
            edge = 0.05 * (max(reach) - min(reach))
            out.y_range = (min(reach) - edge, max(reach) + edge)
            caption = calibrations[0].method.describe(q.name)
            plots.append(Plot(f"{q.name} over time", f"{caption} The band is one sigma of incremental.".strip(), out))
    return plots
