"""A planned motion as a page: whether it is enough, what would be better, and what limits each parameter."""

from __future__ import annotations

from alidade.pipelines import methods
from alidade.pipelines.applications.planning import Plan
from alidade.pipelines.display.figure import BEFORE, COLORS, Figure
from alidade.pipelines.display.units import human_unit, rounded
from alidade.pipelines.methods.meanings import meaning
from alidade.pipelines.reports.answer import Answer
from alidade.pipelines.reports.budget import limits
from alidade.pipelines.reports.result import Plot
from alidade.pipelines.reports.templating import page


def plan_html(plan: Plan) -> str:
    """The page as one HTML text."""
    method = methods.method(plan.method)
    limited = {limit.name: limit for limit in limits(plan.best.budget, plan.best.quantities)}
    now, best, judged = plan.now.sigmas, plan.best.sigmas, [q for q in plan.now.quantities if q.judged]
    rows = []
    for q in judged:
        unit, factor = human_unit(q)
        sigmas = [rounded(factor * sigma) for sigma in (q.require, now[q.name], best[q.name])]
        source, share = limited[q.name].parts[0] if q.name in limited else ("", 0.0)
        limit = f"{source}, {100.0 * share:.0f} %" if source else ""
        verdict = plan.now.verdicts[q.name]
        rows.append((q.name, meaning(method, q.name), unit, *sigmas, verdict, limit))
    return page(
        "alidade.pipelines.reports",
        "plan.html",
        [_plot(plan)],
        method=method.title,
        duration=plan.now.duration,
        answer=_answer(plan),
        rows=rows,
        better=bool(plan.steps),
        motion=plan.scenario_text,
    )


def _answer(plan: Plan) -> Answer:
    question = "Does the planned motion determine what is wanted?"
    if not plan.now.missing:
        sentence = f"{plan.now.duration:.0f} s of it determine everything as accurately as required."
        return Answer(question, "yes", "good", sentence, (), ("Record it.",))
    short = ", ".join(f"{name} by a factor of {rounded(ratio)}" for name, ratio in plan.now.missing.items())
    steps = [f"{step.change[:1].upper()}{step.change[1:]}." for step in plan.steps]
    if not steps:
        steps = ["None of the changes that were tried determines what is missing; a tighter prior would."]
    elif plan.best.missing:
        steps.append(f"Still short with that: {', '.join(plan.best.missing)}.")
    else:
        steps.append(f"With that, {plan.best.duration:.0f} s determine everything as accurately as required.")
    return Answer(question, "no", "bad", f"It falls short of {short}.", (), tuple(steps))


def _plot(plan: Plan) -> Plot:
    """Sigmas over those required."""
    judged = [q for q in plan.now.quantities if q.judged and q.prior_sigma != 0.0]
    out = Figure("sigma / required", "", x_labels=tuple(q.name for q in judged))
    sides = [("planned", plan.now, BEFORE), *([("with changes", plan.best, COLORS[0])] if plan.steps else [])]
    for i, (name, prediction, color) in enumerate(sides):
        sigmas = prediction.sigmas
        out.bars([min(sigmas[q.name] / q.require, 3.0) for q in judged], name, color, (i, len(sides)))
    out.levels(1.0)
    return Plot(
        "Predicted sigmas",
        "Over those required: below the dotted line a parameter is as accurate as required. Bars end at 3.",
        out,
    )
