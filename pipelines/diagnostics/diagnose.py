"""Findings from an estimate: a pure function, without new solutions and without sentences."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines import deadline
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.diagnostics.observability import UNCHANGED, Advise, verdict, weak_directions
from alidade.pipelines.estimation.error_map import UNIT
from alidade.pipelines.estimation.finding import Finding, Severity, by_severity
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import prior_z_scores
from alidade.pipelines.estimation.problem import SLOW_ERROR, ChiSquare, Estimate, Quantity
from alidade.pipelines.estimation.robust import intervals, robust_sigma

NOTE, WEAK, INCONSISTENT = Severity.NOTE, Severity.WEAK, Severity.INCONSISTENT
# Kinds about the residuals, as opposed to priors and requirements.
_RESIDUAL = ("not_converged", "misfit", "noise", "correlation", "rejection")


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the findings; shares are of a family of measurements or of the recording."""

    rejected_note: float = 0.10
    rejected: float = 0.25
    min_family: int = 10  # fewer measurements have no share worth the name, unless it is most of them
    rejected_few: float = 0.5  # of at least `min_few`: three independent outliers of 1 % each are none
    min_few: int = 4
    noise_factor: float = 4.0  # a larger estimate over statement, by `noise_sigmas` of the estimate, is no noise
    noise_sigmas: float = 3.0
    noise_note: float = 2.0
    noise_suspect: float = 1.5  # with correlated residuals
    process_dof: float = 100.0  # processes with fewer are not tested
    lasting: float = 0.10  # residuals correlated, or the end disturbed
    prior_z: float = 4.0
    far_from_prior: float = 5.0  # of a calibrated parameter, in prior sigmas
    no_device: float = 5.0  # sigmas of a device ten times worse than usual, and of the estimate; beyond is a data fault
    determined: float = 0.7  # posterior over prior sigma; above it a prior conflict that a device can have is a note
    inseparable: float = 0.9  # correlation
    material: float = 0.5  # effect over requirement


LIMITS = Thresholds()
# Prior sigma of the worst devices over that of usual ones.
_WORSE = 10.0
# Chance that rejected measurements are the first or the last of a recording in which nothing changed.
_CHANCE = 1e-3
# Share of the parameters from which on a recording is said not to determine them.
_MOST = 0.5
# A data-sheet figure with at least this share of a variance is worth stating better; the largest ones are reported.
_MIN_SHARE, _MAX_REPORTED = 0.2, 3


def diagnose(
    estimate: Estimate,
    quantities: Sequence[Quantity],
    advise: Advise | None = None,
    change: Finding | None = None,
    hypotheses: Sequence[Finding] = (),
    contradictions: Sequence[Finding] = (),
    conflicts: Sequence[Finding] | None = None,
) -> tuple[Finding, ...]:
    """Derive all findings from an estimate, the most severe first; equally severe ones cause before symptom.

    Args:
        estimate: with its final covariance.
        quantities: of the estimate, in its order.
        advise: weights of a direction -> motion that would determine it.
        change, hypotheses, contradictions: findings of the modules `change_test`, `hypothesis_tests` or `split_test`,
            which run where `is_suspect` or (the latter) `rejects_an_end` is true, and `stated_priors`.
        conflicts: `prior_conflicts` of the estimate before they widened it; None: of the estimate.
    """
    published = estimate.solver == "published"  # a reference, judged by its own covariance alone
    failure = Finding("not_converged", NOTE if published else INCONSISTENT, {"message": _failure(estimate, quantities)})
    if not estimate.converged and not published:
        return by_severity([*hypotheses, failure, *rejections(estimate)])
    # What data with a fault determine says nothing of what they would without it.
    directions = () if hypotheses else weak_directions(quantities, estimate.covariance, advise, estimate.values)
    found = [*directions, *contradictions, *hypotheses, *([] if estimate.converged else [failure])]
    if not published:
        conflicts = prior_conflicts(estimate, quantities) if conflicts is None else conflicts
        noise = tuple(_noise(estimate))
        # In noise that is none conflicts and steps of a bias look immaterial, and may be what it comes from.
        symptom = any(each.severity == INCONSISTENT for each in noise)
        weak = [change] if change is not None and change.severity == WEAK else []
        found += [replace(each, severity=INCONSISTENT) if symptom else each for each in (*conflicts, *weak)]
        found += [*([change] if change and not weak else []), *rejections(estimate), *noise, *_correlations(estimate)]
        found += [*_error_map(estimate, quantities), *_slow_errors(estimate, quantities), *disturbances(estimate)]
    found += misfits(estimate.chi_square, estimate.levels)
    is_weak = any(finding.severity == WEAK for finding in directions)
    if is_weak or all(finding.severity == NOTE for finding in found):
        named = {name for c in conflicts or () for name in (c.evidence["parameter"], *c.evidence["inseparable"])}
        contradicted = {q.sheet for q in quantities if q.name in named}
        found += _dominant_priors(quantities, estimate.covariance, is_weak, contradicted)
    if not published:
        found += [*_far_from_prior(estimate, quantities), *_ambiguity(estimate, quantities)]
    return by_severity(found)


def _failure(estimate: Estimate, quantities: Sequence[Quantity]) -> str:
    """Reason why there is no solution, in words: the solver's message, or too many undetermined parameters."""
    found = [verdict(q, sigma) for q, sigma in zip(quantities, estimate.sigmas.tolist(), strict=True) if q.judged]
    open_ones, free = found.count("unobservable"), len(found) - found.count("fixed")
    # What contradicts itself has motion enough.
    square = estimate.chi_square
    contradicts = square is not None and not Fit.of(square.value, square.dof).noise_factor <= LIMITS.noise_factor
    if estimate.converged or contradicts or deadline.passed() or open_ones <= _MOST * free:
        return estimate.message
    return (
        f"the recording is too short, or has too little motion, for {open_ones} of {free} parameters "
        f"({estimate.message})"
    )


def is_suspect(estimate: Estimate, findings: Sequence[Finding], quantities: Sequence[Quantity]) -> bool:
    """Whether the findings call for tests of data faults, each of which solves the problem again.

    A wrong sign that a scale takes leaves no residuals.
    """
    correlated, known = estimate.colours.keys(), {q.name: q for q in quantities}
    if any(f.severity == INCONSISTENT and (f.kind in _RESIDUAL or _no_device(f, known)) for f in findings):
        return True
    return any(
        level.contradicted and (level.found or 0.0) > factor
        for level in estimate.levels
        if (families := estimate.residuals.keys() & set(level.noise.families))
        for factor in (LIMITS.noise_suspect if correlated & families else LIMITS.noise_factor,)
    )


def prior_conflicts(estimate: Estimate, quantities: Sequence[Quantity]) -> tuple[Finding, ...]:
    """Findings on nuisance and tightly stated parameters far from their priors, material ones first, worst first.

    Fixing x_j at its prior mean m would shift x_i by -P_ij / P_jj (x_j - m): the effect of the conflict on x_i.
    """
    P, sigma, x, sensitivities = estimate.covariance, estimate.sigmas, estimate.values, estimate.sensitivities
    nuisance = [j for j, q in enumerate(quantities) if (q.assumed or q.tight) and sigma[j] > 0.0]
    z = [each or 0.0 for each in prior_z_scores(estimate, quantities)]
    left = sorted((j for j in nuisance if abs(z[j]) > LIMITS.prior_z), key=lambda j: -abs(z[j]))
    found: list[tuple[bool, Finding]] = []
    while left:
        j, worst = left[0], quantities[left[0]]
        same = [k for k in nuisance if k != j and abs(P[j, k]) > LIMITS.inseparable * sigma[j] * sigma[k]]
        shift = sensitivities[:, j] * (x[j] - worst.prior_mean)
        effect = {q.name: float(shift[i]) for i, q in enumerate(quantities) if q.required and shift[i]}
        material = any(abs(effect.get(q.name, 0.0)) >= LIMITS.material * q.require for q in quantities if q.required)
        others = tuple(sorted(quantities[k].name for k in same))
        conflict = _prior_conflict(estimate, j, z[j], others, effect, NOTE)
        determined = sigma[j] < LIMITS.determined * (worst.prior_at(x[j]) or worst.scale)
        if material and (determined or _no_device(conflict, {worst.name: worst})):
            conflict = replace(conflict, severity=INCONSISTENT)
        found.append((material, conflict))
        left = [k for k in left[1:] if k not in same]
    return tuple(conflict for _, conflict in sorted(found, key=lambda each: not each[0]))


def _no_device(finding: Finding, quantities: Mapping[str, Quantity]) -> bool:
    """Whether a finding's number is farther from its prior, or from what is stated, than any device can be."""
    found = finding.evidence
    if finding.kind != "prior_conflict" or abs(found["z"]) > LIMITS.no_device * _WORSE:
        return abs(found.get("z", 0.0)) > LIMITS.no_device * _WORSE
    prior = quantities[found["parameter"]]
    # Errors that are slow widen sigma, not what a device can be.
    return bool(
        abs(found["value"] - prior.prior_mean) > LIMITS.no_device * np.hypot(_WORSE * prior.scale, found["sigma"])
    )


def _far_from_prior(estimate: Estimate, quantities: Sequence[Quantity]) -> Iterator[Finding]:
    """Findings of calibrated parameters far from their priors, worst first; legitimate for a mount of 90 deg."""
    z = {
        j: float((estimate.values[j] - q.prior_mean) / q.prior_sigma)
        for j, q in enumerate(quantities)
        if q.prior_sigma and not (q.assumed or q.tight)
    }
    for j in sorted(z, key=lambda j: -abs(z[j])):
        if abs(z[j]) > LIMITS.far_from_prior:
            yield _prior_conflict(estimate, j, z[j], (), {}, NOTE)


def _prior_conflict(
    estimate: Estimate, j: int, z: float, others: tuple[str, ...], effect: dict[str, float], severity: Severity
) -> Finding:
    numbers = {"value": float(estimate.values[j]), "sigma": float(estimate.sigmas[j]), "z": float(z)}
    evidence = {"parameter": estimate.names[j], **numbers, "inseparable": others, "effect": effect}
    return Finding("prior_conflict", severity, evidence)


def rejections(estimate: Estimate) -> list[Finding]:
    """Findings of families with more rejected measurements than outliers explain, the largest share first."""
    every = {f: r.used for f, r in estimate.residuals.items() if len(r.used) >= LIMITS.min_few}
    least = {
        f: LIMITS.rejected_note if len(used) >= LIMITS.min_family else LIMITS.rejected_few for f, used in every.items()
    }
    shares = {f: share for f, used in every.items() if (share := float(np.mean(~used))) > least[f]}
    found = []
    for family in sorted(shares, key=lambda family: -shares[family]):
        share, factor = shares[family], robust_sigma(estimate.residuals[family].whitened)
        evidence = {"family": family, "share": share, "noise_factor": factor}
        found.append(Finding("rejection", INCONSISTENT if share > LIMITS.rejected else NOTE, evidence))
    return found


def is_beyond_noise(estimate: Estimate) -> bool:
    """Whether a noise level is beyond what noise can be."""
    return any(each.severity == INCONSISTENT for each in _noise(estimate))


def _noise(estimate: Estimate) -> Iterator[Finding]:
    """Findings of noise levels that the recording contradicts, and of errors that are correlated in time."""
    for level in estimate.levels:
        known, own = level.together, set(level.noise.families)
        least = -np.inf if level.sigma is None else (level.found or 0.0) - LIMITS.noise_sigmas * level.sigma
        no_noise = bool(own) and least > LIMITS.noise_factor
        differs = known.contradicted or not 1.0 / LIMITS.noise_note < known.scale < LIMITS.noise_note
        is_default = level.noise.source == "default"
        alike = [_share(other) for other in estimate.levels if other is level or own & set(other.noise.families)]
        share = float(np.linalg.norm(alike)) if _share(level) == max(alike) else 0.0
        time = level.noise.correlation_time
        if time is not None and share <= 1.0:
            of = {"noise": level.noise.name, "unit": level.noise.unit}
            yield Finding("correlated_error", NOTE, of | {"used": level.used, "correlation_time": time})
        elif share > 0.5 or (not is_default and (no_noise or (differs and known.scale != 1.0))):
            numbers = {"used": known.used, "factor": known.scale, "estimated_factor": level.found}
            evidence = {"noise": level.noise.name, "unit": level.noise.unit, "source": level.noise.source, **numbers}
            yield Finding("noise", INCONSISTENT if share > 1.0 or (no_noise and not is_default) else NOTE, evidence)


def _share(level: Level) -> float:
    """Ratio of a default noise's level to the limit for noise, beyond which errors are systematic; 0 if stated."""
    is_default = level.noise.source == "default"
    return level.used / (level.noise.no_noise or level.noise.spec.no_noise) if is_default else 0.0


def _correlations(estimate: Estimate) -> Iterator[Finding]:
    """Findings of residuals with correlation lengths, in measurements, too long for noise."""
    for family, length in estimate.colours.items():
        share = length / len(estimate.residuals[family].time)
        if share > LIMITS.lasting:
            yield Finding("correlation", INCONSISTENT, {"family": family, "share": share})


def _error_map(estimate: Estimate, quantities: Sequence[Quantity]) -> Iterator[Finding]:
    """Finding of errors that depend on attitude or gimbal angles; INCONSISTENT far beyond the data sheet."""
    found = estimate.error_map
    if found is None:
        return
    effect = {q.name: float(shift) for q, shift in zip(quantities, found.shift, strict=True) if q.required and shift}
    evidence = {
        "name": found.map.name,
        "unit": UNIT,
        "rms": found.rms,
        "prior": found.map.stated,
        "chi_square": found.chi_square,
        "dof": found.dof,
        "effect": effect,
    }
    yield Finding("error_map", INCONSISTENT if found.rms > LIMITS.noise_factor * found.map.stated else NOTE, evidence)


def _slow_errors(estimate: Estimate, quantities: Sequence[Quantity]) -> Iterator[Finding]:
    """Findings of slow errors outside the noise model that widen a required parameter."""
    ratios = estimate.sandwich
    if ratios is None:
        return
    required = [i for i, q in enumerate(quantities) if q.required]
    worst = max(required, key=lambda i: float(ratios[i]), default=None)
    if worst is not None and ratios[worst] > SLOW_ERROR:
        ratio = float(ratios[worst])
        yield Finding("slow_error", NOTE, {"parameter": quantities[worst].name, "ratio": ratio})


def misfits(chi_square: ChiSquare | None, levels: Sequence[Level]) -> list[Finding]:
    """Findings of chi-square: of all residuals if the noise is known exactly, else of single processes."""
    if chi_square is None:
        return []
    levels = levels if any(level.noise.estimated for level in levels) else ()
    total, found = Fit.of(chi_square.value, chi_square.dof), []
    too_large = not np.isfinite(total.value) or (total.value > total.high and not levels)
    if too_large or total.value < total.low:
        fits = {family: Fit.of(*sums) for family, sums in chi_square.families.items()} or {"all": total}
        largest = max(fits, key=lambda family: fits[family].z if too_large else -fits[family].z)
        found.append(_misfit(None, total, largest, fits[largest].noise_factor, INCONSISTENT if too_large else NOTE))
    measured = {family for level in levels if level.least is None for family in level.noise.families}
    for family, (value, dof) in chi_square.families.items() if levels else ():
        if family not in measured and dof > LIMITS.process_dof and value > LIMITS.noise_factor**2 * dof:
            fit = Fit.of(value, dof)
            found.append(_misfit(family, fit, family, fit.noise_factor, INCONSISTENT))
    return found


def _misfit(family: str | None, fit: Fit, largest: str, noise_factor: float, severity: Severity) -> Finding:
    evidence: dict[str, Any] = {"family": family, "chi_square": fit.value, "dof": fit.dof}
    return Finding("misfit", severity, {**evidence, "largest": largest, "noise_factor": noise_factor})


def disturbances(estimate: Estimate) -> Iterator[Finding]:
    """Findings of intervals with most measurements of a family rejected, in time order.

    One that lasts until the recording's end, and long, is WEAK: what is calibrated may no longer hold.
    """
    for family, time, rejected in _in_order(estimate):
        for first, last in intervals(rejected):
            length, rest = time[last - 1] - time[first], time[-1] - time[last - 1]
            is_long, at_end = length > LIMITS.lasting * (time[-1] - time[0]), rest < LIMITS.lasting * length
            evidence = {
                "family": family,
                "since_s": float(time[first]),
                "time_s": float(time[last - 1]),
                "rejected": int(rejected[first:last].sum()),
            }
            yield Finding("disturbance", WEAK if at_end and is_long else NOTE, evidence)


def rejects_an_end(estimate: Estimate) -> bool:
    """Whether the rejected measurements of a family are those before or after some time, as of a sensor that slipped.

    Of many some fit by chance: a disturbed interval is nearer to the beginning or end than it is long. Of few they are
    exactly the first or the last, which of k among n has the chance 2 / C(n, k).
    """
    for _, time, rejected in _in_order(estimate):
        n, k = len(time), int(rejected.sum())
        if any(min(first, n - last) < last - first for first, last in intervals(rejected)):
            return True
        ways = math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)  # log C(n, k)
        if (rejected[:k].all() or rejected[n - k :].all()) and ways > math.log(2.0 / _CHANCE):
            return True
    return False


def _in_order(estimate: Estimate) -> Iterator[tuple[str, Array, Mask]]:
    """Yield each family with its times (n,), s, in order, and which of its measurements are rejected (n,)."""
    for family, residuals in estimate.residuals.items():
        order = np.argsort(residuals.time, kind="stable")
        yield family, residuals.time[order], ~residuals.used[order]


def _dominant_priors(
    quantities: Sequence[Quantity], covariance: Array, is_weak: bool, contradicted: Collection[str]
) -> Iterator[Finding]:
    """Findings of data-sheet figures that cause a large share of a required parameter's variance, largest first.

    The share of a figure is the part of a variance that conditioning on its nuisance parameters removes:
    P_wn P_nn^-1 P_nw over P_ww; the covariance (n, n) is in the order of the quantities. A figure counts where
    parameters are weak, and as a NOTE where they are as accurate as required and the recording adds next to nothing to
    what the figure states: an error of it is theirs, and no residual shows it. A contradicted one has its own finding.
    """
    variances = np.diag(covariance)
    rows = [i for i, q in enumerate(quantities) if q.judged and variances[i] > (q.require**2 if is_weak else 0.0)]
    figures: dict[str, list[int]] = {}
    for i, q in enumerate(quantities):
        least = 0.0 if is_weak else UNCHANGED * q.scale
        if q.sheet and q.sheet not in contradicted and variances[i] > least**2:
            figures.setdefault(q.sheet, []).append(i)
    shares = {}
    for figure, of in figures.items():
        across = covariance[np.ix_(rows, of)]
        removed = across @ np.linalg.pinv(covariance[np.ix_(of, of)], hermitian=True) @ across.T
        shares[figure] = float(max(np.diag(removed) / variances[rows], default=0.0))
    dominant = [figure for figure in sorted(shares, key=lambda figure: -shares[figure]) if shares[figure] > _MIN_SHARE]
    for figure in dominant[:_MAX_REPORTED]:
        evidence = {"figure": figure, "stated": quantities[figures[figure][0]].scale, "share": shares[figure]}
        yield Finding("dominant_prior", WEAK if is_weak else NOTE, evidence)


def _ambiguity(estimate: Estimate, quantities: Sequence[Quantity]) -> Iterator[Finding]:
    """Finding of a second solution nearly as likely as the best, most different parameters first."""
    if estimate.second is None:
        return
    there, scales = estimate.second.values, np.array([q.scale for q in quantities])
    order = np.argsort(-np.abs(there - estimate.values) / scales)
    values = {estimate.names[i]: (float(there[i]), float(estimate.values[i])) for i in order}
    yield Finding("ambiguous_solution", NOTE, {"chi_square": estimate.second.chi_square, "values": values})
