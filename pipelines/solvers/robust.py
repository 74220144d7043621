"""Least squares with outliers: graduated non-convexity on the problem's truncated loss.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020: surrogates of the
loss, the first one convex for the largest residual that there is, lead to the truncated loss one after the other. What
the last one leaves is plain least squares on the measurements inside the gate, so its covariance means what it says.

It begins with plain least squares, or at the first guess where that explains more measurements: gross outliers take
plain least squares, and small effects that priors alone hold, out of all bounds. Where that ends with most measurements
of a family rejected, it begins again with measurements soft enough that priors hold.

Outliers are a minority. A family of measurements of which more than half are rejected, beyond what chance could make
of one in which every second is an outlier (binomial in the normal approximation, one sided, p = `_MAX_CHANCE`), has
another noise than stated, or its model is wrong: all of it counts then, which chi-square shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines import deadline
from alidade.pipelines.estimation.robust import onsets
from alidade.pipelines.solvers.chain import IndeterminateStateError
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import (
    DEFAULT,
    INITIAL_DAMPING,
    LevenbergConfig,
    Solution,
    minimize,
    states_first,
)
from alidade.pipelines.solvers.linearization import Group, Linearization, System

# Decrease of chi-square per measurement at which plain least squares is near enough to begin with: residuals move by
# .05 sigma yet; and its iterations at most: where they do not do outliers lead, and the surrogates begin anyhow.
_ROUGH_TOLERANCE, _ROUGH_ITERATIONS = 2e-3, 8
# Factor of mu from one surrogate to the next, with one reweighted step each (Yang et al.: 1.4), and the last mu at
# most: weights are 0 or 1 then but for .1 % about the gate. Steps are damped, since what decides a weight is
# determined, and a full one may leave a curved valley.
_MU_STEP, _LAST_MU = 2.5, 1e3
# Share of measurements whose weights are neither 0 nor 1 below which the truncated loss follows: what they say of
# anything is less than that share.
_UNDECIDED = 0.01
# Factor of sigmas where a family has lost most of its measurements: so large that priors hold all; mu and iterations of
# each of the steps, `_MU_STEP` apart, from there to true sigmas.
_SOFTNESS, _HARDENING_MU, _HARDENING_ITERATIONS = 1e4, 0.2, 2
# Chance that a family loses more than half of its measurements to outliers.
_MAX_CHANCE = 1e-3


def solve_robust(
    engine: Linearization, values: Values, loss: TruncatedLoss | None, config: LevenbergConfig = DEFAULT
) -> Solution:
    """Minimise the truncated loss from an initial guess."""
    plain = engine.under(None)
    if loss is None:
        return minimize(plain, values, config)
    count = sum(len(group.model.time) for group in engine.groups if group.is_measurement)
    most = min(_ROUGH_ITERATIONS, config.max_iterations)
    tolerance = _ROUGH_TOLERANCE * max(count, 1)
    rough = replace(config, max_iterations=most, cost_tolerance=tolerance, corrections=0)
    found = minimize(plain, states_first(plain, values), rough)
    iterations, truncated = found.iterations, engine.under(loss)
    if not found.converged and deadline.passed():
        return replace(found, engine=truncated, cost=truncated.cost(found.values))
    start = min(values, found.values, key=truncated.cost) if np.isfinite(found.cost) else values
    start, more = _graduated(engine, start, loss, config)
    # Inside the gate the truncated loss is no other than plain least squares.
    unweighted = truncated.unweighted(start)
    same = start is found.values and truncated.cost_of(unweighted) == plain.cost_of(unweighted)
    final = solve_truncated(engine, start, loss, config, (found.system, found.cost) if same else None)
    iterations += more + final.iterations
    lost = zip(truncated.groups, final.engine.groups, strict=True)
    if any(before.loss is not None and after.loss is None for before, after in lost) and not deadline.passed():
        again = solve_truncated(engine, _hardened(engine, values, loss, config), loss, config)
        iterations += again.iterations
        final = min(final, again, key=lambda each: truncated.cost(each.values))
    return replace(final, iterations=iterations)


def _hardened(engine: Linearization, values: Values, loss: TruncatedLoss, config: LevenbergConfig) -> Values:
    """Find initial values by softened measurements: all sigmas `_SOFTNESS` times as large, reduced in stages.

    A dozen pictures, three of them outliers, are explained by a gyro scale 200 sigmas from its prior, and every way
    from there leads past the minimum. While measurements are soft, priors and process models hold.
    """
    few, softness = _few(config), _SOFTNESS
    values = minimize(_soft(engine.under(None), softness), values, few).values
    few = replace(few, max_iterations=_HARDENING_ITERATIONS)
    while softness > 1.0 and not deadline.passed():
        relaxed = _soft(engine.under(replace(loss, mu=_HARDENING_MU)), softness)
        values = minimize(relaxed, values, few).values
        softness /= _MU_STEP
    return values


def _few(config: LevenbergConfig) -> LevenbergConfig:
    """Options of a minimisation that need not reach the minimum: few iterations, none of them corrections."""
    return replace(config, max_iterations=_ROUGH_ITERATIONS, corrections=0)


def _soft(engine: Linearization, softness: float) -> Linearization:
    """Multiply the sigmas of all measurements by `softness`."""
    soft = [replace(g, weights=g.all_weights / softness) if g.is_measurement else g for g in engine.groups]
    return engine.with_groups(soft)


def solve_truncated(
    engine: Linearization,
    values: Values,
    loss: TruncatedLoss,
    config: LevenbergConfig,
    known: tuple[System, float] | None = None,
) -> Solution:
    """Minimise the truncated loss near some values; a family that loses its majority keeps all measurements.

    `known` is the system about the values, and the cost.
    """
    current, iterations = engine.under(loss), 0
    while True:
        final = minimize(current, values, config, known)
        iterations += final.iterations
        wrong = _mostly_rejected(final.engine, final.values)
        if not wrong:
            return replace(final, iterations=iterations)
        groups = [replace(g, loss=None) if g.family in wrong else g for g in current.groups]
        current, known = current.with_groups(groups), None


def _graduated(
    engine: Linearization, values: Values, loss: TruncatedLoss, config: LevenbergConfig
) -> tuple[Values, int]:
    """Minimise a sequence of surrogates of the truncated loss (GNC); return values and iteration count."""
    residuals = engine.unweighted(values)
    each = zip(engine.groups, residuals, strict=True)
    largest = max((_norms(g, own).max(initial=0.0) for g, own in each if g.loss is not None), default=0.0)
    if largest <= loss.gate:
        return values, 0
    mu, iterations = loss.gate**2 / max(2.0 * largest**2 - loss.gate**2, 1e-300), 0
    while mu < _LAST_MU and not deadline.passed():
        relaxed = engine.under(replace(loss, mu=mu))
        if _undecided(relaxed, residuals) < _UNDECIDED:
            break
        try:
            system, cost = relaxed.at(values)
            step = Tangent(*system.eliminate(INITIAL_DAMPING).solve())
        except (IndeterminateStateError, np.linalg.LinAlgError):
            break
        values, iterations = engine.layout.retract(here := values, step), iterations + 1
        residuals = engine.unweighted(values)
        if not relaxed.cost_of(residuals) < cost:
            values = minimize(relaxed, here, _few(config), (system, cost)).values
            residuals = engine.unweighted(values)
        mu *= _MU_STEP
    return values, iterations


def _undecided(engine: Linearization, residuals: Sequence[Array]) -> float:
    """Share of measurements with a robust weight neither 0 nor 1, from each group's whitened residuals."""
    each = zip(engine.groups, residuals, strict=True)
    whole = np.concatenate([group.used(own) for group, own in each if group.loss is not None])
    return float(((whole > 0.0) & (whole < 1.0)).mean())


def _norms(group: Group, residuals: Array) -> Array:
    """Norms (n,) of measurements, from their unweighted whitened residuals (n, m)."""
    return np.linalg.norm(group.weighted(residuals), axis=1)


def without_onsets(engine: Linearization, solution: Solution) -> Linearization | None:
    """Exclude the measurements at the onset and end of disturbed intervals; None where there are none.

    Of vectors alone: one component of a disturbance varies with the attitude.
    """
    found: dict[str, list[tuple[int, Array, Array, Mask]]] = {}
    for i, group in enumerate(solution.engine.groups):
        if group.loss is not None and group.model.rows > 1:
            residuals = group.residuals(solution.values)
            each = group.model.time, _norms(group, residuals), group.used(residuals) <= 0.5
            found.setdefault(group.family, []).append((i, *each))
    groups = list(engine.groups)
    for parts in found.values():
        time, norms, rejected = (np.concatenate(column) for column in list(zip(*parts, strict=True))[1:])
        order, excluded = np.argsort(time, kind="stable"), np.zeros(len(time), dtype=bool)
        excluded[order] = onsets(time[order], norms[order], rejected[order])
        ends = np.cumsum([len(each[1]) for each in parts])
        for (i, *_), own in zip(parts, np.split(excluded, ends[:-1]), strict=True):
            if own.any():
                groups[i] = replace(groups[i], excluded=own)
    return engine.with_groups(groups) if any(g.excluded is not None for g in groups) else None


def _mostly_rejected(engine: Linearization, values: Values) -> set[str]:
    """Families with significantly more than half of the measurements rejected (binomial test)."""
    counts: dict[str, list[int]] = {}
    for group in engine.groups:
        if group.loss is not None:
            used = group.inliers(values)
            each = counts.setdefault(group.family, [0, 0])
            each[0] += int((~used).sum())
            each[1] += len(used)
    return {
        family
        for family, (rejected, n) in counts.items()
        if 0.5 * math.erfc((2.0 * rejected - 1.0 - n) / math.sqrt(2.0 * n)) < _MAX_CHANCE
    }
