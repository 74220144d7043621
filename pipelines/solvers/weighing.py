"""Minimise while it is found out which measurements count, and how much: with outliers, and noise of unknown size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Array, Factor, Problem
from alidade.pipelines.solvers.assembly import StepBoundary
from alidade.pipelines.solvers.gauss_newton import MOST_DAMPING, MOST_ITERATIONS, Solution, minimize
from alidade.pipelines.solvers.layout import Layout
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.marginal_likelihood import maximise_likelihood, rejected
from alidade.pipelines.solvers.marginals import rows_used
from alidade.pipelines.solvers.noise_levels import far, refined, weigh
from alidade.pipelines.solvers.redundancy import expected_squares
from alidade.pipelines.solvers.system import Linear, System

# So much a measurement is near enough to tell which ones lie outside the gate: on average they move by 0.05 sigma yet.
_ROUGH_TOLERANCE = 1e-3
# Below this mean pull of outliers on plain least squares, in sigmas a measurement, good measurements stay inside the
# gate and the outliers can be cut off at once.
_MILD_PULL = 0.5
# What is held is held this tightly, in the units of its variable; where something may be, plain least squares that
# takes more iterations than this has run into outliers.
_TIED, _MOST_PLAIN = 1e-9, 10
# Outliers are a minority. If the gate would leave less than this share, it is the noise or the model that is wrong:
# nothing is rejected then, and chi-square says so.
_FEWEST_USED = 0.5
# Solutions with other noise levels.
_MOST_LEVELS = 8


def optimize(
    factors: Sequence[Factor],
    values: gtsam.Values,
    shared: Sequence[int],
    loss: TruncatedLoss | None,
    most: int = MOST_ITERATIONS,
    most_damping: float = MOST_DAMPING,
    held: Sequence[int] = (),
    boundaries: Sequence[StepBoundary] = (),
) -> Solution:
    """Minimise; with a loss: plain least squares first, and the graduated relaxation only if it leaves outliers.

    The relaxation begins where plain least squares leads when the vectors `held` stay as they are: outliers taken for
    measurements would drive small effects, which priors hold by no more than measurements count, out of all bounds.
    """
    unweighed = System.of(factors, shared, None, boundaries)
    if loss is None:
        return minimize(unweighed, values, most=most, most_damping=most_damping)
    measurements = sum(len(f.measurement.model.time) for f in factors if f.measurement is not None)
    start = values
    plain = minimize(unweighed, start, _ROUGH_TOLERANCE * measurements, min(most, _MOST_PLAIN) if held else most)
    values, iterations = plain.values, plain.iterations
    norms = _norms(unweighed, values)
    outlying = norms[norms > loss.gate].sum() > _MILD_PULL * len(norms)
    if outlying:
        if held:
            tied = System.of([*factors, *(_tie(key, start.atVector(key)) for key in held)], shared, None, boundaries)
            plain_but_held = minimize(tied, start, _ROUGH_TOLERANCE * measurements, most)
            values, iterations = plain_but_held.values, iterations + plain_but_held.iterations
        values, more = _relaxed(unweighed, loss, values, float(norms.max()))
        iterations += more
    # What is cut off was part of what the states settled among.
    on_floor = None if (norms > loss.gate).any() and (plain.on_floor or outlying) else plain.on_floor
    final, sound = _truncated(unweighed, loss, values, plain.values, most, on_floor)
    iterations += final.iterations
    if outlying and not (sound and final.converged):
        # Among few measurements outliers lead plain least squares far beyond what the priors allow, and what is found
        # from there is none of the likely minima. With noise as large as they are the priors keep their say.
        softened = unweighed.made_of(_softened(factors, float(norms.max()) / loss.gate))
        soft = minimize(softened, start, most=most)
        values, more = _relaxed(unweighed, loss, soft.values, float(_norms(unweighed, soft.values).max()))
        again, _ = _truncated(unweighed, loss, values, soft.values, most)
        iterations += soft.iterations + more + again.iterations
        truncated = unweighed.under(loss)
        if truncated.error(again.values) < truncated.error(final.values):
            final = again
    return replace(final, iterations=iterations)


def _norms(system: System, values: gtsam.Values) -> Array:
    """Whitened norms of all measurements."""
    return np.concatenate([np.linalg.norm(r.whitened, axis=1) for r in system.residuals(values).values()])


def _softened(factors: Sequence[Factor], by: float) -> list[Factor]:
    """The factors with the noise of all measurements so many times as large."""
    return [
        f
        if (m := f.measurement) is None
        else Factor.of(f.family, m.weighed((np.ones(1) if m.weights is None else m.weights) / by), f.beside)
        for f in factors
    ]


def _relaxed(unweighed: System, loss: TruncatedLoss, values: gtsam.Values, largest: float) -> tuple[gtsam.Values, int]:
    """Values to which one surrogate of the loss after the other leads, and the iterations that takes.

    `largest` is the largest whitened norm of a measurement, for which the first surrogate is convex.
    """
    iterations, mu = 0, loss.gate**2 / max(2.0 * largest**2 - loss.gate**2, 1e-300)
    while mu < 1e3:
        relaxed = minimize(unweighed.under(replace(loss, mu=mu)), values, most=2)
        values, iterations = relaxed.values, iterations + relaxed.iterations
        mu *= 4.0
    return values, iterations


def with_levels(
    problem: Problem,
    factors: Sequence[Factor],
    solution: Solution,
    levels: tuple[Level, ...],
    most: int = MOST_ITERATIONS,
) -> tuple[Solution, tuple[Level, ...], Linear, dict[tuple[str, int], float]]:
    """The solution with the noise levels that the recording tells, and these; it linearised, and its expected squares.

    Args:
        problem: the graph's.
        factors: with the noise stated.
        solution: of the same with the levels given.
        levels: to begin with.
        most: iterations of each minimisation.

    Raises:
        IndeterminateError: a variable is not determined.
    """
    if problem.marginal_likelihood and problem.layout is not None and solution.converged:
        layout, at = Layout.of(problem.layout, solution.values)
        engine = Linearization.of(factors, layout)
        outliers = rejected(engine.under(problem.loss), at)
        levels = maximise_likelihood(engine, at, levels, outliers).levels
        weighed = solution.system.made_of(weigh(factors, levels)).under(None)
        again = _again(problem, weighed, solution.values, True, most)
        solution = replace(again, iterations=solution.iterations + again.iterations)
        return solution, levels, *linearized(solution)
    first, (linear, expected) = levels, linearized(solution)
    for _ in range(_MOST_LEVELS if any(level.noise.estimated for level in levels) else 0):
        if not solution.converged:
            break
        system, values, before = solution.system, solution.values, levels
        with system.at(values):
            levels, steady = refined(levels, system.factors, values, expected, levels is first)
        if steady:
            break
        weighed = system.made_of(weigh(factors, levels)).under(None)
        again = _again(problem, weighed, values, far(levels, before), most)
        solution = replace(again, iterations=solution.iterations + again.iterations)
        linear, expected = linearized(solution)
    return solution, levels, linear, expected


def linearized(solution: Solution) -> tuple[Linear, dict[tuple[str, int], float]]:
    """A solution linearised, and the expected squares of its residuals."""
    system, values = solution.system, solution.values
    with system.at(values):
        stands = [np.array(rows_used(stretch.factors, values), dtype=float) for stretch in system.stretches]
    linear = system.linearized(values)
    return linear, expected_squares(linear, stands)


def _again(problem: Problem, system: System, values: gtsam.Values, far: bool, most: int) -> Solution:
    """The solution of a system, not yet under a loss, near values; outliers looked for anew where noise is far off."""
    if problem.loss is None:
        return minimize(system, values, most=most)
    if far:
        return optimize(
            system.factors,
            values,
            system.shared,
            problem.loss,
            most,
            held=problem.assumed,
            boundaries=system.boundaries,
        )
    return _truncated(system, problem.loss, values, values, most)[0]


def _truncated(
    unweighed: System,
    loss: TruncatedLoss,
    values: gtsam.Values,
    plain: gtsam.Values,
    most: int,
    on_floor: bool | None = None,
) -> tuple[Solution, bool]:
    """Least squares on what lies inside the gate, from some values, and whether most do.

    Where few do it is least squares on all, from plain values.
    """
    truncated = unweighed.under(loss)
    final = minimize(truncated, values, most=most, on_floor=on_floor)
    used = np.concatenate([r.used for r in truncated.residuals(final.values).values()])
    if used.mean() < _FEWEST_USED:
        return minimize(unweighed, plain, most=most), False
    return final, True


def _tie(key: int, at: Array) -> Factor:
    """Holds a vector where it is."""
    return Factor("prior", gtsam.PriorFactorVector(key, at, gtsam.noiseModel.Isotropic.Sigma(len(at), _TIED)))
