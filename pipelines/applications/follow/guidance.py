"""What the person recording is told: what is known by now, what has been collected, and what is still missing."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from typing import Any

import numpy as np

from alidade.pipelines.diagnostics import noise_levels
from alidade.pipelines.diagnostics.change_test import Stability, stability
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.observability import Assessment, assess
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.estimation.problem import Array, Quantity
from alidade.pipelines.solvers.incremental import Run

# Parameters a sentence names.
_MOST_NAMED = 6
# Of many parameters so many are shown, the least accurate ones.
_MOST_SHOWN = 14
_BEGIN_ANEW = Motion("look what moved, and begin anew")


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
        change: in what is calibrated, since the recording began; None: none was found.
    """

    time: float
    epoch_ns: int
    quantities: tuple[Quantity, ...]
    values: Array | None
    assessment: Assessment | None
    checklist: tuple[ChecklistItem, ...]
    change: Stability | None = None

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
        return self.assessment is not None and self.assessment.status == "calibrated" and self.change is None

    @property
    def missing(self) -> tuple[str, ...]:
        """What to do, the most urgent first, each sentence once."""
        advice = () if self.assessment is None else tuple(d.advice for d in self.assessment.directions)
        wanted = tuple(f"{c.what}: {c.wanted}" for c in self.checklist if c.wanted)
        return tuple(dict.fromkeys((*advice, *wanted)))

    @property
    def motion(self) -> Motion | None:
        """What to do now: to collect what is missing, then to determine the worst direction; None: go on as now."""
        if self.change is not None:
            return _BEGIN_ANEW
        if self.done:
            return None
        wanted = (c.motion for c in self.checklist if c.wanted and c.motion is not None)
        weak = () if self.assessment is None else (d.motion for d in self.assessment.directions)
        return next(chain(wanted, weak), None)

    @property
    def alarms(self) -> tuple[str, ...]:
        """What is wrong with the recording rather than missing in it, sentences."""
        if self.change is not None:
            return (self.headline,)
        if self.assessment is not None and self.assessment.status == "inconsistent":
            return (self.assessment.headline,)
        return ()

    @property
    def shown(self) -> tuple[int, ...]:
        """Rows of the parameters to be shown: all that are estimated, or those furthest from what is required."""
        rows = [i for i, q in enumerate(self.quantities) if _is_estimated(q)]
        if self.sigmas is None:
            return tuple(rows[:_MOST_SHOWN])
        ratio = self.sigmas / np.array([q.require for q in self.quantities])
        return tuple(sorted(sorted(rows, key=lambda i: -ratio[i])[:_MOST_SHOWN]))

    @property
    def estimated(self) -> tuple[str, ...]:
        """The parameters that are to be determined."""
        return tuple(q.name for q in self.quantities if _is_estimated(q))

    @property
    def summary(self) -> dict[str, Any]:
        """The state in words, as clients are told it."""
        return {
            "time_s": self.time,
            "status": "" if self.assessment is None else self.assessment.status,
            "headline": self.headline,
            "missing": list(self.missing),
            "collected": [{"what": c.what, "have": c.have, "wanted": c.wanted} for c in self.checklist],
        }

    @property
    def headline(self) -> str:
        """The state in one sentence."""
        if self.assessment is None:
            return "not enough yet for an estimate"
        if self.change is not None:
            when = datetime.fromtimestamp(self.epoch_ns * 1e-9 + self.change.time_s, UTC)
            return f"{self.change.sentence} It was {when:%H:%M:%S} UTC: {_BEGIN_ANEW.words}"
        if self.done:
            return "the accuracy wanted is reached: recording may end"
        if not self.short:
            return self.assessment.headline
        more = len(self.short) - _MOST_NAMED
        names = ", ".join(self.short[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
        return f"not yet as accurate as required: {names}"


class Watch:
    """Whether what a run calibrates stays as it is.

    Attributes:
        change: as of the last look; None: none was found.
    """

    def __init__(self) -> None:
        self._seen: tuple[Run, int] | None = None  # the run, and its moments at the last look
        self.change: Stability | None = None

    def look(self, run: Run) -> None:
        """Look again if the run has come to another moment since."""
        now = run, run.moments
        if not run.started or now == self._seen:
            return
        self._seen = now
        found = stability(run.estimate(), run.problem.quantities)
        self.change = found if found is not None and found.changed else None


def _is_estimated(q: Quantity) -> bool:
    return q.judged and q.prior_sigma != 0.0


def view_of(epoch_ns: int, run: Run, checklist: tuple[ChecklistItem, ...], change: Stability | None = None) -> View:
    """The view of a run so far."""
    quantities = run.problem.quantities
    values, assessment = None, None
    if run.started:
        values = run.values()
        decides = not noise_levels.asked(run.levels)
        assessment = assess(quantities, run.covariance(), run.chi_square(), run.problem.advice, decides)
    time = run.time if np.isfinite(run.time) else 0.0
    return View(time, epoch_ns, quantities, values, assessment, checklist, change)
