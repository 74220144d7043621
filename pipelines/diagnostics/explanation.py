"""An assessment with what does not fit, and why that may be, in words and the units people read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from alidade.pipelines import progress
from alidade.pipelines.diagnostics import noise_levels
from alidade.pipelines.diagnostics.assumptions import Strained, strained
from alidade.pipelines.diagnostics.change_test import Moved
from alidade.pipelines.diagnostics.observability import Assessment, Cause
from alidade.pipelines.diagnostics.rejection import rejection_sentence, too_many_rejected
from alidade.pipelines.display.units import human_unit, to_digits_of
from alidade.pipelines.estimation.problem import Estimate, Quantity

# Assumptions that do not hold, and steps between the two sides of a change, that are told.
_MOST_NAMED = 3


@dataclass
class Causes:
    """What may be wrong with a recording, looked for once."""

    look: Callable[[Estimate], tuple[Cause, ...]]
    found: tuple[Cause, ...] | None = None

    def of(self, estimate: Estimate) -> tuple[Cause, ...]:
        """As the first estimate that is asked about has them."""
        if self.found is None:
            with progress.doing("looking for causes"):
                self.found = self.look(estimate)
        return self.found


def explained(assessment: Assessment, estimate: Estimate, quantities: Sequence[Quantity], causes: Causes) -> Assessment:
    """An assessment with what does not fit, and why that may be."""
    counts = {family: len(r.time) for family, r in estimate.residuals.items()}
    wrong_noise = noise_levels.misfit(estimate.levels, assessment.consistency, estimate.colours, counts)
    misfit = assessment.status == "inconsistent" or bool(wrong_noise) or too_many_rejected(estimate.residuals)
    doubtful = misfit or noise_levels.suspicious(estimate.levels, estimate.colours, counts)
    found = causes.of(estimate) if doubtful or not estimate.converged else ()
    if not estimate.converged:
        return assessment.unsolved(estimate.message).explained(found)
    rejected, assumed = rejection_sentence(estimate.residuals), _not_as_assumed(strained(estimate, quantities))
    if misfit or found:
        reasons = filter(None, [wrong_noise, rejected])
        return assessment.misfit(" ".join(reasons)).explained(_first(found, assumed))
    return assessment.remarked(rejected).explained(assumed)


def _first(tried: Sequence[Cause], assumed: Sequence[Cause]) -> list[Cause]:
    """A fault that explains everything goes before an assumption that it strains, noise that does so after it."""
    faults = [cause for cause in tried if not cause.label.startswith("the noise ")]
    return [*faults, *assumed, *(cause for cause in tried if cause not in faults)]


def _not_as_assumed(found: Sequence[Strained]) -> list[Cause]:
    """Assumptions that do not hold, as causes, in the units people read."""
    causes = []
    for each in found[:_MOST_NAMED]:
        q, (unit, factor) = each.quantity, human_unit(each.quantity)
        like = f" (or {', '.join(each.others)}, which it cannot be told from)" if each.others else ""
        sigma, prior = factor * each.sigma, factor * (q.prior_sigma or 0.0)
        value, mean = factor * each.value, factor * q.prior_mean
        found_ = f"{to_digits_of(value, sigma) if mean else f'{value:.3g}'} ± {sigma:.1g} {unit}".strip()
        assumed = f"{to_digits_of(mean, prior) if mean else '0'} ± {prior:.2g} {unit}".strip()
        evidence = f"estimated as {found_} where {assumed} was assumed, a pull of {abs(each.pull):.1f}"
        causes.append(Cause(f"{each.quantity.name} is not what was assumed{like}", evidence))
    return causes


def told_steps(moved: Moved, quantities: Sequence[Quantity]) -> str:
    """The largest steps in the units people read, and what a small one does; empty where the sides say nothing."""
    if not moved.steps:
        return ""
    units = {q.name: human_unit(q) for q in quantities}
    steps = [
        f"{name} by {units[name][1] * step:.2g} ± {units[name][1] * sigma:.1g} {units[name][0]}"
        for name, (step, sigma) in list(moved.steps.items())[:_MOST_NAMED]
    ]
    small = " That is little beside what is required, and in the sigmas." if moved.small(quantities) else ""
    return f" From before to after: {', '.join(steps)}.{small}"
