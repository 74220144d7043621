"""The step of a rotation that all measurements share, at one moment of a recording: a mount that slips.

Every keyframe is a candidate. At the solution the problem is linear, and all that a step at keyframe j needs follows
from a filter that runs forward and one that runs backward, both with their derivatives by the shared parameters: with A
what the forward one has learned of these before j, B the backward one from j on, and (y, V) the difference of their
attitudes at j with its covariance,

    A(parameters) + B(parameters, step) + |y(parameters, step)|^2 / V     the step, the chain unbroken
    A(parameters) + B(parameters, step)                                   motion alone: the attitude is free to jump

A glitch of the reference jumps and has no say in motion; a slip has both, and they agree (Fraser, Potter, IEEE TAC 1969
for the two filters). A step passes for noise, so that levels at the solution hide it: the best candidates are solved
again with the rotation after the step as a variable of its own, levels, widening and linearisation included.

Limits: a parameter of which all measurements hold the same variable; steps of a bias that walks are not looked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.factors.model import ROT3
from alidade.pipelines.estimation.noise import CORRELATED_ERROR, ROUGHLY, Level
from alidade.pipelines.estimation.problem import APART, Factor, Parameter, StepEstimate
from alidade.pipelines.solvers.chain import UNDETERMINED, IndeterminateStateError, Index
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.levenberg import Solution
from alidade.pipelines.solvers.linear_chain import LinearChain, Rows, Widening, add_blocks
from alidade.pipelines.solvers.linearization import Group, Linearization
from alidade.pipelines.solvers.marginal_likelihood import (
    NO_SAY,
    SANDWICH_BLOCK_S,
    LikelihoodMaximum,
    maximise_likelihood,
    sandwich,
    scores,
    unwidened,
    widened,
)

# rad, one sigma of a step before anything is known.
STEP_PRIOR = 0.35
# Share of a recording at either end in which no step is looked for.
_MARGIN = 0.03
# Candidates that are nearer to another one than so many keyframes are that one.
_SAME = 2
# s, to which motion dates a step: half the time between steps that look different to it.
_DATED_S = 1.0
# s within which what jumped and comes back is a glitch of the reference.
_GLITCH_S = 2.0
# Keyframes that are scanned at once.
_BLOCK = 1000
# Fall of chi-square below which no candidate is solved again: 20 are needed for a change in a minute.
NOTHING = 12.0


@dataclass(frozen=True, eq=False)
class Scan:
    """Test statistics of a rotation step before each of J keyframes, linearised at the solution without a step.

    Attributes:
        keyframe: (J,) the first one after it.
        time, since: (J,) s of its first measurement, and of the last one before.
        fall: (J,) of chi-square with the step.
        by_motion: (J,) of the step with the attitude free to jump.
        apart: (J,) chi-square of the difference of both steps, by the covariance of that from motion alone.
        step, information: (J, 3), (J, 3, 3) with the chain unbroken, rad.
    """

    keyframe: Index
    time: Array
    since: Array
    fall: Array
    by_motion: Array
    apart: Array
    step: Array
    information: Array

    def best(self) -> list[int]:
        """Indices of up to four candidates: the largest falls, the largest joint test, the largest that agrees.

        Motion dates a step to about a second, the jump with the chain unbroken to a keyframe. The largest fall may be a
        glitch of the reference, and its end lies close to it.
        """
        both = np.minimum(self.fall, self.by_motion)
        apart = np.abs(self.time - self.time[np.argmax(self.fall)]) > _GLITCH_S
        found: list[int] = []
        for size in (self.fall, np.where(apart, self.fall, 0.0), both, np.where(self.apart < APART, both, 0.0)):
            near = np.abs(self.time - self.time[np.argmax(size)]) <= _DATED_S
            at = int(np.argmax(np.where(near, self.fall, -np.inf)))
            if all(abs(self.keyframe[at] - self.keyframe[i]) > _SAME for i in found):
                found.append(at)
        return found


def scan(chain: LinearChain, variances: Sequence[Array], columns: Index) -> Scan | None:
    """Test for a step of a rotation at every keyframe; None if the recording has too few keyframes.

    Args:
        chain: about the solution.
        variances: (n,) of each kind of rows.
        columns: of the parameter that may step, among the shared ones.
    """
    candidates, time, since = _candidates(chain)
    if not len(candidates):
        return None
    process_size = 0 if chain.process is None else chain.process.values.shape[1]
    parts = [_tests(*each, columns, process_size) for each in _two_sides(chain, variances, candidates)]
    return Scan(candidates, time, since, *(np.concatenate(each) for each in zip(*parts, strict=True)))


def _candidates(chain: LinearChain) -> tuple[Index, Array, Array]:
    """Indices of the keyframes with measurements, time of their first one and of the last one before, s."""
    n, parts = chain.size[0], [r for r in chain.rows if r.is_measurement and len(r.states) == 1]
    first, last = np.full(n, np.inf), np.full(n, -np.inf)
    for rows in parts:
        np.minimum.at(first, rows.states[0][0], rows.time)
        np.maximum.at(last, rows.states[0][0], rows.time)
    before = np.append(-np.inf, np.maximum.accumulate(last)[:-1])
    least = max(1, int(_MARGIN * n))
    k = np.flatnonzero(np.isfinite(first) & np.isfinite(before))
    k = k[(k >= least) & (k < n - least)]
    return k, first[k], before[k]


@dataclass(frozen=True, eq=False)
class _Pass:
    """One Kalman filter pass: predicted and updated states (N, d, 1 + p) with covariances (N, d, d).

    Attributes:
        X, P: predicted.
        Y, R: with the measurements there.
        own: H, g, of the measurements there: of the state, and of that and (1, shared).
    """

    X: Array
    P: Array
    Y: Array
    R: Array
    own: tuple[Array, Array]

    def learned(self, some: slice, beside: Array) -> Array:
        """Information (m, 1 + p, 1 + p) on (1, shared) from some keyframes' measurements, states marginalised out."""
        H, g = (each[some] for each in self.own)
        X, b = self.X[some], H @ self.X[some] + g
        crossed = np.swapaxes(X, 1, 2) @ (b + g)
        out: Array = beside + 0.5 * (crossed + np.swapaxes(crossed, 1, 2)) - np.swapaxes(b, 1, 2) @ self.R[some] @ b
        return out


def _filtered(chain: LinearChain, variances: Sequence[Array]) -> _Pass:
    """Run a Kalman filter over the keyframes, with the states' derivatives by the shared parameters."""
    (n, d), q = chain.size, chain.prior.shape[1]
    F, c, Q = chain.transitions(variances, True)
    H, g = np.zeros((n, d, d)), np.zeros((n, d, q))
    for rows, variance in zip(chain.rows, variances, strict=True):
        if len(rows.states) == 1:
            ((at, J),) = rows.states
            weighed = np.swapaxes(J, 1, 2) / variance[:, None, None]
            add_blocks(H, at, weighed @ J)
            add_blocks(g, at, weighed @ rows.right())
    X, P, Y, R = np.zeros((n, d, q)), np.zeros((n, d, d)), np.zeros((n, d, q)), np.zeros((n, d, d))
    unit = np.eye(d)
    for k in range(n):
        X[k], P[k] = (F[k] @ Y[k - 1] + c[k], F[k] @ R[k - 1] @ F[k].T + Q[k]) if k else (c[k], Q[k])
        R[k] = np.linalg.solve(unit + P[k] @ H[k], P[k])
        Y[k] = X[k] - R[k] @ (H[k] @ X[k] + g[k])
    return _Pass(X, P, Y, R, (H, g))


def _beside(chain: LinearChain, variances: Sequence[Array], begin: int, end: int) -> Array:
    """Weighted squares (m, 1 + p, 1 + p) of [residual | shared Jacobian] of some keyframes' measurements."""
    out = np.zeros((end - begin, chain.prior.shape[1], chain.prior.shape[1]))
    for rows, variance in zip(chain.rows, variances, strict=True):
        if len(rows.states) == 1:
            at = rows.states[0][0]
            some = np.flatnonzero((at >= begin) & (at < end))
            both = rows.right(some)
            add_blocks(out, at[some] - begin, np.swapaxes(both, 1, 2) @ both / variance[some, None, None])
    return out


def _two_sides(
    chain: LinearChain, variances: Sequence[Array], candidates: Index
) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
    """Yield information A, B (m, q, q), states X, Y (m, d, q) before and from j on, and V, in blocks of candidates j.

    A and X are from before j, priors included, B and Y from j on; V is that of their difference.
    """
    n, q = chain.size[0], chain.prior.shape[1]
    forward, backward = _filtered(chain, variances), _filtered(chain.reversed(), variances)

    def learned(begin: int) -> tuple[Array, Array]:
        end = min(begin + _BLOCK, n)
        beside = _beside(chain, variances, begin, end)
        back = backward.learned(slice(n - end, n - begin), beside[::-1])[::-1]
        return forward.learned(slice(begin, end), beside), back

    begins = range(0, n, _BLOCK)
    before, after = _alone(chain, variances), sum((learned(begin)[1].sum(axis=0) for begin in begins), np.zeros((q, q)))
    for begin in begins:
        ahead, back = learned(begin)
        own = candidates[(candidates >= begin) & (candidates < begin + len(ahead))]
        A, B = before + np.cumsum(ahead, axis=0) - ahead, after - np.cumsum(back, axis=0) + back
        before, after, late = before + ahead.sum(axis=0), after - back.sum(axis=0), n - 1 - own
        V = forward.P[own] + backward.R[late]
        yield A[own - begin], B[own - begin], forward.X[own], backward.Y[late], V


def _alone(chain: LinearChain, variances: Sequence[Array]) -> Array:
    """Information (q, q) on (1, shared) from priors and from rows that involve no state."""
    prior = np.roll(chain.prior, 1, axis=1)
    out: Array = prior.T @ prior
    for rows, variance in zip(chain.rows, variances, strict=True):
        if not rows.states:
            both = rows.right()
            out += np.einsum("nmi,nmj,n->ij", both, both, 1.0 / variance)
    return out


def _tests(A: Array, B: Array, X: Array, Y: Array, V: Array, columns: Index, process_size: int) -> tuple[Array, ...]:
    """Test statistics of candidates: fall of chi-square, fall by motion alone, their distance, step, information.

    With motion alone the attitude is free to jump, and not the last `process_size` numbers of a state, a process.
    """
    q, d = A.shape[1], len(columns)
    at = np.append(np.arange(q), 1 + columns)
    alone = B[:, at[:, None], at]
    alone[:, :q, :q] += A
    alone[:, q:, q:] += np.eye(d) / STEP_PRIOR**2
    link = Y[..., at]
    link[..., :q] -= X
    joined = alone + np.swapaxes(link, 1, 2) @ np.linalg.solve(V, link)
    if process_size:
        link, V = link[:, -process_size:], V[:, -process_size:, -process_size:]
        alone = alone + np.swapaxes(link, 1, 2) @ np.linalg.solve(V, link)
    fall, step, information = _step_of(joined, q)
    by_motion, moved, of_motion = _step_of(alone, q)
    return fall, by_motion, _square(of_motion, moved - step), step, information


def _step_of(N: Array, q: int) -> tuple[Array, Array, Array]:
    """Chi-square, value and information of the step, from information N (m, ., .) on (1, shared, step)."""
    right = np.concatenate([N[:, 1:q, :1], N[:, 1:q, q:]], axis=2)
    solved = np.linalg.solve(N[:, 1:q, 1:q], right)
    whole = np.concatenate([N[:, q:, :1], N[:, q:, q:]], axis=2) - N[:, q:, 1:q] @ solved
    information = whole[..., 1:]
    step = np.asarray(-np.linalg.solve(information, whole[..., :1])[..., 0])
    return _square(information, step), step, information


def _square(information: Array, x: Array) -> Array:
    """Quadratic form x' information x, (n,)."""
    return np.asarray(np.einsum("ni,nij,nj->n", x, information, x))


def largest_steps(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> tuple[StepEstimate, ...]:
    """Find the steps of one of `Problem.step_candidates` that explain a recording best, most significant first.

    Empty where the recording determines too little for the tests.
    """
    try:
        return _largest_steps(compiled, levels, solution)
    except (IndeterminateStateError, np.linalg.LinAlgError):
        return ()


def _largest_steps(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> tuple[StepEstimate, ...]:
    values = solution.values
    parameters = [p for p in compiled.problem.parameters if p.key in compiled.problem.step_candidates]
    engine = _with_wider_priors(compiled.engine, values, [p.key for p in parameters])
    used = solution.engine.inliers(values)
    outliers, transient = unwidened(used), unwidened([~_transient(~own) for own in used])
    base = _Fit.of(engine, values, levels, transient)
    scans = [(p, found) for p in parameters if (found := base.scanned(p)) is not None]
    steps = [_scanned(base, p, found) for p, found in scans if found.fall.max() < NOTHING]
    scans = [(p, found) for p, found in scans if found.fall.max() >= NOTHING]
    if scans:
        without = _maximised(engine, values, levels, outliers, transient)
        for p, found in scans:
            for i in found.best():
                with suppress(IndeterminateStateError, np.linalg.LinAlgError):
                    steps.append(_solved_again(without, base, outliers, transient, p, found, i))
    return tuple(sorted(steps, key=lambda step: (-step.statistic, -step.fall)))


def _with_wider_priors(engine: Linearization, values: Values, keys: Sequence[int]) -> Linearization:
    """Widen the priors of variables to how far the values are from them.

    At rest before a slip, motion alone says nothing of the mount, and its prior would count as the mount then.
    """
    groups, own = list(engine.groups), engine.layout.at(keys)
    for i, group in enumerate(groups):
        if group.target == "shared" and not group.is_measurement and len(group.at) == 1:
            far = np.linalg.norm(group.weighted(group.residuals(values)), axis=1)
            wide = np.where(np.isin(group.at[0], own), np.maximum(far, 1.0), 1.0)
            groups[i] = replace(group, weights=group.all_weights / wide[:, None])
    return engine.with_groups(groups)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Solution at the noise levels of largest marginal likelihood, with its linear chain and variances.

    Attributes:
        engine: with the noise stated.
        values, levels: there.
        chain: about it.
        variances: (n,) of each kind of rows.
        minus_two_log_likelihood: of it.
    """

    engine: Linearization
    values: Values
    levels: tuple[Level, ...]
    chain: LinearChain
    variances: list[Array]
    minus_two_log_likelihood: float

    @classmethod
    def of(cls, engine: Linearization, values: Values, levels: Sequence[Level], outliers: Widening) -> _Fit:
        chain = LinearChain.of(engine, values)
        wide = widened(chain, levels, outliers)
        widest = [np.where(np.isinf(out), np.inf, own) for out, own in zip(outliers, wide, strict=True)]
        variances = chain.variances(levels, widest, NO_SAY)
        known = [(np.log(level.scale) / max(level.noise.known, ROUGHLY)) ** 2 for level in levels]
        solved = chain.solved(variances)
        value = np.inf if solved is None else solved.value + float(sum(known))
        return cls(engine, values, tuple(levels), chain, variances, value)

    def scanned(self, parameter: Parameter) -> Scan | None:
        """Test for steps of a parameter at all keyframes; None if it is not shared or the recording too short."""
        layout = self.engine.layout
        columns = np.flatnonzero(layout.root_columns(parameter.key)[:, layout.sizes[3] :].any(axis=0))
        return scan(self.chain, self.variances, columns) if len(columns) else None


def _transient(outliers: Mask) -> Mask:
    """Mask (n,) of the outliers that have inliers both before and after: a disturbance of the reference that ends."""
    used = np.flatnonzero(~outliers)
    between = np.zeros(len(outliers), dtype=bool)
    if len(used):
        between[used[0] : used[-1]] = True
    return outliers & between


def _maximised(
    engine: Linearization, values: Values, levels: Sequence[Level], outliers: Widening, transient: Widening
) -> _Fit:
    """Maximise the marginal likelihood over noise levels and values from initial ones."""
    best = maximise_likelihood(engine, LikelihoodMaximum(values, tuple(levels), outliers))
    return _Fit.of(engine, best.values, best.levels, transient)


def _scanned(base: _Fit, parameter: Parameter, found: Scan) -> StepEstimate:
    """Estimate of the step with the largest fall of chi-square, linearised at the solution without a step."""
    i = int(np.argmax(found.fall))
    layout, covariance = base.engine.layout, np.linalg.inv(found.information[i])
    _, J = parameter.coordinates(layout.to_gtsam(base.values, [parameter.key]), parameter.key)
    named = _named(parameter, J @ found.step[i], J @ covariance @ J.T)
    tests = float(found.fall[i]), float(found.by_motion[i]), float(found.apart[i])
    when = float(found.time[i]), float(found.since[i])
    return StepEstimate(*when, named, *_length(found.step[i], covariance), *tests, 1.0, 1.0, False)


def _named(parameter: Parameter, steps: Array, covariance: Array) -> dict[str, tuple[float, float]]:
    """Step and sigma of each quantity of a parameter, by name."""
    each = zip(steps.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True)
    return {q.name: step for q, step in zip(parameter.quantities, each, strict=True)}


def _length(step: Array, covariance: Array) -> tuple[float, float]:
    """Length of a vector, and its sigma along the vector."""
    length = float(np.linalg.norm(step))
    along = step / max(length, 1e-300)
    return length, float(np.sqrt(along @ covariance @ along))


def _solved_again(
    without: _Fit, base: _Fit, outliers: Widening, transient: Widening, parameter: Parameter, found: Scan, i: int
) -> StepEstimate:
    """Estimate a rotation's step at candidate i of a scan anew, noise levels and widening included.

    Raises:
        IndeterminateStateError, numpy.linalg.LinAlgError: undetermined with the step.
    """
    engine, values, late = split(base.engine, base.values, parameter.key, float(found.time[i]), found.step[i])
    fit = _maximised(engine, values, base.levels, outliers, transient)
    link = [_leads_to(rows, int(found.keyframe[i])) for rows in fit.chain.rows]
    apart = [np.where(to, np.inf, v) for v, to in zip(fit.variances, link, strict=True)]
    joined, alone = fit.chain.solved(fit.variances), fit.chain.solved(apart)
    if joined is None or alone is None:
        raise IndeterminateStateError(UNDETERMINED)
    layout, c = engine.layout, engine.layout.sizes[3]
    first, second = (layout.root_columns(key)[:, c:] for key in (parameter.key, late))
    turn = so3.local(layout.of_key(fit.values, parameter.key), layout.of_key(fit.values, late))
    # Log(A^-1 B) with A Exp(a), B Exp(b).
    D = so3.right_jacobian_inverse(turn) @ (second - so3.matrix(so3.exp(-turn)) @ first)
    C, moved = joined.covariance(D), alone.covariance(D)
    step, by_motion = turn + D @ joined.shared, turn + D @ alone.shared
    ratio_moved, _ = sandwich_ratios(fit.chain, apart, D, first, alone.shared)
    of_step, of_mount = sandwich_ratios(fit.chain, fit.variances, D, first, joined.shared)
    times = np.concatenate([rows.time for rows in fit.chain.rows if rows.is_measurement])
    short = min(found.time[i] - times.min(), times.max() - found.time[i]) < SANDWICH_BLOCK_S
    # A side shorter than a block has no scores of its own: its errors are correlated as everywhere.
    ratio = max(of_step, ratio_moved, of_mount if short else 1.0)
    fall = without.minus_two_log_likelihood - fit.minus_two_log_likelihood
    # Log det of the step's information is what a prior of its width would pay: no evidence for a step.
    fall -= float(np.linalg.slogdet(C)[1])
    at = layout.to_gtsam(fit.values, [parameter.key, late])
    (a, by_a), (b, by_b) = (parameter.coordinates(at, key) for key in (parameter.key, late))
    J = by_b @ second - by_a @ first
    length, sigma = _length(step, C)
    jumped = fall > NOTHING * ratio**2 and length > 3.0 * ratio * sigma
    return StepEstimate(
        float(found.time[i]),
        float(found.since[i]),
        _named(parameter, b - a + J @ joined.shared, joined.covariance(J)),
        length,
        sigma,
        fall,
        float(by_motion @ np.linalg.solve(moved, by_motion)),
        float((by_motion - step) @ np.linalg.solve(moved, by_motion - step)),
        ratio,
        ratio_moved,
        jumped and not _returns(fit, np.flatnonzero(second.any(axis=0)), float(found.time[i]), turn),
    )


def _returns(fit: _Fit, columns: Index, time: float, turn: Array) -> bool:
    """Whether a rotation steps back within `_GLITCH_S`: a glitch of the reference, not a slip of the mount.

    Args:
        fit: with the step.
        columns: of the rotation after it, among the shared parameters.
        time: of the step, s.
        turn: (3,) the step.
    """
    back = scan(fit.chain, fit.variances, columns)
    if back is None:
        return False
    soon = (back.time > time) & (back.time <= time + _GLITCH_S)
    at = int(np.argmax(np.where(soon, back.fall, -np.inf)))
    halved = np.linalg.norm(turn + back.step[at]) < 0.5 * np.linalg.norm(turn)
    return bool(soon[at] and back.fall[at] > APART and halved)


def _leads_to(rows: Rows, keyframe: int) -> Mask:
    """Mask (n,) of linearised rows that join the attitude at a keyframe to that at the keyframe before."""
    if len(rows.states) != 2 or rows.family == CORRELATED_ERROR:
        return np.zeros(len(rows.time), dtype=bool)
    return np.asarray(rows.states[1][0] == keyframe)


def sandwich_ratios(
    chain: LinearChain, variances: Sequence[Array], D: Array, mount: Array, at: Array
) -> tuple[float, float]:
    """Return the largest ratio of sandwich to nominal sigma of a mount's step, and of the mount, the step held fixed.

    The latter is that of the errors of all blocks, also where one side of the step has none of its own. Of all
    directions of each; at least 1.

    Args:
        chain: about the solution without `at`.
        variances: (n,) of each kind of rows.
        D, mount: Jacobians (3, p) of the step and of the mount before it by the shared parameters.
        at: (p,) the solution.
    """
    information, of_scores, _ = scores(chain, variances, at)
    fixed = np.linalg.qr(D.T, mode="complete")[0][:, len(D) :]
    held = sandwich(*(fixed.T @ each @ fixed for each in (information, of_scores)))
    return _largest(D, *sandwich(information, of_scores)), _largest(mount @ fixed, *held)


def _largest(J: Array, nominal: Array, robust: Array) -> float:
    """Largest ratio of robust to nominal sigma, at least 1, over all directions of numbers with Jacobian J."""
    root = np.linalg.inv(np.linalg.cholesky(J @ nominal @ J.T))
    return max(1.0, float(np.linalg.eigvalsh(root @ J @ robust @ J.T @ root.T)[-1]) ** 0.5)


def split(
    engine: Linearization, values: Values, key: int, time: float, step: Array
) -> tuple[Linearization, Values, int]:
    """Add a second rotation in force from a time on; return linearisation, values and the rotation's key.

    Args:
        engine: as it is.
        values: of it.
        key: of the rotation.
        time: s; measurements from it on have the new one.
        step: (3,) first guess of Log(R^-1 R_late); R and R_late are joined by a prior of `STEP_PRIOR`.
    """
    import gtsam

    layout = engine.layout
    (at,) = layout.at([key]).tolist()
    moved = so3.multiply(values.arrays[ROT3][layout.row[at]], so3.exp(step))
    grown, values, late = layout.with_shared(values, ROT3, moved)
    further = int(grown.shared[late] - layout.shared[at])
    groups = [_with_late(group, at, late, int(grown.row[late]), further, time) for group in engine.groups]
    noise = gtsam.noiseModel.Isotropic.Sigma(3, STEP_PRIOR)
    joined = Factor("prior", gtsam.BetweenFactorRot3(key, int(grown.key[late]), gtsam.Rot3(), noise))
    prior = Linearization.of([joined], grown, chain=False).groups
    return replace(engine, layout=grown, groups=[*groups, *prior]), values, int(grown.key[late])


def _with_late(group: Group, at: int, late: int, row: int, further: int, time: float) -> Group:
    """Rewire a group's measurements from a time on to another variable, `further` columns to the right."""
    blocks = [i for i, each in enumerate(group.at) if group.is_measurement and (each == at).all()]
    if not blocks:
        return group
    (i,) = blocks
    after = group.model.time >= time
    positions, gather, columns = list(group.at), list(group.gather), list(group.columns)
    positions[i] = np.where(after, late, at)
    gather[i] = (gather[i][0], np.where(after, row, gather[i][1]))
    columns[i] = [columns[i][0] + further * after[:, None]]
    return replace(group, at=positions, gather=gather, columns=columns)
