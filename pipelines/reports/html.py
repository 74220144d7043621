"""report.html: one file that opens offline.

The page forbids itself any access to the network (Content-Security-Policy), so a report seen anywhere shows what it
shows here.
"""

from __future__ import annotations

import datetime
from contextlib import suppress
from dataclasses import dataclass

from alidade.pipelines.display.units import human_unit, noise_unit, rounded, signed, to_digits_of
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods.meanings import NOISES, meaning
from alidade.pipelines.reports import sentences
from alidade.pipelines.reports.answer import Answer, Tone
from alidade.pipelines.reports.budget import Limit, limits
from alidade.pipelines.reports.calibration import SavedCalibration, saved
from alidade.pipelines.reports.plots import common_plots
from alidade.pipelines.reports.result import Calibration, NoiseResult, Plot, Table, quantities_of, truth_errors
from alidade.pipelines.reports.ros import ros_parameters
from alidade.pipelines.reports.sketch import enlarged, sketch_with, told
from alidade.pipelines.reports.snippets import c_code, python_code
from alidade.pipelines.reports.templating import environment, page

# Beyond so many sigmas of its prior a number says nothing.
_MEANINGLESS = 10.0
# What an input moves by less than this, in sigmas, is not named.
_LEAST_MOVE = 0.1
# So many parameters are named of those that it moves.
_MOST_MOVED = 6


@dataclass(frozen=True)
class _Row:
    """A parameter as people read it."""

    name: str
    meaning: str
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
class _Noise:
    """A noise as people read it, and what is used in SI, as the config has it."""

    name: str
    meaning: str
    unit: str
    source: str
    stated: str
    estimated: str
    sigma: str
    used: str
    used_si: str
    inflation: str


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
    kept = saved(calibration)
    svg = "" if calibration.method.sketch is None else calibration.method.sketch.read_text(encoding="utf-8")
    shown = {name: each for name, each in kept.transforms.items() if f'data-turn="{name}"' in svg}
    sketch = sketch_with(svg, shown)
    found = limits(calibration.budget or {}, calibration.problem.quantities)
    return page(
        "alidade.pipelines.reports",
        "report.html",
        plots,
        c=calibration,
        advice=_advice(calibration),
        method=calibration.method.title,
        start=datetime.datetime.fromtimestamp(facts.epoch_ns // 1_000_000_000, datetime.UTC),
        rows=[row for row in rows if not row.assumed],
        assumptions=[row for row in rows if row.assumed],
        noises=[_noise(each) for each in calibration.noises],
        limits=found,
        advised=_short_of(calibration, found),
        exact=_exact(calibration),
        formulas=[*(formula.text for formula in calibration.formulas), *_constants(calibration)],
        snippets=_snippets(calibration, kept),
        answer=_answer(calibration),
        sketch=sketch,
        turns=[(name, f"{each.child} to {each.parent}", told(each), enlarged(each)) for name, each in shown.items()],
        stability=_stability(calibration),
        signed=signed,
        tables=[each for each in own if isinstance(each, Table)],
    )


def _constants(calibration: Calibration) -> list[str]:
    """The numbers of the recording that formulas need, as formulas; those that are in none left out."""
    needed = " ".join(formula.expression for formula in calibration.formulas)
    return [f"{name} = {value:.6g}" for name, value in calibration.problem.constants.items() if name in needed]


_TONES: dict[str, Tone] = {"calibrated": "good", "weak": "warn", "unobservable": "bad", "inconsistent": "bad"}


def _answer(calibration: Calibration) -> Answer:
    """The verdict, and what follows from it."""
    found, question = calibration.status, "Is it as accurate as required, and does it fit the recording?"
    steps = sentences.next_steps(calibration.findings)
    return Answer(question, found, _TONES[found], calibration.headline, calibration.notes, steps)


def _advice(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Verdict, parameters and advice of weak directions, those with the same advice together."""
    return [
        (severity.name.lower(), labels, sentences.capital(what))
        for severity in (Severity.UNOBSERVABLE, Severity.WEAK)
        for labels, what in sentences.by_advice(calibration.findings, severity)
    ]


def _snippets(calibration: Calibration, kept: SavedCalibration) -> list[tuple[str, str]]:
    """Language -> what to copy; of formulas that only a person can read, none."""
    parameters = calibration.parameters
    values = {name: parameters[name].value for name in calibration.applied if name in parameters}
    numbers = {**calibration.problem.constants, **values}
    code: list[tuple[str, str]] = []
    # A method that is installed may have its own way of writing formulas.
    with suppress(ValueError, KeyError, SyntaxError):
        code = [(name, make(calibration.formulas, numbers)) for name, make in _LANGUAGES.items()]
    return [*code, ("ROS 2 parameters", ros_parameters(kept, list(values)))]


_LANGUAGES = {"Python": python_code, "C": c_code}


def _stability(calibration: Calibration) -> str:
    """The result of the test for a change; empty where it was not made."""
    found = calibration.stability
    if found is None:
        return ""
    changes = [
        sentences.sentence(f, calibration.quantities) for f in calibration.findings if f.kind in ("change", "jump")
    ]
    if changes:
        return changes[0]
    name = next(iter(found.departures), "")
    return (
        f"No significant change: the largest is at {found.time_s:.0f} s, mostly of {name} "
        f"(p = {min(found.level, 1.0):.2g})."
    )


def _short_of(calibration: Calibration, found: list[Limit]) -> list[str]:
    """What limits the parameters that are not as accurate as required; where all are, the one that is nearest to it."""
    of = {p.name: p.sigma / p.require for p in calibration.parameters.values() if p.require}
    known = [limit for limit in found if limit.name in of]
    short = [limit for limit in known if of[limit.name] > 1.0]
    told = short or sorted(known, key=lambda limit: -of[limit.name])[:1]
    return [limit.sentence for limit in told]


def _noise(found: NoiseResult) -> _Noise:
    unit, factor = noise_unit(found.name, found.unit)
    return _Noise(
        name=found.name,
        meaning=NOISES.get(found.name, ""),
        unit=unit,
        source=found.source,
        stated=rounded(factor * found.stated, 3),
        estimated="" if found.estimated is None else rounded(factor * found.estimated, 3),
        sigma="" if found.sigma is None else rounded(factor * found.sigma, 1),
        used=rounded(factor * found.used, 3),
        used_si="" if factor == 1.0 else f"{found.used:.3g} {found.unit}",
        inflation=f"{found.inflation:.2f}" if found.inflation > 1.0 else "",
    )


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
        found.append(_Exact(name, off_by, ", ".join([*told, *rest]) or "nothing noticeably"))
    return found


def _moved(quantity: Quantity, move: float, sigma: float) -> str:
    unit, factor = human_unit(quantity)
    size = f"{to_digits_of(factor * move, factor * sigma)} {unit}".strip()
    return f"{quantity.name} {signed(move / sigma)} σ ({size})"


def notebook_html(calibration: Calibration) -> str:
    """The parameters and the verdict as a fragment of HTML, for notebooks."""
    template = environment("alidade.pipelines.reports").get_template("notebook.html")
    return template.render(c=calibration, rows=_rows(calibration))


def _rows(calibration: Calibration) -> list[_Row]:
    errors = truth_errors(calibration)
    rows = []
    quantities = quantities_of(calibration.problem, calibration.estimate)
    for q, p in zip(quantities, calibration.parameters.values(), strict=True):
        unit, factor = human_unit(q)
        known = p.sigma < _MEANINGLESS * q.scale
        error = errors.get(p.name)
        in_sigmas = f" ({signed(error.error_sigmas)} σ)" if error and error.error_sigmas is not None and known else ""
        rows.append(
            _Row(
                name=p.name,
                meaning=meaning(calibration.method, p.name),
                value=to_digits_of(factor * p.value, factor * p.sigma) if known else "unknown",
                sigma=to_digits_of(factor * p.sigma, factor * p.sigma) if known else "unknown",
                unit=unit,
                prior="free" if p.prior_sigma is None else rounded(factor * p.prior_sigma, 3),
                require="" if p.require is None else rounded(factor * p.require, 3),
                verdict=p.observability or "",
                assumed=p.group is not None,
                pull="" if p.pull is None else signed(p.pull),
                error=to_digits_of(factor * error.error, factor * p.sigma) + in_sigmas if error and known else "",
            )
        )
    return rows
