"""Why residuals do not fit: causes tried for real, each by solving again with the data or the config changed.

    causes = find_causes(method, data, config)      # after a calibration that ended inconsistent
    causes[0].label, causes[0].evidence             # the likeliest

A cause counts when the recording fits with it, or fits far better. Noise is offered where it is said to be known
exactly and nothing else explains: noise large enough fits anything.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.pipelines import parallel
from alidade.pipelines.diagnostics.cross_validation import cut
from alidade.pipelines.diagnostics.observability import Cause
from alidade.pipelines.diagnostics.outcome import Outcome, at_once, outcome, quick_score
from alidade.pipelines.diagnostics.rejection import too_many_rejected
from alidade.pipelines.diagnostics.trial_cases import Trial, faults, trials
from alidade.pipelines.estimation.problem import Estimate, Residuals
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.methods import Method

# Trials are made on this much of a recording, s, where it fits worst, and looked at on less.
_STRETCH, _SHORT = 30.0, 8.0
# Two numbers of one recording differ by more than chance beyond this many sigmas.
_SIGNIFICANT = 5.0
# A change that leaves more than this share of the noise factor explains little.
_BETTER = 0.8
# Noise so many times larger explains anything, and is never offered.
_MOST_NOISE = 4.0
_MOST_NAMED = 3
# How well noise counts as known, in the logarithm, when the recording is asked for it: what it contradicts counts for
# little, and what would be known worse than this could hardly be contradicted.
_KNOWN = 0.1
# How far the typical residual has to fall for a change to be looked at closely.
_PROMISING = 0.97
# A change whose typical residual is so many times the least one's explains nothing that the other does not.
_RIVAL = 3.0
# Noise this far from the one stated is worth a word.
_NOTABLE = 1.1
_WHAT = "looking for causes"


def find_causes(method: Method, data: Any, config: Config, estimate: Estimate | None = None) -> tuple[Cause, ...]:
    """What makes a recording fit that does not, the likeliest first; empty when nothing that was tried does.

    Args:
        method: that read the data.
        data: what the method read.
        config: of the recording.
        estimate: its calibration, which tells where to look; by default the whole is tried.
    """
    hypotheses = method.hypotheses()
    known = config.noise_known == 0.0
    # With the noise stated: levels made to fit hide what is looked for.
    config = config.model_copy(update={"noise_known": 0.0})
    if estimate is not None and hypotheses.cut:
        data = cut(hypotheses, data, *_worst_stretch(estimate.residuals, _STRETCH))
    before = outcome(method, data, config)
    if before is None or (before.fits and not too_many_rejected(before.estimate.residuals)):
        return ()
    found = _explaining(method, _screened(method, data, config, before), before)
    if any(after.fits for after, _ in found):
        found = [each for each in found if each[0].fits]
    if not found:
        last = _explaining(method, faults(hypotheses, data, config, last=True), before)
        found = [each for each in last if each[0].fits]
    if not found and known:
        return _noise(method, data, config)
    return tuple(Cause(label, _evidence(before, after)) for after, label in found[:_MOST_NAMED])


def _explaining(method: Method, tried: Iterable[Trial], before: Outcome) -> list[tuple[Outcome, str]]:
    """The changes that explain the misfit, the best first, each with what is wrong in words."""
    tried, found = list(tried), []
    works = [partial(outcome, method, changed, config) for _, changed, config in tried]
    solved = parallel.done(works, _WHAT, min((at_once(method, changed) for _, changed, _ in tried), default=1))
    for (label, *_), after in zip(tried, solved, strict=True):
        if after is not None and _explains(before, after):
            found.append((after, _named(label, after)))
    return sorted(found, key=lambda each: each[0].factor)


def _screened(method: Method, data: Any, config: Config, before: Outcome) -> list[Trial]:
    """The changes worth a closer look, by the typical residual after a few iterations."""
    hypotheses = method.hypotheses()
    stretch = _worst_stretch(before.estimate.residuals, _SHORT) if hypotheses.cut else (-np.inf, np.inf)
    found = list(trials(method, data, config))
    looked_at = [*((changed, other) for _, changed, other in found), (data, config)]
    short = [(cut(hypotheses, changed, *stretch), other) for changed, other in looked_at]
    works = [partial(quick_score, method, *each) for each in short]
    *scores, as_it_is = parallel.done(works, _WHAT, at_once(method, short[-1][0]))
    enough = min(_PROMISING * as_it_is, _RIVAL * min(scores, default=np.inf))
    return [found[i] for i in np.argsort(scores)[:_MOST_NAMED] if scores[i] < enough]


def _worst_stretch(residuals: Mapping[str, Residuals], length: float) -> tuple[float, float]:
    """Of the residuals' time, the stretch with the largest sum of squares, rejected ones counted in full."""
    time = np.concatenate([r.time for r in residuals.values()])
    square = np.concatenate([(r.whitened**2).sum(axis=1) for r in residuals.values()])
    order = np.argsort(time, kind="stable")
    time, total = time[order], np.append(0.0, np.cumsum(square[order]))
    ends = np.searchsorted(time, time + length)
    first = int(np.argmax(total[ends] - total[: len(time)]))
    start = max(min(time[first], time[-1] - length), time[0])
    return float(start) - 0.1, float(start) + length + 0.1


def _named(label: str, after: Outcome) -> str:
    """With the delays that were found, which stand in it by name."""
    found = zip(after.estimate.names, after.estimate.values, after.estimate.sigmas, strict=True)
    return label.format(**{name: f"{1e3 * value:.3g} ± {1e3 * sigma:.2g} ms" for name, value, sigma in found})


def _explains(before: Outcome, after: Outcome) -> bool:
    """Whether a change makes chi-square fall by far more than chance and to (nearly) what it should be."""
    fall = (before.cost - after.cost) / max(after.factor, 1.0) ** 2
    return fall > _SIGNIFICANT**2 and (after.fits or after.factor < _BETTER * before.factor)


def _evidence(before: Outcome, after: Outcome) -> str:
    fits = "and fits" if after.fits else "and still does not fit"
    return (
        f"with that changed chi-square falls from {before.cost:.4g} to {after.cost:.4g} for {after.rows:.4g} degrees "
        f"of freedom {fits}"
    )


def _noise(method: Method, data: Any, config: Config) -> tuple[Cause, ...]:
    """The noises that are stated too small, as the recording has them; none so large as to explain anything."""
    found = outcome(method, data, config.model_copy(update={"noise_known": _KNOWN}))
    levels = [level for level in found.estimate.levels if level.contradicted] if found is not None else []
    return tuple(
        Cause(
            f"the noise {level.noise.name} is stated {level.scale:.2g} times too small",
            f"the recording says {level.used:.3g} {level.noise.unit}, stated are {level.noise.stated:.3g}",
        )
        for level in sorted(levels, key=lambda level: -level.scale)
        if _NOTABLE < level.scale <= _MOST_NOISE
    )
