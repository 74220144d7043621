"""Test for a step of offsets at one moment: hard iron that moved, a gyro bias that jumped.

Rows of measurements are summed in pieces, before and after a moment (Andrews, "Tests for parameter instability and
structural change with unknown change point", Econometrica 61, 1993). In a graph without states they are residuals, in a
chain of states innovations of the inliers with their derivatives by the shared unknowns. They have Huber's weight; of
residuals also what the robust loss rejects, as it does all before a step. The moment is that of the largest fall of
chi-square.

The covariance W of the step d holds for white noise. With the steps d_b found when one block of the recording is left
out (delete-a-block jackknife: Künsch, "The jackknife and the bootstrap for general stationary observations", Annals of
Statistics 17, 1989), the ratio r of actual to white sigmas of q offsets, pooled and along d, is

    J = (n - 1) / n sum over n blocks of (d_b - d) (d_b - d)'
    r^2 = max(1, trace(W^-1 J) / q, d' W^-1 J W^-1 d / d' W^-1 d)

and d' W^-1 d / (q r^2) is F-distributed. Each offset adds the degrees of freedom of a difference of two means (Welch
1947). The p-value is that of one moment times the number of blocks (Bonferroni): within a block all steps look alike.

Residuals at rest repeat one error, which no block would show: in all blocks the device turns equally far. Innovations
at rest are new information: all blocks have equally many rows.

Priors of the offsets have no say, since one that the recording contradicts would ask for a step. Those of the other
unknowns have, which may not be determined without.

Limits: blocks have to be longer than rows are correlated. The first and the last fifth have no moments. What an
innovation remembers of states before the step is left out, a second or so.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array, Index
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import OffsetStep
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.levenberg import Point
from alidade.pipelines.solvers.linearization import NOT_MEASURED
from alidade.pipelines.solvers.marginal_likelihood import chain_about, innovations_by_shared
from alidade.pipelines.solvers.posterior import Reported

# Blocks, as of `ratio_by_blocks`, those on either side of a step at least, and moments in each, fewer of few rows. Of
# less than `_FEWEST` rows a block, as of means over rests, each row is one.
_BLOCKS, _SIDE, _MOMENTS, _FEWEST = 25, 5, 10, 4
# Huber's bound, sigmas: normal noise seldom reaches it. 1.345, the usual one, makes a gyro bias's steps 14 % too small.
_BOUND = 3.0
# Parts whose mean Jacobians show how far a device turned.
_PARTS = 500


def largest_offset_step(
    compiled: Compiled, solution: Point, levels: Sequence[Level] | None = None
) -> OffsetStep | None:
    """Find the most significant step of one of `Problem.offsets`; None with too few rows, or where none is determined.

    Args:
        compiled: the problem.
        solution: at its noise levels.
        levels: of a chain of states; None: of a graph without states, with states there is no test.
    """
    if not compiled.problem.offsets or (levels is None and compiled.layout.sizes[0] > 1):
        return None
    pieces = _residuals(compiled, solution) if levels is None else _innovations(compiled, solution, levels)
    if pieces.blocks < 2 * _SIDE:
        return None
    reported = Reported.of(compiled, solution.values)
    inverse = np.asarray(np.linalg.pinv(reported.jacobian[:, compiled.layout.sizes[3] :]), dtype=float)
    found = list[OffsetStep]()
    for names in compiled.problem.offsets:
        with suppress(np.linalg.LinAlgError):
            found.append(pieces.largest(names, inverse[:, [reported.names.index(name) for name in names]]))
    best = min(found, key=lambda each: each.level, default=None)
    return None if best is None else replace(best, level=min(best.level * len(found), 1.0))


def _residuals(compiled: Compiled, solution: Point) -> _Pieces:
    """Linearise all measurements at a solution, also those rejected, and sum them in pieces of equal turn."""
    size = compiled.layout.sizes[4] + 1
    times, measured, prior = list[Array](), list[Array](), [np.zeros((0, size))]
    for group in solution.engine.groups:
        rows = np.concatenate(replace(group, loss=None, excluded=None).rows(solution.values, size)[0])
        if group.family in NOT_MEASURED:
            prior.append(rows)
            continue
        times.append(np.repeat(group.model.time, group.model.rows))
        measured.append(rows)
    return _Pieces.of(np.concatenate(times), np.concatenate(measured), np.concatenate(prior), by_turn=True)


def _innovations(compiled: Compiled, solution: Point, levels: Sequence[Level]) -> _Pieces:
    """Sum the innovations of a chain's inliers about its solution in pieces of equally many rows."""
    chain, variances = chain_about(compiled, levels, solution)
    times, measured, inliers = list[Array](), list[Array](), solution.engine.inliers(solution.values)
    for kind, G, e in innovations_by_shared(chain, variances):
        used = inliers[kind.group]
        times.append(np.repeat(kind.time[used], e.shape[1]))
        measured.append(np.concatenate([G, -e[..., None]], axis=2)[used].reshape(-1, G.shape[2] + 1))
    prior = np.column_stack([chain.prior[:, :-1], -chain.prior[:, -1]])
    return _Pieces.of(np.concatenate(times), np.concatenate(measured), prior, by_turn=False)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Normal equations of a recording's rows [derivatives by the shared unknowns | right side], in pieces by time.

    Attributes:
        starts: (pieces,) time of the first measurement of each, s.
        blocks: number of blocks, each of as many pieces.
        squares: (pieces, s + 1, s + 1) their normal equations, right side last.
        prior: (s + 1, s + 1) the same of priors.
        count: number of rows.
    """

    starts: Array
    blocks: int
    squares: Array
    prior: Array
    count: int

    @classmethod
    def of(cls, time: Array, rows: Array, prior: Array, by_turn: bool) -> _Pieces:
        """Sum rows (n, s + 1), each with Huber's weight, in pieces of equal turn, or of equally many rows.

        Args:
            time: (n,) s.
            rows: of measurements, whitened.
            prior: (r, s + 1) rows of priors.
            by_turn: whether the device turns equally far in all pieces.
        """
        n, order = len(time), np.argsort(time, kind="stable")
        time, rows = time[order], rows[order]
        blocks = n if n < _FEWEST * _BLOCKS else _BLOCKS
        pieces = blocks * min(_MOMENTS, n // blocks)
        first = _equal_turns(rows[:, :-1], pieces) if by_turn else np.arange(pieces) * n // pieces
        weights = np.minimum(1.0, _BOUND / np.maximum(np.abs(rows[:, -1:]), 1e-300))
        squares = np.array([each.T @ each for each in np.split(np.sqrt(weights) * rows, first[1:])])
        return cls(time[first], blocks, squares, prior.T @ prior, n)

    def largest(self, names: tuple[str, ...], moves: Array) -> OffsetStep:
        """Most significant step of numbers (q,) whose unit moves (s, q) the shared unknowns.

        Raises numpy.linalg.LinAlgError where it is not determined.
        """
        from scipy.special import fdtrc

        pieces, q = len(self.starts), len(names)
        of_moves = self.prior[:, :-1] @ moves
        prior = self.prior - of_moves @ np.linalg.pinv(moves.T @ of_moves[:-1]) @ of_moves.T
        least = _SIDE * pieces // self.blocks
        steps = [self._step(moment, moves, prior) for moment in range(least, pieces - least + 1)]
        best = int(np.argmax([fall for fall, *_ in steps]))
        fall, step, white = steps[best]
        ratio = self._ratio(least + best, moves, prior, step, white)
        sides = self.blocks * np.array([least + best, pieces - least - best]) / pieces
        dof = np.square((1.0 / sides).sum()) / (1.0 / (sides**2 * (sides - 1.0))).sum()
        level = float(fdtrc(q, q * dof, fall / (q * ratio**2)))
        sigmas = ratio * np.sqrt(np.diag(white))
        each = dict(zip(names, zip(step.tolist(), sigmas.tolist(), strict=True), strict=True))
        tried = self.blocks - 2 * _SIDE + 1
        return OffsetStep(float(self.starts[least + best]), _as_sigmas(level), min(level * tried, 1.0), each)

    def _step(self, moment: int, moves: Array, prior: Array) -> tuple[float, Array, Array]:
        """Fall of chi-square by a step before a piece, the step (q,), and its covariance (q, q) under white noise."""
        s, (before, after) = len(moves), _columns(moves)
        sums = [each.sum(axis=0) for each in (self.squares[:moment], self.squares[moment:])]
        whole = before.T @ (prior + sums[0]) @ before + after.T @ sums[1] @ after
        found = np.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        left = (whole[-1, -1] - whole[-1, :-1] @ found) / max(self.count - len(found), 1)
        white = np.linalg.inv(whole[:-1, :-1])[s:, s:] * left
        return float(found[s:] @ np.linalg.solve(white, found[s:])), found[s:], white

    def _ratio(self, moment: int, moves: Array, prior: Array, step: Array, white: Array) -> float:
        """Ratio of jackknife to white sigma of a step, at least 1.

        Args:
            moment: piece before which the step is.
            moves, prior: of the offsets; normal equations of the priors, without their say on these.
            step, white: (q,) and its covariance (q, q) under white noise.
        """
        q, (before, after) = len(step), _columns(moves)
        each = np.concatenate([before.T @ self.squares[:moment] @ before, after.T @ self.squares[moment:] @ after])
        of_blocks = np.add.reduceat(each, np.arange(0, len(each), len(each) // self.blocks))
        without = before.T @ prior @ before + of_blocks.sum(axis=0) - of_blocks
        found = np.linalg.solve(without[:, :-1, :-1], without[:, :-1, -1:])[:, -q:, 0]
        off = found - step
        jackknife = off.T @ off * ((self.blocks - 1.0) / self.blocks)
        along = np.linalg.solve(white, step)
        pooled = float(np.trace(np.linalg.solve(white, jackknife))) / q
        return float(np.sqrt(max(1.0, pooled, float(along @ jackknife @ along / (along @ step)))))


def _columns(moves: Array) -> tuple[Array, Array]:
    """Matrices (s + 1, s + q + 1) that map shared unknowns and a step to the unknowns before and after the step."""
    s, q = moves.shape
    before = np.hstack([np.eye(s + 1, s), np.zeros((s + 1, q)), np.eye(s + 1)[:, s:]])
    after = before.copy()
    after[:s, s:-1] = moves
    return before, after


def _equal_turns(jacobians: Array, count: int) -> Index:
    """First rows (count,) of pieces of the Jacobians (n, s) in each of which the device turns as far."""
    n, parts = len(jacobians), min(_PARTS, len(jacobians))
    first, piece = np.arange(parts) * n // parts, np.arange(count)
    means = np.add.reduceat(jacobians, first) / np.diff(first, append=n)[:, None]
    means /= np.maximum(np.sqrt(np.square(means).mean(axis=0)), np.finfo(float).tiny)
    turned = np.cumsum(np.linalg.norm(np.diff(means, axis=0, prepend=means[:1]), axis=1))
    part = np.searchsorted(turned, turned[-1] * piece / count)
    # Each begins at a part of its own.
    part = np.minimum(np.maximum.accumulate(part - piece) + piece, parts - count + piece)
    return np.asarray(first[part])


def _as_sigmas(level: float) -> float:
    """Convert a p-value to the size of a standard normal number that is exceeded with that probability."""
    from scipy.special import ndtri

    return float(-ndtri(np.clip(level, np.finfo(float).tiny, 1.0 - np.finfo(float).eps)))
