"""Guidance for the person recording: current estimate, data collected, and data still missing."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.change_test import change_finding, stability
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.diagnose import misfits
from alidade.pipelines.diagnostics.observability import Advise, Verdict, finite_covariance, verdicts, weak_directions
from alidade.pipelines.display.units import human_unit, rounded, to_digits_of
from alidade.pipelines.estimation.finding import Finding, Motion, Severity, by_severity, status
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.reports import sentences
from alidade.pipelines.solvers.incremental import IncrementalSolver

# Parameters a sentence names.
_MOST_NAMED = 6
# Of many parameters so many are shown, the least accurate ones.
_MOST_SHOWN = 14
# How a sentence begins that says why there is no estimate yet.
WAITING = "not enough yet: "
_BEGIN_ANEW = Motion("look what moved, and begin anew")


@dataclass(frozen=True)
class View:
    """State of the calibration of a recording that is being followed.

    Attributes:
        time: s from the session's start up to which the recording was taken.
        epoch_ns: the session's start, Unix ns.
        quantities: what is calibrated.
        values: (n,) of them, as estimated by now; None while there is too little.
        covariance: (n, n) of them; None while there is too little.
        checklist: what there is of what the method needs.
        change: finding on a material change of what is calibrated, since the recording began; None: none was found.
        findings: on the estimate, the most severe first.
        advise: weights of a direction -> motion that would determine it.
    """

    time: float
    epoch_ns: int
    quantities: tuple[Quantity, ...]
    values: Array | None
    covariance: Array | None
    checklist: tuple[ChecklistItem, ...]
    change: Finding | None = None
    findings: tuple[Finding, ...] = ()
    advise: Advise | None = None

    @property
    def sigmas(self) -> Array | None:
        """Standard deviations (n,) of the estimate; None without one."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Parameter -> verdict, of those with a required accuracy; empty while there are too few data."""
        if self.covariance is None or self.values is None:
            return {}
        return verdicts(self.quantities, self.covariance, self.findings, self.values)

    @property
    def status(self) -> str:
        """Status of the estimate; "initialising" until there is one, with noise levels found."""
        return "initialising" if self.covariance is None else status(self.findings)

    @property
    def short(self) -> tuple[str, ...]:
        """Names of the parameters that have not reached their required accuracy."""
        if self.covariance is None:
            return tuple(q.name for q in self.quantities if q.prior_sigma != 0.0)
        return tuple(name for name, verdict in self.verdicts.items() if verdict in ("weak", "unobservable"))

    @property
    def done(self) -> bool:
        """Whether the recording, not priors alone, gives every parameter its required accuracy, and none changed."""
        return self.status == "calibrated" and self.change is None

    @property
    def missing(self) -> tuple[str, ...]:
        """Sentences about data to collect, then about motions to make, each once, in the order of `motion`."""
        wanted = tuple(f"{c.what}: {c.wanted}" for c in self.checklist if c.wanted)
        advice = tuple(finding.evidence["advice"] for finding in self._directions)
        return tuple(dict.fromkeys((*wanted, *advice)))

    @property
    def motion(self) -> Motion | None:
        """Motion to make now: for missing data, then for the weakest direction; None: continue as now."""
        if self.change is not None:
            return _BEGIN_ANEW
        if self.done:
            return None
        wanted = (c.motion for c in self.checklist if c.wanted and c.motion is not None)
        weak = (self.advise(finding.evidence["weights"]) for finding in self._directions if self.advise is not None)
        return next(chain(wanted, weak), None)

    @property
    def _directions(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.kind == "direction")

    @property
    def alarms(self) -> tuple[str, ...]:
        """Sentences about what is wrong with the recording, as opposed to missing."""
        if self.change is not None:
            return (self.headline,)
        return (self._verdict,) if self.status == "inconsistent" else ()

    @property
    def shown(self) -> tuple[int, ...]:
        """Indexes of the parameters to show: all that are estimated, or those farthest from their required accuracy."""
        rows = [i for i, q in enumerate(self.quantities) if _is_estimated(q)]
        if self.sigmas is None:
            return tuple(rows[:_MOST_SHOWN])
        ratio = self.sigmas / np.array([q.require for q in self.quantities])
        return tuple(sorted(sorted(rows, key=lambda i: -ratio[i])[:_MOST_SHOWN]))

    @property
    def rows(self) -> list[dict[str, str]]:
        """Name, unit and required sigma of the parameters to show, and value, sigma and verdict once there are some."""
        rows, verdicts = [], self.verdicts
        for i in self.shown:
            q = self.quantities[i]
            unit, factor = human_unit(q)
            row = {"name": q.name, "unit": unit, "require": rounded(factor * q.require)}
            if self.values is not None and self.sigmas is not None:
                value, sigma = factor * float(self.values[i]), factor * float(self.sigmas[i])
                row |= {"value": to_digits_of(value, sigma), "sigma": rounded(sigma), "verdict": verdicts[q.name]}
            rows.append(row)
        return rows

    @property
    def estimated(self) -> tuple[str, ...]:
        """Names of the parameters that the recording is to determine."""
        return tuple(q.name for q in self.quantities if _is_estimated(q))

    @property
    def summary(self) -> dict[str, Any]:
        """State as a mapping of words and numbers, as clients receive it."""
        return {
            "time_s": self.time,
            "status": self.status,
            "headline": self.headline,
            "missing": list(self.missing),
            "collected": [{"what": c.what, "have": c.have, "wanted": c.wanted} for c in self.checklist],
        }

    @property
    def headline(self) -> str:
        """The state in one sentence."""
        if self.covariance is None:
            return "not enough yet for an estimate"
        if self.change is not None:
            when = datetime.fromtimestamp(self.epoch_ns * 1e-9 + self.change.evidence["time_s"], UTC)
            text = sentences.sentence(self.change, {q.name: q for q in self.quantities})
            return f"{text} It was {when:%H:%M:%S} UTC: {_BEGIN_ANEW.words}"
        if self.done:
            return "the accuracy wanted is reached: recording may end"
        if not self.short:
            return self._verdict
        more = len(self.short) - _MOST_NAMED
        names = ", ".join(self.short[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
        return f"not yet as accurate as required: {names}"

    @property
    def _verdict(self) -> str:
        return sentences.headline(self.findings, {q.name: q for q in self.quantities}, self.verdicts)


class Watch:
    """Watches whether the parameters that a run calibrates stay constant.

    Attributes:
        change: finding on a material change, as of the last look; None: none was found.
    """

    def __init__(self) -> None:
        self._seen: tuple[IncrementalSolver, int] | None = None  # the run, and its moments at the last look
        self.change: Finding | None = None

    def look(self, run: IncrementalSolver) -> None:
        """Test for a change of the parameters, if the run has advanced since the last test."""
        now = run, run.moments
        if not run.started or now == self._seen:
            return
        self._seen = now
        quantities = run.problem.quantities
        found = stability(run.estimate(), quantities)
        finding = None if found is None or not found.changed else change_finding(found, {}, quantities)
        # What moves nothing that is required is a note of the result, and in its sigmas.
        self.change = finding if finding is not None and finding.severity > Severity.NOTE else None


def _is_estimated(q: Quantity) -> bool:
    return q.judged and q.prior_sigma != 0.0


def view_of(
    epoch_ns: int, run: IncrementalSolver, checklist: tuple[ChecklistItem, ...], change: Finding | None = None
) -> View:
    """Return the current view of an incremental run."""
    quantities, advise = run.problem.quantities, run.problem.advice
    time = run.time if np.isfinite(run.time) else 0.0
    if not run.started:
        return View(time, epoch_ns, quantities, None, None, checklist, change)
    covariance, values = finite_covariance(quantities, run.covariance()), run.values()
    weak = weak_directions(quantities, covariance, advise, values)
    findings = by_severity([*weak, *misfits(run.chi_square(), run.state.levels)])
    return View(time, epoch_ns, quantities, values, covariance, checklist, change, findings, advise)
