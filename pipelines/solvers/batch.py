"""Batch: all steps in one graph, solved once.

The outer loop is our own, since gtsam's optimizers copy all values into Python at every call of a Python factor, which
makes them quadratic in the number of variables. Linearising, ordering and elimination stay gtsam's. Elimination
is by QR: tight processes beside loose priors cost Cholesky its digits, and QR costs only half as much again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors.loss import TruncatedLoss
from pipelines.graph.noise import Level
from pipelines.graph.problem import Array, Estimate, Factor, Problem, Told
from pipelines.solvers.assembly import Assembly, StepBoundary
from pipelines.solvers.coloured import added_variance, coloured, inflations
from pipelines.solvers.curvature import second_order
from pipelines.solvers.history import sequential_history
from pipelines.solvers.influence import Influence, influence, strongest, uncertainty_budget
from pipelines.solvers.marginals import (
    IndeterminateError,
    chi_square,
    joint_covariance,
    reported,
    rows_used,
    smoothed,
)
from pipelines.solvers.minima import likeliest
from pipelines.solvers.noise_levels import far, refined, weigh
from pipelines.solvers.redundancy import expected_squares
from pipelines.solvers.spurious import information_of_noise
from pipelines.solvers.system import Linear, System, without_rejected
from pipelines.solvers.told import told

# Frames in one vectorised factor: past this the Jacobians' zeros cost more than the Python calls they save.
CHUNK = 20
_MOST_ITERATIONS = 60
# Damping in units of an unknown's own information, beyond which no step is left to be made.
_MOST_DAMPING = 1e8
# An error (unit: half a squared sigma) less than this above the minimum has nothing more than 0.005 sigma off. What a
# linearisation foresaw wrongly of its step is about what is left for the next one.
_ERROR_TOLERANCE = 1e-5
# A step that was to lower the error by less than this, half a sigma, and does by less than a third of it has only
# to do with what is of second order: noise, which is all that a sensor at rest tells of a mount or a delay.
_LITTLE = 0.15
# A step off by more than this from what it foresaw leaves states unsettled; the next one is misled by them if it is off
# by more than a share of what it foresaw, and in all.
_OFF, _MISLED = 0.1, 0.01
# Parts of a step along it that are tried, and how many steps the states have to return to the floor.
_SHARES, _MOST_RETURNS = (1.0, 0.3, 0.1, 0.03), 2
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


@dataclass(frozen=True)
class Solution:
    """Values at a minimum of a system, and how it was reached; `unsettled`: the states may be off the floor yet."""

    system: System
    values: gtsam.Values
    converged: bool
    message: str
    iterations: int
    unsettled: bool = False


def solve_batch(
    problem: Problem,
    most: int = _MOST_ITERATIONS,
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
    best, second = likeliest(problem, solution, _minimize, whole.current_keys)
    if best is not solution:
        solution, (about, expected) = best, _expected(best)
    solved = time.perf_counter()
    values, system, ordering = solution.values, solution.system, solution.system.ordering
    linear, factors = about.graph, system.factors
    course = sequential_history(problem, linear, ordering, values, about.boundaries)
    marginal = (
        joint_covariance(problem, linear, ordering, values, whole.current_keys)
        if course is None
        else course.covariance[-1]
    )
    noise = information_of_noise(problem, about, marginal, whole.current_keys)
    if noise is not None:
        marginal = joint_covariance(problem, linear, ordering, values, whole.current_keys, noise)
    bent = second_order(problem, system, values, marginal, whole.current_keys)
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
    most: int = _MOST_ITERATIONS,
    most_damping: float = _MOST_DAMPING,
    held: Sequence[int] = (),
    boundaries: Sequence[StepBoundary] = (),
) -> Solution:
    """Minimise; with a loss: plain least squares first, and the graduated relaxation only if it leaves outliers.

    The relaxation begins where plain least squares leads when the vectors `held` stay as they are: outliers taken for
    measurements would drive small effects, which priors hold by no more than measurements count, out of all bounds.
    """
    unweighed = System.of(factors, shared, None, boundaries)
    if loss is None:
        return _minimize(unweighed, values, most=most, most_damping=most_damping)
    measurements = sum(len(f.measurement.model.time) for f in factors if f.measurement is not None)
    start = values
    plain = _minimize(unweighed, start, _ROUGH_TOLERANCE * measurements, min(most, _MOST_PLAIN) if held else most)
    values, iterations = plain.values, plain.iterations
    norms = _norms(unweighed, values)
    outlying = norms[norms > loss.gate].sum() > _MILD_PULL * len(norms)
    if outlying:
        if held:
            tied = System.of([*factors, *(_tie(key, start.atVector(key)) for key in held)], shared, None, boundaries)
            plain_but_held = _minimize(tied, start, _ROUGH_TOLERANCE * measurements, most)
            values, iterations = plain_but_held.values, iterations + plain_but_held.iterations
        values, more = _relaxed(unweighed, loss, values, float(norms.max()))
        iterations += more
    final, sound = _truncated(unweighed, loss, values, plain.values, most, plain.unsettled and not outlying)
    iterations += final.iterations
    if outlying and not (sound and final.converged):
        # Among few measurements outliers lead plain least squares far beyond what the priors allow, and what is found
        # from there is none of the likely minima. With noise as large as they are the priors keep their say.
        softened = unweighed.made_of(_softened(factors, float(norms.max()) / loss.gate))
        soft = _minimize(softened, start, most=most)
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
        relaxed = _minimize(unweighed.under(replace(loss, mu=mu)), values, most=2)
        values, iterations = relaxed.values, iterations + relaxed.iterations
        mu *= 4.0
    return values, iterations


def with_levels(
    problem: Problem,
    factors: Sequence[Factor],
    solution: Solution,
    levels: tuple[Level, ...],
    most: int = _MOST_ITERATIONS,
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
        return _minimize(system, values, most=most)
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
    final = _minimize(truncated, values, most=most, unsettled=unsettled)
    used = np.concatenate([r.used for r in truncated.residuals(final.values).values()])
    if used.mean() < _FEWEST_USED:
        return _minimize(unweighed, plain, most=most), False
    return final, True


def _tie(key: int, at: Array) -> Factor:
    """Holds a vector where it is."""
    return Factor("prior", gtsam.PriorFactorVector(key, at, gtsam.noiseModel.Isotropic.Sigma(len(at), _TIED)))


def _minimize(
    system: System,
    values: gtsam.Values,
    tolerance: float = _ERROR_TOLERANCE,
    most: int = _MOST_ITERATIONS,
    most_damping: float = _MOST_DAMPING,
    unsettled: bool = False,
) -> Solution:
    """Gauss-Newton steps, damped (Levenberg-Marquardt) only where full ones fail.

    A full step along a curved valley, such as that of two mounts whose product alone is known, leaves the floor and
    raises the error by what is of second order. Damping would only make it crawl; there the states are brought back to
    the floor instead, see `_along_valley`.

    A large step too leaves states off the floor, and by so much the next one would be misled about shared variables
    that little tells, such as a camera's roll: these swing, and the states after them, for steps on end. Where it is
    misled, states go to the floor alone in its place, also at the start if they are `unsettled`.
    """
    error = system.error(values)
    if not np.isfinite(error):
        return Solution(system, values, False, "the residuals at the start are not finite", 0)
    damping = 0.0
    for iteration in range(1, most + 1):
        linear, settled = _linearized(system, values), None
        while True:
            delta, foreseen = _step(system, values, linear, damping)
            candidate = values if delta is None else values.retract(delta)
            new_error = np.inf if delta is None else system.error(candidate)
            misled = abs(error - new_error - foreseen) > max(_MISLED, _MISLED * foreseen)
            if unsettled and misled and damping == 0.0:
                settled, its_error = _states_alone(system, values, linear)
                if its_error < error:
                    candidate, new_error, foreseen = settled, its_error, error - its_error
                    break
            if delta is not None and damping == 0.0 and error < new_error:
                candidate, new_error = _along_valley(system, values, error, delta)
            if new_error <= error + _ERROR_TOLERANCE:
                break
            if damping == 0.0 and delta is not None and foreseen < _LITTLE:
                return Solution(system, values, True, f"converged after {iteration} iterations", iteration)
            damping = max(10.0 * damping, 1e-6)
            if damping > most_damping:
                return Solution(system, values, False, f"no step lowers the error of {error:.6g}", iteration)
        fall, rounding = error - new_error, 1e-13 * error + 1e-10 * new_error
        values, error = candidate, new_error
        off = abs(fall - foreseen)
        small = foreseen < _LITTLE and fall < 0.3 * foreseen
        if damping == 0.0 and candidate is not settled and (small or min(fall, off) < tolerance + rounding):
            return Solution(system, values, True, f"converged after {iteration} iterations", iteration, off > _OFF)
        unsettled = damping == 0.0 and off > _OFF
        damping = damping / 10.0 if damping > 1e-6 else 0.0
    return Solution(system, values, False, f"not converged after {most} iterations", most)


def _states_alone(system: System, values: gtsam.Values, linear: Linear | None) -> tuple[gtsam.Values, float]:
    """Values and error where the states go with the shared variables held; infinite if they are not determined."""
    try:
        candidate = None if linear is None else values.retract(linear.states_alone())
    except IndeterminateError:
        candidate = None
    return (values, np.inf) if candidate is None else (candidate, system.error(candidate))


def _along_valley(
    system: System, values: gtsam.Values, error: float, delta: gtsam.VectorValues
) -> tuple[gtsam.Values, float]:
    """Values on a step's way with a lower error, and that error; infinite if there is none.

    The states are solved for anew with the shared variables held where the step takes them, and these go less far until
    that lowers the error.
    """
    for share in _SHARES:
        candidate = values.retract(delta.scale(share))
        for _ in range(_MOST_RETURNS):
            candidate, new_error = _returned(system, candidate)
            if new_error < error:
                return candidate, new_error
    return values, np.inf


def _returned(system: System, values: gtsam.Values) -> tuple[gtsam.Values, float]:
    """Values nearer to the floor, and their error: the states alone moved, or of a graph without any what is known."""
    linear = _linearized(system, values)
    if linear is None or linear.has_states:
        return _states_alone(system, values, linear)
    candidate = values.retract(linear.of_the_known())
    return candidate, system.error(candidate)


def _linearized(system: System, values: gtsam.Values) -> Linear | None:
    """A system about some values; None: a stretch does not determine what it alone holds."""
    try:
        return system.linearized(values)
    except IndeterminateError:
        return None


def _step(
    system: System, values: gtsam.Values, linear: Linear | None, damping: float
) -> tuple[gtsam.VectorValues | None, float]:
    """One (damped) step, None if the system is singular, and by how much it should lower the error."""
    try:
        if damping > 0.0:
            linear = system.linearized(values, damping) if linear is None else linear.damped(damping)
        return (None, 0.0) if linear is None else linear.step()
    except (RuntimeError, IndeterminateError):
        return None, 0.0
