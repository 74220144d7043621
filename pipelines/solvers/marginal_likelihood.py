"""Noise levels by maximum marginal likelihood (Laplace), all families together with the parameters.

About a solution the problem is linear: rows r + J x of variance v(h), h the noise levels, x the states of a chain and
the shared parameters. Integrating x out leaves, up to a constant,

    -2 log L = chi2(minimum) + log det H + sum log v + sum ((log h - log h0) / sigma_h)^2

with H the information of states and parameters, priors included (Harville, J. Amer. Stat. Assoc. 1977; Barfoot, Forbes,
Yoon, IEEE RA-L 2020). Its gradient is zero where restricted maximum likelihood's equations hold. It is maximised over
log h at a fixed linearisation; the caller then solves with the levels found, and linearises again.

Measurements whose innovation lies beyond the gate are widened until it does not, never left out for that: leaving them
out lowers the level, and the lower level leaves out more. The nodes of a bias that walks stay where the solution has
them, relative to the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.factors.model import ROT3
from alidade.pipelines import deadline
from alidade.pipelines.estimation.noise import ROUGHLY, Level
from alidade.pipelines.estimation.problem import Problem, Residuals
from alidade.pipelines.solvers.chain import UNDETERMINED, IndeterminateStateError
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import certain_ratio, sigma_ratio
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import LevenbergConfig, Point, Solution, minimize, states_first
from alidade.pipelines.solvers.linear_chain import LinearChain, LinearSolution, Rows, Widening
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.noise_estimation import apply_levels
from alidade.pipelines.solvers.posterior import Reported

# A measurement is widened to the 99.9 % gate of its innovation, and an outlier beyond so many times that.
OUTLIER_GATES = 3.0
# By which the variance of a measurement without a say is multiplied, where it cannot be infinite.
NO_SAY = 1e12
# Keyframes that determine a correlation time.
ENOUGH_FOR_TIME = 2000
# Newton steps, none longer than this in the logarithm of a level; one that lowers -2 log L by less is the last: levels
# are then within .2 of their sigmas, as random signs have them.
_MOST_STEPS, _LONGEST_STEP, _SETTLED = 12, 1.5, 0.05
# A step may be shortened so often, and raise -2 log L by so much: rounding.
_HALVINGS, _FINE = 6, 1e-3
# s, within which errors may be correlated however they are.
SANDWICH_BLOCK_S = 5.0
# Linearisations before the first solution; solutions at most, or linearisations without solutions between; levels have
# settled whose logarithms move by less.
_ROUNDS, _MOST_SOLUTIONS, _STEADY = 2, 6, 0.05
# Sigmas above what is stated at which two noises of the same rows begin, see `_from_above`, and up to which a default
# is expected.
_ABOVE = 2.0
# Ratio of the noise of measurements at two sets of levels up to which these are the same.
_SAME = 1.2
# By which another maximum has to lower -2 log L: what one more noise does by chance once in a thousand.
_CLEARLY = 10.8
# s, correlation times at which an error is looked for, and between which its time is found; how finely, in the
# logarithm. With longer ones a slip passes for an error: 3 deg in 30 s of two pictures a second.
CORRELATION_TIMES, SHORTEST, LONGEST, _FINELY = (0.15, 0.5, 1.5), 0.05, SANDWICH_BLOCK_S / 3.0, 0.2
# Random right sides that estimate traces: a quarter of a level's own sigma.
_SIGNS = 24


def estimate_levels(
    chain: LinearChain, levels: Sequence[Level], widening: Widening | None = None, from_above: bool = False
) -> tuple[Level, ...]:
    """Estimate the noise levels of largest marginal likelihood at a linearisation, by average-information steps.

    What is stated counts as roughly known at first, which gives what the recording says; then as well as it is known,
    unless the recording contradicts it.

    Args:
        chain: the problem about a solution.
        levels: to begin with.
        widening: as it is, None: none.
        from_above: whether another maximum is looked for, see `_from_above`.

    Raises:
        IndeterminateStateError: states or parameters are not determined at the levels to begin with.
    """
    some, factors = chain.liveliest(chain.factors(widening))
    found, value = _maximum(some, factors, levels)
    above = _from_above(some, levels) if from_above else None
    if above is not None:
        other, least = _maximum(some, factors, above)
        if least < value - _CLEARLY:
            found = other
    if all(found[i].known >= ROUGHLY for i in _free(some, found)):
        return found
    used, _ = _maximum(some, factors, found, closely=True)
    return tuple(replace(now, found=then.found, sigma=then.sigma) for now, then in zip(used, found, strict=True))


def _free(chain: LinearChain, levels: Sequence[Level]) -> list[int]:
    """Indices of the levels that are estimated and of which a chain has rows."""
    return [i for i, each in enumerate(levels) if each.noise.estimated and any(r.has(each.noise) for r in chain.rows)]


def _maximum(
    chain: LinearChain, factors: Sequence[Array], levels: Sequence[Level], closely: bool = False
) -> tuple[tuple[Level, ...], float]:
    """Maximise the marginal likelihood over the free levels; return all levels and -2 log L with their prior.

    What parameters miss their priors by is not in it: a scale beyond its data sheet is no noise.

    Args:
        chain, levels: as above.
        factors: (n,) of the variances of each kind of rows.
        closely: whether levels count as known as well as they are, and not roughly.

    Raises:
        IndeterminateStateError: states or parameters are not determined at these levels.
    """
    free = _free(chain, levels)
    known = np.array([levels[i].known if closely else max(levels[i].noise.known, ROUGHLY) for i in free])
    generator = np.random.default_rng(0)
    signs = [generator.choice([-1.0, 1.0], (*rows.residuals.shape, _SIGNS)) for rows in chain.rows]

    def at(u: Array) -> tuple[float, tuple[Level, ...], LinearSolution | None]:
        scales = dict(zip(free, np.exp(u).tolist(), strict=True))
        tried = tuple(replace(level, scale=scales.get(i, level.scale)) for i, level in enumerate(levels))
        found = chain.solved([v * f for v, f in zip(chain.variances(tried), factors, strict=True)])
        return np.inf if found is None else found.value + float(((u / known) ** 2).sum()), tried, found

    if not free:
        return tuple(levels), at(np.zeros(0))[0]
    lowest = np.log([max(levels[i].noise.least, 1e-300) for i in free])
    u = np.maximum(np.log([levels[i].scale for i in free]), lowest)
    value, tried, solution = at(u)
    if solution is None:
        raise IndeterminateStateError(UNDETERMINED)
    information = np.diag(known**-2.0)
    for _ in range(_MOST_STEPS):
        if deadline.passed():
            break
        gradient, information = solution.score(_shares(chain, tried, free), signs)
        gradient, information = gradient + u / known**2, information + np.diag(known**-2.0)
        # What lies at its bound, and would go below, stays.
        moving = np.flatnonzero((u > lowest) | (gradient < 0.0))
        move = np.zeros(len(free))
        move[moving] = -np.linalg.solve(information[np.ix_(moving, moving)], gradient[moving])
        move = np.maximum(move, lowest - u)
        predicted, before = -float(gradient @ move), value
        move *= min(1.0, _LONGEST_STEP / max(float(np.abs(move).max()), 1e-300))
        for _ in range(_HALVINGS):
            ahead = at(u + move)
            if ahead[0] < value + _FINE:
                break
            move = 0.3 * move
        else:
            break
        u = u + move
        value, tried, solution = ahead
        assert solution is not None
        if min(predicted, before - value) < _SETTLED:
            break
    covariance = np.asarray(np.linalg.inv(information), dtype=float)
    spread = dict(zip(free, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    found = tuple(
        replace(level, found=level.scale, sigma=level.scale * spread[i]) if i in spread else level
        for i, level in enumerate(tried)
    )
    missed = chain.prior[:, :-1] @ solution.shared + chain.prior[:, -1]
    value += chain.log_det_of_process - float(missed @ missed)
    return _effective(chain, found, free, covariance), value


def unwidened(used: Sequence[Mask]) -> Widening:
    """Widening without effect: factor 1 for each group's inliers (n,), infinity for the rejected measurements."""
    return [np.where(own, 1.0, np.inf) for own in used]


def widened(chain: LinearChain, levels: Sequence[Level], widening: Widening) -> Widening:
    """Widening of the measurements at given noise levels; `widening` marks the measurements rejected so far.

    An outlier is what was rejected and, without any say of its own, lies beyond `OUTLIER_GATES` gates of the solution:
    the innovation of the first measurements has no prediction.

    Raises:
        IndeterminateStateError: states or parameters are not determined without what was rejected, if anything was.
    """
    rejected = [np.isinf(each) for each in widening]
    stated, kept = chain.variances(levels), chain.variances(levels, unwidened([~each for each in rejected]), NO_SAY)
    residuals = [rows.residuals for rows in chain.rows]
    if any(rejected[rows.group].any() for rows in chain.rows if rows.is_measurement):
        # Only what was rejected is judged by the residuals that the solution leaves.
        solution = chain.solved(kept)
        if solution is None:
            raise IndeterminateStateError(UNDETERMINED)
        residuals = solution.residuals()
    limits, found = chain.limits, list(widening)
    for kind, each in chain.innovations(kept, limits).items():
        group, limit = chain.rows[kind].group, limits[kind]
        left = (residuals[kind] ** 2).sum(axis=1) / stated[kind]
        wide = np.sqrt(np.maximum(np.where(rejected[group], left, each.squares) / limit, 1.0))
        found[group] = np.where(rejected[group] & (left > OUTLIER_GATES**2 * limit), np.inf, wide)
    return found


def scores(chain: LinearChain, variances: Sequence[Array], at: Array | None = None) -> tuple[Array, Array, int]:
    """Return information (p, p) of the shared parameters, covariance (p, p) of its scores, and the number of blocks.

    With innovations e and their derivatives G by the shared parameters the one is G'G, the other, which is the same for
    white noise, the sum over blocks of `SANDWICH_BLOCK_S` of G'e e'G, whatever is correlated within blocks. Both have
    the prior's information.

    Args:
        chain: about the solution.
        variances: (n,) of each kind of rows.
        at: (p,) the solution, from where the chain is about it; None: there.
    """
    p = chain.prior.shape[1] - 1
    known = chain.prior[:, :p].T @ chain.prior[:, :p]
    information, of_scores, blocks = known.copy(), known.copy(), 0
    for rows, G, e in innovations_by_shared(chain, variances, at):
        information += np.einsum("nmi,nmj->ij", G, G)
        block = ((rows.time - rows.time.min()) / SANDWICH_BLOCK_S).astype(int)
        blocks = int(block.max()) + 1
        sums = np.zeros((blocks, p))
        np.add.at(sums, block, np.einsum("nmi,nm->ni", G, e))
        of_scores += sums.T @ sums
    return information, of_scores, blocks


def innovations_by_shared(
    chain: LinearChain, variances: Sequence[Array], at: Array | None = None
) -> Iterator[tuple[Rows, Array, Array]]:
    """Yield each kind of measurements with the derivatives (n, m, p) of their innovations, and these (n, m).

    Arguments as of `scores`.
    """
    for kind, each in chain.innovations(variances, chain.limits, by_shared=True).items():
        G = each.whitened[..., 1:]
        yield chain.rows[kind], G, each.whitened[..., 0] + (0.0 if at is None else G @ at)


def sandwich(information: Array, of_scores: Array) -> tuple[Array, Array]:
    """Return nominal and sandwich covariance from the information (p, p) and the covariance of its scores (p, p).

    C = information^-1 and C B C with B of the scores: Liang, Zeger, Biometrika 1986.
    """
    C = np.asarray(np.linalg.pinv(information, hermitian=True))
    return C, C @ of_scores @ C


def _shares(chain: LinearChain, levels: Sequence[Level], which: Sequence[int]) -> list[list[Array]]:
    """Shares (n,) of the variance of each kind of rows that the levels `which` contribute."""
    return [[rows.share(levels[i], levels) for rows in chain.rows] for i in which]


def _effective(
    chain: LinearChain, levels: Sequence[Level], free: Sequence[int], covariance: Array
) -> tuple[Level, ...]:
    """Set the effective total noise of each level whose rows an additional noise shares that nobody states.

    `covariance` (k, k) is of the logarithms of the free ones.
    """
    unstated = [level.noise for level in levels if level.noise.beside and level.noise.source == "default"]
    out, added = list(levels), {family for noise in unstated for family in noise.families}
    for i, level in enumerate(levels):
        own = [k for k, rows in enumerate(chain.rows) if rows.family in added & {*level.noise.families}]
        if level.noise.beside or not own:
            continue
        variance = np.concatenate([chain.rows[k].variance(levels) for k in own])
        parts = [np.concatenate([each[k] for k in own]) for each in _shares(chain, levels, free)]
        shares = np.array([(part * variance).sum() for part in parts]) / variance.sum()
        size = float(np.sqrt(variance.mean()))
        out[i] = replace(level, effective=(size, size * float(shares @ covariance @ shares) ** 0.5))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class LikelihoodMaximum:
    """Values, noise levels and widening at or near the maximum of the marginal likelihood.

    Attributes:
        values: of all variables.
        levels: of the noises.
        widening: of the measurements.
    """

    values: Values
    levels: tuple[Level, ...]
    widening: Widening


def maximise_likelihood(
    linearization: Linearization, start: LikelihoodMaximum, rounds: int = _MOST_SOLUTIONS, from_above: bool = False
) -> LikelihoodMaximum:
    """Maximise the marginal likelihood by alternating noise levels and Gauss-Newton steps of the values.

    Nodes of a bias stay where they are.

    Args:
        linearization: of the factors, with the noise stated.
        start: values near the solution, levels, what is widened and rejected.
        rounds: linearisations, at most; two or more end once the levels have settled.
        from_above: whether another maximum is looked for, see `_from_above`.
    """
    _, _, nodes, c, _ = linearization.layout.sizes
    for number in range(rounds):
        if deadline.passed():
            break
        chain, before = LinearChain.of(linearization, start.values), start.levels
        levels = estimate_levels(chain, start.levels, start.widening, from_above)
        widening, values = widened(chain, levels, start.widening), start.values
        solution = chain.solved(chain.variances(levels, widening))
        if solution is not None:
            step = Tangent(solution.states.reshape(chain.size), np.zeros((nodes, c)), solution.shared)
            values = linearization.layout.retract(values, step)
        start = LikelihoodMaximum(values, levels, widening)
        if number and _settled(levels, before):
            break
    return start


def _settled(levels: Sequence[Level], before: Sequence[Level]) -> bool:
    """Whether no noise level moved by `_STEADY` in its logarithm from the one before."""
    return all(abs(np.log(a.scale / b.scale)) < _STEADY for a, b in zip(levels, before, strict=True))


def _from_above(chain: LinearChain, levels: Sequence[Level]) -> tuple[Level, ...] | None:
    """Start levels with equal shares, at `_ABOVE`, of all noises that have rows in common; None where none have any.

    -2 log L is flat in the logarithm of a level whose share vanishes: what begins there stays, and another noise takes
    its part.
    """
    out, found = list(levels), False
    for i, added in enumerate(levels):
        parts = [r.beside for r in chain.rows if r.family in added.noise.families and r.beside is not None]
        if not (added.noise.beside and added.noise.estimated and parts):
            continue
        for j, own in enumerate(levels):
            if not own.noise.beside and set(own.noise.families) & set(added.noise.families):
                above = float(np.exp(_ABOVE * own.noise.known)) if own.noise.estimated else 1.0
                out[j] = replace(own, scale=max(own.scale, above))
                unit = added.noise.stated * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
                out[i], found = replace(added, scale=out[j].scale / max(unit, 1e-300)), True
    return tuple(out) if found else None


def at_widening(linearization: Linearization, levels: Sequence[Level], widening: Widening) -> Linearization:
    """Return a linearisation weighted by noise levels and widened; outliers left out."""
    used = [np.isfinite(wide) for wide in widening]
    engine = apply_levels(linearization, levels).counting(used)
    groups = [
        replace(group, weights=group.all_weights / np.where(own, wide, 1.0)[:, None]) if group.is_measurement else group
        for group, wide, own in zip(engine.groups, widening, used, strict=True)
    ]
    return engine.with_groups(groups)


def solve_likelihood(
    compiled: Compiled, solution: Solution, levels: Sequence[Level], config: LevenbergConfig
) -> tuple[Compiled, Solution, tuple[Level, ...]]:
    """Minimise at the noise levels of largest marginal likelihood, on a refined graph if the levels need one.

    Args:
        compiled: the problem, compiled for the chain.
        solution: with the levels given.
        levels: to begin with.
        config: of the last minimisation.
    """
    problem = compiled.problem
    found = LikelihoodMaximum(solution.values, tuple(levels), unwidened(solution.engine.inliers(solution.values)))
    if problem.refined_graph is not None:
        found = maximise_likelihood(compiled.engine, found, rounds=1, from_above=True)
        found = replace(found, levels=_with_correlated_error(compiled, found))
        compiled, found = _for_levels(problem, compiled, found)
        over_time = _over_best_time(compiled, found)
        if over_time is not found.levels:
            compiled, found = _for_levels(problem, compiled, replace(found, levels=over_time))
    engine = compiled.engine
    for number in range(_MOST_SOLUTIONS):
        before = found.levels
        found = maximise_likelihood(engine, found, 1 if number else _ROUNDS, from_above=not number)
        solution = minimize(at_widening(engine, found.levels, found.widening), found.values, config)
        found = replace(found, values=solution.values)
        if deadline.passed() or (number and _settled(found.levels, before)):
            break
    return compiled, solution, found.levels


def _for_levels(problem: Problem, known: Compiled, found: LikelihoodMaximum) -> tuple[Compiled, LikelihoodMaximum]:
    """Compile the graph that noise levels need, with the parameters found; the known one where it serves."""
    graph = problem.at_levels(found.levels)
    if graph is problem:
        return known, found
    compiled = Compiled.of(graph, "chain")
    late = [g.model.time[np.isinf(w)] for g, w in zip(known.engine.groups, found.widening, strict=True)]
    times = np.concatenate(late)
    used = [~(np.isin(g.model.time, times) & g.is_measurement) for g in compiled.engine.groups]
    values = _with_parameters(compiled, known, found.values)
    found = LikelihoodMaximum(values, found.levels, unwidened(used))
    # Its first states follow vision's noise, and about these a scale of the gyro's rates would fit noise.
    engine = at_widening(compiled.engine, found.levels, found.widening)
    starts = [states_first(engine, each) for each in (values, *_attitudes_of_inliers(compiled, used, values))]
    found = replace(found, values=min(starts, key=engine.cost))
    if _correlation_time(found.levels) is not None:
        # Unwidened outliers would pass for noise, and once its level is small what is correlated stays so.
        chain = LinearChain.of(compiled.engine, found.values)
        found = replace(found, widening=widened(chain, found.levels, found.widening))
    return compiled, found


def _correlation_time(levels: Sequence[Level]) -> float | None:
    """Correlation time, s, of the error that one of the noise levels is of; None: all are white, or walks."""
    return next((each.noise.correlation_time for each in levels if each.noise.correlation_time is not None), None)


def _with_correlated_error(compiled: Compiled, found: LikelihoodMaximum) -> tuple[Level, ...]:
    """Return the noise levels, with that of a correlated error if the recording shows one that matters.

    It shows one if at one of `CORRELATION_TIMES` -2 log L falls by more than one more noise lowers it by chance.

    Args:
        compiled: the problem, in which such an error is looked for.
        found: the maximum without it.
    """
    error, layout = compiled.problem.correlated_error, compiled.layout
    if error is None or not error.level.noise.estimated:
        return found.levels
    columns = np.flatnonzero(layout.root_columns(error.key)[:, layout.sizes[3] :].any(axis=0))
    chain = LinearChain.of(compiled.engine, found.values)
    some, factors = chain.liveliest(chain.factors(found.widening))
    measured = {rows.family for rows in chain.rows if rows.is_measurement}
    # What is correlated passes for white noise, however little of that is stated.
    white = [each.used for each in found.levels if measured & {*each.noise.families} and not each.noise.beside]
    if not white:
        return found.levels
    start = replace(error.level, scale=max(white) / error.level.noise.stated)
    try:
        _, without = _maximum(some, factors, found.levels)
        wider = some.with_error(columns, error.level.noise.stated, CORRELATION_TIMES[0])
        factors = wider.with_process_factors(factors)
        tried = [
            _maximum(wider.with_correlation_time(time), factors, (*found.levels, start.over(time)))
            for time in CORRELATION_TIMES
        ]
    except IndeterminateStateError:
        # All pictures of a part of the chain are rejected.
        return found.levels
    levels, value = min(tried, key=lambda each: each[1])
    return levels if value < without - _CLEARLY and levels[-1].used > error.least else found.levels


def _over_best_time(compiled: Compiled, found: LikelihoodMaximum) -> tuple[Level, ...]:
    """Return the noise levels with the correlation time of largest marginal likelihood; the same if it is near.

    Args:
        compiled: the problem with a correlated error, or without.
        found: near the maximum with the correlation time as it is.
    """
    from scipy.optimize import minimize_scalar

    known = _correlation_time(found.levels)
    if known is None:
        return found.levels
    chain = LinearChain.of(compiled.engine, found.values)
    some, factors = chain.liveliest(chain.factors(found.widening), ENOUGH_FOR_TIME)
    tried: dict[float, tuple[Level, ...]] = {}

    def value(log_time: float) -> float:
        time, near = float(np.exp(log_time)), [found.levels, *tried.values()][-1]
        levels = [each if each.noise.correlation_time is None else each.over(time) for each in near]
        tried[log_time], least = _maximum(some.with_correlation_time(time), factors, levels)
        return least

    bounds = np.log([SHORTEST, LONGEST])
    try:
        best = float(minimize_scalar(value, bounds=bounds, method="bounded", options={"xatol": _FINELY}).x)
    except IndeterminateStateError:
        return found.levels
    return tried[best] if abs(best - np.log(known)) > _FINELY else found.levels


def _with_parameters(compiled: Compiled, known: Compiled, values: Values) -> Values:
    """Initial values of a problem with the parameters replaced by those of another graph of the problem."""
    layout, arrays = compiled.layout, {block: array.copy() for block, array in compiled.initial.arrays.items()}
    keys = [p.key for p in compiled.problem.parameters]
    for key, at in zip(keys, layout.at(keys).tolist(), strict=True):
        arrays[layout.blocks[layout.block[at]]][layout.row[at]] = known.layout.of_key(values, key)
    return Values(arrays)


def _attitudes_of_inliers(compiled: Compiled, used: Sequence[Mask], values: Values) -> list[Values]:
    """Initial values with the attitudes beside rejected measurements on arcs between those at others, if there are any.

    First attitudes are as measured. From one that is half a turn off no increment says which way to turn; over long
    rejected stretches they are better than arcs.
    """
    groups = [(g, own) for g, own in zip(compiled.engine.groups, used, strict=True) if g.is_measurement]
    seen = [(g.place[own], g.place[~own]) for g, own in groups if g.target == "state"]
    inliers, outliers = (np.unique(np.concatenate(each)) for each in zip(*seen, strict=True)) if seen else ((), ())
    kept = np.setdiff1d(inliers, outliers)
    layout = compiled.layout
    states = np.flatnonzero((layout.keyframe >= 0) & (layout.block == layout.blocks.index(ROT3)))
    keyframes, rows = layout.keyframe[states], layout.row[states]
    after = np.searchsorted(kept, keyframes)
    # Of keyframes between the same two inliers as an outlier.
    lost = np.isin(after, np.searchsorted(kept, outliers)) & ~np.isin(keyframes, kept)
    if len(kept) < 2 or not lost.any():
        return []
    arrays = {block: array.copy() for block, array in values.arrays.items()}
    measured = arrays[ROT3][rows[np.argsort(keyframes)]][kept]
    arrays[ROT3][rows[lost]] = so3.interpolate(kept, measured, keyframes[lost])
    return [Values(arrays)]


def sandwich_of(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> Array:
    """Ratio (n,) of sandwich to nominal sigma of the reported numbers; at least 1, and 1 if not significant.

    Above 1 where something errs slowly that no noise of the model has, as with the pose. Up to `certain_ratio` it
    counts as 1.
    """
    chain, variances = chain_about(compiled, levels, solution)
    reported = Reported.of(compiled, solution.values).jacobian[:, compiled.layout.sizes[3] :]
    information, of_scores, blocks = scores(chain, variances)
    nominal, robust = sandwich(information, of_scores)
    above, below = (np.einsum("ri,ij,rj->r", reported, C, reported) for C in (robust, nominal))
    ratio = sigma_ratio(below, above)
    return np.where(ratio > certain_ratio(blocks), np.maximum(ratio, 1.0), 1.0)


def chain_about(compiled: Compiled, levels: Sequence[Level], solution: Point) -> tuple[LinearChain, list[Array]]:
    """Linearise the chain about a solution; return it and the variances (n,) of each kind of rows."""
    chain = LinearChain.of(compiled.engine, solution.values)
    return chain, chain.variances(levels, unwidened(solution.engine.inliers(solution.values)), NO_SAY)


def levels_settled(
    compiled: Compiled, levels: Sequence[Level], solution: Solution, before: Sequence[Level], since: float
) -> bool:
    """Whether noise levels suffice for the measurements to come: determined, and the same as from less.

    A default is determined if the measurements exclude levels above it as its prior does: at `_ABOVE` of the prior's
    sigmas -2 log L rises by as much as the prior adds there. At rest it does not for what grows with motion; of
    measurements, that does not matter while it is a fifth of their noise even there. Levels are the same that give the
    measurements since then the same noise, to a fifth, as the levels before.

    Args:
        compiled, levels, solution: as above.
        before: levels of the solution before.
        since: time of that one, s.
    """
    chain = LinearChain.of(compiled.engine, solution.values)
    widening = unwidened(solution.engine.inliers(solution.values))
    found = chain.solved(chain.variances(levels, widening, NO_SAY))
    if found is None:
        return False
    for rows in chain.rows:
        late = rows.time > since
        now, then = (float(rows.variance(each)[late].mean()) if late.any() else 1.0 for each in (levels, before))
        if not _SAME**-2 < now / then < _SAME**2:
            return False
    for i, level in enumerate(levels):
        if not (level.noise.estimated and level.noise.source == "default"):
            continue
        above = replace(level, scale=level.scale * float(np.exp(_ABOVE * level.noise.known)))
        larger = [*levels[:i], above, *levels[i + 1 :]]
        own = [rows for rows in chain.rows if rows.has(level.noise)]
        if own and all(
            r.is_measurement and r.variance(larger).mean() < _SAME**2 * r.variance(levels).mean() for r in own
        ):
            continue
        tried = chain.solved(chain.variances(larger, widening, NO_SAY))
        if tried is not None and tried.value < found.value + _ABOVE**2:
            return False
    return True


def innovations_of(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> dict[str, Residuals]:
    """Innovations of each family at given noise levels: white, of unit variance, if the model is right."""
    chain, variances = chain_about(compiled, levels, solution)
    used = solution.engine.inliers(solution.values)
    return {
        chain.rows[k].family: Residuals(chain.rows[k].time, each.whitened[..., 0], used[chain.rows[k].group])
        for k, each in chain.innovations(variances, chain.limits).items()
    }
