"""Noise levels from the recording: a variance component for every measurement noise, all of them together.

Restricted maximum likelihood with what was stated as prior (real sensors' noise is known to a part of itself at best).
With u the logarithm of a noise's level over the one stated, chi2 the sum of its whitened squares, r their redundancy
and tau how well the level is known,

    chi2 - r - u / tau^2 = 0

Without the last term that is Foerstner's iteration, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", Allgemeine Vermessungs-Nachrichten 1979. Between two solutions of the graph chi2 is taken to
go with exp(-2 u) and r to stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import cast

import gtsam
import numpy as np

from alidade.factors.vectorized import VectorizedFactor
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.solvers.marginals import sum_of_squares

# Levels stay as they are while what would change is less than this, in the logarithm.
_NEGLIGIBLE = 0.01
# Where the root mean square and the typical residual differ by more than this factor, the gate is in the wrong place:
# outliers are taken for measurements, or measurements for outliers. The typical one does not mind.
_HEAVY = 1.3
# Of fewer residuals there is no typical one.
_FEWEST = 50
_NEWTON = 20
# A noise beside others is looked for within this of what was stated, in the logarithm.
_WIDEST = 7.0
# Of it a residual counts as no more than this, in sigmas; what the square of a normal number is then expected to be.
_CLIPPED, _EXPECTED = 2.0, 0.9205
# A sum of squares is too small by so many of its sigmas.
_APART = 3.0


def weigh(factors: Sequence[Factor], levels: Sequence[Level]) -> list[Factor]:
    """The factors with their measurements' noise at these levels."""
    scaled = [level for level in levels if (level.used > 0.0 if level.noise.beside else level.scale != 1.0)]
    if not scaled:
        return list(factors)
    families = {family for level in scaled for family in level.noise.families}
    return [_weighed(f, scaled) if f.family in families else f for f in factors]


def far(levels: Sequence[Level], others: Sequence[Level]) -> bool:
    """Whether levels are so far from others that outliers of the one are measurements of the other."""
    pairs = zip(levels, others, strict=True)
    return any(not 1.0 / _HEAVY < a.scale / b.scale < _HEAVY for a, b in pairs if not a.noise.beside)


def _weighed(factor: Factor, levels: Sequence[Level]) -> Factor:
    for level in levels:
        if factor.family in level.noise.families:
            factor = _at_level(factor, level)
    return factor


def _at_level(factor: Factor, level: Level) -> Factor:
    vectorized = factor.vectorized
    if vectorized is not None:
        weights = _weights(vectorized)
        if level.noise.beside:
            weights = (weights**-2.0 + _beside(factor, level.used)) ** -0.5
        else:
            weights[:, _rows(level.noise, weights.shape[1])] /= level.scale
        weighed, of = vectorized.weighed(weights), Factor.process_of if factor.measurement is None else Factor.of
        return of(factor.family, weighed, factor.beside)
    native = cast(gtsam.NoiseModelFactor, factor.factor)
    stated = cast(gtsam.noiseModel.Gaussian, native.noiseModel())
    noise = gtsam.noiseModel.Gaussian.Information(stated.information() / level.scale**2)
    return Factor(factor.family, native.cloneWithNewNoiseModel(noise))


def _weights(vectorized: VectorizedFactor) -> Array:
    """(n, m), those it has."""
    shape = len(vectorized.model.time), vectorized.model.rows
    return np.ones(shape) if vectorized.weights is None else vectorized.weights.copy()


def _beside(factor: Factor, level: float) -> Array:
    """(n, 1) variance of a noise beside others, in units of what the factor is whitened by."""
    assert factor.beside is not None
    return ((level * factor.beside) ** 2)[:, None]


def refined(
    levels: Sequence[Level],
    factors: Sequence[Factor],
    values: gtsam.Values,
    expected: Mapping[tuple[str, int], float],
    first: bool,
) -> tuple[tuple[Level, ...], bool]:
    """The levels at a solution, and whether they are those that it was made with.

    Args:
        levels: that the factors have now.
        factors: of the graph, under the loss in force.
        values: the solution.
        expected: squares of the rows of families, see marginals.expected_squares.
        first: whether it was made with the levels stated, which may have put the gate in the wrong place.
    """
    found = list(levels)
    steady = True
    for i, level in enumerate(levels):
        redundancy = _redundancy(level.noise, expected)
        if level.least is not None and redundancy >= 1.0:
            found[i] = _within(level, factors, values, redundancy)
        elif level.noise.estimated and level.noise.beside and redundancy > 0.0:
            found[i], kept = _found_beside(level, factors, values, redundancy)
            steady &= kept
            continue
        elif level.noise.estimated and redundancy >= 1.0:
            found[i] = _refined(level, factors, values, redundancy, first)
        steady &= abs(np.log(found[i].scale / level.scale)) < _NEGLIGIBLE
    return tuple(found if not steady else _at(found, levels)), steady


def _redundancy(noise: Noise, expected: Mapping[tuple[str, int], float]) -> float:
    """Expected sum of a noise's whitened squares if it is at the level it has."""
    return sum(
        square
        for (family, row), square in expected.items()
        if family in noise.families and (noise.rows is None or row in noise.rows)
    )


def _at(found: Sequence[Level], levels: Sequence[Level]) -> list[Level]:
    """What was found, with the levels that are used."""
    return [replace(new, scale=old.scale) for new, old in zip(found, levels, strict=True)]


def _refined(level: Level, factors: Sequence[Factor], values: gtsam.Values, redundancy: float, first: bool) -> Level:
    """What the level should be."""
    square, typical = _size(level.noise, factors, values)
    if first and typical > 0.0 and not _HEAVY**-2 < square / typical < _HEAVY**2:
        square = typical
    ratio = float(np.sqrt(max(square / redundancy, 1e-12)))
    found = level.scale * ratio
    told = replace(level, found=found, sigma=found * (2.0 * redundancy) ** -0.5)
    scale = float(np.exp(_level(float(np.log(level.scale)), square, redundancy, told.known)))
    return replace(told, scale=max(scale, level.noise.least))


def _found_beside(
    level: Level, factors: Sequence[Factor], values: gtsam.Values, redundancy: float
) -> tuple[Level, bool]:
    """A noise beside others as the residuals have it, and whether that changes little.

    With v the variance of a row, f the part of it that is this noise's, and e the residual, all rows alike redundant,
    the root of: sum f (e^2 / v - r / n) - ln(level) / tau^2. Where outliers are rejected, what is beyond two sigmas
    counts as that: a pose near iron is not to pass for repeatability.
    """
    own = [(f, v) for f in factors if f.family in level.noise.families and (v := f.vectorized) is not None]
    unit = np.concatenate([_beside(f, level.noise.stated) for f, _ in own])
    variance = np.concatenate([_weights(v) for _, v in own]) ** -2.0
    square = np.concatenate([v.residuals(values) for _, v in own]) ** 2 * variance
    rest, share = variance - unit * level.scale**2, redundancy / variance.size
    rejecting = any(v.loss is not None for _, v in own)
    most, expected = (_CLIPPED**2, _EXPECTED) if rejecting else (np.inf, 1.0)
    low, high = -_WIDEST, _WIDEST
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        part = unit * np.exp(2.0 * middle)
        whitened = np.minimum(square / (share * (rest + part)), most) / expected
        score = share * (part / (rest + part) * (whitened - 1.0)).sum() - middle / level.known**2
        low, high = (middle, high) if score > 0.0 else (low, middle)
    scale = float(np.exp(low))
    part = unit * scale**2
    sigma = float((2.0 * share * ((part / (rest + part)) ** 2).sum() + level.known**-2) ** -0.5)
    changed = float(np.abs((rest + part) / variance - 1.0).max())
    return replace(level, scale=scale, found=scale, sigma=scale * sigma), changed < 2.0 * _NEGLIGIBLE


def _within(level: Level, factors: Sequence[Factor], values: gtsam.Values, redundancy: float) -> Level:
    """A process at the level that its residuals have, between what its samples say and what was stated.

    Where measurements take most of the redundancy its squares hardly tell the levels between: it stays as stated if
    these fit, else it is taken down to its samples and up from there as far as its residuals ask for.
    """
    assert level.least is not None
    ratio = _square(level.noise, factors, values) / redundancy
    if level.scale == 1.0:
        fits = ratio > 1.0 - _APART * (2.0 / redundancy) ** 0.5
        if fits:
            return replace(level, noise=replace(level.noise, families=()), least=None)
        return replace(level, scale=level.least)
    return replace(level, scale=float(np.clip(level.scale * max(ratio, 1.0) ** 0.5, level.least, 1.0)))


def _level(now: float, square: float, redundancy: float, known: float) -> float:
    """The root u of square exp(2 (now - u)) - redundancy - u / known^2."""
    u = now
    for _ in range(_NEWTON):
        expected = square * np.exp(2.0 * (now - u))
        step = (expected - redundancy - u / known**2) / (2.0 * expected + known**-2)
        u += float(np.clip(step, -1.0, 1.0))
        if abs(step) < 1e-6:
            break
    return u


def _rows(noise: Noise, rows: int) -> list[int]:
    return list(range(rows)) if noise.rows is None else [row for row in noise.rows if row < rows]


def _square(noise: Noise, factors: Sequence[Factor], values: gtsam.Values) -> float:
    """Sum of squares of all whitened residuals of a noise's families that are used."""
    return sum(sum_of_squares(f, values) for f in factors if f.family in noise.families)


def _size(noise: Noise, factors: Sequence[Factor], values: gtsam.Values) -> tuple[float, float]:
    """Sum of squares of a noise's whitened residuals that are used, and what it would be if all were of typical size.

    Of few residuals, and of processes, the latter is 0.
    """
    if any(f.measurement is None for f in factors if f.family in noise.families):
        return _square(noise, factors, values), 0.0
    parts, used = [], []
    for f in factors:
        if f.measurement is not None and f.family in noise.families:
            residuals = f.measurement.residuals(values)
            parts.append(residuals[:, _rows(noise, residuals.shape[1])])
            used.append(f.measurement.used(values))
    if not parts:
        return 0.0, 0.0
    square = sum(float((part[kept] ** 2).sum()) for part, kept in zip(parts, used, strict=True))
    every = np.concatenate([part.ravel() for part in parts])
    rows = sum(int(kept.sum()) * part.shape[1] for part, kept in zip(parts, used, strict=True))
    return square, rows * robust_sigma(every) ** 2 if len(every) >= _FEWEST else 0.0
