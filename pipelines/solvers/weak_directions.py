"""One rule for what a recording hardly determines.

The reported numbers are whitened by their priors, q = mean + L u. A direction of the calibrated numbers in u whose
posterior sigma, second order included, is above MAX_SIGMA of the prior's is weak: it keeps its prior mean and its prior
sigma and is uncorrelated with all others. The values of the others are the minimum with the weak ones fixed at their
prior means, their covariance is what that and the prior of the weak ones leave.

What a linearised system says along weak directions cannot be relied on: noise of the states at which it is linearised
looks like information (about the only axis of a motion a mount cannot be known, yet the axis wavers), and the strong
directions turn while the weak ones move by as much as their priors allow. A prior is right, if wide: for an error with
covariance C, E[NEES] = tr(P^-1 C) is the number of directions for every P made of diagonal blocks of C. It is the
truncated solution of the self-calibration literature (Maye, Furgale, Siegwart, "Self-supervised calibration for robotic
systems", IEEE Intelligent Vehicles Symposium 2013), with priors as the yardstick. Two things the rule needs beside it,
by `python -m benchmarks.initialisation` (mean NEES against its two-sided 99.9 % interval, 8 recordings):

- Second order. A tumbled magnetometer at rest knows some directions a million times better than others, and these bend:
  without `curvature` the NEES of 10 numbers was 53,000, 990, 94 at the first three moments, that of the indexer's 17 at
  rest 149, 124, 51; with it 9 to 11, and 19 to 21.
- Assumed sensor errors (`Reported.calibrated`) are never weak: they are small, so that linear theory holds for them.
  Fixed at their priors they cost ordinary recordings information: sigmas of a head's time offset and of a gimbal's
  mounting angles were 1.9 times as wide. Now all are what the linear system says.

Everything follows from the square-root information R u = d of the reported numbers.

Limits: the first two or three attitudes of a triad whose gains are open by a half bend by more than second order: one
recording of eight has a NEES of 70 to 460 of 10 numbers there, and the mean is outside its interval, as in no other
case. Adding the variance of third order from slopes at half the way cured one of its three kinds of recording and
spoilt two. Where no constrained minimum is found all that is calibrated has its prior.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.solvers.chain import IndeterminateStateError
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import Point, followed
from alidade.pipelines.solvers.posterior import Reported, ReportedRoot

# Posterior sigma of a direction, in sigmas of the priors in force, above which the direction is weak.
MAX_SIGMA = 0.3
# Ratio of a posterior's variance to its prior's that no linear system has.
BEYOND = 1.0 + 1e-9
# Ratio of sigmas up to which the better known of two directions follows the other one.
FOLLOWS = 0.5
# Singular values of a square-root information below which there is none: sigmas of 1e4 prior sigmas.
UNDETERMINED = 1e-4
# Steps to the constrained solution, and how near it has to be, in sigmas; how often strong directions may turn weak.
MAX_STEPS, NEAR, ROUNDS = 15, 0.02, 3
# By what chi-square may rise beside that when weak directions move to their priors: a contradiction of 4 sigmas.
CONTRADICTION = 4.0
# Part of their priors by which weak directions go to these at a time: what is curved would lead a longer step astray.
LEAP = 0.5
# Random moves whose slopes show along which ways anything is curved, and the share of its sigma, as root mean square,
# by which all that is curved has to follow a way.
DRAWS, STRAIGHT = 3, 0.1
# Chance that moves drawn so far happen to be across a way that something follows by its sigma: of one normal number to
# be below x it is .8 x. Below this chance no more moves are drawn where all look straight.
MISSED = 0.02
# Random moves along which slopes half the way are compared with those of the whole, and what these may miss, in sigmas
# of the combination of numbers that misses most. Gimbals and heads at rest miss .03 to .05, a cube whose gains are
# known to a tenth .02; two or three attitudes of a triad whose gains are open by a half up to 1.2.
THIRD_DRAWS, MAX_THIRD = 8, 0.05
# A direction with a sigma within this share of the prior follows less known ones.
KNOWN = 0.1


@dataclass(frozen=True, eq=False)
class WeakDirections:
    """Orthonormal directions of the whitened numbers u: strong (determined by the recording) and weak.

    Attributes:
        strong: (m, k) columns, best determined first.
        weak: (m, w) columns.
        sigmas: (k,) posterior sigmas of the strong directions, in sigmas of the prior.
        precision: (m, m) of the prior in force on u, identity where every number has one.
        calibrated: (m,) which numbers may be weak; None: all.
    """

    strong: Array
    weak: Array
    sigmas: Array
    precision: Array
    calibrated: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls, R: Array, precision: Array, calibrated: NDArray[np.bool_] | None = None, at_least: int = 0
    ) -> WeakDirections:
        """Split the directions of a square-root information R (m, m), prior included.

        Args:
            R: rows of unit variance.
            precision: (m, m) of the prior in force on u.
            calibrated: (m,) which numbers may be weak, all by default.
            at_least: number of weak directions to be kept, so that an iteration cannot alternate.
        """
        _, sizes, axes = np.linalg.svd(R)
        wide = axes[min(int(np.count_nonzero(sizes * MAX_SIGMA >= 1.0)), len(R) - at_least) :].T
        weak = _calibrated(wide, calibrated, at_least)
        if not weak.shape[1]:
            return cls(axes.T, weak, 1.0 / np.maximum(sizes, UNDETERMINED), precision, calibrated)
        return cls.given(R, weak, precision, calibrated)

    @classmethod
    def given(
        cls, R: Array, weak: Array, precision: Array, calibrated: NDArray[np.bool_] | None = None
    ) -> WeakDirections:
        """Split by given weak directions (m, w); the others get the covariance from R and the weak ones' prior.

        With C = (R_o'R_o)^-1 of the others, G = -C R_o'R_w their slope along the weak ones and S the prior covariance
        of the weak ones it is C + G S G'. Those that would follow the weak ones past their own priors are weak, too.
        """
        w = weak.shape[1]
        others = np.linalg.svd(weak, full_matrices=True)[0][:, w:] if w else np.eye(len(R))
        T = np.asarray(np.linalg.qr(R @ np.hstack([others, weak]), mode="r"), dtype=float)
        k = others.shape[1]
        own = np.linalg.svd(T[:k, :k])
        root = own[2].T / np.maximum(own[1], UNDETERMINED)
        if w:
            slope = np.linalg.lstsq(T[:k, :k], T[:k, k:], rcond=None)[0]
            prior = np.linalg.inv(weak.T @ precision @ weak)
            root = np.hstack([root, slope @ np.linalg.cholesky(prior)])
        try:
            turned, sigmas, _ = np.linalg.svd(root, full_matrices=False)
        except np.linalg.LinAlgError:  # LAPACK's divide and conquer, rarely, where columns differ by many decades
            _, sigmas, axes = np.linalg.svd(root.T, full_matrices=False)
            turned = axes.T
        order = np.argsort(sigmas)
        strong, sigmas = others @ turned[:, order], sigmas[order]
        beyond = sigmas**2 > BEYOND * np.einsum("ia,ia->a", strong, np.linalg.solve(precision, strong))
        if w and beyond.any():
            return cls.given(R, np.hstack([weak, strong[:, beyond]]), precision, calibrated)
        return cls(strong, weak, sigmas, precision, calibrated)

    @property
    def prior_covariance(self) -> Array:
        """Covariance (w, w) of the weak directions under the prior alone, given the strong ones."""
        return np.asarray(np.linalg.inv(self.weak.T @ self.precision @ self.weak), dtype=float)

    def prior_mean(self, u: Array) -> Array:
        """Mean (w,) of the weak directions under the prior alone, given the strong ones of u (m,)."""
        given = self.strong @ (self.strong.T @ u)
        return np.asarray(-self.prior_covariance @ (self.weak.T @ (self.precision @ given)))

    @property
    def axes(self) -> Array:
        """Axes (m, m) by columns, the strong directions first."""
        return np.hstack([self.strong, self.weak])

    @property
    def all_sigmas(self) -> Array:
        """Sigmas (m,) along the axes: posterior for strong directions, prior for weak ones."""
        return np.concatenate([self.sigmas, np.sqrt(np.diag(self.prior_covariance))])

    @property
    def followers(self) -> NDArray[np.bool_]:
        """Mask (k, m): the strong direction is so well determined that a move along the axis shifts its estimate."""
        return np.asarray(self.sigmas[:, None] < FOLLOWS * self.all_sigmas)

    def covariance(self) -> Array:
        """Covariance (m, m) of u: posterior for strong directions, prior for weak ones, uncorrelated."""
        root = self.strong * self.sigmas
        return root @ root.T + self.weak @ self.prior_covariance @ self.weak.T

    def root(self, power: float) -> Array:
        """Covariance (m, m) of the strong directions, raised to power / 2."""
        return np.asarray((self.strong * self.sigmas**power) @ self.strong.T)

    def again(self, R: Array) -> WeakDirections:
        """Keep the weak directions and recompute the strong ones from another square-root information (m, m)."""
        return WeakDirections.given(R, self.weak, self.precision, self.calibrated)

    def with_curvature(self, covariance: Array) -> WeakDirections:
        """Add second-order covariance (k, k) to the strong directions; directions that get too wide become weak."""
        least = self.sigmas.min(initial=np.inf) ** 2  # which no eigenvalue of the sum is below, but by rounding
        variances, axes = np.linalg.eigh(np.diag(self.sigmas**2) + covariance)
        variances = np.maximum(variances, least)
        axes, wide = self.strong @ axes, variances > MAX_SIGMA**2
        more = _calibrated(axes[:, wide], self.calibrated)
        if not more.shape[1]:
            return replace(self, strong=axes, sigmas=np.sqrt(variances))
        left = np.linalg.svd(axes.T @ more, full_matrices=True)[0][:, more.shape[1] :]
        root = axes @ left
        own, turn = np.linalg.eigh(left.T @ (variances[:, None] * left))
        return replace(
            self, strong=root @ turn, weak=np.hstack([more, self.weak]), sigmas=np.sqrt(np.maximum(own, least))
        )


def _calibrated(wide: Array, calibrated: NDArray[np.bool_] | None, at_least: int = 0) -> Array:
    """Directions (m, .) in the span of wide ones (m, n) that consist mostly of calibrated numbers."""
    if calibrated is None or not wide.shape[1]:
        return wide
    shares, turn = np.linalg.eigh(wide[calibrated].T @ wide[calibrated])
    count = max(int(np.count_nonzero(shares > 0.5)), min(at_least, len(shares)))
    return np.asarray(wide @ turn[:, len(shares) - count :])


def constrained_step(directions: WeakDirections, R: Array, d: Array, u: Array) -> Array:
    """Step (m,) of u to the minimum over the strong directions, the weak ones at their prior means.

    Args:
        directions: of the system at u.
        R, d: square-root information of the move, |R du - d| minimal.
        u: (m,) where the system is linearised.
    """
    strong, weak, there = directions.strong, directions.weak, u
    for _ in range(2 if weak.shape[1] else 1):  # to where the weak ones go the others follow
        move = directions.prior_mean(there) - weak.T @ u
        own, *_ = np.linalg.lstsq(R @ strong, d - R @ weak @ move, rcond=None)
        there = u + strong @ own + weak @ move
    return np.asarray(there - u)


def constrained(reported: Reported, R: Array, d: Array) -> tuple[Reported, WeakDirections]:
    """Move the numbers to a linear system's minimum, weak directions at their priors; return both.

    Args:
        reported: where the system is linearised.
        R, d: square-root information of the move.
    """
    directions, numbers = WeakDirections.of(R, reported.prior, reported.calibrated), reported.numbers.copy()
    numbers[reported.free] += reported.scale * constrained_step(directions, R, d, reported.u)
    return replace(reported, numbers=numbers), directions


def slopes(
    directions: WeakDirections,
    roots: Callable[[Array], Iterable[Array]],
    follows: NDArray[np.bool_],
    ways: Array,
) -> Array:
    """Slopes (n, k, m), in sigmas, of the strong directions along all axes, at points offset by ways (m, n).

    Args:
        directions: of the system at its solution.
        roots: square-root information (m, m) of u at the points moved by (m, n), all else following.
        follows: (k, m) which slopes count; others are 0.
        ways: in sigmas of the axes.
    """
    axes, sigmas, k = directions.axes, directions.all_sigmas, len(directions.sigmas)
    there = roots(axes @ (sigmas[:, None] * ways))
    triangles = [np.asarray(np.linalg.qr(R @ axes, mode="r"), dtype=float)[:k] for R in there]
    return np.array([np.where(follows, -R / np.diag(R)[:, None], 0.0) * sigmas for R in triangles])


def curvature(directions: WeakDirections, roots: Callable[[Array], Iterable[Array]]) -> Array:
    """Second-order covariance (k, k) of the strong directions, from their nonlinear dependence on the others.

    A strong direction that follows by w'Hw/2, w white in units of sigmas, has the variance tr(HH)/2 and the mean
    tr(H)/2 beside what the linear system says. Hw is the slope of its conditional minimum at w. Slopes at DRAWS
    random w span the few ways along which anything is curved; slopes along these give H.

    Args:
        directions: of the system at its solution.
        roots: square-root information (m, m) of u at the points moved by (m, n), all else following.
    """
    k, m = len(directions.sigmas), len(directions.precision)
    if not k:
        return np.zeros((0, 0))
    follows = directions.followers
    drawn = np.empty((0, k, m))
    # Drawn as moves of u, whatever the signs of the axes, which rounding decides.
    for way in np.random.default_rng(0).standard_normal((DRAWS, m)) @ directions.axes:
        drawn = np.concatenate([drawn, slopes(directions, roots, follows, way[:, None])])
        spread = np.sqrt(directions.sigmas**2 + np.square(drawn).sum(axis=2).mean(axis=0))
        found = np.sqrt(np.square(drawn / spread[:, None]).sum(axis=(1, 2)))
        if found.max() < STRAIGHT and (0.8 * found).prod() < MISSED:
            return np.zeros((k, k))
    sizes, ways = np.linalg.svd((drawn / spread[:, None]).reshape(-1, m), full_matrices=False)[1:]
    ways = ways[sizes > STRAIGHT * np.sqrt(DRAWS)]
    if not len(ways):
        return np.zeros((k, k))
    ways *= np.copysign(1.0, ways @ way)[:, None]  # to the side of the last draw: rounding decides which one svd takes
    H = slopes(directions, roots, follows, np.sqrt(len(ways)) * ways.T) / np.sqrt(len(ways))
    mean = 0.5 * np.einsum("ial,il->a", H, ways)
    return np.asarray(0.5 * np.einsum("ial,ibl->ab", H, H) + np.outer(mean, mean))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Final posterior of the reported numbers, the source of all results.

    Attributes:
        at: values of all variables, weak directions at their prior means, with the system there; its engine is without
            the measurements that are rejected.
        reported: the numbers there.
        directions: strong and weak ones, second order included.
        converged: whether there is a constrained minimum; else all that is calibrated has its prior.
    """

    at: Point
    reported: Reported
    directions: WeakDirections
    converged: bool

    @property
    def covariance(self) -> Array:
        """Covariance (n, n) of all reported numbers, fixed ones zero."""
        return self.reported.covariance(self.directions.covariance())

    def second_order_share(self) -> float:
        """Largest ratio of second-order to linear variance over all strong directions."""
        linear = self.directions.again(self.reported.root(self.at.factorization.root).R)
        unit = linear.strong / linear.sigmas
        return float(np.linalg.norm((self.directions.strong * self.directions.sigmas).T @ unit, 2)) ** 2 - 1.0


def constrained_solution(compiled: Compiled, minimum: Point) -> Posterior:
    """Compute the posterior near a minimum, with its weak directions at the prior.

    Args:
        compiled: the problem.
        minimum: of its factors, without the measurements that are rejected: elsewhere the loss would reject others.

    Raises:
        IndeterminateStateError: a state is not determined.
    """
    found = _constrained(compiled, minimum)
    if not found.converged:
        return _unknown(compiled, minimum)
    for _ in range(ROUNDS):
        second_order = curvature(found.directions, partial(moved_roots, compiled, found))
        directions = found.directions.with_curvature(second_order)
        if directions.weak.shape[1] == found.directions.weak.shape[1]:
            break
        constrained = _constrained(compiled, found.at, directions)
        if _contradicts(found, constrained):
            break
        found = constrained
    return replace(found, directions=directions)


def _contradicts(before: Posterior, after: Posterior) -> bool:
    """Whether the cost contradicts moving additional directions to their prior means.

    What is hardly determined can be moved at a cost: a chi-square of (move / MAX_SIGMA)^2, to first order.
    """
    moved = np.linalg.norm(after.directions.weak.T @ (after.reported.u - before.reported.u))
    return bool(after.at.cost - before.at.cost > (moved / MAX_SIGMA) ** 2 + CONTRADICTION**2)


def _unknown(compiled: Compiled, minimum: Point) -> Posterior:
    """Posterior where no constrained minimum is found: all calibrated numbers at their priors.

    Where these do not determine the states, the values stay, with the covariance of the priors.
    """
    found = unfinished(compiled, minimum)
    with suppress(IndeterminateStateError):
        found = _constrained(compiled, minimum, found.directions)
    return replace(found, converged=False)


def unfinished(compiled: Compiled, point: Point) -> Posterior:
    """Posterior about values that are no minimum: all calibrated numbers keep their prior covariance."""
    reported = Reported.of(compiled, point.values)
    R = reported.root(point.factorization.root).R
    weak = np.eye(len(R))[:, reported.calibrated]
    return Posterior(
        point, reported, WeakDirections.given(R, weak, reported.prior, reported.calibrated), converged=False
    )


def at_prior(posterior: Posterior, numbers: NDArray[np.bool_]) -> Posterior:
    """Put some free numbers (m,) at their priors, uncorrelated with the rest, whose marginal stays.

    Those without a prior stay as they are.
    """
    reported, directions = posterior.reported, posterior.directions
    fixed = numbers & reported.bounded
    prior, rest = (np.eye(len(fixed))[:, mask] for mask in (fixed, ~fixed))
    variances, axes = np.linalg.eigh(rest.T @ directions.covariance() @ rest)
    there = reported.numbers.copy()
    there[reported.free[fixed]] = reported.mean[fixed]
    own = replace(directions, strong=rest @ axes, weak=prior, sigmas=np.sqrt(np.maximum(variances, 0.0)))
    return replace(posterior, reported=replace(reported, numbers=there), directions=own)


def beyond_second_order(compiled: Compiled, found: Posterior) -> NDArray[np.bool_]:
    """Mask (m,) of free numbers with significant terms beyond second order, alike within one variable.

    Second order goes far enough where slopes grow in proportion to the way: half the way they are half of what they
    are at the whole one. What that misses is compared with the covariance of all that stays. Without this the mean NEES
    of the 10 numbers of a tumbled magnetometer at rest is 81, 14, 24 at its first moments, with it 10, 9, 10.
    """
    reported, directions = found.reported, found.directions
    left = np.ones(len(reported.free), dtype=bool)
    linear = directions.again(reported.root(found.at.factorization.root).R)
    ways = np.random.default_rng(0).standard_normal((len(linear.axes), THIRD_DRAWS))
    roots = partial(moved_roots, compiled, found)
    follows = linear.followers & (linear.sigmas < KNOWN)[:, None]
    try:
        half, whole = (slopes(linear, roots, follows, length * ways) for length in (0.5, 1.0))
    except (IndeterminateStateError, np.linalg.LinAlgError):
        return left
    missed = linear.strong @ np.hstack(list(half - 0.5 * whole)) / np.sqrt(THIRD_DRAWS)
    prior = directions.weak @ np.linalg.cholesky(directions.prior_covariance)
    known = np.hstack([directions.strong * directions.sigmas, prior])
    numbers = [len(p.quantities) for p in compiled.problem.parameters]
    own = np.repeat(np.arange(len(numbers)), numbers)[reported.free]
    while _share(known[left], missed[left]) > MAX_THIRD:
        each = [left & (own != one) for one in np.unique(own[left])]
        left = min(each, key=lambda some: _share(known[some], missed[some]))
    return ~left


def _share(known: Array, missed: Array) -> float:
    """Largest ratio of two sigmas over all combinations of numbers, from square roots (k, .) of their covariances."""
    if not len(known):
        return 0.0
    R = np.asarray(np.linalg.qr(known.T, mode="r"))
    return float(np.linalg.norm(np.linalg.solve(R.T, missed), 2))


def _constrained(compiled: Compiled, start: Point, fixed: WeakDirections | None = None) -> Posterior:
    """Find the minimum with the weak directions at their prior means; directions are re-found unless `fixed`.

    `start` is a minimum without constraints; the memory of its factorization is freed.
    """
    weak, at, values, engine = 0, start, start.values, start.engine
    for step in range(MAX_STEPS):
        if step:
            at.forget_factorization()
            at = Point.of(engine, values)
        reported = Reported.of(compiled, values)
        found = reported.root(at.factorization.root)
        directions = (
            WeakDirections.of(found.R, reported.prior, reported.calibrated, weak)
            if fixed is None
            else fixed.again(found.R)
        )
        weak = directions.weak.shape[1]
        du = constrained_step(directions, found.R, found.d, reported.u)
        size = np.linalg.norm(directions.strong.T @ du / directions.sigmas), np.linalg.norm(directions.weak.T @ du)
        at_minimum = not step and not weak  # values are the minimum, and nothing is to be moved away from it
        if at_minimum or max(size) < NEAR:
            return Posterior(at, reported, directions, True)
        if size[1] > LEAP:
            du *= LEAP / size[1]
        elif size[1] > NEAR and fixed is None:
            fixed = directions
        share, values = 1.0, _moved(at, found, du)
        if size[1] < NEAR:  # the weak directions are where they are to be: from here on the cost falls
            while engine.cost(values) > at.cost and share > 1e-3:
                share *= 0.3
                values = _moved(at, found, share * du)
    return Posterior(at, reported, directions, False)


def _moved(at: Point, found: ReportedRoot, du: Array) -> Values:
    """Move the reported numbers by du (m,) and all other unknowns to their conditional optimum."""
    return at.engine.layout.retract(at.values, followed(at.factorization, found.last(du[:, None])))


def moved_roots(compiled: Compiled, found: Posterior, moves: Array) -> Iterator[Array]:
    """Yield the square-root information (m, m) of u re-linearised at points offset by the columns of (m, n)."""
    at = found.at
    last = found.reported.root(at.factorization.root).last(moves, 0.0)
    states, nodes = at.factorization.propagate(last)
    for i in range(moves.shape[1]):
        move = Tangent(states[..., i], nodes[..., i], last[at.factorization.c :, i])
        there = Point.of(at.engine, at.engine.layout.retract(at.values, move))
        yield Reported.of(compiled, there.values).root(there.system.root()).R
