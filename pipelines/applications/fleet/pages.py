"""Reports of fleets and of Monte Carlo studies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.factors.array import Array, Index
from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.analysis import Population, Unit, iso, sentence, units_of_interest
from alidade.pipelines.applications.fleet.histories import History
from alidade.pipelines.applications.fleet.statistics import Component
from alidade.pipelines.display.figure import COLORS, PALE, REJECTED, Figure, Plot, Shape, milliseconds, thin
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import rounded, shown_unit, to_digits_of
from alidade.pipelines.methods import method
from alidade.pipelines.reports.report import Block, Bullets, Plots, Report, Section, Summary, Text

if TYPE_CHECKING:
    from alidade.pipelines.applications.fleet.fleet import Outcome
    from alidade.pipelines.applications.fleet.montecarlo import Study

# Rows of a list on the page; the CSV has all.
_MOST_LISTED = 200
_MONTH = 30.0
_MOST_BARS = 60
# Recordings of a plot in which lines join those of a unit; more would hide the points.
_MOST_JOINED = 1000


def fleet_report(outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> Report:
    """The report of a fleet."""
    results = outcome.results
    attention = units_of_interest(results, fleet, found)
    dates = [r["date"] for r in results.values() if r["date"] is not None]
    units = len({r["unit"] for r in results.values()})
    first, last = ((iso(date) or "no date")[:10] for date in (min(dates, default=None), max(dates, default=None)))
    interrupted = " (interrupted: the same command continues)" if outcome.interrupted else ""
    heading = f"Fleet of {units} units"
    return Report(
        title=heading,
        heading=heading,
        about=f"{len(results)} of {outcome.recordings} recordings{interrupted}, {first} to {last}: {outcome.verdicts}",
        summary=_attention(attention, units, bool(fleet)),
        sections=(
            Section("Units outside the control limits", _attention_blocks(attention, len(found))),
            Section("Parameters", (_parameter_table(fleet),)),
            Section("Parameters over time", (Plots(tuple(map(population_plot, fleet))),) if fleet else ()),
        ),
    )


def study_report(study: Study) -> Report:
    """The report of a Monte Carlo study."""
    solvers = [solver for solver in study.solvers if study.estimates(solver)]
    interrupted = " (interrupted: the same command continues)" if study.interrupted else ""
    own = [solver for solver in solvers if solver != "published"] or solvers
    plots = tuple(plot for solver in own for plot in (_nees_plot(study, solver), _errors_plot(study, solver)))
    failures = (
        Section(
            f"{solver}: {len(seeds)} runs without an estimate",
            (Bullets(tuple(f"seed {seed}: {reason}" for seed, reason in seeds.items())),),
        )
        for solver in study.solvers
        if (seeds := study.failures(solver))
    )
    return Report(
        title=f"{study.method}: {study.scenario}",
        heading=f"{method(study.method).title}: {study.scenario}, simulated {len(study.results)} times",
        about=f"{len(study.results)} of {study.seeds} runs, {study.kept} from an earlier run{interrupted}",
        summary=_consistency(study, own),
        sections=(
            Section("Consistency", (_consistency_table(study, solvers),)),
            *failures,
            Section("Parameters", (_accuracy_table(study, solvers),), printed="never"),
            Section("Distributions", (Plots(plots),) if plots else ()),
        ),
    )


# -- fleets


def _attention(found: Sequence[Unit], units: int, parameters: bool) -> Summary:
    """Return the summary of the units that need attention."""
    question = "Which units need attention?"
    if not found:
        answer = "none" if parameters else "cannot say"
        text = f"None of {units} units stands out." if parameters else "No recording gave a calibration to compare."
        step = "Run the same command when there are new recordings; those finished are kept."
        return Summary(question, answer, "good" if parameters else "fixed", text, (), (step,))
    steps = (
        "Start with the first in the table: units that changed, then those unlike the others.",
        "Record a unit again before it is sent back: what stands out twice is the unit, not the recording.",
    )
    return Summary(question, f"{len(found)} of {units}", "warn", f"Of {units} units, {sentence(found)}.", (), steps)


def _attention_blocks(attention: Sequence[Unit], several: int) -> tuple[Block, ...]:
    """Return a table with a row for each finding, and a text on the units in which changes can be found."""
    rows = tuple(
        (
            unit.name if i == 0 else "",
            Cell(f.kind, tone="" if f.kind in ("weak", "unobservable") else "bad"),
            f.text,
            "" if f.z is None else f"{f.z:+.1f}",
        )
        for unit in attention[:_MOST_LISTED]
        for i, f in enumerate(unit.findings)
    )
    columns = ("unit", Column("finding", "text", wide=True), Column("description", "prose"), "z")
    hidden = len(attention) - _MOST_LISTED
    repeated = (
        f"{several} units were recorded several times; changes of what belongs to the device are looked for in these."
        if several
        else "No unit was recorded several times: none can be seen to have changed."
    )
    return (
        *((Table("", "", columns, rows, "attention", "", None),) if rows else ()),
        *((Text(f"{hidden} more are in the tables beside this page."),) if hidden > 0 else ()),
        Text(repeated),
    )


def _parameter_table(fleet: Sequence[Population]) -> Table:
    """Return a table with a row for each parameter, in the unit people read."""
    several = len({p.method for p in fleet}) > 1
    columns = (
        "parameter",
        *((Column("method", "text"),) if several else ()),
        *(Column("belongs to", "text"), Column("unit", "text"), "recordings", "centre"),
        *(Column(head, wide=True) for head in ("between units", "within a unit", "typical sigma", "control limits")),
        *("beyond", "outlying", "changed", Column("drift in 30 days", wide=True)),
    )
    caption = (
        "Between units, within a unit: standard deviations beyond the sigmas, each with its sigma or a 95 % bound, "
        "outliers excluded. Parameters of a recording (turn-on bias) differ each time and are no change. z: distance "
        "from the centre over spread and sigma, or a change over its sigma. Beyond: recordings with |z| above 3 "
        "(0.27 % expected). Outlying, changed: p = 0.01 for the whole fleet."
    )
    rows = tuple(_parameter_row(p, several) for p in fleet)
    return Table("", caption, columns, rows, style="many", most_rows=None)


def _parameter_row(p: Population, several: bool) -> tuple[Cell | str, ...]:
    unit, factor = shown_unit(p.unit, p.require)
    sigma = factor * float(np.median(p.sigmas))
    centre = limits = beyond = drift = ""
    if p.spread and p.control:
        scatter = float(np.hypot(factor * p.spread.tau, sigma))
        centre = to_digits_of(factor * p.spread.centre, scatter)
        limits = " … ".join(to_digits_of(factor * bound, scatter) for bound in p.control)
        beyond = str(p.beyond)
    if p.drift:
        slope, slope_sigma = (_MONTH * factor * number for number in (p.drift.slope, p.drift.sigma))
        drift = f"{to_digits_of(slope, slope_sigma)} ± {rounded(slope_sigma)}"
    outlying, changed = int(p.outlying.sum()), len({p.units[i] for i in np.flatnonzero(p.changed)})
    return (
        Cell(p.name, hint=method(p.method).describe(p.name)),
        *((p.method,) if several else ()),
        *("device" if p.of_device else "recording", unit, str(len(p.values)), centre),
        *(_component(p.population, factor), _component(p.repeatability, factor), rounded(sigma), limits, beyond),
        *(Cell(str(count), tone="bad" if count else "") for count in (outlying, changed)),
        Cell(drift, tone="bad" if p.drifts else ""),
    )


def _component(component: Component | None, factor: float) -> str:
    """Format a standard deviation with its sigma, or the upper bound of one that is 0."""
    if component is None:
        return ""
    if component.value == 0.0:
        return f"< {rounded(factor * component.upper)}"
    value, sigma = (to_digits_of(factor * x, factor * component.sigma) for x in (component.value, component.sigma))
    return f"{value} ± {sigma}"


def population_plot(p: Population) -> Plot:
    """Plot a parameter's values by date, those of a unit joined, with the control limits, and their histogram."""
    unit, factor = shown_unit(p.unit, p.require)
    out = Figure(unit, "date", share=0.8, x_scale="datetime")
    counts = Figure("", "recordings", share=0.2, y_shared=True)
    flagged = p.outlying | p.changed
    good = np.flatnonzero(~flagged)
    _add_recordings(out, p, good[thin(len(good))], factor, "recording", COLORS[0])
    edges = np.histogram_bin_edges(factor * p.values, bins=int(np.clip(2.0 * math.sqrt(len(p.values)), 10, _MOST_BARS)))
    ends = _add_counts(counts, factor * p.values[good], edges, "recording", COLORS[0])
    if flagged.any():
        _add_recordings(out, p, np.flatnonzero(flagged), factor, "outlying or changed", REJECTED)
        _add_counts(counts, factor * p.values[flagged], edges, "outlying or changed", REJECTED, ends)
    if p.spread and p.control:
        out.levels(factor * p.spread.centre, dash="solid")
        out.levels(factor * np.array(p.control), dash="dashed")
    if len(p.values) <= _MOST_JOINED:
        out.line(*_joined(p, factor), color=PALE, width=1.0)
    low, high = (factor * (p.values + k * p.sigmas) for k in (-2.0, 2.0))
    reach = np.concatenate([low, high, factor * np.array((p.spread and p.control) or ())])
    edge = 0.05 * np.ptp(reach)
    out.y_range = (float(reach.min() - edge), float(reach.max() + edge))
    caption = f"{len(p.values)} recordings of {len(set(p.units))} units, ± 2 sigmas, those of a unit joined"
    limits = "; dashed are the control limits, three standard deviations about the centre" if p.spread else ""
    return Plot(f"{p.name} ({p.method})", f"{caption}{limits}.", out, (counts,))


def _joined(p: Population, factor: float) -> tuple[Array, Array]:
    """Return dates, ms, and values of the recordings, unit by unit in the order of time, NaN between units."""
    order = sorted(range(len(p.values)), key=lambda i: (p.units[i], p.dates[i]))
    dates, values = milliseconds(iso(p.dates[i]) for i in order), factor * p.values[order]
    gaps = [k for k in range(1, len(order)) if p.units[order[k]] != p.units[order[k - 1]]]
    return np.insert(dates, gaps, np.nan), np.insert(values, gaps, np.nan)


def _add_recordings(out: Figure, p: Population, some: Any, factor: float, name: str, color: str) -> None:
    dates = milliseconds(iso(p.dates[i]) for i in some)
    values, sigmas = factor * p.values[some], factor * p.sigmas[some]
    out.segments(dates, values - 2.0 * sigmas, dates, values + 2.0 * sigmas, color, name)
    shape: Shape = "x" if color == REJECTED else "circle"
    out.points(dates, values, name, color, 6, shape=shape, texts=[f"{p.units[i]}, {p.recordings[i]}" for i in some])


def _add_counts(out: Figure, values: Array, edges: Array, name: str, color: str, below: Index | int = 0) -> Index:
    """Draw a horizontal histogram, counted here so that the page does not grow with the fleet; return its ends."""
    ends = below + np.histogram(values, edges)[0]
    out.boxes(np.broadcast_to(below, ends.shape), ends, edges[:-1], edges[1:], name, color)
    return ends


# -- studies


def _consistency(study: Study, solvers: Sequence[str]) -> Summary:
    """Return the summary of whether the sigmas are consistent; the published solver counts only where it is alone."""
    question = "Are the sigmas consistent?"
    judged = {solver: study.nees(solver) for solver in solvers}
    if not judged:
        steps = ("See below why the runs failed.",)
        return Summary(question, "cannot say", "fixed", "No run gave an estimate.", (), steps)
    said = ", ".join(
        f"{solver} has a mean NEES of {rounded(nees.mean, 3)}, expected {nees.dof:g}, 99 % interval "
        f"{rounded(nees.low, 3)} to {rounded(nees.high, 3)}"
        for solver, nees in judged.items()
    )
    wrong = [solver for solver, nees in judged.items() if not nees.consistent]
    needed = max(nees.needed for nees in judged.values())
    fewest = min(nees.runs for nees in judged.values())
    if not wrong and fewest < needed:
        text = f"Too few runs for a test: {fewest}; sigmas a fifth too small show in {needed}. {said}."
        return Summary(question, "cannot say", "fixed", text, (), (f"Give `--runs {needed}` or more.",))
    if not wrong:
        steps = ("Rely on the sigmas of recordings like this one; another motion or sensor is another study.",)
        return Summary(question, "yes", "good", f"Errors are as large as the sigmas say: {said}.", (), steps)
    steps = ("See below which parameters' ratio of error to sigma is far from 1, and which are biased.",)
    return Summary(question, "NO", "bad", f"Not those of {', '.join(wrong)}: {said}.", (), steps)


_WITHIN = ("within 1 sigma", "2 sigmas", "3 sigmas")


def _consistency_table(study: Study, solvers: Sequence[str]) -> Table:
    rows: list[Row] = []
    for solver in solvers:
        nees, seconds = study.nees(solver), [result["seconds"] for result in study.estimates(solver)]
        rows.append(
            (
                *(solver, str(nees.runs), f"{nees.dof:g}", f"{nees.mean:.4g}", f"{nees.low:.3f} … {nees.high:.3f}"),
                Cell("yes", tone="good") if nees.consistent else Cell("no", tone="bad"),
                *_shares(statistics.coverage(study.normalised(solver))),
                f"{float(np.median(seconds)):.2g}",
                ", ".join(f"{count} {status}" for status, count in study.statuses(solver).items()),
            )
        )
    columns: Columns = (
        *("solver", "runs", "parameters", "mean NEES", Column("99 % interval", wide=True), Column("inside", "text")),
        *(Column(head, group="coverage") for head in (*_WITHIN, "median time, s")),
        Column("verdicts", "text", wide=True, group="coverage"),
    )
    caption = (
        "NEES: squared estimation error in units of the joint covariance; its mean is the number of parameters if the "
        "covariance is right. Normal errors: 68.3 %, 95.4 % and 99.7 % within 1, 2 and 3 sigmas."
    )
    return Table("", caption, columns, tuple(rows), style="many", most_rows=None)


def _accuracy_table(study: Study, solvers: Sequence[str]) -> Table:
    rows: list[Row] = []
    for solver in solvers:
        for name, (a, parameter) in study.accuracies(solver).items():
            unit, factor = shown_unit(parameter["unit"], parameter["require"])
            bias = f"{to_digits_of(factor * a.bias, factor * a.bias_sigma)} ± {rounded(factor * a.bias_sigma)}"
            rows.append(
                (
                    *(Cell(name, hint=method(study.method).describe(name)), solver, unit),
                    Cell(bias, tone="bad" if abs(a.bias) > 3.0 * a.bias_sigma else ""),
                    *(rounded(factor * a.rms, 3), rounded(factor * a.sigma, 3), f"{a.rms / a.sigma:.3g}"),
                    *_shares(a.coverage),
                )
            )
    columns = (
        *("parameter", Column("solver", "text"), Column("unit", "text"), Column("bias", wide=True)),
        *("RMS error", "RMS sigma", "ratio", *_WITHIN),
    )
    caption = (
        "Bias: mean error with its standard error; red beyond three of them. The RMS error should be what the sigmas "
        "predict: a ratio of 1."
    )
    return Table("", caption, columns, tuple(rows), style="many", most_rows=None)


def _shares(coverage: Iterable[float]) -> tuple[str, ...]:
    return tuple(f"{100.0 * share:.1f} %" for share in coverage)


def _nees_plot(study: Study, solver: str) -> Plot:
    found = study.estimates(solver)
    values = np.array([result["nees"] for result in found])
    dof = study.nees(solver).dof
    # Outliers are in the table.
    top = 1.5 * max(float(np.quantile(values, 0.95)), dof + 3.0 * math.sqrt(2.0 * dof))
    out = Figure("runs", "NEES")
    _histogram(out, np.minimum(values, top), 0.0, top, lambda x: _chi_square_density(x, dof), f"chi-square of {dof:g}")
    return Plot(
        f"{solver}: NEES",
        f"Normalised estimation error squared of {len(values)} runs; the line is what true covariances give. "
        f"Those beyond {rounded(top, 3)}, {int((values > top).sum())}, stand in the last bar.",
        out,
    )


def _errors_plot(study: Study, solver: str) -> Plot:
    values = study.normalised(solver)
    out, density = Figure("errors", "error, sigmas"), np.vectorize(NormalDist().pdf, otypes=[float])
    _histogram(out, np.clip(values, -5.0, 5.0), -5.0, 5.0, density, "normal distribution")
    return Plot(
        f"{solver}: errors in sigmas",
        f"{len(values)} errors of all parameters; those beyond 5 sigmas stand in the outer bars.",
        out,
    )


def _histogram(out: Figure, values: Array, low: float, high: float, density: Any, name: str) -> None:
    bars = 30
    counts, edges = np.histogram(values, bins=bars, range=(low, high))
    out.boxes(edges[:-1], edges[1:], np.zeros(bars), counts, "runs" if low == 0.0 else "errors", COLORS[0], alpha=0.7)
    x = np.linspace(low, high, 300)[1:]
    expected = len(values) * (high - low) / bars * density(x)
    out.line(x, expected, name, COLORS[1], width=2.5)


def _chi_square_density(x: Array, dof: float) -> Array:
    half = 0.5 * dof
    return np.asarray(np.exp((half - 1.0) * np.log(x) - 0.5 * x - half * math.log(2.0) - math.lgamma(half)))
