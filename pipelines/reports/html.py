"""report.html: one file that opens offline.

The page forbids itself any access to the network (Content-Security-Policy), so a report seen anywhere shows what it
shows here.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass

from pipelines.graph.problem import Quantity
from pipelines.judgement.observability import by_advice
from pipelines.reports.budget import Limit, limits
from pipelines.reports.plots import common_plots
from pipelines.reports.result import Calibration, Plot, Table, quantities_of, truth_errors
from pipelines.reports.templating import environment, page
from pipelines.reports.units import human_unit, to_digits_of

# Beyond so many sigmas of its prior a number says nothing.
_MEANINGLESS = 10.0
# What an input moves by less than this, in sigmas, is not worth a word.
_LEAST_MOVE = 0.1
# So many parameters are named of those that it moves.
_MOST_MOVED = 6


@dataclass(frozen=True)
class _Row:
    """A parameter as people read it."""

    name: str
    value: str
    sigma: str
    unit: str
    prior: str
    require: str
    verdict: str
    assumed: bool
    pull: str
    error: str


@dataclass(frozen=True)
class _Exact:
    """An input taken for exact and what it does to parameters if it is off by what it usually is."""

    name: str
    off_by: str
    moves: str


def report_html(calibration: Calibration) -> str:
    """The report as one HTML text."""
    own = list(calibration.plots(calibration)) if calibration.plots else []
    plots = [*(each for each in own if isinstance(each, Plot)), *common_plots(calibration)]
    facts, rows = calibration.facts, _rows(calibration)
    found = limits(calibration.budget or {}, calibration.problem.quantities)
    return page(
        "pipelines.reports",
        "report.html",
        plots,
        c=calibration,
        by_advice=by_advice,
        method=calibration.method.title,
        start=datetime.datetime.fromtimestamp(facts.epoch_ns // 1_000_000_000, datetime.UTC),
        rows=[row for row in rows if not row.assumed],
        assumptions=[row for row in rows if row.assumed],
        noises=calibration.noises,
        limits=found,
        advised=_short_of(calibration, found),
        exact=_exact(calibration),
        formulas=[*(formula.text for formula in calibration.formulas), *_constants(calibration)],
        tables=[each for each in own if isinstance(each, Table)],
    )


def _constants(calibration: Calibration) -> list[str]:
    """The numbers of the recording that formulas need, as formulas; those that are in none left out."""
    needed = " ".join(formula.expression for formula in calibration.formulas)
    return [f"{name} = {value:.6g}" for name, value in calibration.problem.constants.items() if name in needed]


def _short_of(calibration: Calibration, found: list[Limit]) -> list[str]:
    """What limits the parameters that are not as accurate as required; where all are, the one that is nearest to it."""
    of = {p.name: p.sigma / p.require for p in calibration.parameters.values() if p.require}
    known = [limit for limit in found if limit.name in of]
    short = [limit for limit in known if of[limit.name] > 1.0]
    told = short or sorted(known, key=lambda limit: -of[limit.name])[:1]
    return [limit.sentence for limit in told]


def _exact(calibration: Calibration) -> list[_Exact]:
    """The inputs that are taken for exact, each with the parameters that it moves by more than a trifle."""
    quantities = {q.name: q for q in calibration.problem.quantities if not q.assumed}
    found = []
    for name, sensitivity in (calibration.sensitivity or {}).items():
        step, unit = sensitivity.step, sensitivity.unit
        sigmas = {p: calibration.parameters[p].sigma for p in quantities if p in sensitivity.parameters}
        moves = {p: step * sensitivity.parameters[p] for p in sigmas}
        worth = [p for p in moves if abs(moves[p]) > _LEAST_MOVE * sigmas[p]]
        worth.sort(key=lambda p: -abs(moves[p]) / sigmas[p])
        told = [_moved(quantities[p], moves[p], sigmas[p]) for p in worth[:_MOST_MOVED]]
        rest = [f"{len(worth) - len(told)} more by less"] if len(worth) > len(told) else []
        off_by = f"{100.0 * step:g} %" if unit == "1" else f"{step:g} {unit}"
        found.append(_Exact(name, off_by, ", ".join([*told, *rest]) or "nothing worth a word"))
    return found


def _moved(quantity: Quantity, move: float, sigma: float) -> str:
    unit, factor = human_unit(quantity)
    size = f"{to_digits_of(factor * move, factor * sigma)} {unit.removeprefix('1')}".strip()
    return f"{quantity.name} {move / sigma:+.1f} σ ({size})"


def notebook_html(calibration: Calibration) -> str:
    """The parameters and the verdict as a fragment of HTML, for notebooks."""
    template = environment("pipelines.reports").get_template("notebook.html")
    return template.render(c=calibration, rows=_rows(calibration))


def _rows(calibration: Calibration) -> list[_Row]:
    errors = truth_errors(calibration)
    rows = []
    quantities = quantities_of(calibration.problem, calibration.estimate)
    for q, p in zip(quantities, calibration.parameters.values(), strict=True):
        unit, factor = human_unit(q)
        known = p.sigma < _MEANINGLESS * q.scale
        error = errors.get(p.name)
        in_sigmas = f" ({error.error_sigmas:+.1f} σ)" if error and error.error_sigmas is not None and known else ""
        rows.append(
            _Row(
                name=p.name,
                value=to_digits_of(factor * p.value, factor * p.sigma) if known else "unknown",
                sigma=to_digits_of(factor * p.sigma, factor * p.sigma) if known else "unknown",
                unit=unit,
                prior="free" if p.prior_sigma is None else f"{factor * p.prior_sigma:.3g}",
                require="" if p.require is None else f"{factor * p.require:.3g}",
                verdict=p.observability or "",
                assumed=p.group is not None,
                pull="" if p.pull is None else f"{p.pull:+.1f}",
                error=to_digits_of(factor * error.error, factor * p.sigma) + in_sigmas if error and known else "",
            )
        )
    return rows
