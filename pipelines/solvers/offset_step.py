"""Test for a step of offsets at one moment, in graphs of shared unknowns alone: hard iron that moved.

A robust loss rejects what was recorded before a step as outliers, and coloured residuals widen sigmas until it passes.
So the test takes all measurements, each with Huber's weight, and the covariance of the step d from the steps d_b found
when one block of the recording is left out (delete-a-block jackknife: Künsch, "The jackknife and the bootstrap for
general stationary observations", Annals of Statistics 17, 1989):

    covariance of d = (n - 1) / n sum over n blocks of (d_b - d) (d_b - d)',     at least that of white noise

The device turns equally far in all blocks: while it rests it repeats one error, which no block would show. The moment
is that of the largest fall of chi-square. Of few blocks the chi-square of d is Hotelling's T^2, with the degrees of
freedom of a difference of two means (Welch 1947), tested at the level over the number of blocks (Bonferroni): within a
block all steps look alike.

Limits: blocks have to be longer than residuals are correlated. The first and the last fifth of what a device turns have
no moments.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array, Index
from alidade.pipelines.estimation.problem import OffsetStep
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.levenberg import Point
from alidade.pipelines.solvers.linearization import NOT_MEASURED
from alidade.pipelines.solvers.posterior import Reported

# Blocks, as of `ratio_by_blocks`, those on either side of a step at least, and moments in each. Of fewer measurements
# than moments, as of means over rests, each is a block.
_BLOCKS, _SIDE, _MOMENTS = 25, 5, 4
# Huber's bound, sigmas: 95 % as efficient as least squares on normal noise.
_BOUND = 1.345
# Parts whose mean Jacobians show how far a device turned.
_PARTS = 500


def largest_offset_step(compiled: Compiled, solution: Point) -> OffsetStep | None:
    """Find the most significant step of one of `Problem.offsets`; None with states, or with too few measurements.

    Args:
        compiled: the problem.
        solution: at its noise levels.
    """
    if not compiled.problem.offsets or compiled.layout.sizes[0] > 1:
        return None
    rows = _Rows.of(compiled, solution)
    if rows.block[-1] + 1 < 2 * _SIDE:
        return None
    reported = Reported.of(compiled, solution.values)
    inverse = np.asarray(np.linalg.pinv(reported.jacobian), dtype=float)
    found = []
    for names in compiled.problem.offsets:
        with suppress(np.linalg.LinAlgError):
            found.append(rows.largest(names, inverse[:, [reported.names.index(name) for name in names]]))
    if not found:
        return None
    best = min(found, key=lambda each: each.level)
    return replace(best, level=min(best.level * len(found), 1.0))


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of all measurements in order of time, in pieces.

    Attributes:
        starts: (pieces,) time of the first measurement of each, s.
        block: (pieces,) block that each is in.
        squares: (pieces, s + 1, s + 1) their normal equations, right side last.
        prior: (s + 1, s + 1) the same of priors.
        count: number of rows.
    """

    starts: Array
    block: Index
    squares: Array
    prior: Array
    count: int

    @classmethod
    def of(cls, compiled: Compiled, solution: Point) -> _Rows:
        """Linearise all measurements of a recording at a solution, each with Huber's weight."""
        size = compiled.layout.sizes[4] + 1
        times, measured, weighted, prior = list[Array](), list[Array](), list[Array](), np.zeros((size, size))
        for group in solution.engine.groups:
            rows = np.concatenate(replace(group, loss=None, excluded=None).rows(solution.values, size)[0])
            if group.family in NOT_MEASURED:
                prior += rows.T @ rows
                continue
            weights = np.minimum(1.0, _BOUND / np.maximum(np.abs(rows[:, -1:]), 1e-300))
            times.append(np.repeat(group.model.time, group.model.rows))
            measured.append(rows)
            weighted.append(np.sqrt(weights) * rows)
        time = np.concatenate(times)
        order, n = np.argsort(time, kind="stable"), len(time)
        blocks, pieces = (n, n) if n < _BLOCKS * _MOMENTS else (_BLOCKS, _BLOCKS * _MOMENTS)
        starts = _equal_turns(np.concatenate(measured)[order, :-1], pieces)
        squares = np.array([rows.T @ rows for rows in np.split(np.concatenate(weighted)[order], starts[1:])])
        return cls(time[order][starts], np.arange(pieces) * blocks // pieces, squares, prior, n)

    def largest(self, names: tuple[str, ...], moves: Array) -> OffsetStep:
        """Most significant step of numbers (q,) whose unit moves (s, q) the shared unknowns.

        Raises numpy.linalg.LinAlgError where it is not determined.
        """
        pieces, blocks = len(self.starts), int(self.block[-1]) + 1
        least, prior = -(-_SIDE * pieces // blocks), self._prior_without(moves)
        tests = [self._test(moment, moves, prior) for moment in range(least, pieces - least + 1)]
        best = int(np.argmax([fall for fall, *_ in tests]))
        _, size, step, covariance = tests[best]
        each = zip(names, zip(step.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True), strict=True)
        level = _level(size, len(names), blocks * (least + best) / pieces, blocks)
        tried = blocks - 2 * _SIDE + 1
        return OffsetStep(float(self.starts[least + best]), as_sigmas(level), min(level * tried, 1.0), dict(each))

    def _prior_without(self, moves: Array) -> Array:
        """Normal equations (s + 1, s + 1) of the priors, their say on the numbers that step taken out.

        A prior that the recording contradicts would ask for a step.
        """
        of_moves = self.prior[:, :-1] @ moves
        return self.prior - of_moves @ np.linalg.pinv(moves.T @ of_moves[:-1]) @ of_moves.T

    def _test(self, moment: int, moves: Array, prior: Array) -> tuple[float, float, Array, Array]:
        """Fall of chi-square by a step before a piece, its test statistic, the step (q,) and its covariance (q, q)."""
        s, q = moves.shape
        after = np.block([[np.eye(s), moves, np.zeros((s, 1))], [np.zeros((1, s + q)), np.ones((1, 1))]])
        before = after * np.repeat([1.0, 0.0, 1.0], [s, q, 1])
        of_blocks = np.zeros((int(self.block[-1]) + 1, s + q + 1, s + q + 1))
        for part, columns in ((slice(moment), before), (slice(moment, None), after)):
            np.add.at(of_blocks, self.block[part], columns.T @ self.squares[part] @ columns)
        whole = before.T @ prior @ before + of_blocks.sum(axis=0)
        found = np.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        without = whole - of_blocks
        each = np.linalg.solve(without[:, :-1, :-1], without[:, :-1, -1:])[..., 0]
        step, off = found[s:], (each - found)[:, s:]
        robust = off.T @ off * ((len(off) - 1.0) / len(off))
        left = (whole[-1, -1] - whole[-1, :-1] @ found) / max(self.count - len(found), 1)
        white = np.linalg.inv(whole[:-1, :-1])[s:, s:] * left
        sizes = [float(step @ np.linalg.solve(covariance, step)) for covariance in (robust, white)]
        return sizes[1], min(sizes), step, robust if sizes[0] <= sizes[1] else white


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


def _level(square: float, q: int, before: float, blocks: int) -> float:
    """p-value of Hotelling's T^2 of a difference of q means, with so many `blocks`, some of them `before`."""
    from scipy.special import fdtrc

    counts = np.array([before, blocks - before])
    dof = np.square((1.0 / counts).sum()) / (1.0 / (counts**2 * (counts - 1.0))).sum()
    return float(fdtrc(q, dof - q + 1.0, square * (dof - q + 1.0) / (q * dof)))


def as_sigmas(level: float) -> float:
    """Convert a p-value to the size of a standard normal number that is exceeded with that probability."""
    from scipy.special import ndtri

    return float(-ndtri(np.clip(level, np.finfo(float).tiny, 1.0 - np.finfo(float).eps)))
