"""What a linearised graph leaves out of the covariance where parameters may still move far.

A sensor at rest tells a sum of bias and mounting angle times rate to the last digit, and neither of both. The linear
system knows the sum along the tangent at the estimate alone: at the true values, a tenth of a radian off, it differs by
what is of second order, which is thousands of its sigmas. So the directions that are known have, beside the variance
that the linear system gives them, that of how far they follow the ones that are less known.

How they follow is the slope T of the error's floor, none at the estimate, and elsewhere linear in the way w there. Of
a known direction that follows by w'Hw/2 it is T = Hw, with w in sigmas: its variance tr(HH)/2 is half the mean of TT'
over draws of w, and its mean tr(H)/2 half that of Tw. Slopes tell that from far fewer draws than the ways themselves,
which are products of sigmas. They are those of the reported numbers, so that what bends because numbers are no linear
functions of the variables is among it.

The slopes of three draws show along which few ways anything bends, three or four of 35. Of random draws sixteen would
leave the variance a half too small or too large, and where it is too small errors count for more than they count for
less where it is too large. So draws are at right angles to each other along these ways, as many times as there are, of
which the means above are exact; along all others, and in length, they are as random ones are, so that they show what is
of higher order too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array, Problem
from alidade.pipelines.solvers.marginals import (
    IndeterminateError,
    marginal,
    ordering_of,
    prior_units,
    reported,
)

if TYPE_CHECKING:
    from alidade.pipelines.solvers.system import Linear, System

# A direction with a sigma within this share of the prior follows those of which its sigma is within this share.
_WEAK, _LESS = 0.1, 0.5
# Where no sigma of what is calibrated is beyond this share nothing is drawn.
_SURE = 0.01
# Looked at after so many draws: where no direction gained this share of its squared sigma, none is said to bend. One
# that gains all of it shows so little in so few draws with a chance of 3 %.
_SLIGHT = {1: 1e-3, 3: 0.1}
# Ways along which all that bends does so by less than this share of its variance are not looked for.
_STRAIGHT = 0.01
_DRAWS = 8
# Second order goes far enough where slopes at half the way miss half of those at the whole by this share, at most, of
# the sigma that any combination has with it. Gimbals and heads at rest have 0.03 to 0.05, a cube whose gains are known
# to a tenth 0.02; two or three attitudes of a triad whose gains are open by a half have up to 1.2.
_THIRD = 0.05
# Information in units of the priors' with which there is no prior.
_ANYWHERE = 0.5


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """The covariance that a linear system does not know of, and how it was found.

    Attributes:
        covariance: (n, n) of the reported numbers.
        floor: whose slopes tell it.
        ways: (m, k) drawn.
        slopes: (k, m, m) at these.
        variance: (m, m) that they tell of the directions, not bounded by the priors.
    """

    covariance: Array
    floor: _Floor
    ways: Array
    slopes: Array
    variance: Array

    def share(self) -> float:
        """What it adds to the variance of the combination of numbers that gains most by it, over what that had."""
        return float(np.linalg.eigvalsh(self.variance / np.outer(self.floor.sigmas, self.floor.sigmas))[-1])

    def beyond(self) -> NDArray[np.bool_]:
        """(n,) which reported numbers have a part in what is of higher order still; of the others the covariance holds.

        Those of one variable go together, and all where slopes at half the way cannot be found.
        """
        numbers = [len(p.quantities) for p in self.floor.problem.parameters]
        variable = np.repeat(np.arange(len(numbers)), numbers)
        own, left = variable[self.floor.free], np.ones(len(self.floor.free), dtype=bool)
        try:
            while self._third(left) > _THIRD:
                left = min((left & (own != each) for each in np.unique(own[left])), key=self._third)
        except (RuntimeError, IndeterminateError, np.linalg.LinAlgError):
            left[:] = False
        return ~np.isin(np.arange(len(variable)), self.floor.free[left])

    def _third(self, of: NDArray[np.bool_]) -> float:
        """What slopes at half the way miss of half of those at the whole, in sigmas of the combination that has most.

        Args:
            of: (m,) which of the free numbers are combined.
        """
        if not of.any():
            return 0.0
        known, missed = self._roots
        R = np.asarray(np.linalg.qr(known[of].T, mode="r"))
        return float(np.linalg.norm(np.linalg.solve(R.T, missed[of]), 2))

    @cached_property
    def _roots(self) -> tuple[Array, Array]:
        """Square roots (m, .) of the free numbers' covariance with second order, and of what half the way misses."""
        halves, _ = self.floor.slopes(0.5 * self.ways[:, :_DRAWS])
        known = np.linalg.cholesky(np.diag(self.floor.sigmas**2) + self.variance)
        missed = np.hstack(list(halves - 0.5 * self.slopes[:_DRAWS])) / np.sqrt(len(halves))
        return self.floor.vectors @ known, self.floor.vectors @ missed


def second_order(
    problem: Problem,
    about: Linear,
    covariance: Array,
    current_keys: Mapping[int, int],
) -> SecondOrder | None:
    """The covariance of the reported numbers that the linear system does not know of.

    None where nothing may move far, or where what moves has neither prior nor measurements, and may be anywhere.

    Args:
        problem: the graph's.
        about: the same, linearised at its solution.
        covariance: (n, n) of the reported numbers as the linearised graph has it.
        current_keys: parameter key -> variable that holds its value.
    """
    calibrated = [q.prior_sigma != 0.0 and not q.assumed for q in problem.quantities]
    scales = np.array([q.scale for q in problem.quantities])
    scaled = (covariance / np.outer(scales, scales))[np.ix_(calibrated, calibrated)]
    if not len(scaled) or np.linalg.eigvalsh(scaled)[-1] < _SURE**2:
        return None
    try:
        floor = _Floor.of(problem, about, current_keys)
        if floor is None:
            return None
        generator, n = np.random.default_rng(0), len(floor.sigmas)
        slopes, moved = np.zeros((0, n, n)), np.zeros((0, n))
        for count, slight in _SLIGHT.items():
            more = floor.slopes(floor.vectors.T @ generator.standard_normal((n, count - len(slopes))))
            slopes, moved = np.concatenate([slopes, more[0]]), np.concatenate([moved, more[1]])
            bent = 0.5 * np.square(slopes).sum(axis=2) + 0.25 * np.square((slopes @ moved[:, :, None])[:, :, 0])
            if (bent.sum(axis=0) / floor.sigmas**2).max() < slight:
                return None
        ways = _balanced(_bending(slopes, floor.sigmas), floor.vectors.T, generator)
        slopes, moved = floor.slopes(ways)
    except (RuntimeError, IndeterminateError, np.linalg.LinAlgError):
        return None
    mean = 0.5 * np.mean(slopes @ moved[:, :, None], axis=0)[:, 0]
    variance = 0.5 * np.mean(slopes @ slopes.transpose(0, 2, 1), axis=0) + np.outer(mean, mean)
    found = np.zeros_like(covariance)
    found[np.ix_(floor.free, floor.free)] = floor.axes @ _bounded(variance) @ floor.axes.T
    return SecondOrder(found, floor, ways, slopes, variance)


@dataclass(frozen=True)
class _Floor:
    """The least error for each value of the reported numbers, about the solution.

    Attributes:
        problem: the graph's.
        about: it linearised at the solution.
        current_keys: parameter key -> variable that holds its value.
        system: the same without what is rejected there: far from the solution the loss would reject what is good.
        keys: variables that hold the numbers.
        free: (n,) which numbers are free.
        scale: (n,) their priors'.
        vectors: (n, n) columns, independent directions in these scales, the best known one first.
        sigmas: (n,) of the directions.
        numbers: (m,) reported at the solution.
    """

    problem: Problem
    about: Linear
    current_keys: Mapping[int, int]
    system: System
    keys: Sequence[int]
    free: NDArray[np.intp]
    scale: Array
    vectors: Array
    sigmas: Array
    numbers: Array

    @classmethod
    def of(cls, problem: Problem, about: Linear, current_keys: Mapping[int, int]) -> _Floor | None:
        """None where a direction has neither prior nor measurements."""
        values, keys = about.values, [current_keys.get(p.key, p.key) for p in problem.parameters]
        free, scale, unit = prior_units(problem.parameters, values, keys)
        system = about.system.without_rejected(values)
        information = unit.T @ about.information(keys) @ unit
        eigenvalues, vectors = np.linalg.eigh(information)
        if eigenvalues[0] < _ANYWHERE:
            return None
        sigmas, numbers = eigenvalues[::-1] ** -0.5, reported(problem, values, current_keys)
        return cls(problem, about, current_keys, system, keys, free, scale, vectors[:, ::-1], sigmas, numbers)

    @property
    def axes(self) -> Array:
        """(n, n) columns, the directions in the numbers' own units."""
        return self.scale[:, None] * self.vectors

    def slopes(self, ways: Array) -> tuple[Array, Array]:
        """Slopes (k, n, n) of each direction along the less known ones at ways (n, k), and how far (k, n) these went.

        All is in sigmas, but for what follows. Raises IndeterminateError if states are not determined.
        """
        unit = prior_units(self.problem.parameters, self.about.values, self.keys)[2]
        follows = (self.sigmas[:, None] < _LESS * self.sigmas) & (self.sigmas < _WEAK)[:, None]
        slopes, moved = [], []
        for there in self.about.followed(self.keys, unit @ self.vectors @ (self.sigmas[:, None] * ways)):
            unit_there = prior_units(self.problem.parameters, there, self.keys)[2]
            linear = marginal(self.system.linearize(there), self.system.ordering, self.keys)
            A, _ = linear.jacobian(ordering_of(self.keys))
            # One row a direction: it and those less known, the better known ones marginalised out.
            R = np.asarray(np.linalg.qr(A @ unit_there @ self.vectors, mode="r"))
            slopes.append(np.where(follows, -R / np.diag(R)[:, None], 0.0) * self.sigmas)
            off = (reported(self.problem, there, self.current_keys) - self.numbers)[self.free] / self.scale
            moved.append(self.vectors.T @ off / self.sigmas)
        return np.array(slopes), np.array(moved)


def _bounded(variance: Array) -> Array:
    """A variance (n, n) in units of the priors', no more any way than what these leave.

    Beyond that slopes do not go on as they begin.
    """
    squares, ways = np.linalg.eigh(variance)
    return variance if squares[-1] <= 1.0 else np.asarray((ways * np.minimum(squares, 1.0)) @ ways.T)


def _bending(slopes: Array, sigmas: Array) -> Array:
    """Unit rows (r, n), at right angles, along which something bends, by slopes (k, n, n) of what is known so well.

    One at least.
    """
    spread = np.sqrt(sigmas**2 + 0.5 * np.square(slopes).sum(axis=2).mean(axis=0))
    rows = (slopes / spread[:, None]).reshape(-1, len(sigmas))
    sizes, ways = np.linalg.svd(rows, full_matrices=False)[1:]
    return np.asarray(ways[: max(1, int(np.sum(sizes**2 > _STRAIGHT * len(slopes))))])


def _balanced(along: Array, turned: Array, generator: np.random.Generator) -> Array:
    """Draws (n, k), their parts along r unit rows (r, n) in sets of r at right angles, each sqrt(r) long.

    They are drawn in the numbers' scales and `turned` (n, n) from these to the directions: of directions of which as
    much is known rounding decides which they are, and of rows their signs.
    """
    r = len(along)
    drawn = turned @ generator.standard_normal((along.shape[1], r * -(-_DRAWS // r)))
    inside = along @ drawn
    for begin in range(0, inside.shape[1], r):
        Q, R = np.linalg.qr(inside[:, begin : begin + r])
        inside[:, begin : begin + r] = np.sqrt(r) * np.where(np.diag(R) < 0.0, -Q, Q)
    return np.asarray(drawn + along.T @ (inside - along @ drawn))
