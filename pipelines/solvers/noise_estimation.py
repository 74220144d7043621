"""Noise levels from the recording: a variance component for every measurement noise, all of them together.

Restricted maximum likelihood with what was stated as prior (real sensors' noise is known to a part of itself at best).
With u the logarithm of a noise's level over the one stated, chi2 the sum of its whitened squares, r their redundancy
and tau how well the level is known,

    chi2 - r - u / tau^2 = 0

Without the last term that is Foerstner's iteration, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", Allgemeine Vermessungs-Nachrichten 1979. Between two solutions chi2 is taken to go with
exp(-2 u) and r to stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from alidade.factors.array import Array
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.noise import ROUGHLY, Level, Noise
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.levenberg import LevenbergConfig, Solution, minimize
from alidade.pipelines.solvers.linearization import Group, Linearization
from alidade.pipelines.solvers.posterior import expected_squares
from alidade.pipelines.solvers.robust import solve_robust, solve_truncated

# (family, row of its measurements) -> expected sum of squares under noise of unit variance.
ExpectedSquares = Mapping[tuple[str, int], float]


# Solutions with other levels at most, and the change of a level's logarithm below which levels stay.
_MAX_SOLUTIONS, _NEGLIGIBLE = 8, 0.01
# Ratio of the root mean square to the typical residual beyond which the gate is in the wrong place: outliers pass as
# measurements, or measurements are rejected. The typical residual is robust to that; fewer than so many have none.
_MISPLACED, _MIN_RESIDUALS = 1.3, 50
# Bound of the logarithm of a noise beside others, over what was stated. Of it a residual counts as no more than so many
# sigmas, where the square of a normal number is expected to be as given.
_MAX_ADDITIONAL, _CLIPPED, _CLIPPED_SQUARE = 7.0, 2.0, 0.9205
# Level of any noise at least: without noise residuals are of rounding, which no step makes less.
_LEAST = 1e-6
# Sigmas by which a sum of squares is too small for its process.
_TOO_SMALL = 3.0


def estimate_noise(
    engine: Linearization,
    solution: Solution,
    levels: tuple[Level, ...],
    loss: TruncatedLoss | None,
    config: LevenbergConfig,
) -> tuple[Solution, tuple[Level, ...]]:
    """Estimate the noise levels from the residuals; return the solution with these levels, and the levels.

    Args:
        engine: with the noise stated.
        solution: of the same with the levels given.
        levels: to begin with.
        loss: of the problem; None: no outliers are expected.
        config: of every minimisation.

    Raises:
        IndeterminateStateError: a state is not determined.
    """
    first = levels
    if not any(level.noise.estimated or level.least is not None for level in levels):
        return solution, levels
    for _ in range(_MAX_SOLUTIONS):
        if not solution.converged:
            break
        before, values = levels, solution.values
        expected = expected_squares(solution.engine, solution.system, solution.factorization, values)
        levels, steady = refine(levels, solution.engine, values, expected, levels is first)
        if steady:
            break
        solution.forget_factorization()
        weighted = apply_levels(engine, levels)
        if loss is None:
            again = minimize(weighted, values, config)
        elif _far(levels, before):
            again = solve_robust(weighted, values, loss, config)
        else:
            again = solve_truncated(weighted, values, loss, config)
        solution = replace(again, iterations=solution.iterations + again.iterations)
    return solution, levels


def apply_levels(engine: Linearization, levels: Sequence[Level]) -> Linearization:
    """Scale the measurements' weights from the noise used for whitening to the noise at some levels."""
    scaled = acting(levels)
    if not scaled:
        return engine
    return engine.with_groups([_at_levels(group, scaled) for group in engine.groups])


def acting(levels: Iterable[Level]) -> list[Level]:
    """Select the levels whose noise differs from the noise used for whitening."""
    return [level for level in levels if (level.used > 0.0 if level.noise.beside else level.scale != 1.0)]


def _at_levels(group: Group, levels: Sequence[Level]) -> Group:
    own = [level for level in levels if group.family in level.noise.families]
    if not own:
        return group
    weights = level_weights(group.all_weights, own, group.beside, group.fixed)
    return replace(group, weights=weights, model=group.model.at_noise(weights))


def level_weights(weights: Array, levels: Iterable[Level], beside: Array | None, fixed: Array | None = None) -> Array:
    """Weights (n, m) that change measurements from the noise used for whitening to the noise at some levels.

    Args:
        weights: (n, m) beside the levels.
        levels: of their noises.
        beside: (n,) what a unit of an additional noise adds to the whitened residuals.
        fixed: (n,) part of the variance that no level scales.
    """
    weights, share = weights.copy(), np.zeros(len(weights)) if fixed is None else fixed
    for level in levels:
        if level.noise.beside:
            weights = (weights**-2.0 + _additional(beside, level.used)) ** -0.5
        else:
            by = np.sqrt(share + (1.0 - share) * level.scale**2)
            weights[:, _rows(level.noise, weights.shape[1])] /= by[:, None]
    return weights


def _additional(beside: Array | None, level: float) -> Array:
    """Variance (n, 1) of an additional noise, in units of the whitening variance."""
    assert beside is not None
    return ((level * beside) ** 2)[:, None]


def _far(levels: Sequence[Level], others: Sequence[Level]) -> bool:
    """Whether a level differs so much from its former value that the former gate rejects the wrong measurements."""
    pairs = zip(levels, others, strict=True)
    low, high = 1.0 / _MISPLACED, _MISPLACED
    return any(not low < a.scale / b.scale < high for a, b in pairs if not a.noise.beside)


def refine(
    levels: Sequence[Level],
    engine: Linearization,
    values: Values,
    expected: ExpectedSquares,
    first: bool,
) -> tuple[tuple[Level, ...], bool]:
    """Update the noise levels from the residuals at a solution; return them and whether they have converged.

    Args:
        levels: that the engine has now.
        engine: under the loss in force.
        values: the solution.
        expected: squares of the rows of families there.
        first: whether it was made with the levels stated, which may have put the gate in the wrong place.
    """
    found, steady = list(levels), True
    for i, level in enumerate(levels):
        groups = [g for g in engine.groups if g.family in level.noise.families]
        redundancy = _redundancy(level.noise, expected)
        if level.least is not None and redundancy >= 1.0:
            found[i] = _within(level, groups, values, redundancy)
        elif level.noise.estimated and level.noise.beside and redundancy > 0.0:
            found[i], kept = _found_beside(level, groups, values, redundancy)
            steady &= kept
            continue
        elif level.noise.estimated and redundancy >= 1.0:
            found[i] = _refined(level, groups, values, redundancy, first)
        steady &= bool(abs(np.log(found[i].scale / level.scale)) < _NEGLIGIBLE)
    if steady:
        found = [replace(new, scale=old.scale) for new, old in zip(found, levels, strict=True)]
    return tuple(found), steady


def _redundancy(noise: Noise, expected: ExpectedSquares) -> float:
    """Expected sum of a noise's whitened squares at its current level."""
    return sum(
        square
        for (family, row), square in expected.items()
        if family in noise.families and (noise.rows is None or row in noise.rows)
    )


def _refined(level: Level, groups: Sequence[Group], values: Values, redundancy: float, first: bool) -> Level:
    """Update one noise level from its whitened residuals."""
    square, typical = _size(level.noise, groups, values)
    if first and typical > 0.0 and not _MISPLACED**-2 < square / typical < _MISPLACED**2:
        square = typical
    found = max(level.scale * float(np.sqrt(max(square / redundancy, 0.0))), _LEAST)
    known = replace(level, found=found, sigma=found * (2.0 * redundancy) ** -0.5)
    scale = float(np.exp(_level(float(np.log(level.scale)), square, redundancy, known.known)))
    return replace(known, scale=max(scale, level.noise.least, _LEAST))


def _found_beside(level: Level, groups: Sequence[Group], values: Values, redundancy: float) -> tuple[Level, bool]:
    """Update an additional noise from the residuals; return its level and whether it has converged.

    With v the variance of a row, f the part of it that is this noise's, and e the residual, all rows alike redundant,
    the root of: sum f (e^2 / v - r / n) - ln(level) / tau^2. Where outliers are rejected, what is beyond two sigmas
    counts as that: a pose near iron is not to pass for repeatability.
    """
    weights = [g.all_weights for g in groups]
    added = [_additional(g.beside, level.noise.stated) for g in groups]
    unit = np.concatenate([np.broadcast_to(a, w.shape).ravel() for a, w in zip(added, weights, strict=True)])
    variance = np.concatenate([w.ravel() for w in weights]) ** -2.0
    square = np.concatenate([g.residuals(values).ravel() for g in groups]) ** 2
    rest, share = variance - unit * level.scale**2, redundancy / variance.size
    rejecting = any(g.loss is not None for g in groups)
    most, expected = (_CLIPPED**2, _CLIPPED_SQUARE) if rejecting else (np.inf, 1.0)
    low, high = -_MAX_ADDITIONAL, _MAX_ADDITIONAL
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        part = unit * np.exp(2.0 * middle)
        whitened = np.minimum(square / (share * (rest + part)), most) / expected
        score = share * (part / (rest + part) * (whitened - 1.0)).sum() - middle / level.known**2
        low, high = (middle, high) if score > 0.0 else (low, middle)
    found = max(float(np.exp(low)), level.noise.least)
    part = unit * found**2
    # As in `_level`, of all noise of the rows: the mean square is more than the mode's by what few rows leave unknown.
    more = np.expm1(2.0 / (2.0 * redundancy + min(level.known, ROUGHLY) ** -2)) * (rest + part).sum() / unit.sum()
    scale, part = float(np.sqrt(found**2 + more)), part + more * unit
    sigma = float((2.0 * share * ((part / (rest + part)) ** 2).sum() + level.known**-2) ** -0.5)
    changed = float(np.abs((rest + part) / variance - 1.0).max())
    return replace(level, scale=scale, found=found, sigma=found * sigma), changed < 2.0 * _NEGLIGIBLE


def _within(level: Level, groups: Sequence[Group], values: Values, redundancy: float) -> Level:
    """Update the level of a process from its residuals, between its lower bound `least` and the stated level.

    Where measurements take most of the redundancy its squares hardly determine levels in between: it stays as stated if
    these fit, else it is taken down to its samples and up from there as far as its residuals ask for.
    """
    assert level.least is not None
    ratio = sum(_used_square(g, values).sum() for g in groups) / redundancy
    if level.scale == 1.0:
        if ratio > 1.0 - _TOO_SMALL * (2.0 / redundancy) ** 0.5:
            return replace(level, noise=replace(level.noise, families=()), least=None)
        return replace(level, scale=level.least)
    return replace(level, scale=float(np.clip(level.scale * max(ratio, 1.0) ** 0.5, level.least, 1.0)))


def _level(now: float, square: float, redundancy: float, known: float) -> float:
    """Logarithm of the root of a noise level's posterior mean square.

    The mode u is the root of square exp(2 (now - u)) - redundancy - u / known^2, by Newton's method. With v the
    variance of the logarithm there, the mean square is exp(2 (u + v)): sigmas contain what few residuals leave unknown.
    """
    u, step, curvature = now, np.inf, np.inf
    while abs(step) > 1e-6:
        expected = square * np.exp(2.0 * (now - u))
        curvature = 2.0 * expected + known**-2
        step = (expected - redundancy - u / known**2) / curvature
        u += float(np.clip(step, -1.0, 1.0))
    return u + 1.0 / curvature


def _rows(noise: Noise, rows: int) -> list[int]:
    return list(range(rows)) if noise.rows is None else [row for row in noise.rows if row < rows]


def _used_square(group: Group, values: Values) -> Array:
    """Squares (n, m) of the weighted residuals, zero for rejected measurements."""
    residuals = group.residuals(values)
    return np.where((group.used(residuals) > 0.5)[:, None], group.weighted(residuals) ** 2, 0.0)


def _size(noise: Noise, groups: Sequence[Group], values: Values) -> tuple[float, float]:
    """Sum of the inliers' squared whitened residuals of a noise, and that sum estimated from their typical size.

    Of few residuals, and of processes, the latter is 0.
    """
    if any(not g.is_measurement for g in groups):
        return float(sum(_used_square(g, values).sum() for g in groups)), 0.0
    square, rows, every = 0.0, 0, [np.empty(0)]
    for g in groups:
        residuals, own = g.residuals(values), _rows(noise, g.model.rows)
        used = g.used(residuals) > 0.5
        whitened = g.weighted(residuals)[:, own]
        square += float((whitened[used] ** 2).sum())
        rows += int(used.sum()) * len(own)
        every.append(whitened.ravel())
    whole = np.concatenate(every)
    return square, rows * robust_sigma(whole) ** 2 if len(whole) >= _MIN_RESIDUALS else 0.0
