"""The pages of studies and fleets: HTML that opens offline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.analysis import Population, iso
from alidade.pipelines.applications.fleet.attention import Unit, readable, sentence, units_of_interest
from alidade.pipelines.applications.fleet.histories import History
from alidade.pipelines.applications.fleet.statistics import Component
from alidade.pipelines.display.figure import COLORS, REJECTED, Figure, Shape, milliseconds, thin
from alidade.pipelines.display.units import human_unit, rounded, to_digits_of
from alidade.pipelines.estimation.problem import Array, Quantity
from alidade.pipelines.methods import method
from alidade.pipelines.methods.meanings import meaning
from alidade.pipelines.reports.answer import Answer
from alidade.pipelines.reports.result import Plot
from alidade.pipelines.reports.templating import page

if TYPE_CHECKING:
    from alidade.pipelines.applications.fleet.fleet import Outcome
    from alidade.pipelines.applications.fleet.montecarlo import Study
    from alidade.pipelines.applications.fleet.store import Result

# Rows of a list on the page; the CSV has all.
_MOST_LISTED = 200
_MONTH = 30.0
_MOST_BARS = 60


def fleet_html(outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> str:
    """The page of a fleet."""
    results = outcome.results
    attention = units_of_interest(results, fleet, found)
    statuses = [r["status"] for r in results.values()]
    dates = [r["date"] for r in results.values() if r["date"] is not None]
    return page(
        "alidade.pipelines.applications.fleet",
        "fleet.html",
        [_population_plot(p) for p in fleet],
        outcome=outcome,
        counts={status: statuses.count(status) for status in sorted(set(statuses))},
        units=len({r["unit"] for r in results.values()}),
        first=iso(min(dates, default=None)),
        last=iso(max(dates, default=None)),
        several=len(found),
        answer=_attention(attention, len({r["unit"] for r in results.values()}), bool(fleet)),
        attention=attention[:_MOST_LISTED],
        hidden=max(len(attention) - _MOST_LISTED, 0),
        parameters=[_parameter_row(p) for p in fleet],
        methods=len({p.method for p in fleet}),
    )


def _attention(found: Sequence[Unit], units: int, parameters: bool) -> Answer:
    """Which units need attention."""
    question = "Which units need attention?"
    if not found:
        word = "none" if parameters else "cannot say"
        said = f"None of {units} units stands out." if parameters else "No recording gave a calibration to compare."
        step = "Run the same command when there are new recordings; those finished are kept."
        return Answer(question, word, "good" if parameters else "fixed", said, (), (step,))
    steps = (
        "Start with the first in the table: units that changed, then those unlike the others.",
        "Record a unit again before it is sent back: what stands out twice is the unit, not the recording.",
    )
    return Answer(question, f"{len(found)} of {units}", "warn", f"Of {units} units, {sentence(found)}.", (), steps)


def study_html(study: Study) -> str:
    """The page of a Monte Carlo study."""
    solvers = [solver for solver in study.solvers if study.estimates(solver)]
    return page(
        "alidade.pipelines.applications.fleet",
        "montecarlo.html",
        [plot for solver in solvers for plot in (_nees_plot(study, solver), _errors_plot(study, solver))],
        study=study,
        title=method(study.method).title,
        answer=_truth(study, solvers),
        finished=len(study.results),
        rows=[_consistency_row(study, solver) for solver in solvers],
        failures={solver: study.failures(solver) for solver in study.solvers},
        accuracies=[
            _accuracy_row(study, solver, *row) for solver in solvers for row in study.accuracies(solver).items()
        ],
    )


# -- fleets


def _parameter_row(p: Population) -> dict[str, Any]:
    """The cells of a parameter, in the unit people read."""
    unit, factor = readable(p)
    sigma = factor * float(np.median(p.sigmas))
    row: dict[str, Any] = {
        "name": p.name,
        "meaning": meaning(method(p.method), p.name),
        "method": p.method,
        "unit": unit,
        "count": len(p.values),
    }
    row |= {"sigma": rounded(sigma)}
    row |= {"centre": "", "low": "", "high": "", "beyond": "", "drift": "", "drifts": p.drifts}
    row |= {"outlying": int(p.outlying.sum()), "changed": len({p.units[i] for i in np.flatnonzero(p.changed)})}
    row |= {"of": "device" if p.of_device else "recording"}
    row |= {"population": _component(p.population, factor), "repeatability": _component(p.repeatability, factor)}
    if p.spread and p.control:
        scatter = float(np.hypot(factor * p.spread.tau, sigma))
        row["centre"] = to_digits_of(factor * p.spread.centre, scatter)
        low, high = (to_digits_of(factor * bound, scatter) for bound in p.control)
        row |= {"low": low, "high": high, "beyond": p.beyond}
    if p.drift:
        slope, slope_sigma = (_MONTH * factor * number for number in (p.drift.slope, p.drift.sigma))
        row["drift"] = f"{to_digits_of(slope, slope_sigma)} ± {rounded(slope_sigma)}"
    return row


def _component(component: Component | None, factor: float) -> str:
    """A standard deviation with its sigma, or what it is not more than."""
    if component is None:
        return ""
    if component.value == 0.0:
        return f"< {rounded(factor * component.upper)}"
    value, sigma = (to_digits_of(factor * x, factor * component.sigma) for x in (component.value, component.sigma))
    return f"{value} ± {sigma}"


def _population_plot(p: Population) -> Plot:
    unit, factor = readable(p)
    out = Figure(unit, "date", share=0.8, x_scale="datetime")
    counts = Figure("", "recordings", share=0.2, y_shared=True)
    flagged = p.outlying | p.changed
    good = np.flatnonzero(~flagged)
    _add_recordings(out, p, good[thin(len(good))], factor, "recording", COLORS[0])
    edges = np.histogram_bin_edges(factor * p.values, bins=int(np.clip(2.0 * math.sqrt(len(p.values)), 10, _MOST_BARS)))
    told = _add_counts(counts, factor * p.values[good], edges, "recording", COLORS[0])
    if flagged.any():
        _add_recordings(out, p, np.flatnonzero(flagged), factor, "outlying or changed", REJECTED)
        _add_counts(counts, factor * p.values[flagged], edges, "outlying or changed", REJECTED, told)
    if p.spread and p.control:
        out.levels(factor * p.spread.centre, dash="solid")
        out.levels(factor * np.array(p.control), dash="dashed")
    caption = f"{len(p.values)} recordings of {len(set(p.units))} units, with one sigma each"
    limits = "; dashed are the control limits, three standard deviations about the centre" if p.spread else ""
    return Plot(f"{p.name} ({p.method})", f"{caption}{limits}.", out, (counts,))


def _add_recordings(out: Figure, p: Population, some: Any, factor: float, name: str, color: str) -> None:
    dates = milliseconds(iso(p.dates[i]) for i in some)
    values, sigmas = factor * p.values[some], factor * p.sigmas[some]
    out.segments(dates, values - sigmas, dates, values + sigmas, color, name)
    shape: Shape = "x" if color == REJECTED else "circle"
    out.points(dates, values, name, color, 6, shape=shape, texts=[f"{p.units[i]}, {p.recordings[i]}" for i in some])


def _add_counts(
    out: Figure, values: Array, edges: Array, name: str, color: str, below: NDArray[np.intp] | int = 0
) -> NDArray[np.intp]:
    """Bars that lie down beside the values, counted here: the page does not grow with the fleet. Returns their ends."""
    ends = below + np.histogram(values, edges)[0]
    out.boxes(np.broadcast_to(below, ends.shape), ends, edges[:-1], edges[1:], name, color)
    return ends


# -- studies


def _truth(study: Study, solvers: Sequence[str]) -> Answer:
    """Whether the sigmas are true; of the published solver, whose are not its own, nothing is promised."""
    question = "Are the sigmas consistent?"
    judged = {solver: study.nees(solver) for solver in solvers if solver != "published"} or {
        solver: study.nees(solver) for solver in solvers
    }
    if not judged:
        return Answer(
            question, "cannot say", "fixed", "No run gave an estimate.", (), ("See below why the runs failed.",)
        )
    said = ", ".join(
        f"{solver} has a mean NEES of {rounded(nees.mean, 3)} where {nees.dof:g} is right and chance allows "
        f"{rounded(nees.low, 3)} to {rounded(nees.high, 3)}"
        for solver, nees in judged.items()
    )
    wrong = [solver for solver, nees in judged.items() if not nees.consistent]
    if not wrong:
        steps = ("Rely on the sigmas of recordings like this one; another motion or sensor is another study.",)
        return Answer(question, "yes", "good", f"Errors are as large as the sigmas say: {said}.", (), steps)
    steps = ("See below which parameters' ratio of error to sigma is far from 1, and which are biased.",)
    return Answer(question, "no", "bad", f"Not those of {', '.join(wrong)}: {said}.", (), steps)


def _consistency_row(study: Study, solver: str) -> dict[str, Any]:
    nees = study.nees(solver)
    return {
        "solver": solver,
        "nees": nees,
        "coverage": statistics.coverage(study.normalised(solver)),
        "statuses": ", ".join(f"{count} {status}" for status, count in study.statuses(solver).items()),
        "seconds": float(np.median([result["seconds"] for result in study.estimates(solver)])),
    }


def _accuracy_row(study: Study, solver: str, name: str, row: tuple[statistics.Accuracy, Result]) -> dict[str, Any]:
    a, parameter = row
    unit, factor = human_unit(Quantity(name, parameter["unit"], None, 1.0, parameter["require"] or math.inf))
    return {
        "solver": solver,
        "name": name,
        "meaning": meaning(method(study.method), name),
        "unit": unit,
        "bias": f"{to_digits_of(factor * a.bias, factor * a.bias_sigma)} ± {rounded(factor * a.bias_sigma)}",
        "biased": abs(a.bias) > 3.0 * a.bias_sigma,
        "rms": rounded(factor * a.rms, 3),
        "sigma": rounded(factor * a.sigma, 3),
        "ratio": a.rms / a.sigma,
        "coverage": a.coverage,
    }


def _nees_plot(study: Study, solver: str) -> Plot:
    found = study.estimates(solver)
    values = np.array([result["nees"] for result in found])
    dof = study.nees(solver).dof
    # What lies far out is told by the table.
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
    out = Figure("errors", "error, sigmas")
    _histogram(
        out,
        np.clip(values, -5.0, 5.0),
        -5.0,
        5.0,
        np.vectorize(NormalDist().pdf, otypes=[float]),
        "normal distribution",
    )
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
