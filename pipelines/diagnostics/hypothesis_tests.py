"""Hypotheses on why residuals do not fit: faults of the data, each tested by solving again with that fault corrected.

    find_hypotheses(method.graph, method.faults, data, config, estimate)

A hypothesis counts when the recording fits with it, or fits far better. Noise is offered where it is stated as known
exactly and nothing else fits: noise large enough fits anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import parallel
from alidade.pipelines.diagnostics.cross_validation import Build, TrialFit, max_concurrent, score_trial, solve_trial
from alidade.pipelines.diagnostics.diagnose import diagnose, is_beyond_noise, is_suspect, rejections
from alidade.pipelines.diagnostics.fault_models import FaultModel, ScaleFactor
from alidade.pipelines.diagnostics.observability import rejects_many
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Estimate, Residuals
from alidade.pipelines.settings import Config

# Trials use this much of a recording, s, where it fits worst; their scores use less.
_SEGMENT_S, _SCORE_SEGMENT_S = 30.0, 8.0
# A fall of chi-square beyond the square of this is no chance, and within it two hypotheses are equivalent.
_SIGNIFICANT = 5.0
# A correction that leaves more than this share of the noise factor explains little.
_MAX_REMAINING = 0.8
# One that leaves chi-square above so many times its degrees of freedom leaves the cause unknown, and is no explanation.
_MAX_LEFT = 10.0
# Larger noise explains anything, and is never offered.
_MAX_NOISE_FACTOR = 4.0
_MAX_TESTED, _MAX_REPORTED = 3, 3
# How well noise counts as known, one sigma of its logarithm, where it is looked for.
_NOISE_KNOWN = 0.1
# A score is promising below this share of the score as recorded, and below so many times the best one.
_PROMISING, _MAX_RIVAL = 0.97, 3.0
# Scores within this share of the best are alike: the flip of any axis is the exchange of any two, with another mount.
_ALIKE = 0.05
# Noise less than this factor from its statement is not reported, nor larger than it was.
_MIN_NOISE_FACTOR = 1.1
_WHAT = "testing hypotheses"

# The fit with a fault corrected, and the fault in words.
_Tested = tuple[TrialFit, str]


def find_hypotheses(
    build: Build,
    model: FaultModel,
    data: Any,
    config: Config,
    estimate: Estimate | None = None,
    freed: Config | None = None,
) -> tuple[Finding, ...]:
    """Find faults whose correction makes a misfitting recording fit, the best fit first.

    Tested is the segment where residuals are worst by the noise as stated, the whole without an `estimate`. A fault has
    to explain more than `freed` does, the config in which what the recording contradicts is free. Where the estimate
    has not converged, or its noise is beyond what noise can be, that is explained by a fault without which there is a
    solution above suspicion.
    """
    if estimate is not None and model.cut and estimate.residuals:
        # Noise that was estimated to grow with the motion is largest where a fault shows.
        stated = solve_trial(build, data, as_stated(config)) if config.noise_known else None
        residuals = estimate.residuals if stated is None else stated.estimate.residuals
        data = model.segment(data, *_worst_segment(residuals, _SEGMENT_S))
    found = _explaining_misfit(build, model, data, config, freed)
    if found or estimate is None or (estimate.converged and not is_beyond_noise(estimate)):
        return found
    return _findings(None, _above_suspicion(build, model, data, config, estimate))


def _explaining_misfit(
    build: Build, model: FaultModel, data: Any, config: Config, freed: Config | None
) -> tuple[Finding, ...]:
    """Find faults without which chi-square falls significantly, arguments as of `find_hypotheses`."""
    known = config.noise_known == 0.0
    config = as_stated(config)
    before = solve_trial(build, data, config)
    if before is None or (before.fits and not rejects_many(rejections(before.estimate))):
        return ()
    without = None if freed is None else solve_trial(build, data, as_stated(freed))
    if without is not None and without.fits and not rejects_many(rejections(without.estimate)):
        return ()
    concurrent = max_concurrent(model.times(data))
    cases = list(trial_cases(build, model, data, config))
    found = _explaining(build, _promising(build, model, cases, data, config, before.estimate), before, concurrent)
    if any(after.fits for after, _ in found):
        found = [each for each in found if each[0].fits]
    if not found:
        fallback = _explaining(build, _data_faults(model, data, config, "fallback"), before, concurrent)
        found = [each for each in fallback if each[0].fits]
    if not found and known:
        found = _noise(build, data, config)
    if without is not None:
        found = [each for each in found if each[0].cost < without.cost]
    return _findings(before.cost, found[:_MAX_REPORTED])


def as_stated(config: Config) -> Config:
    """Return a config whose noise is known as stated: levels that are estimated hide what is looked for."""
    return config.model_copy(update={"noise_known": 0.0})


def _above_suspicion(build: Build, model: FaultModel, data: Any, config: Config, estimate: Estimate) -> list[_Tested]:
    """Return wrong signs and orders of axes without which there is a solution above suspicion, the likeliest first.

    The noise is estimated where the config leaves it open: as stated it may be why nothing fits. Readings in other
    units have another noise, and would not compare.
    """
    cases = [*_inverted_signs(model, data, config), *_axis_orders(model, data, config)]
    cases = _promising(build, model, cases, data, config, estimate)
    solved = _solved(build, cases, max_concurrent(model.times(data)))
    found = [
        each
        for each in solved
        if each[0].estimate.converged
        and each[0].fits
        and not is_suspect(each[0].estimate, diagnose(each[0].estimate, each[0].quantities), each[0].quantities)
    ]
    return sorted(found, key=lambda each: each[0].cost_with_priors)


def misstatements(build: Build, model: FaultModel, data: Any, config: Config) -> tuple[Finding, ...]:
    """Find config statements without which the recording fits equally well and much nearer to the priors.

    Arguments as of `find_hypotheses`. Faults without such a statement cost nothing.
    """
    if not (cases := list(_data_faults(model, data, config, "stated"))):
        return ()
    before, *found = _solved(build, [TrialCase("", data, config), *cases], max_concurrent(model.times(data)))
    limit = before[0].cost_with_priors - _SIGNIFICANT**2
    nearer = [each for each in found if each[0].cost_with_priors < limit]
    return _findings(before[0].cost, sorted(nearer, key=lambda each: each[0].cost_with_priors))


def _findings(before: float | None, found: Sequence[_Tested]) -> tuple[Finding, ...]:
    """Combine hypotheses of nearly equal cost into one finding: the best, with the others as equivalents.

    `before` is chi-square as recorded; None without a solution.
    """
    groups: list[list[_Tested]] = []
    for each in found:
        if groups and each[0].cost_with_priors - groups[-1][0][0].cost_with_priors < _SIGNIFICANT**2:
            groups[-1].append(each)
        else:
            groups.append([each])
    return tuple(
        Finding(
            "hypothesis",
            Severity.INCONSISTENT,
            {
                "label": group[0][1],
                "chi_square_before": before,
                "chi_square_after": group[0][0].cost,
                "dof": group[0][0].dof,
                "equivalents": [label for _, label in group[1:]],
            },
        )
        for group in groups
    )


def _explaining(build: Build, cases: Iterable[TrialCase], before: TrialFit, concurrent: int) -> list[_Tested]:
    """Solve the cases and keep those that explain the misfit, the best fit first.

    A unit counts where its rates fit better than zeros do: at rest, but for a fault of the gyro, all small rates fit.
    """
    cases = list(cases)
    found = [each for each in _solved(build, cases, concurrent) if _explains(before, each[0])]
    explained = {label for _, label in found}
    silent = [replace(case, data=case.silent) for case in cases if case.silent is not None and case.label in explained]
    costs = {label: without.cost for without, label in _solved(build, silent, concurrent)}
    found = [each for each in found if each[0].cost < costs.get(each[1], np.inf) - _SIGNIFICANT**2]
    # Corrections that fit alike are weighed by their priors: a mount that is likely before one that is not.
    return sorted(found, key=lambda each: each[0].cost_with_priors / max(each[0].dof, 1.0))


def _solved(build: Build, cases: Iterable[TrialCase], concurrent: int) -> list[_Tested]:
    """Solve the cases and keep those with a solution."""
    cases = list(cases)
    works = [partial(solve_trial, build, case.data, case.config, case.label) for case in cases]
    fits = parallel.done(works, _WHAT, concurrent)
    return [(after, case.label) for case, after in zip(cases, fits, strict=True) if after is not None]


def _promising(
    build: Build, model: FaultModel, found: Sequence[TrialCase], data: Any, config: Config, before: Estimate
) -> list[TrialCase]:
    """Select the cases worth solving, by scores after a few iterations on a short segment."""
    cases = [*found, TrialCase("", data, config)]
    if model.cut and before.residuals:
        worst = _worst_segment(before.residuals, _SCORE_SEGMENT_S)
        cases = [TrialCase(case.label, model.segment(case.data, *worst), case.config) for case in cases]
    works = [partial(score_trial, build, case.data, case.config, case.label) for case in cases]
    scored = parallel.done(works, _WHAT, max_concurrent(model.times(cases[-1].data)))
    (*scores, recorded), (*priors, _) = zip(*scored, strict=True)
    best = min(scores, default=np.inf)
    enough = min(_PROMISING * recorded, _MAX_RIVAL * best)
    order = np.lexsort((priors, np.maximum(scores, (1.0 + _ALIKE) * best)))
    return [found[i] for i in order[:_MAX_TESTED] if scores[i] < enough]


def _worst_segment(residuals: Mapping[str, Residuals], length: float) -> tuple[float, float]:
    """Start and end, s, of the segment with the largest sum of squares, rejected measurements counted in full."""
    time = np.concatenate([r.time for r in residuals.values()])
    square = np.concatenate([(r.whitened**2).sum(axis=1) for r in residuals.values()])
    order = np.argsort(time, kind="stable")
    time, total = time[order], np.append(0.0, np.cumsum(square[order]))
    ends = np.searchsorted(time, time + length)
    first = int(np.argmax(total[ends] - total[: len(time)]))
    start = max(min(time[first], time[-1] - length), time[0])
    return float(start) - 0.1, float(start) + length + 0.1


def _explains(before: TrialFit, after: TrialFit) -> bool:
    """Whether a correction explains the misfit.

    Of a corrected gyro also the noise at rest is another: far larger than its residuals it fits any motion.
    """
    if after.factor < 1.0 / _MAX_NOISE_FACTOR and _is_noisier(before.estimate.levels, after.estimate.levels):
        return False
    return explains(before, [after])


def explains(before: TrialFit, parts: Sequence[TrialFit]) -> bool:
    """Whether separate fits of parts explain the misfit of a recording: a significant fall of chi-square, and a fit."""
    return scaled_fall(before, parts) > _SIGNIFICANT**2 and is_near(before, parts)


def scaled_fall(before: TrialFit, parts: Sequence[TrialFit]) -> float:
    """Fall of chi-square by fitting parts separately, over the noise variance factor with which these would fit."""
    return (before.cost - sum(part.cost for part in parts)) / max(_reduced(parts), 1.0)


def _reduced(parts: Sequence[TrialFit]) -> float:
    """Chi-square of several fits together over their degrees of freedom."""
    return sum(part.cost for part in parts) / max(sum(part.dof for part in parts), 1.0)


def is_near(before: TrialFit, parts: Sequence[TrialFit]) -> bool:
    """Whether parts of a recording fit, or nearly, and far better than the whole.

    Nearly: chi-square over dof is at most `_MAX_LEFT`, and below `_MAX_REMAINING` squared of what it was.
    """
    square = _reduced(parts)
    nearly = square < (_MAX_REMAINING * before.factor) ** 2 and square <= _MAX_LEFT
    return nearly or all(part.fits for part in parts)


def _is_noisier(before: Sequence[Level], after: Sequence[Level]) -> bool:
    """Whether a noise after a correction is larger than before it."""
    known = {level.noise.name: level.used for level in before}
    return any(level.used > _MIN_NOISE_FACTOR * known.get(level.noise.name, np.inf) for level in after)


def _noise(build: Build, data: Any, config: Config) -> list[_Tested]:
    """Noises with an estimate larger than stated, the largest first, limited to plausible factors."""
    found = solve_trial(build, data, config.model_copy(update={"noise_known": _NOISE_KNOWN}))
    levels = [level for level in found.estimate.levels if level.contradicted] if found is not None else []
    return [
        (found, f"{level.noise.name} is {level.used:.3g} {level.noise.unit}, {level.scale:.2g} times its statement")
        for level in sorted(levels, key=lambda level: -level.scale)
        if found is not None and _MIN_NOISE_FACTOR < level.scale <= _MAX_NOISE_FACTOR
    ]


# Stamps are moved by this much first, s, and numbers scaled by this much; then so many times to the bottom of a
# parabola.
_FIRST_SHIFT, _SECOND_SHIFT, _FIRST_SCALING, _SECOND_SCALING, _PARABOLAS = 0.01, 1e-3, 0.01, 5e-3, 4


@dataclass(frozen=True)
class TrialCase:
    """A fault, in words, with the data and config that correct the fault.

    Attributes:
        label: the fault.
        data, config: without it.
        silent: data with zero in place of the readings in question, which the correction has to fit better than.
    """

    label: str
    data: Any
    config: Config
    silent: Any = None


def trial_cases(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield all faults to test, except those that count only where no other fits."""
    yield from _data_faults(model, data, config)
    yield from _inverted_signs(model, data, config)
    yield from _axis_orders(model, data, config)
    yield from _units(model, data, config)
    yield from _late_stamps(build, model, data, config)
    yield from _scale_factors(build, model, data, config)


def _data_faults(model: FaultModel, data: Any, config: Config, role: str = "usual") -> Iterator[TrialCase]:
    """Yield trial cases of the method's own faults of one role."""
    for fault in model.faults:
        if fault.role == role and (corrected := fault.corrected(data, config)) is not None:
            yield TrialCase(fault.label, *corrected)


def _readings(model: FaultModel, data: Any) -> Iterator[tuple[str, str, Sequence[str], Array]]:
    """Yield field, sensor, columns and readings of the present sensors with possibly wrong axes."""
    for name, (sensor, columns) in model.signs.items():
        if (values := getattr(data, name)) is not None:
            yield name, sensor, columns, values


def _inverted_signs(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases for every combination of inverted axes of a sensor."""
    for name, sensor, columns, values in _readings(model, data):
        for signs in product((1.0, -1.0), repeat=len(columns)):
            wrong = [column for column, sign in zip(columns, signs, strict=True) if sign < 0.0]
            if wrong:
                axes = " and ".join(wrong)
                label = f"the sign of the {sensor}'s {axes} is wrong"
                factor = np.array(signs) if values.ndim > 1 else signs[0]
                yield TrialCase(label, replace(data, **{name: factor * values}), config)


def _axis_orders(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with a sensor's axes permuted: two swapped, or a right angle about the third."""
    for name, sensor, columns, values in _readings(model, data):
        if len(columns) < 3:
            continue
        for i, j in combinations(range(3), 2):
            swapped = np.eye(3)
            swapped[[i, j]] = swapped[[j, i]]
            third = columns[3 - i - j]
            labels = {
                f"the {sensor}'s {columns[i]} and {columns[j]} are swapped": np.ones(3),
                f"the {sensor} is turned by 90 deg about its {third}": np.where(np.arange(3) == i, -1.0, 1.0),
                f"the {sensor} is turned by 90 deg the other way about its {third}": np.where(
                    np.arange(3) == j, -1.0, 1.0
                ),
            }
            for label, signs in labels.items():
                yield TrialCase(label, replace(data, **{name: values @ swapped * signs}), config)


def _units(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with rates in deg/s, or converted to rad/s twice."""
    for name, sensor, _, values in _readings(model, data):
        if "gyro" in name:
            for label, changed in {
                f"the {sensor} is in deg/s, not rad/s": np.deg2rad(values),
                f"the {sensor} was turned from deg/s to rad/s twice": np.rad2deg(values),
            }.items():
                silent = replace(data, **{name: 0.0 * values})
                yield TrialCase(label, replace(data, **{name: changed}), config, silent)


def _late_stamps(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield a trial case with delayed stamps shifted to the smallest residuals."""
    if model.clock is None:
        return
    stamps, source = model.clock

    def moved(shift: float) -> tuple[Any, Config]:
        return replace(data, **{stamps: getattr(data, stamps) + shift}), config

    shift = _bottom(build, moved, _FIRST_SHIFT, _SECOND_SHIFT)
    if shift:
        side = "early" if shift > 0.0 else "late"
        yield TrialCase(f"the stamps of the {source} are {1e3 * abs(shift):.3g} ms too {side}", *moved(shift))


def _scale_factors(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with config numbers multiplied by the factor of smallest residuals."""
    for factor in model.scalings:
        if factor.apply(data, config, 1.0) is None:
            continue

        def changed(more: float, factor: ScaleFactor = factor) -> tuple[Any, Config]:
            found = factor.apply(data, config, 1.0 + more)
            assert found is not None
            return found

        if more := _bottom(build, changed, _FIRST_SCALING, _SECOND_SCALING):
            yield TrialCase(factor.label.format(factor=1.0 + more), *changed(more))


def _bottom(build: Build, changed: Callable[[float], tuple[Any, Config]], first: float, second: float) -> float | None:
    """Find how far stamps or a number of the config are off, by the smallest residuals; None if nothing is found.

    By steps of a first size, then of a second. First by scores: chi-square levels off where most measurements are
    rejected, but near the bottom discriminates best.
    """
    rough = _lowest(lambda size: score_trial(build, *changed(size))[0] ** 2, first)
    if not rough:
        return rough
    found = _lowest(partial(_cost, build, changed), second, rough)
    return rough if found is None else found


def _cost(build: Build, changed: Callable[[float], tuple[Any, Config]], size: float) -> float:
    """Cost of the solution after a change of some size; infinite without a solution."""
    found = solve_trial(build, *changed(size), label=f"change of {size:.3g}")
    return found.cost if found else np.inf


def _lowest(cost: Callable[[float], float], step: float, start: float = 0.0) -> float | None:
    """Find the size of a change with the lowest cost, from `start` on; None if there is none.

    From the best so far a step to either side, and to the bottom of the parabola through the three.
    """
    known, best = {start: cost(start)}, start
    for _ in range(_PARABOLAS):
        sides = best - step, best + step
        known |= {size: cost(size) for size in sides if size not in known}
        left, middle, right = known[sides[0]], known[best], known[sides[1]]
        bend = left - 2.0 * middle + right
        if not np.isfinite(bend):
            return None
        if bend > 0.0:
            bottom = best + float(np.clip(0.5 * step * (left - right) / bend, -5.0 * step, 5.0 * step))
            known[bottom] = cost(bottom)
        best = min(known, key=known.__getitem__)
        if best not in sides:
            step *= 0.2
    return best
