"""Second-order correction of a batch posterior, for a smoother that continues from it.

The smoother knows the linear system alone. What `weak_directions` adds to it, the covariance of second order and the
directions that are weak because of it, is added to the smoother's covariance until the next batch solution.

Second order goes far enough where the slopes of strong directions grow in proportion to the way: at half the way they
are half of what they are at the whole one. Gimbals and heads at rest miss that by .03 to .05 sigma, a cube whose gains
are known to a tenth by .02; two or three attitudes of a triad whose gains are open by a half by up to 1.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.solvers.batch import Solved
from alidade.pipelines.solvers.chain import Array, IndeterminateStateError
from alidade.pipelines.solvers.levenberg import without_rejected
from alidade.pipelines.solvers.weak_directions import Posterior, WeakDirections, moved_roots, slopes

# Random ways along which slopes at half the way are compared with those at the whole.
DRAWS = 8
# What these may miss, in sigmas of the combination of numbers that misses most; see above.
MAX_THIRD = 0.05
# A direction with a sigma within this share of the prior follows less known ones.
KNOWN = 0.1
# Share of a direction that is not among others, above which it is none of these.
APART = 0.5


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """Second-order terms of a posterior beside its linear system.

    Attributes:
        covariance: (m, m) of the free reported numbers, in units of their usual priors' sigmas; no larger.
        share: largest ratio of it to the variance that the linear system has; infinite where directions are weak
            because of it.
    """

    covariance: Array
    share: float

    @classmethod
    def of(cls, posterior: Posterior) -> SecondOrder:
        """The second order of a posterior."""
        reported, directions = posterior.reported, posterior.directions
        R = reported.root(posterior.factorization.root).R
        linear = directions.again(R)
        more = _covariance(directions) - _covariance(linear)
        own = WeakDirections.of(R, reported.prior, reported.calibrated).weak
        ways, sizes, _ = np.linalg.svd(directions.weak - own @ (own.T @ directions.weak), full_matrices=False)
        curved = ways[:, sizes > APART]
        unit = linear.strong / linear.sigmas
        share = np.linalg.eigvalsh(unit.T @ more @ unit).max(initial=0.0)
        variances, axes = np.linalg.eigh(more)
        # Beyond the priors slopes do not go on as they begin.
        covariance = (axes * np.clip(variances, 0.0, 1.0)) @ axes.T + curved @ curved.T
        return cls(covariance, np.inf if curved.shape[1] else float(share))


def _covariance(directions: WeakDirections) -> Array:
    """Covariance (m, m) of the strong directions."""
    root = directions.strong * directions.sigmas
    return np.asarray(root @ root.T)


def beyond_second_order(solved: Solved) -> NDArray[np.bool_]:
    """Which reported numbers (n,) are part of terms of higher than second order; see the module.

    Those of one variable go together, and all where slopes at half the way cannot be found.
    """
    problem, free = solved.compiled.problem, solved.posterior.reported.free
    numbers = [len(p.quantities) for p in problem.parameters]
    variable = np.repeat(np.arange(len(numbers)), numbers)
    own, left = variable[free], np.ones(len(free), dtype=bool)
    try:
        known, missed = _roots(solved)
        while _third(known[left], missed[left]) > MAX_THIRD:
            each = [left & (own != one) for one in np.unique(own[left])]
            left = min(each, key=lambda some: _third(known[some], missed[some]))
    except (IndeterminateStateError, np.linalg.LinAlgError):
        left[:] = False
    return ~np.isin(np.arange(len(variable)), free[left])


def _third(known: Array, missed: Array) -> float:
    """Third-order error of the slopes half the way, in sigmas of the worst combination of numbers.

    Args:
        known, missed: (k, .) square roots of covariances of some numbers.
    """
    if not len(known):
        return 0.0
    R = np.asarray(np.linalg.qr(known.T, mode="r"))
    return float(np.linalg.norm(np.linalg.solve(R.T, missed), 2))


def _roots(solved: Solved) -> tuple[Array, Array]:
    """Square roots (m, .) of two covariances in prior sigmas: of the free numbers, and of what half slopes miss."""
    posterior, compiled = solved.posterior, solved.compiled
    engine = without_rejected(solved.engine, solved.solution.values)
    linear = posterior.directions.again(posterior.reported.root(posterior.factorization.root).R)
    follows = linear.followers & (linear.sigmas < KNOWN)[:, None]
    if not follows.any():
        return linear.axes * linear.all_sigmas, np.zeros((len(linear.axes), 1))
    roots = partial(moved_roots, compiled.problem, engine, posterior, compiled.current_keys)
    ways = np.random.default_rng(0).standard_normal((len(linear.axes), DRAWS))
    half, whole = (slopes(linear, roots, follows, length * ways) for length in (0.5, 1.0))
    missed = np.hstack(list(half - 0.5 * whole)) / np.sqrt(DRAWS)
    wide = posterior.directions
    known = np.hstack([wide.strong * wide.sigmas, wide.weak @ np.linalg.cholesky(wide.prior_covariance)])
    return known, linear.strong @ missed
