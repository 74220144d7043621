"""What the person recording is told: what is known by now, what has been collected, and what is still missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.graph.problem import Array, Quantity
from pipelines.judgement.checklist import ChecklistItem
from pipelines.judgement.observability import Assessment, assess
from pipelines.solvers.incremental import Run

# Parameters a sentence names.
_MOST_NAMED = 6


@dataclass(frozen=True)
class View:
    """The state of a recording being followed.

    Attributes:
        time: s from the session's start up to which the recording was taken.
        epoch_ns: the session's start, Unix ns.
        quantities: what is calibrated.
        values: (n,) of them, as estimated by now; None while there is too little.
        assessment: of that estimate.
        checklist: what there is of what the method needs.
    """

    time: float
    epoch_ns: int
    quantities: tuple[Quantity, ...]
    values: Array | None
    assessment: Assessment | None
    checklist: tuple[ChecklistItem, ...]

    @property
    def sigmas(self) -> Array | None:
        """(n,) standard deviations."""
        return None if self.assessment is None else self.assessment.sigmas

    @property
    def short(self) -> tuple[str, ...]:
        """The parameters whose accuracy wanted is not reached."""
        if self.assessment is None:
            return tuple(q.name for q in self.quantities if q.prior_sigma != 0.0)
        return tuple(name for name, verdict in self.assessment.verdicts.items() if verdict in ("weak", "unobservable"))

    @property
    def done(self) -> bool:
        """Whether every parameter is as accurate as required, by what was recorded and not by its prior alone."""
        return self.assessment is not None and self.assessment.status == "calibrated"

    @property
    def missing(self) -> tuple[str, ...]:
        """What to do, the most urgent first, each sentence once."""
        advice = () if self.assessment is None else tuple(d.advice for d in self.assessment.directions)
        wanted = tuple(f"{c.what}: {c.wanted}" for c in self.checklist if c.wanted)
        return tuple(dict.fromkeys((*advice, *wanted)))

    @property
    def headline(self) -> str:
        """The state in one sentence."""
        if self.assessment is None:
            return "not enough yet for an estimate"
        if self.done:
            return "the accuracy wanted is reached: recording may end"
        if not self.short:
            return self.assessment.headline
        more = len(self.short) - _MOST_NAMED
        names = ", ".join(self.short[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
        return f"not yet as accurate as required: {names}"


def view_of(epoch_ns: int, run: Run, checklist: tuple[ChecklistItem, ...]) -> View:
    """The view of a run so far."""
    quantities = run.problem.quantities
    values, assessment = None, None
    if run.started:
        values = run.values()
        assessment = assess(quantities, run.covariance(), run.chi_square(), run.problem.advice)
    time = run.time if np.isfinite(run.time) else 0.0
    return View(time, epoch_ns, quantities, values, assessment, checklist)
