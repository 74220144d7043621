"""plan.html and what `plan` prints: whether a planned motion suffices, what would be better, error budgets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alidade.pipelines import methods
from alidade.pipelines.display.figure import BEFORE, COLORS, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import human_unit, rounded
from alidade.pipelines.files import plain_json
from alidade.pipelines.reports.calibration_report import direction_blocks
from alidade.pipelines.reports.report import Code, Plots, Report, Section, Summary, Text
from alidade.pipelines.reports.sentences import capital, label, limits

if TYPE_CHECKING:
    from alidade.pipelines.applications.planning import Plan

# Bars of the plot end at so many times the requirement.
_MAX_RATIO = 3.0


def plan_json(plan: Plan) -> str:
    """JSON of `plan`: predicted sigmas now and with all changes, with their budget; what is missing; changes."""
    now, best = plan.now, plan.best
    return plain_json(
        "plan",
        {
            "method": plan.method,
            "status": now.status,
            "duration_s": now.duration,
            "parameters": [
                {
                    "name": q.name,
                    "unit": q.unit,
                    "require": q.require,
                    "sigma": now.sigmas[q.name],
                    "sigma_with_changes": best.sigmas[q.name],
                    "verdict": now.verdicts[q.name],
                    "budget": dict(best.budget.get(q.name, {})),
                }
                for q in now.quantities
                if q.judged
            ],
            "directions": [
                {
                    "verdict": d.severity.name.lower(),
                    "label": label(d.evidence["weights"]),
                    "advice": d.evidence["advice"],
                }
                for d in now.directions
            ],
            "changes": [{"change": step.change, "gain": step.gain} for step in plan.steps],
            "missing": now.missing,
            "missing_with_changes": best.missing,
            "scenario": plan.scenario_text,
        },
    )


def plan_report(plan: Plan) -> Report:
    """The report of a planned motion."""
    title = f"{methods.method(plan.method).title}: a planned motion"
    motion = (
        Code(plan.scenario_text),
        Text("A scenario file for `alidade simulate` and `alidade plan`; what is not in it is as by default."),
    )
    return Report(
        title=title,
        heading=title,
        about=f"{plan.now.duration:.0f} s, predicted from the noise that the scenario states; nothing was recorded.",
        summary=_summary(plan),
        sections=(
            Section("Parameters", (_parameter_table(plan),)),
            Section("Unobservable and weak directions", direction_blocks(plan.now.directions)),
            Section("Plots", (Plots((_plot(plan),)),)),
            Section("The better motion", motion if plan.steps else (), printed="never"),
        ),
    )


def _parameter_table(plan: Plan) -> Table:
    method, now, best = methods.method(plan.method), plan.now.sigmas, plan.best.sigmas
    budgets = {limit.name: limit for limit in limits(plan.best.budget, plan.best.quantities)}
    changed = ("with changes",) if plan.steps else ()
    rows: list[Row] = []
    for q in plan.now.quantities:
        if not q.judged:
            continue
        unit, factor = human_unit(q)
        sigmas = (q.require, now[q.name], *(best[q.name] for _ in changed))
        source, share = budgets[q.name].parts[0] if q.name in budgets else ("", 0.0)
        verdict = plan.now.verdicts[q.name]
        cells: Row = (unit, *(rounded(factor * sigma) for sigma in sigmas), Cell(verdict, tone=verdict))
        largest = f"{source}, {100.0 * share:.0f} %" if source else ""
        rows.append((Cell(q.name, hint=method.describe(q.name)), *cells, largest))
    columns: Columns = (
        *("parameter", Column("unit", "text"), "required", "predicted"),
        *changed,
        *(Column("verdict", "text"), Column("limited by", "text", wide=True)),
    )
    caption = "Required and predicted are standard deviations in the unit of the row."
    return Table("", caption, columns, tuple(rows), "parameters", "dense", None)


def _summary(plan: Plan) -> Summary:
    question, duration = "Does the planned motion determine what is wanted?", plan.now.duration
    if not plan.now.missing:
        fixed = [q.name for q in plan.now.quantities if q.judged and q.prior_sigma == 0.0]
        what = "all free parameters" if fixed else "everything"
        rest = f"; fixed are {', '.join(fixed)}" if fixed else ""
        text = f"This motion, {duration:.0f} s of it, determines {what} as accurately as required{rest}."
        return Summary(question, "yes", "good", text, (), ("Record it.",))
    short = ", ".join(f"{name} by a factor of {rounded(ratio)}" for name, ratio in plan.now.missing.items())
    steps = [f"{capital(step.change)} ({step.gain:.1f} nats of what is missing)." for step in plan.steps]
    if not steps:
        steps = ["None of the changes tried determines what is missing; a tighter prior would."]
    elif plan.best.missing:
        left = ", ".join(f"{name} by {ratio:.2g}" for name, ratio in plan.best.missing.items())
        steps.append(f"Still short with that: {left}.")
    else:
        steps.append(f"With that, {plan.best.duration:.0f} s determine everything as accurately as required.")
    return Summary(question, "no", "bad", f"It falls short of {short}.", (), tuple(steps))


def _plot(plan: Plan) -> Plot:
    """Plot predicted over required sigmas, as planned and with the proposed changes."""
    shown = [q for q in plan.now.quantities if q.judged and q.prior_sigma != 0.0]
    out = Figure("sigma / required", "", x_labels=tuple(q.name for q in shown))
    sides = [("planned", plan.now, BEFORE), *([("with changes", plan.best, COLORS[0])] if plan.steps else [])]
    for i, (name, prediction, color) in enumerate(sides):
        sigmas = prediction.sigmas
        out.bars([min(sigmas[q.name] / q.require, _MAX_RATIO) for q in shown], name, color, (i, len(sides)))
    out.levels(1.0)
    largest = max((mark.columns["high"].max() for mark in out.marks if "high" in mark.columns), default=0.0)
    out.y_range = (0.0, 1.05 * max(1.0, float(largest)))
    caption = (
        "Over those required: below the dotted line a parameter is as accurate as required. "
        f"Bars end at {_MAX_RATIO:g}."
    )
    return Plot("Predicted sigmas", caption, out)
