"""What the command line prints: tables for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from pipelines.reports.result import Calibration
    from pipelines.sessions.info import SessionFacts

_console = Console(highlight=False)

_COLOURS = {
    "calibrated": "green",
    "observable": "green",
    "weak": "yellow",
    "prior": "yellow",
    "unobservable": "red",
    "inconsistent": "red",
    "fixed": "dim",
}


def say(text: str) -> None:
    """One line, never broken."""
    _console.print(escape(text), soft_wrap=True)


def show(calibrations: Sequence[Calibration]) -> None:
    """One table: a row a parameter, the truth where known, value and sigma (and error in sigmas) of each solver."""
    from pipelines.reports.result import truth_errors
    from pipelines.reports.units import human_unit, to_digits_of

    truths = [truth_errors(c) for c in calibrations]
    alone = len(calibrations) == 1
    table = Table(header_style="bold", row_styles=["", "dim"] if not alone else [])
    table.add_column("parameter")
    table.add_column("unit")
    if any(truths):
        table.add_column("truth", justify="right")
    for c in calibrations:
        table.add_column("value" if alone else c.estimate.solver, justify="right")
        table.add_column("sigma", justify="right")
        if any(truths):
            table.add_column("error / sigma" if alone else "err/s", justify="right")
    if alone:
        table.add_column("verdict")
    for q in calibrations[0].problem.quantities:
        unit, factor = human_unit(q)
        row = [q.name, unit]
        known = next((t[q.name] for t in truths if q.name in t), None)
        found = [{p.name: p for p in c.parameters}.get(q.name) for c in calibrations]
        finest = min((p.sigma for p in found if p is not None and p.sigma > 0.0), default=0.0) * factor
        if any(truths):
            row.append(to_digits_of(known.value * factor, finest) if known else "")
        for p, t in zip(found, truths, strict=True):
            row += ["-", "-"] if p is None else _number(p.value * factor, p.sigma * factor)
            if any(truths):
                error = t[q.name].error_sigmas if q.name in t else None
                row.append("" if error is None else f"{error:+.1f}")
        if alone and found[0] is not None:
            verdict = found[0].observability
            row.append(f"[{_COLOURS[verdict]}]{verdict}[/]")
        table.add_row(*row)
    _console.print(table)
    for c in calibrations:
        _verdict(c, name=not alone)


def show_facts(name: str, facts: SessionFacts) -> None:
    """The topics of a recording and the methods it can serve."""
    table = Table(title=f"{escape(name)}, {facts.duration_s:.1f} s", header_style="bold", title_justify="left")
    for column in ("topic", "type"):
        table.add_column(column)
    for column in ("messages", "rate, Hz", "largest gap", "duplicates", "out of order"):
        table.add_column(column, justify="right")
    for t in facts.topics:
        gap = "" if t.largest_gap_s is None else f"{t.largest_gap_s:.3g} s at {t.largest_gap_at_s:.1f} s"
        rate = "" if t.rate_hz is None else f"{t.rate_hz:.4g}"
        table.add_row(escape(t.name), t.type, str(t.count), rate, gap, str(t.duplicates), str(t.out_of_order))
    _console.print(table)
    if facts.attachments:
        say(f"attachments: {', '.join(facts.attachments)}")
    for method, missing in facts.missing.items():
        if missing:
            say(f"{method}: no, it lacks {'; '.join(missing)}")
        else:
            _console.print(f"[green]{method}: yes[/]")


def _number(value: float, sigma: float) -> list[str]:
    from pipelines.reports.units import to_digits_of

    return [to_digits_of(value, sigma), "fixed" if sigma == 0.0 else f"{sigma:.2g}"]


def _verdict(calibration: Calibration, name: bool) -> None:
    assessment = calibration.assessment
    solver = f"{calibration.estimate.solver}: " if name else ""
    _console.print(f"{solver}[{_COLOURS[assessment.status]}]{escape(assessment.headline)}[/]", soft_wrap=True)
    for direction in assessment.directions:
        say(f"  {direction.verdict}: {direction.label}: {direction.advice}")
    for note in calibration.notes:
        say(f"  note: {note}")
