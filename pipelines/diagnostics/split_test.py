"""Test whether something changed during a recording, however much: the parts before and after are solved separately.

A change that is large beside the noise leaves no solution of the whole recording to compare anything with: it is
rejected as outliers, or ends in whatever the priors leave free. Both parts fit by themselves. The time is bisected: of
two parts the one without the change fits, and the change is in the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from alidade.pipelines import deadline, parallel
from alidade.pipelines.diagnostics.change_test import Stability
from alidade.pipelines.diagnostics.cross_validation import Build, TrialFit, max_concurrent, solve_trial
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.diagnostics.hypothesis_tests import as_stated, explains, is_near, scaled_fall
from alidade.pipelines.settings import Config

# The time of a change is found to 2^-7 of the recording; where no split explains the misfit yet, to 2^-20, less than a
# sample of hours: an average over a turn that the change is in fits neither part.
_BISECTIONS, _MOST_BISECTIONS = 7, 20
RESOLUTION = 2.0**-_BISECTIONS
# Shorter parts, as a share of the recording, show nothing.
_SHORTEST = 0.02
_SEARCH = "the search for a change"


@dataclass(frozen=True)
class _Split:
    """Separate fits of the parts of a recording before and after a time, s, and whether they explain its misfit."""

    time_s: float
    parts: Sequence[TrialFit]
    explains: bool

    @property
    def cost(self) -> float:
        """Sum of the parts' costs."""
        return sum(part.cost for part in self.parts)


def change_by_parts(
    build: Build, model: FaultModel, data: Any, config: Config, freed: Config | None = None
) -> Stability | None:
    """Find the time at which something changed; None unless that explains why the recording does not fit.

    It has to explain more than `freed` does, the config in which what the recording contradicts is free. Nor is there
    one where the deadline passes before it is found.
    """
    config = as_stated(config)
    before = solve_trial(build, data, config)
    if before is None:
        return None
    best = _bisected(build, model, data, config, before)
    if best is None or not best.explains:
        return None
    without = None if freed is None else solve_trial(build, data, as_stated(freed))
    if deadline.passed(_SEARCH) or (without is not None and without.cost < best.cost):
        return None
    fall = scaled_fall(before, best.parts)
    found = Stability.of_fall(fall, len(before.quantities), 1.0 / RESOLUTION, best.time_s, {})
    return found if found.changed else None


def _bisected(build: Build, model: FaultModel, data: Any, config: Config, before: TrialFit) -> _Split | None:
    """Return the best split, by cost of those that explain the misfit; None where neither half fits.

    Of any two parts the one without the change fits, or what is wrong is not one change.
    """
    best: _Split | None = None
    start, stop = low, high = model.span(data)
    for number in range(_MOST_BISECTIONS):
        if number >= _BISECTIONS and best is not None and best.explains:
            break
        middle = 0.5 * (low + high)
        if min(middle - start, stop - middle) < _SHORTEST * (stop - start):
            break
        segments = [model.segment(data, start, middle), model.segment(data, middle, stop + 1.0)]
        works = [partial(solve_trial, build, part, config, f"change at {middle:.1f} s") for part in segments]
        fits = parallel.done(works, "either side", max_concurrent(model.times(data)))
        parts = [fit for fit in fits if fit is not None]
        if deadline.passed(_SEARCH):  # what has no solution then was not tried
            return None
        if not any(is_near(before, [part]) for part in parts):
            break
        if len(parts) == len(fits):
            split = _Split(middle, parts, explains(before, parts))
            if best is None or (not split.explains, split.cost) < (not best.explains, best.cost):
                best = split
        # A part that has no solution at all is the one with the change.
        first, second = (np.inf if fit is None else fit.factor for fit in fits)
        low, high = (low, middle) if first > second else (middle, high)
    return best
