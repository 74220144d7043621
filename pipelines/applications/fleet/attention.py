"""Units of a fleet that need attention, with the reasons in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from alidade.pipelines.applications.fleet.analysis import Population, iso
from alidade.pipelines.applications.fleet.histories import History
from alidade.pipelines.applications.fleet.store import UnitResult
from alidade.pipelines.diagnostics.device_changes import Change
from alidade.pipelines.display.units import shown_unit, to_digits_of
from alidade.pipelines.reports.joint_report import what

Kind = Literal["changed", "outlying", "failed", "inconsistent", "unobservable", "weak"]
# In the order of how much they matter.
_KINDS: tuple[Kind, ...] = ("changed", "outlying", "inconsistent", "failed", "unobservable", "weak")
_MOST_NAMED = 12


@dataclass(frozen=True)
class Finding:
    """Finding about a unit that stands out; `z` is the distance, sigmas, None for a finding without a distance."""

    kind: Kind
    text: str
    z: float | None = None


@dataclass(frozen=True)
class Unit:
    """Unit of the fleet with its findings, the worst first."""

    name: str
    findings: tuple[Finding, ...]


def units_of_interest(
    results: Mapping[str, UnitResult], fleet: Sequence[Population], found: Sequence[History]
) -> list[Unit]:
    """Return the units that need attention: changed units first, then outliers by distance."""
    units: dict[str, list[Finding]] = {}
    populations = {(p.method, p.name): p for p in fleet}
    for history in found:
        units.setdefault(history.unit, []).extend(_changed(history, populations))
    for p in fleet:
        for i in _farthest(p):
            units.setdefault(p.units[i], []).append(_outlying(p, i))
    for recording, result in results.items():
        if result["status"] != "calibrated":
            reason = result["reason"].removeprefix(f"{recording}: ") or result["status"]
            text = f"{Path(recording).name}, exit code {result['exit_code']}: {reason}"
            units.setdefault(result["unit"], []).append(Finding(result["status"], text))
    sorted_ = [Unit(name, tuple(sorted(each, key=_order))) for name, each in units.items() if each]
    return sorted(sorted_, key=lambda unit: _order(unit.findings[0]))


def sentence(units: Sequence[Unit]) -> str:
    """Sentence that names the units that need attention, the first few of many."""
    if not units:
        return "no unit needs attention"
    more = len(units) - _MOST_NAMED
    named = ", ".join(unit.name for unit in units[:_MOST_NAMED])
    need = "unit needs" if len(units) == 1 else "units need"
    return f"{len(units)} {need} attention: {named}{f' and {more} more' if more > 0 else ''}"


def _order(finding: Finding) -> tuple[int, float]:
    return _KINDS.index(finding.kind), -abs(finding.z or 0.0)


def _changed(history: History, fleet: Mapping[tuple[str, str], Population]) -> list[Finding]:
    def between(after: int) -> str:
        return f"between {_day(history.dates[after])} and {_day(history.dates[after + 1])}"

    def step_text(step: Change) -> str:
        p = fleet[history.method, step.name]
        unit, factor = shown_unit(p.unit, p.require)
        size, sigma = (to_digits_of(factor * x, factor * step.sigma) for x in (step.size, step.sigma))
        return f"{what(step)} by {size} ± {sigma} {unit} ".rstrip() + f" {between(step.after)}"

    jointly = [
        Finding("changed", f"all parameters together {between(after)}, none by more than chance for itself")
        for after in history.together
    ]
    return [*(Finding("changed", step_text(step), step.z) for step in history.found), *jointly]


def _farthest(p: Population) -> list[int]:
    """Return the index of the farthest recording of each outlying unit."""
    far: dict[str, int] = {}
    for i in np.flatnonzero(p.outlying).tolist():
        if abs(p.z[i]) > abs(p.z[far.setdefault(p.units[i], i)]):
            far[p.units[i]] = i
    return list(far.values())


def _outlying(p: Population, i: int) -> Finding:
    assert p.spread is not None  # without one nothing is outlying
    unit, factor = shown_unit(p.unit, p.require)
    off, scale = factor * (p.values[i] - p.spread.centre), factor * float(np.hypot(p.spread.tau, p.sigmas[i]))
    text = f"{p.name} is {to_digits_of(off, scale)} {unit} ".rstrip()
    return Finding("outlying", f"{text} off the fleet's centre ({_day(p.dates[i])})", float(p.z[i]))


def _day(date: float) -> str:
    return (iso(date) or "")[:16].replace("T", " ").removesuffix(" 00:00")
