"""Test for a change of the calibrated parameters within a recording.

If nothing changed, the estimate from what was recorded until t differs from the final one by a normal number with the
covariance P(t) - P(T): the later estimate uses all that the earlier one does, and more (Hausman 1978, for an estimator
that is efficient). The largest such difference over the recording is compared with its distribution without a change:
paths drawn with the same covariances, whose steps from moment to moment are independent.

That takes the priors for true. A parameter far beyond its prior departs from it as it becomes known, and nothing has
changed: such priors are widened to what was found before anything is compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.parameters import prior_z_scores
from alidade.pipelines.estimation.problem import Estimate, OffsetStep, Quantity, StepEstimate
from alidade.pipelines.estimation.widening import by_wider_priors, widened

# Probability of calling a recording changed in which nothing changed.
LEVEL = 1e-3
# Most paths drawn, a batch at a time; so many that reach the largest difference give its p-value to a tenth (Besag and
# Clifford 1991), and no more are drawn.
_PATHS, _BATCH, _REACHING = 4000, 500, 100
# Directions in which the rest of the recording added less than this share of the variance have no information about a
# change.
_LEAST = 1e-3
# A step between the segments is significant beyond so many sigmas, and material from this share of the requirement on.
_STEP, _MATERIAL, _SURE = 3.0, 0.5, 2.0
# s between times at which a step of the mount would look different: in simulated recordings half of the largest tests
# exceed chi-square's quantile of that many times.
_EVERY_S = 2.0
# Numbers of a step of a rotation.
_TURNS = 3
# rad: motion capture of healthy recordings differs by up to .29 deg over minutes, and jumps by up to .48 deg at rest.
_LEAST_STEP, _USUAL_JUMP = np.deg2rad(0.25), np.deg2rad(0.5)
# Differences that are named where no segment has a solution.
_MAX_NAMED = 3
# Source of variance, as in the budget.
CHANGE = "change during the recording"
# Priors are widened to what was found from so many sigmas on.
_BEYOND = 3.0
# Two moments make no path.
_FEWEST_MOMENTS = 5
# Coloured residuals are as many measurements as they have independent segments. With fewer of these for each number
# than this, inflated covariances, which hold for long recordings, say too little of how far an estimate may be off.
_STRETCHES = 3.0


@dataclass(frozen=True)
class Stability:
    """Largest difference between the estimate at any earlier time and the final one, or largest step; with its p-value.

    Attributes:
        statistic: its size as a standard normal number.
        level: p-value, anywhere in the recording.
        time_s: when, s.
        differences: parameter -> final estimate less that until then, and the sigma of that, SI; the largest over its
            sigma first.
    """

    statistic: float
    level: float
    time_s: float
    differences: Mapping[str, tuple[float, float]]

    @classmethod
    def of_fall(
        cls, fall: float, numbers: int, times: float, time_s: float, differences: Mapping[str, tuple[float, float]]
    ) -> Stability:
        """Build the test of a change of so many numbers by chi-square's fall, at the best of so many times."""
        from scipy.special import chdtrc

        size = float(_as_normal(np.array([fall]), np.array([numbers]))[0])
        return cls(size, min(float(chdtrc(numbers, fall)) * times, 1.0), time_s, differences)

    @property
    def departures(self) -> dict[str, float]:
        """Estimate before the change minus the final one, in sigmas of the difference, by parameter; largest first."""
        return {name: -size / max(sigma, 1e-300) for name, (size, sigma) in self.differences.items()}

    @property
    def changed(self) -> bool:
        """Whether the difference is significant."""
        return self.level < LEVEL


def change_finding(
    found: Stability, parts: Mapping[str, SplitHalf], quantities: Sequence[Quantity], ratio: float = 1.0
) -> Finding | None:
    """Finding of kind `change`: a NOTE if no step is material; None if no step is significant.

    Its steps are those between the segments that are significant, the most significant first; where the segments have
    none, the estimate of the whole recording less that until the change, if that is significant by itself. A step is
    material that is by two sigmas more than half of what is required; nuisance parameters have no requirement.

    Args:
        found: a change that is more than chance.
        parts: parameter -> values before and after it; none where the segments have no solution.
        quantities: of the estimate.
        ratio: of sandwich to nominal sigmas, the largest of a required parameter: sigmas of a segment do not show what
            errs slowly over the whole recording.
    """
    steps = _significant({name: (part.step, part.step_sigma) for name, part in parts.items()}, ratio)
    if not steps:
        steps = _significant(dict(islice(found.differences.items(), _MAX_NAMED)), ratio)
    if not steps and (parts or found.differences):
        return None
    required = {q.name: q.require for q in quantities}
    material = any(abs(step) - _SURE * s > _MATERIAL * required[name] for name, (step, s) in steps.items())
    # Without segments nobody knows what the change of a required parameter is; that of others is never material.
    known = bool(parts) or (bool(steps) and all(np.isinf(required[name]) for name in steps))
    severity = Severity.NOTE if known and not material else Severity.INCONSISTENT
    return Finding("change", severity, {"since_s": found.time_s, "time_s": found.time_s, "steps": steps})


def _significant(steps: Mapping[str, tuple[float, float]], ratio: float) -> dict[str, tuple[float, float]]:
    """Select steps beyond `_STEP` sigmas, the sigmas multiplied by the ratio; most significant first."""
    wide = {name: (size, ratio * sigma) for name, (size, sigma) in steps.items()}
    return _by_size({name: step for name, step in wide.items() if abs(step[0]) > _STEP * step[1]})


def _by_size(steps: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Sort steps by size over sigma, the largest first."""
    return dict(sorted(steps.items(), key=lambda item: -abs(item[1][0]) / max(item[1][1], 1e-300)))


def offset_finding(step: OffsetStep, quantities: Sequence[Quantity]) -> Finding | None:
    """Finding of kind `change` on a step of offsets that are a mean over the recording; None if it is not significant.

    WEAK if it is material: a mean of what changed is right for no part of the recording.
    """
    steps = _significant(step.steps, 1.0)
    if step.level >= LEVEL or not steps:
        return None
    required = {q.name: q.require for q in quantities}
    material = any(abs(size) - _SURE * sigma > _MATERIAL * required[name] for name, (size, sigma) in steps.items())
    evidence = {"since_s": step.time_s, "time_s": step.time_s, "steps": steps}
    return Finding("change", Severity.WEAK if material else Severity.NOTE, evidence)


def step_stability(step: StepEstimate, duration: float) -> Stability:
    """Convert a step estimate to a stability test, its p-value corrected for the number of possible times."""
    times = max(duration, _EVERY_S) / _EVERY_S
    return Stability.of_fall(step.statistic, _TURNS, times, step.time_s, _by_size(step.steps))


def step_finding(steps: Sequence[StepEstimate], duration: float, quantities: Sequence[Quantity]) -> Finding | None:
    """Most severe finding of kind `change` or `jump` on significant steps; None if no step is significant.

    A change is a step that motion alone shows too, and the same one; it is a NOTE where it is not material. A `jump` is
    a material one that motion does not attribute to the mount. The most significant of the steps comes first.
    `duration` is the recording's, s.
    """
    found = [f for s in steps if (f := _changed(s, duration, quantities)) is not None]
    jumps = [s for s in steps if _is_jump(s, duration) and _is_material(s, quantities)]
    found += [_jump(step) for step in sorted(jumps, key=_certain_size, reverse=True)]
    return max(found, key=lambda finding: finding.severity, default=None)


def _changed(step: StepEstimate, duration: float, quantities: Sequence[Quantity]) -> Finding | None:
    """Finding of kind `change` on a step; None if the step is not significant."""
    significant = _significant(step.steps, step.ratio)
    if not significant or not step_stability(step, duration).changed:
        return None
    severity = Severity.INCONSISTENT if _is_material(step, quantities) else Severity.NOTE
    return Finding("change", severity, {"since_s": step.since_s, "time_s": step.time_s, "steps": significant})


def _jump(step: StepEstimate) -> Finding:
    """Finding that vision's attitudes jumped: a NOTE if not by the mount, or no farther than usual, else WEAK."""
    severity = Severity.WEAK if step.agrees and _certain_size(step) > _USUAL_JUMP else Severity.NOTE
    sizes = {"size": step.size, "sigma": step.ratio * step.sigma}
    return Finding("jump", severity, {"since_s": step.since_s, "time_s": step.time_s, **sizes})


def _certain_size(step: StepEstimate) -> float:
    """Lower bound of a step's size at two sigmas, rad."""
    return step.size - _SURE * step.ratio * step.sigma


def _is_material(step: StepEstimate, quantities: Sequence[Quantity]) -> bool:
    """Whether a step certainly exceeds half the required accuracy and the slow error of a reference."""
    required = min(q.require for q in quantities if q.name in step.steps)
    return _certain_size(step) > max(_MATERIAL * required, _LEAST_STEP)


def _is_jump(step: StepEstimate, duration: float) -> bool:
    """Whether the vision reference jumps significantly at a step, by the mount's slip or by its own error."""
    return step.jumped and step_stability(replace(step, by_motion=np.inf, apart=0.0), duration).changed


def with_change(estimate: Estimate, change: Finding) -> Estimate:
    """Add an immaterial change to an estimate's covariance: P + s s', with all steps s at once."""
    steps: Mapping[str, tuple[float, float]] = change.evidence["steps"]
    step = np.array([steps.get(name, (0.0, 0.0))[0] for name in estimate.names])
    return widened(estimate, CHANGE, step[:, None], change.evidence["time_s"])


def stability(estimate: Estimate, quantities: Sequence[Quantity]) -> Stability | None:
    """Test whether calibrated quantities changed during a recording, by the offset step found, else by the history.

    None where an estimate has neither, and where nothing could change.

    Quantities, in the estimate's order, are left out if they walk, since they may change, and if they are hardly better
    known than before.
    """
    if (step := estimate.offset_step) is not None:
        return Stability(step.statistic, step.level, step.time_s, _by_size(step.steps))
    posterior_history = estimate.posterior_history
    if posterior_history is None:
        return None
    # Information about other numbers is as much the noise of its states, which moves the estimate without being
    # chance as the covariances have it.
    determined = [q.determined(sigma) for q, sigma in zip(quantities, estimate.sigmas.tolist(), strict=True)]
    kept = np.flatnonzero(posterior_history.steady & determined)
    late = posterior_history.time >= _long_enough(estimate, len(kept))
    if late.sum() < _FEWEST_MOMENTS or not len(kept):
        return None
    time = posterior_history.time[late]
    values, covariance = posterior_history.values[late], posterior_history.covariance[late]
    z = np.abs([each or 0.0 for each in prior_z_scores(estimate, quantities)])
    # Under priors so wide that no parameter lies far beyond its own.
    if (wider := by_wider_priors(quantities, np.where(z >= _BEYOND, z, 1.0), values, covariance)) is not None:
        values, covariance = values + wider[0], covariance + wider[1] @ np.swapaxes(wider[1], 1, 2)
    # By one factor: each by its own would turn the directions that are known well, where many are correlated.
    P = float(estimate.inflations[kept].max()) ** 2 * covariance[:, kept[:, None], kept]
    difference = values[:-1, kept] - values[-1, kept]
    whitening = [_whitening(P[i], P[-1]) for i in range(len(P) - 1)]
    ranks = np.array([len(rows) for rows in whitening])
    sizes = _as_normal(np.array([((W @ d) ** 2).sum() for W, d in zip(whitening, difference, strict=True)]), ranks)
    worst = int(np.argmax(sizes))
    beyond = _p_value(P, whitening, ranks, float(sizes[worst]))
    sigmas = np.sqrt(np.maximum(np.diag(P[worst] - P[-1]), 1e-12 * np.diag(P[worst])))
    names = [quantities[k].name for k in kept.tolist()]
    differences = zip((-difference[worst]).tolist(), sigmas.tolist(), strict=True)
    found = _by_size(dict(zip(names, differences, strict=True)))
    return Stability(float(sizes[worst]), beyond, float(time[worst]), found)


def _long_enough(estimate: Estimate, numbers: int) -> float:
    """Time, s, from which every coloured family has enough correlation lengths; infinite if one never has."""
    latest = -np.inf
    for family, together in estimate.colours.items():
        times = np.sort(estimate.residuals[family].time)
        needed = int(np.ceil(_STRETCHES * numbers * together))
        if together > 1.0:
            latest = max(latest, float(times[needed - 1]) if needed <= len(times) else np.inf)
    return latest


def _whitening(P: Array, last: Array) -> Array:
    """Matrix (r, n) that whitens the difference between an estimate with covariance P and the final one."""
    root = np.linalg.cholesky(P + 1e-12 * np.diag(np.diag(P)))
    scaled = np.linalg.solve(root, np.linalg.solve(root, P - last).T)
    eigenvalues, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    informed = eigenvalues > _LEAST
    return np.asarray((vectors[:, informed] / np.sqrt(eigenvalues[informed])).T @ np.linalg.inv(root))


def _as_normal(square: Array, dof: Array) -> Array:
    """Convert chi-square to a standard normal number (Wilson, Hilferty 1931); -inf for zero degrees of freedom."""
    dof = np.broadcast_to(dof, square.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = (np.cbrt(square / dof) - (1.0 - 2.0 / (9.0 * dof))) / np.sqrt(2.0 / (9.0 * dof))
    return np.where(dof > 0, size, -np.inf)


def _p_value(P: Array, whitening: Sequence[Array], ranks: Array, size: float) -> float:
    """Share of simulated histories whose largest normalised difference is at least `size`."""
    rng = np.random.default_rng(0)
    n = P.shape[1]
    roots = [_root(P[i] - P[i + 1], P[i]) for i in range(len(P) - 1)]
    count, drawn = 0, 0
    while drawn < _PATHS and count < _REACHING:
        difference = np.zeros((_BATCH, n))
        largest = np.full(_BATCH, -np.inf)
        for i in reversed(range(len(roots))):
            difference += rng.standard_normal((_BATCH, n)) @ roots[i].T
            square = ((difference @ whitening[i].T) ** 2).sum(axis=1)
            largest = np.maximum(largest, _as_normal(square, ranks[i]))
        count, drawn = count + int((largest >= size).sum()), drawn + _BATCH
    return count / drawn


def _root(covariance: Array, larger: Array) -> Array:
    """R with R R' the covariance, negative eigenvalues set to zero; `larger` covariance gives the scale."""
    scale = np.sqrt(np.maximum(np.diag(larger), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(eigenvalues, 0.0)))
