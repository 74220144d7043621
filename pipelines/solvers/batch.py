"""Batch calibration: the maximum a-posteriori estimate of all parameters from a whole recording.

Outliers are found by graduated non-convexity (`robust`), noise levels by restricted maximum likelihood
(`noise_estimation`), other minima are looked at where a method says that they may be, weak directions stay at their
priors (`weak_directions`). What is reported follows from one factorisation at the end (`posterior`).

Of two minima whose measurements are explained alike only their priors tell which is meant. The likelihood ratio of two
points that are not nested has no distribution of its own; `BatchConfig.close` is where one number off by its prior
would be excluded at one percent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Array, Estimate, History, Minimum, Problem, Residuals, Told
from alidade.pipelines.solvers.engines import Compiled, EngineName
from alidade.pipelines.solvers.error_budget import (
    Influence,
    added_variance,
    autocorrelations,
    error_budget,
    inflation,
    most_influential,
)
from alidade.pipelines.solvers.layout import Layout, Tangent, Values
from alidade.pipelines.solvers.levenberg import Engine, Factorization, LevenbergConfig, Solution, minimize
from alidade.pipelines.solvers.noise_estimation import apply_levels, estimate_noise, group_weights
from alidade.pipelines.solvers.posterior import (
    Reported,
    chi_square,
    expected_squares,
    leverages,
    sqrt_information,
)
from alidade.pipelines.solvers.posterior_history import posterior_history, smoothed_bias
from alidade.pipelines.solvers.robust import RobustConfig, solve_robust
from alidade.pipelines.solvers.weak_directions import WeakDirections, constrained_step


@dataclass(frozen=True)
class BatchConfig:
    """Options of the batch solver.

    Attributes:
        robust: how minima and outliers are looked for.
        close: chi-square above the least below which another minimum is told: 99 % quantile of one degree of freedom.
        followed: chi-square above the least up to which values are followed to their minimum, which takes off far less.
        different: part of its prior scale by which a number of another solution differs.
        influential: number of the most influential measurements that are told.
        constrained_steps: steps to the minimum with the weak directions at their priors, at most.
        constrained_tolerance: of these, in posterior sigmas.
    """

    robust: RobustConfig = field(default_factory=RobustConfig)
    close: float = 6.635
    followed: float = 3.0 * 6.635
    different: float = 0.1
    influential: int = 20
    constrained_steps: int = 10
    constrained_tolerance: float = 1e-3

    @classmethod
    def of(cls, max_iterations: int) -> BatchConfig:
        """The defaults with other iterations of each minimisation."""
        return cls(RobustConfig(LevenbergConfig(max_iterations=max_iterations)))


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution with everything that is asked of it later.

    Attributes:
        compiled: the problem.
        solution: with the noise levels in force, weak directions at their priors.
        levels: of the noises.
        factorization: of the system there.
        reported: the numbers there.
        directions: of them.
        second: the second best solution, if it is close.
    """

    compiled: Compiled
    solution: Solution
    levels: tuple[Level, ...]
    factorization: Factorization
    reported: Reported
    directions: WeakDirections
    second: Minimum | None = None


def solve(compiled: Compiled, config: BatchConfig | None = None, levels: tuple[Level, ...] | None = None) -> Solved:
    """Solve a compiled problem.

    Args:
        compiled: the problem.
        config: options.
        levels: of the noises, where they are known; None: from the recording.

    Raises:
        IndeterminateStateError: states other than the parameters are not determined.
    """
    config, problem = config or BatchConfig(), compiled.problem
    start = problem.noises if levels is None else levels
    engine: Engine = compiled.engine
    solution = solve_robust(apply_levels(engine, start), compiled.initial, problem.loss, config.robust)
    if levels is None:
        solution, start = estimate_noise(engine, solution, start, problem.loss, config.robust, _expected)
    solution, second = _best(compiled, solution, config)
    return _constrained(compiled, solution, start, second, config)


def solve_batch(
    problem: Problem,
    max_iterations: int = LevenbergConfig.max_iterations,
    budget: bool = False,
    changed: Iterable[tuple[str, Problem]] = (),
    device: Collection[str] = (),
    elsewhere: Callable[[Told], Mapping[str, float]] | None = None,
    engine: EngineName = "auto",
) -> Estimate:
    """The maximum a-posteriori estimate with the joint marginal covariance of its parameters.

    Args:
        problem: to be solved.
        max_iterations: of each minimisation, after which it counts as not converged.
        budget: also where the variance of each number comes from, which measurements move it most, and by how much it
            is elsewhere in the `changed` graphs.
        changed: names and graphs of the same recording in which something is a little different.
        device: names of the numbers whose priors are not the recording's; asks for what it says without them.
        elsewhere: of what it says, linear about its solution, the numbers about which it is to be linear instead.
        engine: that eliminates the linear systems.

    Raises:
        IndeterminateStateError: states other than the parameters are not determined.
    """
    begin = time.perf_counter()
    compiled = Compiled.of(problem, engine)
    built = time.perf_counter()
    config = BatchConfig.of(max_iterations)
    solved = solve(compiled, config)
    found = time.perf_counter()
    estimate = _estimate(solved, config, budget, changed)
    if device:
        estimate = replace(estimate, told=_told(solved, device, elsewhere))
    done = time.perf_counter()
    return replace(estimate, seconds={"build": built - begin, "solve": found - built, "marginals": done - found})


def _expected(engine: Engine, factorization: Factorization, values: Values) -> dict[tuple[str, int], float]:
    return expected_squares(list(leverages(engine, factorization, values)))


def _best(compiled: Compiled, solution: Solution, config: BatchConfig) -> tuple[Solution, Minimum | None]:
    """The solution or, if another minimum is deeper, that one; and the second best if it is close."""
    problem, layout = compiled.problem, compiled.layout
    if problem.elsewhere is None or not solution.converged:
        return solution, None
    engine, found = solution.engine, [solution]
    for other in problem.elsewhere(layout.to_gtsam(solution.values)):
        values = layout.from_gtsam(other)
        if engine.cost(values) - solution.cost < config.followed:
            minimum = minimize(engine, values, config.robust.minimizer)
            found += [minimum] if minimum.converged else []
    best, *others = sorted(found, key=lambda each: each.cost)
    here = _numbers(compiled, best.values)
    scales = np.array([q.scale for q in problem.quantities])
    for each in others:
        there = _numbers(compiled, each.values)
        if (np.abs(there - here) > config.different * scales).any():
            above = each.cost - best.cost
            return best, Minimum(there, above) if above < config.close else None
    return best, None


def _numbers(compiled: Compiled, values: Values) -> Array:
    """(n,) reported numbers at some values."""
    return Reported.of(compiled.problem, compiled.layout, values, compiled.current_keys).numbers


def _constrained(
    compiled: Compiled, solution: Solution, levels: tuple[Level, ...], second: Minimum | None, config: BatchConfig
) -> Solved:
    """The solution with the weak directions at their priors."""
    layout, weak = compiled.layout, 0
    for _ in range(config.constrained_steps):
        factorization = solution.system.eliminate()
        reported = Reported.of(compiled.problem, layout, solution.values, compiled.current_keys)
        root = reported.root(factorization.root)
        directions = WeakDirections.of(root.R, reported.prior, weak)
        weak = directions.weak.shape[1]
        found = Solved(compiled, solution, levels, factorization, reported, directions, second)
        if not weak or not solution.converged:
            return found
        du = constrained_step(directions, root.R, root.d, reported.u)
        if (np.abs(directions.strong.T @ du) < config.constrained_tolerance * directions.sigmas).all() and (
            np.abs(directions.weak.T @ du) < config.constrained_tolerance
        ).all():
            return found
        last = root.last(du[:, None])
        states, nodes = factorization.given(last)
        move = Tangent(states[..., 0], nodes[..., 0], last[factorization.c :, 0])
        values = layout.retract(solution.values, move)
        system, cost = solution.engine.at(values)
        solution = replace(solution, values=values, system=system, cost=cost)
    return found


def _estimate(
    solved: Solved, config: BatchConfig, budget: bool, changed: Iterable[tuple[str, Problem]]
) -> Estimate:
    """Everything that is reported of a solution."""
    compiled, solution, reported = solved.compiled, solved.solution, solved.reported
    problem, engine, values = compiled.problem, solution.engine, solution.values
    names = tuple(q.name for q in problem.quantities)
    covariance = reported.covariance(solved.directions.covariance())
    correlations = autocorrelations(engine, values) if solved.levels else {}
    influence, added = None, dict[str, Array]()
    if budget or correlations:
        influence = Influence.of(reported, solved.directions, engine, solved.factorization, values)
        added = added_variance(influence, correlations)
    by = inflation(names, covariance, influence.names if influence else (), added)
    covariance = covariance * np.outer(by, by)
    course = posterior_history(
        problem, engine, solution.system, solved.factorization, values, compiled.current_keys, engine.time
    )
    residuals = residuals_by_family(engine, values)
    known = compiled.layout.to_gtsam(values) if problem.attitudes else None
    out = Estimate(
        solver="batch",
        names=names,
        values=reported.numbers,
        covariance=covariance,
        inflation=by,
        colours={family: 1.0 + 2.0 * float(lags.sum()) for family, lags in correlations.items()},
        converged=solution.converged,
        message=solution.message,
        residuals=residuals,
        chi_square=chi_square(list(leverages(engine, solved.factorization, values))),
        history=None if course is None else course.history.inflated(by),
        course=course,
        smoothed=_smoothed(solved, covariance),
        attitudes=problem.attitudes(compiled.keyframes, known) if problem.attitudes and known else None,
        rejected={family: int((~r.used).sum()) for family, r in residuals.items()},
        levels=solved.levels,
        second=solved.second,
    )
    if not budget or influence is None:
        return out
    sigmas = {q.name: sigma for q, sigma in zip(problem.quantities, out.sigmas.tolist(), strict=True) if not q.assumed}
    return replace(
        out,
        budget=error_budget(problem, influence, added, covariance),
        moved={name: moves for name, other in changed if (moves := _moves(solved, influence, other))},
        strongest=most_influential(influence, sigmas, config.influential),
    )


def residuals_by_family(engine: Engine, values: Values) -> dict[str, Residuals]:
    """Family -> whitened residuals of its measurements at some values, in the order of the problem's factors."""
    parts: dict[str, list[tuple[Array, Array, Array, Array]]] = {}
    for group in engine.groups:
        if group.is_measurement:
            residuals = group.evaluate(values)[0]
            each = group.factors, group.model.time, group.weighted(residuals), group.used(residuals) > 0.5
            parts.setdefault(group.family, []).append(each)
    out = {}
    for family, found in parts.items():
        factors, times, whitened, used = (np.concatenate(column) for column in zip(*found, strict=True))
        order = np.argsort(factors, kind="stable")
        out[family] = Residuals(times[order], whitened[order], used[order])
    return out


def _smoothed(solved: Solved, covariance: Array) -> History | None:
    """The reported numbers over time where a bias walks: of its nodes from the whole recording."""
    compiled, layout = solved.compiled, solved.compiled.layout
    *_, count, c, _ = layout.sizes
    if count < 3 or c == 0:
        return None
    engine, values = solved.solution.engine, solved.solution.values
    moving = [p for p in compiled.problem.parameters if p.key in compiled.current_keys]
    if len(moving) != 1:
        return None
    (parameter,) = moving
    keys = np.array([_node_key(layout, parameter.key, j) for j in range(count)])
    begins = engine.time[np.searchsorted(engine.piece, np.arange(count))]
    bias = smoothed_bias(layout, solved.factorization, values, begins, keys, slice(0, len(parameter.quantities)))
    names = [q.name for q in compiled.problem.quantities]
    at = [names.index(q.name) for q in parameter.quantities]
    whole = np.tile(solved.reported.numbers, (count, 1)), np.tile(np.sqrt(np.diag(covariance)), (count, 1))
    whole[0][:, at], whole[1][:, at] = bias.values, bias.sigmas
    return History(begins, *whole)


def _node_key(layout: Layout, first: int, node: int) -> int:
    """The variable of a bias in force at a node; `first` is that of the first one."""
    if node == 0:
        return first
    return int(layout.key[(layout.node == node) & (layout.part == 0)][0])


def _moves(solved: Solved, influence: Influence, changed: Problem) -> dict[str, float]:
    """By how much the numbers are elsewhere in a graph that is a little different, empty where its variables differ.

    Noise levels, and which measurements are rejected, are those of the solution.
    """
    own, values = solved.solution.engine, solved.solution.values
    other = Compiled.of(changed, "gtsam" if solved.compiled.problem.layout is None else "auto")
    engine = apply_levels(other.engine, solved.levels)
    shapes = [[(g.family, g.target, len(g.model.time), g.model.rows) for g in e.groups] for e in (own, engine)]
    if not np.array_equal(other.layout.key, solved.compiled.layout.key) or shapes[0] != shapes[1]:
        return {}
    kept = [
        replace(new, loss=None, weights=group_weights(new) * (g.used(g.evaluate(values)[0]) > 0.5)[:, None])
        for g, new in zip(own.groups, engine.groups, strict=True)
    ]
    moves = influence.moves(engine.with_groups(kept))
    return dict(zip(influence.names, moves.tolist(), strict=True))


def _told(
    solved: Solved, device: Collection[str], elsewhere: Callable[[Told], Mapping[str, float]] | None
) -> Told:
    """What a graph says, linear about its solution or where the reported numbers are to be."""
    compiled, engine, values = solved.compiled, solved.solution.engine, solved.solution.values
    own = sqrt_information(compiled.problem, engine, values, compiled.current_keys, device)
    wanted = {} if elsewhere is None else elsewhere(own)
    if not wanted:
        return own
    return sqrt_information(compiled.problem, engine, values, compiled.current_keys, device, wanted)
