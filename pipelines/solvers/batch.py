"""Batch: all steps in one graph, solved once."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Array, Course, Estimate, Factor, History, Minimum, Problem, Pull, Told
from alidade.pipelines.solvers.assembly import CHUNK, Assembly, StepBoundary
from alidade.pipelines.solvers.coloured import added_variance, coloured, inflations
from alidade.pipelines.solvers.curvature import second_order
from alidade.pipelines.solvers.gauss_newton import MOST_ITERATIONS, Solution, minimize
from alidade.pipelines.solvers.history import sequential_history
from alidade.pipelines.solvers.influence import Influence, influence, strongest, uncertainty_budget
from alidade.pipelines.solvers.marginals import chi_square, joint_covariance, reported, smoothed
from alidade.pipelines.solvers.minima import likeliest
from alidade.pipelines.solvers.noise_levels import weigh
from alidade.pipelines.solvers.pull import without_pull
from alidade.pipelines.solvers.spurious import Spurious, information_of_noise
from alidade.pipelines.solvers.system import Linear, without_rejected
from alidade.pipelines.solvers.told import told
from alidade.pipelines.solvers.weighing import linearized, optimize, with_levels

# The measurements that matter most are so many.
_STRONGEST = 20


def solve_batch(
    problem: Problem,
    most: int = MOST_ITERATIONS,
    budget: bool = False,
    changed: Iterable[tuple[str, Problem]] = (),
    device: Collection[str] = (),
    elsewhere: Callable[[Told], Mapping[str, float]] | None = None,
) -> Estimate:
    """The maximum a-posteriori estimate with the joint marginal covariance of its parameters.

    Outliers are found by graduated non-convexity on the problem's truncated loss: the final solution is plain least
    squares on the measurements inside the gate, so its covariance and chi-square mean what they say.

    Args:
        problem: to be solved.
        most: iterations of each minimisation, after which it counts as not converged.
        budget: also where the variance of each number comes from, which measurements move it most, and by how much it
            is elsewhere in the `changed` graphs.
        changed: names and graphs of the same recording in which something is a little different.
        device: names of the numbers whose priors are not the recording's; asks for what it says without them.
        elsewhere: of what it says, linear about its solution, the numbers about which it is to be linear instead.

    Raises:
        IndeterminateError: states other than the parameters are not determined; names the variable.
    """
    start = time.perf_counter()
    whole = Assembly.of(problem.steps(CHUNK))
    built = time.perf_counter()
    found = _found(problem, whole, most)
    solved = time.perf_counter()
    solution, about, keys = found.solution, found.about, whole.current_keys
    values, system = solution.values, solution.system
    marginal = _covariance(problem, found, keys)
    residuals = system.residuals(values)
    with system.at(values):
        summary = chi_square(problem, system.factors, values, marginal, found.expected)
        colours = coloured(system.factors, values) if found.levels else {}
    weights = _Weights(np.ones(len(marginal)))
    if budget or colours:
        weights = _weights(problem, found, keys, marginal, colours, budget, changed)
    smooth = _smoothed(problem, about, whole.boundaries, marginal)
    done = time.perf_counter()
    return Estimate(
        solver="batch",
        names=tuple(q.name for q in problem.quantities),
        values=reported(problem, values, keys),
        covariance=marginal * np.outer(weights.inflation, weights.inflation),
        inflation=weights.inflation,
        colours={family: 1.0 + 2.0 * float(lags.sum()) for family, lags in colours.items()},
        converged=solution.converged,
        message=solution.message,
        residuals=residuals,
        chi_square=summary,
        history=None if found.course is None else found.course.history.inflated(weights.inflation),
        course=found.course,
        smoothed=smooth,
        attitudes=problem.attitudes(whole.keyframes, values) if problem.attitudes else None,
        budget=weights.budget,
        moved=weights.moved,
        strongest=weights.strongest,
        rejected={family: int((~r.used).sum()) for family, r in residuals.items()},
        levels=found.levels,
        told=_told(problem, about, keys, device, elsewhere) if device else None,
        second=found.second,
        seconds={"build": built - start, "solve": solved - built, "marginals": done - solved},
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """A solution, and what its linear system says.

    Attributes:
        solution: of the graph with these noise levels.
        levels: of the noises.
        second: the second best one, if it is close.
        about: the system linearised there.
        expected: squares of its residuals by family and row.
        course: what was known at some moments.
        marginal: (n, n) covariance of the reported numbers at the end.
        noise: what of their information is noise.
    """

    solution: Solution
    levels: tuple[Level, ...]
    second: Minimum | None
    about: Linear
    expected: dict[tuple[str, int], float]
    course: Course | None
    marginal: Array
    noise: Spurious | None


def _found(problem: Problem, whole: Assembly, most: int) -> _Found:
    """The likeliest solution with the noise levels that the recording tells, which noise does not pull."""
    shared, keys = whole.shared(problem), whole.current_keys
    weighed = weigh(whole.factors, problem.noises)
    solution = optimize(
        weighed, whole.initial, shared, problem.loss, most, held=problem.assumed, boundaries=whole.boundaries
    )
    # As large as the solution, and of no more use.
    whole.initial, whole.timestamps = gtsam.Values(), {}
    solution, levels, about, expected = with_levels(problem, whole.factors, solution, problem.noises, most)
    best, second = likeliest(problem, solution, minimize, keys)
    if best is not solution:
        solution, (about, expected) = best, linearized(best)
    course, marginal, noise = _known(problem, about, keys)
    if solution.converged:
        unpulled = without_pull(problem, solution, noise, keys, most)
        if unpulled is not solution:
            solution, (about, expected) = unpulled, linearized(unpulled)
            course, marginal, noise = _known(problem, about, keys)
    return _Found(solution, levels, second, about, expected, course, marginal, noise)


def _covariance(problem: Problem, found: _Found, current_keys: Mapping[int, int]) -> Array:
    """Of the reported numbers (n, n), without information that is noise, and with what is of second order."""
    marginal, about = found.marginal, found.about
    if found.noise is not None:
        marginal = joint_covariance(problem, about, current_keys, found.noise.information)
    bent = second_order(problem, about, marginal, current_keys)
    return marginal if bent is None else marginal + bent.covariance


@dataclass(frozen=True, eq=False)
class _Weights:
    """By what single measurements and inputs move the reported numbers; all but the first None unless asked for.

    Attributes:
        inflation: (n,) of the sigmas, by noise that is not white.
        budget: where variances come from.
        moved: by name of what is changed, by how much each number is elsewhere then.
        strongest: the measurements that matter most.
    """

    inflation: Array
    budget: Mapping[str, Mapping[str, float]] | None = None
    moved: Mapping[str, Mapping[str, float]] | None = None
    strongest: tuple[Pull, ...] | None = None


def _weights(
    problem: Problem,
    found: _Found,
    current_keys: Mapping[int, int],
    marginal: Array,
    colours: Mapping[str, Array],
    budget: bool,
    changed: Iterable[tuple[str, Problem]],
) -> _Weights:
    """Influence of the measurements, and what follows from it."""
    weight = influence(problem, found.about, current_keys)
    added = added_variance(weight, colours)
    inflation = inflations(problem, marginal, weight.names, added)
    if not budget:
        return _Weights(inflation)
    sigmas = zip(problem.quantities, inflation * np.sqrt(np.diag(marginal)), strict=True)
    return _Weights(
        inflation,
        uncertainty_budget(problem, weight, added),
        {name: moves for name, other in changed if (moves := _moves(other, found.solution, found.levels, weight))},
        strongest(weight, {q.name: sigma for q, sigma in sigmas if not q.assumed}, _STRONGEST),
    )


def _smoothed(problem: Problem, about: Linear, boundaries: Sequence[StepBoundary], marginal: Array) -> History | None:
    """The reported numbers over time, where other variables hold them before the end than after it."""
    # Times from which on other variables held the parameters than before; after the last one they are those reported.
    changes = [
        (b.time, b.current_keys)
        for i, b in enumerate(boundaries)
        if i == 0 or b.current_keys != boundaries[i - 1].current_keys
    ]
    if len(changes) <= 2:
        return None
    return smoothed(problem, about.triangular.tree, about.values, changes[:-1], marginal)


def _known(
    problem: Problem, about: Linear, current_keys: Mapping[int, int]
) -> tuple[Course | None, Array, Spurious | None]:
    """What was known at some moments, covariance of the reported numbers at the end, and what of that is noise."""
    system, values = about.system, about.values
    course = sequential_history(
        problem, about.graph, system.ordering, values, about.boundaries, system.boundaries[0].time
    )
    marginal = joint_covariance(problem, about, current_keys) if course is None else course.covariance[-1]
    return course, marginal, information_of_noise(problem, about, marginal, current_keys)


def _told(
    problem: Problem,
    about: Linear,
    current_keys: Mapping[int, int],
    device: Collection[str],
    elsewhere: Callable[[Told], Mapping[str, float]] | None,
) -> Told:
    """What a graph says, linear about its solution or where the reported numbers are to be."""
    values = about.values
    own = told(problem, about, current_keys, device)
    wanted = {} if elsewhere is None else elsewhere(own)
    if not wanted:
        return own
    moves = {}
    for p in problem.parameters:
        key = current_keys.get(p.key, p.key)
        numbers, J = p.coordinates(values, key)
        to = [wanted.get(q.name, number) for q, number in zip(p.quantities, numbers, strict=True)]
        moves[key] = np.linalg.pinv(J) @ (np.array(to) - numbers)
    there = values.retract(about.holding(moves).solution())
    return told(problem, about.system.linearized(there), current_keys, device)


def _moves(changed: Problem, solution: Solution, levels: tuple[Level, ...], found: Influence) -> dict[str, float]:
    """By how much the numbers are elsewhere in a graph that is a little different, empty where its variables differ.

    Noise levels, and which measurements are rejected, are those of the solution.
    """
    system, values = solution.system, solution.values
    factors = weigh(Assembly.of(changed.steps(CHUNK)).factors, levels)
    factors += system.factors[len(factors) :]  # what balances the pull of noise
    if [_shape(f) for f in factors] != [_shape(f) for f in system.factors]:
        return {}
    with system.at(values):
        kept = [without_rejected(f, own, values) for f, own in zip(factors, system.factors, strict=True)]
    moves = found.moves(system.made_of(kept).under(None).linearized(values))
    return dict(zip(found.names, moves.tolist(), strict=True))


def _shape(factor: Factor) -> tuple[str, list[int], int]:
    """What the factors of two graphs of one recording have in common: family, variables, how many measurements."""
    vectorized = factor.vectorized
    return factor.family, factor.factor.keys(), 0 if vectorized is None else len(vectorized.model.time)
