"""Output of the commands with --json: SI, and null where a number is not finite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from alidade.pipelines.diagnostics.cross_validation import peak, rms
from alidade.pipelines.reports.sentences import label

if TYPE_CHECKING:
    from alidade.pipelines.applications.apply import Applied
    from alidade.pipelines.applications.discovery import Suggestion
    from alidade.pipelines.applications.planning import Plan
    from alidade.pipelines.applications.table_discovery import Columns
    from alidade.pipelines.applications.validate import Validated
    from alidade.pipelines.recording.topics import SessionFacts


def plain_json(kind: str, content: Mapping[str, Any]) -> str:
    """JSON text of a command's result, under its schema `alidade.<kind>/1`."""
    from pydantic_core import to_json

    return to_json({"schema": f"alidade.{kind}/1", **content}, indent=1, inf_nan_mode="null").decode()


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


def applied_json(applied: Applied) -> str:
    """JSON of `apply`: the file, its corrected topics, notes."""
    topics = [
        {
            "name": topic.name,
            "recorded": topic.recorded,
            "sensors": topic.sensors,
            "messages": len(topic.messages),
            "frame_id": topic.messages.frame_id,
        }
        for topic in applied.topics
    ]
    return plain_json("applied", {"file": str(applied.path), "topics": topics, "notes": applied.notes})


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


def facts_json(
    facts: SessionFacts, found: Sequence[Suggestion], unused: Sequence[str], columns: Columns | None = None
) -> str:
    """JSON of `info`: the facts, and what each method has, lacks and could use."""
    suggested = {suggestion.method: suggestion for suggestion in found}
    content = asdict(facts)
    proposed = content.pop("proposed")
    content["methods"] = {
        name: {
            "served": not missing,
            "missing": missing,
            "proposed": proposed.get(name, ()),
            "suggested": {key: source.model_dump() for key, source in suggested[name].topics.items()}
            if name in suggested
            else {},
            "reasons": suggested[name].reasons if name in suggested else (),
            "still_missing": suggested[name].missing if name in suggested else missing,
        }
        for name, missing in content.pop("missing").items()
    }
    if columns is not None:
        tables = {topic: table.model_dump(exclude_defaults=True) for topic, table in columns.columns.items()}
        content["columns"] = {"columns": tables, "reasons": list(columns.reasons), "doubts": list(columns.doubts)}
    return plain_json("info", content | {"unused": list(unused)})
