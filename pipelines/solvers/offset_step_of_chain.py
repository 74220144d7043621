"""Test for a step of offsets at one moment, in a chain of states: a gyro bias that jumped.

By the innovations e of the solution, whitened, and their derivatives G by the shared unknowns, summed before and after
a moment (Andrews, "Tests for parameter instability and structural change with unknown change point", Econometrica 61,
1993). With I and S the sums of G'G and -G'e over the whole, I2 and S2 over what is after the moment, and M what a unit
of the offsets moves, the step d lowers chi-square by d' A d:

    d = A^-1 M' (S2 - I2 I^-1 S),     A = M' (I2 - I2 I^-1 I2) M

Its covariance is A^-1, or that of the scores of blocks with the step taken out where that is more. Priors have no say:
one that the recording contradicts would ask for a step. The moment is that of the largest fall, its p-value that of one
moment times their number (Bonferroni).

Limits: noise levels are those without a step, which raises them, and sigmas with them. What an innovation remembers of
states before the step is left out, a second or so. There are no moments in the first and the last seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import OffsetStep
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.levenberg import Solution
from alidade.pipelines.solvers.linear_chain import LinearChain
from alidade.pipelines.solvers.marginal_likelihood import SANDWICH_BLOCK_S, chain_about, innovations_by_shared
from alidade.pipelines.solvers.offset_step import as_sigmas
from alidade.pipelines.solvers.posterior import Reported

# s, blocks of scores; so many together count as independent, and are on either side of a moment.
_BLOCK_S = 1.0
_APART = round(SANDWICH_BLOCK_S / _BLOCK_S)


def largest_offset_step_of_chain(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> OffsetStep | None:
    """Find the most significant step of one of `Problem.offsets` in a chain.

    None without offsets, in a recording too short for a moment, and where no step is determined.

    Args:
        compiled: the problem.
        levels, solution: of it.
    """
    found: list[OffsetStep] = []
    if compiled.problem.offsets:
        scores = _Scores.of(*chain_about(compiled, levels, solution))
        jacobian = Reported.of(compiled, solution.values).jacobian[:, compiled.layout.sizes[3] :]
        inverse = np.asarray(np.linalg.pinv(jacobian), dtype=float)
        names = [q.name for q in compiled.problem.quantities]
        for offsets in compiled.problem.offsets:
            with suppress(np.linalg.LinAlgError, ValueError):
                found.append(scores.largest(offsets, inverse[:, [names.index(name) for name in offsets]]))
    best = min(found, key=lambda each: each.level, default=None)
    return None if best is None else replace(best, level=min(best.level * len(found), 1.0))


@dataclass(frozen=True, eq=False)
class _Scores:
    """Scores of a chain's shared unknowns, summed over blocks of `_BLOCK_S`.

    Attributes:
        start: of the first block, s.
        information: (B, s, s) of each.
        scores: (B, s) as innovations ask the unknowns to move.
    """

    start: float
    information: Array
    scores: Array

    @classmethod
    def of(cls, chain: LinearChain, variances: Sequence[Array]) -> _Scores:
        """Sum the scores of all measurements of a chain about its solution."""
        s, times = chain.prior.shape[1] - 1, [rows.time for rows in chain.rows if rows.is_measurement]
        start, stop = min(float(t.min()) for t in times), max(float(t.max()) for t in times)
        count = 1 + int((stop - start) / _BLOCK_S)
        out = cls(start, np.zeros((count, s, s)), np.zeros((count, s)))
        for time, G, e in innovations_by_shared(chain, variances):
            order = np.argsort(time, kind="stable")
            firsts = np.searchsorted(time[order], start + _BLOCK_S * np.arange(count + 1))
            for block, (first, last) in enumerate(pairwise(firsts.tolist())):
                some = order[first:last]
                own = G[some].reshape(-1, s)
                out.information[block] += own.T @ own
                out.scores[block] -= e[some].ravel() @ own
        return out

    def largest(self, names: tuple[str, ...], moves: Array) -> OffsetStep:
        """Most significant step of numbers (q,) whose unit moves (s, q) the shared unknowns.

        Raises:
            numpy.linalg.LinAlgError: the step is not determined.
            ValueError: the recording is too short for any moment.
        """
        from scipy.special import chdtrc

        after, score = (np.cumsum(each[::-1], axis=0)[::-1] for each in (self.information, self.scores))
        scale = np.sqrt(np.maximum(np.diag(after[0]), np.finfo(float).tiny))
        known = np.linalg.pinv(after[0] / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        tests = []
        for first in range(_APART, len(self.scores) - _APART):
            seen = after[first] @ known
            A = moves.T @ (after[first] - seen @ after[first]) @ moves
            step = np.linalg.solve(A, moves.T @ (score[first] - seen @ score[0]))
            tests.append((float(step @ A @ step), first, step, A))
        fall, first, step, A = max(tests, key=lambda each: each[0])
        ratio = self._ratio(first, moves @ step, known, fall)
        level = float(chdtrc(len(names), fall / ratio**2))
        sigmas = ratio * np.sqrt(np.diag(np.linalg.inv(A)))
        steps = dict(zip(names, zip(step.tolist(), sigmas.tolist(), strict=True), strict=True))
        return OffsetStep(self.start + _BLOCK_S * first, as_sigmas(level), min(level * len(tests), 1.0), steps)

    def _ratio(self, first: int, move: Array, known: Array, fall: float) -> float:
        """Ratio of sandwich to nominal sigma of the size of a step, at least 1.

        Args:
            first: block from which on the step is.
            move: (s,) of the shared unknowns by the step.
            known: (s, s) covariance of the shared unknowns without the step.
            fall: of chi-square by the step.
        """
        later = np.arange(len(self.scores)) >= first
        of_move = known @ self.information[later].sum(axis=0) @ move
        whole = known @ self.scores.sum(axis=0) - of_move
        left = self.scores - self.information @ whole - later[:, None] * (self.information @ move)
        of_step = later * (left @ move) - left @ of_move
        together = np.add.reduceat(of_step, np.arange(0, len(of_step), _APART))
        return max(1.0, float(np.sqrt((together**2).sum() / max(fall, np.finfo(float).tiny))))
