"""compare.html: the solvers side by side, and whether the recording agrees with itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import human_unit, signed, to_digits_of
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.reports.calibration_report import summary_of
from alidade.pipelines.reports.plots import histories
from alidade.pipelines.reports.report import Block, Bullets, Details, Plots, Report, Section, Summary, Text, Tone
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import truth_errors
from alidade.pipelines.reports.results_table import result_cards

if TYPE_CHECKING:
    from alidade.pipelines.applications.comparison import Comparison

# Bars of z end here: a published solver may be hundreds of its sigmas off.
_MAX_Z = 12.0
# Difference of the published solver from batch that is counted, in sigmas of batch.
_FAR = 3.0
_COLORS = dict(zip(("incremental", "published", "batch", "halves"), COLORS, strict=False))


def comparison_report(comparison: Comparison) -> Report:
    """The report of a comparison of solvers on one recording."""
    calibrations = sorted(comparison.calibrations, key=lambda c: c.estimate.solver == "published")
    first, halves = calibrations[0], comparison.halves
    quantities = [q for q in first.problem.quantities if q.prior_sigma != 0.0]
    z = _z_scores(calibrations)
    by_solver = dict(zip((c.estimate.solver for c in calibrations), z, strict=True))
    if halves:
        by_solver["halves"] = {name: half.z for name, half in halves.items()}
    online = comparison.of("incremental") or first
    plots = tuple(histories(online))
    over_time = (Details(f"Estimates of {online.estimate.solver} over time", (Plots(plots),), "fold"),)
    return Report(
        title=f"{first.method.title} comparison ({first.recording})",
        heading=f"{first.method.title}: solvers compared",
        about=f"{first.recording}: {', '.join(f'{c.estimate.solver} {c.status}' for c in calibrations)}",
        summary=comparison_summary(comparison),
        sections=(
            Section("Solvers", _solvers(calibrations, quantities, z)),
            Section("Differences", (Plots((_differences(by_solver, quantities),)), *_held_out(comparison))),
            Section("First and second half", _halves(first, quantities, halves), printed="never"),
            Section("Over time", over_time if plots else ()),
        ),
    )


def _solvers(
    calibrations: Sequence[Calibration], quantities: Sequence[Quantity], z: Sequence[Mapping[str, float]]
) -> tuple[Block, ...]:
    """Return the verdict of each solver, a table of required parameters, and a collapsed one of nuisance parameters."""
    verdicts = [(c, summary_of(c, result_cards(c))) for c in calibrations]
    required = [q for q in quantities if q.required]
    others = [q for q in quantities if not q.required]
    known = any(truth_errors(c) for c in calibrations)
    what = "error over sigma" if known else "difference from batch, in batch's sigmas"
    caption = (
        f"Value ± sigma; z: {what}. Batch solves the whole recording at once and is the one to go by; incremental as "
        "it would live; published is the solver of the publication that the method is from."
    )
    blocks: list[Block] = [
        Bullets(tuple(f"{c.estimate.solver}: {c.status}. {said.text}" for c, said in verdicts)),
        _solver_table(calibrations, required, z, caption),
    ]
    if others:
        blocks.append(Details("Nuisance parameters", (_solver_table(calibrations, others, z),), "fold"))
    return tuple(blocks)


def _solver_table(
    calibrations: Sequence[Calibration],
    quantities: Sequence[Quantity],
    z: Sequence[Mapping[str, float]],
    caption: str = "",
) -> Table:
    """Return a table with the truth, where known, and value, sigma and z of each solver."""
    truths = {name: error.value for c in calibrations for name, error in truth_errors(c).items()}
    columns: list[Column | str] = ["parameter", Column("unit", "text"), *(["truth"] if truths else [])]
    for c in calibrations:
        columns += [Column(c.estimate.solver, group=c.estimate.solver), Column("z", group=c.estimate.solver)]
    rows: list[Row] = []
    for q in quantities:
        unit, factor = human_unit(q)
        row: list[Cell | str] = [Cell(q.name, hint=calibrations[0].method.describe(q.name)), unit]
        if truths:
            truth = truths.get(q.name)
            sigmas = [p.sigma for c in calibrations if (p := c.parameters.get(q.name)) and p.sigma > 0.0]
            row.append("" if truth is None else to_digits_of(truth * factor, min(sigmas, default=0.0) * factor))
        for c, scores in zip(calibrations, z, strict=True):
            p = c.parameters.get(q.name)
            row.append("-" if p is None else _with_sigma(factor * p.value, factor * p.sigma))
            row.append(signed(scores[q.name]) if q.name in scores else "")
        rows.append(tuple(row))
    return Table("", caption, tuple(columns), tuple(rows), style="small", most_rows=None)


def _z_scores(calibrations: Sequence[Calibration]) -> list[dict[str, float]]:
    """Return for each solver parameter -> z: error over sigma where the truth is known, else difference from batch."""
    errors = [truth_errors(c) for c in calibrations]
    if any(errors):
        return [{name: e.error_sigmas for name, e in each.items() if e.error_sigmas is not None} for each in errors]
    batch = next((c for c in calibrations if c.estimate.solver == "batch"), None)
    return [{} if batch is None or c is batch else _from_batch(c, batch) for c in calibrations]


def _from_batch(calibration: Calibration, batch: Calibration) -> dict[str, float]:
    """Return parameter -> difference of a solver's value from batch's, in batch's sigmas, where that is not fixed."""
    both = ((p, batch.parameters[name]) for name, p in calibration.parameters.items() if name in batch.parameters)
    return {own.name: (own.value - other.value) / other.sigma for own, other in both if other.sigma != 0.0}


def comparison_summary(comparison: Comparison) -> Summary:
    """Return a summary of whether batch and incremental agree, and both halves of the recording."""
    tone: Tone = {"yes": "good", "no": "bad", "cannot say": "fixed"}[comparison.answer]  # type: ignore[assignment]
    text = " ".join(filter(None, [_solvers_agree(comparison), *_halves_agree(comparison)]))
    steps = {
        "yes": ("Go by the batch solver's result, and apply it.",),
        "cannot say": ("Record about twice as long.",) if comparison.tested and not comparison.stopped else (),
        "no": (_after_disagreement(comparison),),
    }[comparison.answer]
    stopped = (comparison.stopped.removesuffix("."),) if comparison.stopped else ()
    notes = (*comparison.calibrations[0].facts.notes, *stopped)
    question = f"Do the solvers{' and both halves' if comparison.tested else ''} agree?"
    return Summary(question, comparison.answer, tone, text, notes, steps)


def _after_disagreement(comparison: Comparison) -> str:
    """What to do where halves or solvers disagree, a sentence."""
    if comparison.far:
        return (
            "Ask what happened between the halves: a knock, a cable, warming up; a gyro's bias walks, and may differ "
            "for that."
        )
    if any(noise.correlation_time is not None for each in comparison.calibrations for noise in each.noises):
        return "Go by batch: it models that vision's errors are correlated in time, incremental does not."
    return "Go by batch; give incremental a longer `--window`."


def _solvers_agree(comparison: Comparison) -> str:
    online = comparison.difference("incremental")
    if online is None:
        said = "Batch and incremental cannot be compared"
    elif abs(online.z) <= comparison.MAX_DIFFERENCE:
        said = f"Batch and incremental agree within {abs(online.z):.1f} sigma"
    else:
        said = f"Batch and incremental differ by {abs(online.z):.1f} sigma ({online.parameter})"
    published, batch = comparison.of("published"), comparison.of("batch")
    if published is None or batch is None:
        return f"{said}."
    common = published.parameters.keys() & batch.parameters.keys()
    far = [z for z in _from_batch(published, batch).values() if abs(z) > _FAR]
    return f"{said}; published differs by more than {_FAR:g} sigma in {len(far)} of {len(common)} parameters."


def _halves_agree(comparison: Comparison) -> Iterator[str]:
    halves, far = comparison.halves, comparison.far
    limit = f"{comparison.limit:.1f} sigma (p = {comparison.SIGNIFICANCE:g})"
    if far:
        differences = ", ".join(f"{name} ({signed(z)})" for name, z in far.items())
        yield f"The halves of the recording differ by more than {limit}: {differences}."
    elif halves:
        most = max(abs(half.z) for half in halves.values())
        yield f"Both halves agree in all {len(halves)} parameters: {most:.1f} sigma at most, threshold {limit}."
    elif comparison.tested and comparison.stopped:
        yield "The time limit ended the test of the halves."
    elif comparison.unsolved:
        one = len(comparison.unsolved) == 1
        which = f"The {comparison.unsolved[0]} half" if one else "Neither half"
        yield f"{which} {'does not determine' if one else 'determines'} the calibration by itself: it has no solution."
    elif comparison.tested:
        yield "Neither half determines a parameter by itself."


def _held_out(comparison: Comparison) -> tuple[Text, ...]:
    sizes = ", ".join(f"{size:.2f} ({family})" for family, size in comparison.predicted.items())
    said = f"Held-out measurements are predicted to {sizes} of their sigmas; 1 is expected."
    return (Text(said, style=""),) if sizes else ()


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
    return (Table("", caption, columns, tuple(rows), "halves", "small", None),) if rows else ()


def _differences(z: Mapping[str, Mapping[str, float]], quantities: Sequence[Quantity]) -> Plot:
    """Plot z of each parameter by each solver, and of the halves."""
    out = Figure("z", "", 420, x_labels=tuple(q.name for q in quantities))
    shown = {name: scores for name, scores in z.items() if scores}
    for k, (name, scores) in enumerate(shown.items()):
        out.bars([scores.get(q.name, np.nan) for q in quantities], name, _COLORS[name], (k, len(shown)))
    out.levels((-4.0, -2.0, 2.0, 4.0))
    largest = max((abs(score) for scores in shown.values() for score in scores.values()), default=0.0)
    reach = max(4.5, min(1.1 * largest, _MAX_Z))
    out.y_range = (-reach, reach)
    also = "; halves: second half less first, in sigmas of the difference" if "halves" in shown else ""
    return Plot("z of each parameter", f"z as in the table{also}. Dotted: 2 and 4; bars end at {_MAX_Z:g}.", out)
