"""Batch calibration: the maximum a-posteriori estimate of all parameters from a whole recording.

Outliers are found by graduated non-convexity (`robust`), noise levels by restricted maximum likelihood
(`noise_estimation`), other minima are looked at where a method says that they may be, weak directions stay at their
priors (`weak_directions`). What is reported follows from one factorisation at the end (`posterior`).

Of two minima whose measurements are explained alike only their priors differ. The likelihood ratio of two
points that are not nested has no distribution of its own; `CLOSE` is where one number off by its prior
would be excluded at one percent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import deadline
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import (
    EngineName,
    Estimate,
    Minimum,
    Problem,
    Residuals,
    SqrtInformation,
    slow_widening,
)
from alidade.pipelines.solvers.chain import IndeterminateStateError
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import (
    ColouredNoise,
    Influence,
    added_covariance,
    autocorrelations,
    coloured_noises,
    error_budget,
    most_influential,
    sigma_ratio,
)
from alidade.pipelines.solvers.error_map_test import with_error_map
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.levenberg import DEFAULT, LevenbergConfig, Point, Solution, minimize
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.marginal_likelihood import innovations_of, sandwich_of, solve_likelihood
from alidade.pipelines.solvers.noise_estimation import apply_levels, estimate_noise
from alidade.pipelines.solvers.offset_step import largest_offset_step
from alidade.pipelines.solvers.posterior import Reported, chi_square, leverages, moved_to, sqrt_information
from alidade.pipelines.solvers.posterior_history import posterior_history, smoothed
from alidade.pipelines.solvers.robust import solve_robust, solve_truncated, without_onsets
from alidade.pipelines.solvers.step_test import largest_steps
from alidade.pipelines.solvers.weak_directions import Posterior, constrained_solution, unfinished

# Number of the most influential measurements that are reported.
INFLUENTIAL = 20
# Chi-square above the least below which another minimum is reported: 99 % quantile of one degree of freedom.
CLOSE = 6.635
# Chi-square above the least up to which values are followed to their minimum, which takes off far less.
_FOLLOWED = 3.0 * CLOSE
# Part of its prior scale by which a number of another solution differs.
_DIFFERENT = 0.1


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution of a problem, with its posterior and diagnostics computed on demand.

    Attributes:
        compiled: the problem.
        solution: with the noise levels in force.
        levels: of the noises.
        posterior: of the reported numbers, weak directions at their priors.
        second: the second best solution, if it is close.
        stopped: whether the time limit had passed when it was made.
    """

    compiled: Compiled
    solution: Solution
    levels: tuple[Level, ...]
    posterior: Posterior
    second: Minimum | None = None
    stopped: bool = False

    @property
    def converged(self) -> bool:
        """Whether the values are a minimum over all directions, or over all strong ones, the weak at their priors.

        Along weak directions the cost varies by chance: where it is least there says nothing.
        """
        constrained = self.posterior.converged and self.posterior.directions.weak.shape[1] > 0
        return self.solution.converged or (constrained and not self.stopped)

    @property
    def message(self) -> str:
        """Why the minimisation converged, or why it did not."""
        at_priors = self.converged and not self.solution.converged
        return "converged with weak directions at their priors" if at_priors else self.solution.message

    @property
    def engine(self) -> Linearization:
        """Linearisation of the graph with the solution's noise weights, rejected measurements left out."""
        return self.posterior.at.engine

    @property
    def values(self) -> Values:
        """Values of all variables, weak directions at their priors."""
        return self.posterior.at.values


def solve(compiled: Compiled, config: LevenbergConfig = DEFAULT, levels: tuple[Level, ...] | None = None) -> Solved:
    """Solve a compiled problem.

    Args:
        compiled: the problem.
        config: of every minimisation.
        levels: of the noises, where they are known; None: from the recording.

    Raises:
        IndeterminateStateError: states other than the parameters are not determined.
    """
    problem = compiled.problem
    start = problem.noises if levels is None else levels
    engine = compiled.engine
    solution = solve_robust(apply_levels(engine, start), compiled.initial, problem.loss, config)
    if levels is None and problem.marginal_likelihood and engine.is_chain:
        # Noise far from what was stated may be why there is no minimum yet.
        if np.isfinite(solution.cost) and any(level.noise.estimated for level in start) and not deadline.passed():
            with suppress(*(() if solution.converged else (IndeterminateStateError,))):
                compiled, solution, start = solve_likelihood(compiled, solution, start, config)
                problem = compiled.problem
    elif levels is None:
        solution, start = estimate_noise(engine, solution, start, problem.loss, config)
    if problem.loss is not None and not problem.marginal_likelihood and solution.converged:
        rest = without_onsets(engine, solution)
        if rest is not None:
            weighted = apply_levels(rest, start)
            solution = solve_truncated(weighted, solution.values, problem.loss, config)
            if levels is None:
                solution, start = estimate_noise(rest, solution, start, problem.loss, config)
    solution, second = _best(compiled, solution, config)
    found = _posterior_of(compiled, solution)
    return Solved(compiled, solution, start, found, second, stopped=deadline.passed())


def _posterior_of(compiled: Compiled, solution: Solution) -> Posterior:
    """Compute the posterior near a solution; where that is no minimum and determines no state, where it started.

    Raises:
        IndeterminateStateError: states are not determined, of what has no minimum where it started.
    """
    posterior = unfinished if deadline.passed() and not solution.converged else constrained_solution
    with suppress(*(() if solution.converged else (IndeterminateStateError,))):
        return posterior(compiled, solution.at_inliers())
    return unfinished(compiled, Point.of(solution.engine, compiled.initial))


def solve_batch(
    problem: Problem,
    max_iterations: int = LevenbergConfig.max_iterations,
    budget: bool = False,
    changed: Iterable[tuple[str, Problem]] = (),
    device: Collection[str] = (),
    elsewhere: Callable[[SqrtInformation], Mapping[str, float]] | None = None,
    engine: EngineName = "auto",
    error_map: bool = False,
    steps: bool = False,
    history: bool = False,
) -> Estimate:
    """Compute the maximum a-posteriori estimate with the joint covariance of all parameters.

    Args:
        problem: to be solved.
        max_iterations: of each minimisation, after which it counts as not converged.
        budget: also where the variance of each number comes from, which measurements move it most, and by how much it
            is elsewhere in the `changed` graphs.
        changed: names and graphs of the same recording in which something is a little different.
        device: names of the numbers whose priors are not the recording's; asks for what it says without them.
        elsewhere: of what it says, linear about its solution, the numbers about which it is to be linear instead.
        engine: that eliminates the linear systems.
        error_map: whether to look for errors of measurements that depend on where they are made.
        steps: whether to test for a step of what `Problem.step_candidates` names.
        history: also the posterior at earlier moments of the recording.

    Raises:
        IndeterminateStateError: states other than the parameters are not determined.
    """
    begin = time.perf_counter()
    compiled = Compiled.of(problem, engine)
    built = time.perf_counter()
    solved = solve(compiled, LevenbergConfig(max_iterations))
    found = time.perf_counter()
    estimate = whole_estimate(solved, budget, changed, steps, history)
    if device:
        estimate = replace(estimate, sqrt_info=_information_of(solved, device, elsewhere))
    if error_map:
        estimate = with_error_map(solved.compiled.problem, solved.posterior, estimate)
    done = time.perf_counter()
    return replace(estimate, seconds={"build": built - begin, "solve": found - built, "marginals": done - found})


def _best(compiled: Compiled, solution: Solution, config: LevenbergConfig) -> tuple[Solution, Minimum | None]:
    """Return the deepest minimum among the solution and the alternatives, and the next one if its cost is close."""
    problem, layout = compiled.problem, compiled.layout
    if problem.elsewhere is None or not solution.converged:
        return solution, None
    engine, found = solution.engine, [solution]
    for other in problem.elsewhere(layout.to_gtsam(solution.values)):
        if deadline.passed("the search for other solutions"):
            break
        values = layout.from_gtsam(other)
        if engine.cost(values) - solution.cost < _FOLLOWED:
            minimum = minimize(engine, values, config)
            found += [minimum] if minimum.converged else []
    best, *others = sorted(found, key=lambda each: each.cost)
    here = Reported.of(compiled, best.values).numbers
    scales = np.array([q.scale for q in problem.quantities])
    for each in others:
        there = Reported.of(compiled, each.values).numbers
        if (np.abs(there - here) > _DIFFERENT * scales).any():
            above = each.cost - best.cost
            return best, Minimum(there, above) if above < CLOSE else None
    return best, None


def whole_estimate(
    solved: Solved,
    budget: bool = False,
    changed: Iterable[tuple[str, Problem]] = (),
    steps: bool = False,
    history: bool = False,
) -> Estimate:
    """Compute the complete estimate of a solution, with covariance and diagnostics; see `solve_batch`."""
    compiled, engine, values, posterior = solved.compiled, solved.engine, solved.values, solved.posterior
    problem, found = compiled.problem, posterior.at
    names = tuple(q.name for q in problem.quantities)
    fit = chi_square(leverages(engine, found.system, found.factorization, values))
    correlations = dict[str, Array]()
    if solved.levels and not problem.marginal_likelihood:
        correlations = autocorrelations(engine, values, len(posterior.reported.free))
    influence, noises, added = None, dict[str, ColouredNoise](), dict[str, Array]()
    if budget or correlations:
        influence = Influence.of(posterior)
        noises = coloured_noises(influence, correlations, fit.families)
        added = added_covariance(influence, noises)
    nominal = posterior.covariance
    covariance = nominal.copy()
    covariance[np.ix_(posterior.reported.free, posterior.reported.free)] += sum(added.values(), np.zeros(()))
    by = sigma_ratio(np.diag(nominal), np.diag(covariance))
    sandwich, largest, wide, innovations = None, None, by, dict[str, Residuals]()
    offset_step = None
    if problem.marginal_likelihood and engine.is_chain and solved.solution.converged:
        sandwich = sandwich_of(compiled, solved.levels, solved.solution)
        innovations = innovations_of(compiled, solved.levels, solved.solution) if budget else innovations
        if steps:
            largest = largest_steps(compiled, solved.levels, solved.solution)
            offset_step = largest_offset_step(compiled, solved.solution, solved.levels)
        widened = slow_widening(sandwich, len(names))
        wide, covariance = by * widened, covariance * np.outer(widened, widened)
    elif steps:
        offset_step = largest_offset_step(compiled, found)
    past = posterior_history(compiled, posterior) if history else None
    residuals = residuals_by_family(engine, values)
    out = Estimate(
        solver="batch",
        names=names,
        values=posterior.reported.numbers,
        covariance=covariance,
        inflation=by,
        sandwich=sandwich,
        steps=largest,
        offset_step=offset_step,
        colours={family: noise.together for family, noise in noises.items()},
        converged=solved.converged,
        message=solved.message,
        residuals=residuals,
        innovations=innovations,
        chi_square=fit,
        history=None if past is None else past.history.inflated(wide),
        posterior_history=past,
        smoothed=smoothed(compiled, posterior, covariance),
        attitudes=problem.attitudes and problem.attitudes(compiled.keyframes, compiled.layout.to_gtsam(values)),
        rejected={family: int((~r.used).sum()) for family, r in residuals.items()},
        levels=solved.levels,
        second=solved.second,
    )
    if not budget or influence is None:
        return out
    sigmas = {q.name: sigma for q, sigma in zip(problem.quantities, out.sigmas.tolist(), strict=True) if not q.assumed}
    return replace(
        out,
        budget=error_budget(influence, added, covariance),
        moved={name: moves for name, other in changed if (moves := _moves(solved, influence, other))},
        strongest=most_influential(influence, sigmas, INFLUENTIAL),
    )


def residuals_by_family(engine: Linearization, values: Values) -> dict[str, Residuals]:
    """Return each family's whitened residuals at some values, in the order of the problem's factors."""
    out = {}
    for family, groups in engine.measured.items():
        order = np.argsort(np.concatenate([g.factors for g in groups]), kind="stable")
        each = [(g.model.time, g.weighted(g.residuals(values)), g.inliers(values)) for g in groups]
        out[family] = Residuals(*(np.concatenate(column)[order] for column in zip(*each, strict=True)))
    return out


def _moves(solved: Solved, influence: Influence, changed: Problem) -> dict[str, float]:
    """Return each reported number's change under a slightly changed graph; empty if the variables differ.

    Noise levels, and which measurements are rejected, are those of the solution.
    """
    own, values = solved.engine, solved.values
    other = Compiled.of(changed.at_levels(solved.levels), "gtsam" if solved.compiled.problem.layout is None else "auto")
    engine = apply_levels(other.engine, solved.levels)
    shapes = [[(g.family, g.target, len(g.model.time), g.model.rows) for g in e.groups] for e in (own, engine)]
    if not np.array_equal(other.layout.key, solved.compiled.layout.key) or shapes[0] != shapes[1]:
        return {}
    moves = influence.moves(engine.counting(own.inliers(values)))
    return dict(zip(influence.names, moves.tolist(), strict=True))


def _information_of(
    solved: Solved, device: Collection[str], elsewhere: Callable[[SqrtInformation], Mapping[str, float]] | None
) -> SqrtInformation:
    """Return square-root information about the reported numbers, linearised at the solution or `elsewhere`."""
    compiled, engine, values = solved.compiled, solved.engine, solved.values
    own = sqrt_information(compiled, engine, values, device)
    wanted = {} if elsewhere is None else elsewhere(own)
    if not wanted:
        return own
    return sqrt_information(compiled, engine, moved_to(compiled, engine, values, wanted), device)
