"""Batch: all steps in one graph, solved once."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from factors.loss import TruncatedLoss
from pipelines.graph.noise import Level
from pipelines.graph.problem import Array, Course, Estimate, Factor, Problem, Told
from pipelines.solvers.assembly import Assembly, StepBoundary
from pipelines.solvers.coloured import added_variance, coloured, inflations
from pipelines.solvers.curvature import second_order
from pipelines.solvers.gauss_newton import MOST_DAMPING, MOST_ITERATIONS, Solution, minimize
from pipelines.solvers.history import sequential_history
from pipelines.solvers.influence import Influence, influence, strongest, uncertainty_budget
from pipelines.solvers.marginals import (
    chi_square,
    joint_covariance,
    reported,
    rows_used,
    smoothed,
)
from pipelines.solvers.minima import likeliest
from pipelines.solvers.noise_levels import far, refined, weigh
from pipelines.solvers.pull import without_pull
from pipelines.solvers.redundancy import expected_squares
from pipelines.solvers.spurious import Spurious, information_of_noise
from pipelines.solvers.system import Linear, System, without_rejected
from pipelines.solvers.told import told

# Frames in one vectorised factor: past this the Jacobians' zeros cost more than the Python calls they save.
CHUNK = 20
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
    shared = whole.shared(problem)
    weighed = weigh(whole.factors, problem.noises)
    solution = optimize(
        weighed, whole.initial, shared, problem.loss, most, held=problem.assumed, boundaries=whole.boundaries
    )
    # As large as the solution, and of no more use.
    whole.initial, whole.timestamps = gtsam.Values(), {}
    solution, levels, about, expected = with_levels(problem, whole.factors, solution, problem.noises, most)
    best, second = likeliest(problem, solution, minimize, whole.current_keys)
    if best is not solution:
        solution, (about, expected) = best, _expected(best)
    course, marginal, noise = _known(problem, about, whole.current_keys)
    if solution.converged:
        unpulled = without_pull(problem, solution, noise, whole.current_keys, most)
        if unpulled is not solution:
            solution, (about, expected) = unpulled, _expected(unpulled)
            course, marginal, noise = _known(problem, about, whole.current_keys)
    solved = time.perf_counter()
    values, system, ordering = solution.values, solution.system, solution.system.ordering
    linear, factors = about.graph, system.factors
    if noise is not None:
        marginal = joint_covariance(problem, linear, ordering, values, whole.current_keys, noise.information)
    bent = second_order(problem, about, marginal, whole.current_keys)
    if bent is not None:
        marginal = marginal + bent
    residuals = system.residuals(values)
    with system.at(values):
        summary = chi_square(problem, factors, values, marginal, expected)
        colours = coloured(factors, values) if levels else {}
    sources, moved, pulls, inflation = None, None, None, np.ones(len(marginal))
    if budget or colours:
        found = influence(problem, about, whole.current_keys)
        added = added_variance(found, colours)
        inflation = inflations(problem, marginal, found.names, added)
        if budget:
            sources = uncertainty_budget(problem, found, added)
            sigmas = zip(problem.quantities, inflation * np.sqrt(np.diag(marginal)), strict=True)
            pulls = strongest(found, {q.name: sigma for q, sigma in sigmas if not q.assumed}, _STRONGEST)
            moved = {name: moves for name, other in changed if (moves := _moves(other, solution, levels, found))}
    # Times from which on other variables held the parameters than before; after the last one they are those reported.
    ends = whole.boundaries
    changes = [
        (b.time, b.current_keys) for i, b in enumerate(ends) if i == 0 or b.current_keys != ends[i - 1].current_keys
    ]
    smooth = smoothed(problem, about.triangular.tree, values, changes[:-1], marginal) if len(changes) > 2 else None
    done = time.perf_counter()
    return Estimate(
        solver="batch",
        names=tuple(q.name for q in problem.quantities),
        values=reported(problem, values, whole.current_keys),
        covariance=marginal * np.outer(inflation, inflation),
        inflation=inflation,
        colours={family: 1.0 + 2.0 * float(lags.sum()) for family, lags in colours.items()},
        converged=solution.converged,
        message=solution.message,
        residuals=residuals,
        chi_square=summary,
        history=None if course is None else course.history.inflated(inflation),
        course=course,
        smoothed=smooth,
        attitudes=problem.attitudes(whole.keyframes, values) if problem.attitudes else None,
        budget=sources,
        moved=moved,
        strongest=pulls,
        rejected={family: int((~r.used).sum()) for family, r in residuals.items()},
        levels=levels,
        told=_told(problem, about, whole.current_keys, device, elsewhere) if device else None,
        second=second,
        seconds={"build": built - start, "solve": solved - built, "marginals": done - solved},
    )


def _known(
    problem: Problem, about: Linear, current_keys: Mapping[int, int]
) -> tuple[Course | None, Array, Spurious | None]:
    """What was known at some moments, covariance of the reported numbers at the end, and what of that is noise."""
    linear, ordering, values = about.graph, about.system.ordering, about.values
    course = sequential_history(problem, linear, ordering, values, about.boundaries)
    marginal = (
        joint_covariance(problem, linear, ordering, values, current_keys) if course is None else course.covariance[-1]
    )
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
    final, sound = _truncated(unweighed, loss, values, plain.values, most, plain.unsettled and not outlying)
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
    first, (linear, expected) = levels, _expected(solution)
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
        linear, expected = _expected(solution)
    return solution, levels, linear, expected


def _expected(solution: Solution) -> tuple[Linear, dict[tuple[str, int], float]]:
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
    unsettled: bool = False,
) -> tuple[Solution, bool]:
    """Least squares on what lies inside the gate, from some values, perhaps unsettled, and whether most do.

    Where few do it is least squares on all, from plain values.
    """
    truncated = unweighed.under(loss)
    final = minimize(truncated, values, most=most, unsettled=unsettled)
    used = np.concatenate([r.used for r in truncated.residuals(final.values).values()])
    if used.mean() < _FEWEST_USED:
        return minimize(unweighed, plain, most=most), False
    return final, True


def _tie(key: int, at: Array) -> Factor:
    """Holds a vector where it is."""
    return Factor("prior", gtsam.PriorFactorVector(key, at, gtsam.noiseModel.Isotropic.Sigma(len(at), _TIED)))
