"""One rule for what a recording hardly determines.

The reported numbers are whitened by their priors, q = mean + L u. A direction of u whose posterior sigma is above
MAX_SIGMA of the prior's is weak: it keeps its prior mean and its prior sigma and is uncorrelated with all others. The
values of the strong directions are the minimum over these, the weak ones fixed at their prior means.

What a linearised system says along weak directions cannot be relied on: noise of the states at which it is linearised
looks like information (about the only axis of a motion a mount cannot be known, yet the axis wavers), and the strong
directions turn while the weak ones move by as much as their priors allow. A prior is right, if wide: for an error with
covariance C, E[NEES] = tr(P^-1 C) is the number of directions for every P made of diagonal blocks of C. It is the
truncated solution of the self-calibration literature (Maye, Furgale, Siegwart, "Self-supervised calibration for robotic
systems", IEEE Intelligent Vehicles Symposium 2013), with priors as the yardstick.

Everything follows from the square-root information R u = d of the reported numbers by one singular value decomposition;
nothing is squared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Posterior sigma of a direction, in sigmas of the priors in force, above which the direction is weak.
MAX_SIGMA = 0.3
# Ratio of sigmas up to which the better known of two directions follows the other one.
FOLLOWS = 0.5
# Random moves whose slopes show along which ways anything is curved, and the share of its sigma, as root mean square,
# by which all that is curved has to follow a way.
DRAWS, STRAIGHT = 3, 0.1


@dataclass(frozen=True, eq=False)
class WeakDirections:
    """Orthonormal directions of the whitened numbers u, split by what the recording determines.

    Attributes:
        strong: (m, k) columns, best determined first.
        weak: (m, w) columns.
        sigmas: (k,) posterior sigmas of the strong directions, in sigmas of the prior.
        precision: (m, m) of the prior in force on u, identity where every number has one.
    """

    strong: Array
    weak: Array
    sigmas: Array
    precision: Array

    @classmethod
    def of(cls, R: Array, precision: Array, at_least: int = 0) -> WeakDirections:
        """Split the directions of a square-root information R (m, m), prior included.

        Args:
            R: rows of unit variance.
            precision: (m, m) of the prior in force on u.
            at_least: number of weak directions to be kept, so that an iteration cannot alternate.
        """
        _, sizes, directions = np.linalg.svd(R)
        k = min(int(np.count_nonzero(sizes * MAX_SIGMA >= 1.0)), len(R) - at_least)
        return cls(directions[:k].T, directions[k:].T, 1.0 / sizes[:k], precision)

    @property
    def prior_covariance(self) -> Array:
        """(w, w) of the weak directions under the prior alone, the strong ones given."""
        return np.linalg.inv(self.weak.T @ self.precision @ self.weak)

    def prior_mean(self, u: Array) -> Array:
        """(w,) of the weak directions under the prior alone, the strong ones of u (m,) given."""
        given = self.strong @ (self.strong.T @ u)
        return np.asarray(-self.prior_covariance @ (self.weak.T @ (self.precision @ given)))

    def covariance(self) -> Array:
        """(m, m) of u: posterior of the strong directions, prior of the weak ones, no correlation between the two."""
        root = self.strong * self.sigmas
        return root @ root.T + self.weak @ self.prior_covariance @ self.weak.T

    def with_curvature(self, covariance: Array) -> WeakDirections:
        """Add a covariance (k, k) of second order to the strong directions; those that become too wide are weak."""
        variances, axes = np.linalg.eigh(np.diag(self.sigmas**2) + covariance)
        kept, axes = variances <= MAX_SIGMA**2, self.strong @ axes
        weak = np.hstack([axes[:, ~kept], self.weak])
        return WeakDirections(axes[:, kept], weak, np.sqrt(variances[kept]), self.precision)


def constrained_step(directions: WeakDirections, R: Array, d: Array, u: Array) -> Array:
    """Move (m,) of u to the minimum over the strong directions, the weak ones at their prior means.

    Args:
        directions: of the system at u.
        R, d: square-root information of the move, |R du - d| minimal.
        u: (m,) where the system is linearised.
    """
    strong, *_ = np.linalg.lstsq(R @ directions.strong, d, rcond=None)
    there = u + directions.strong @ strong
    strong_part = directions.strong @ (directions.strong.T @ there)
    return np.asarray(strong_part + directions.weak @ directions.prior_mean(there) - u)


def curvature(directions: WeakDirections, roots: Callable[[Array], Iterable[Array]]) -> Array:
    """Covariance (k, k) of second order: how far strong directions follow the less known ones.

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
    wide = np.sqrt(np.diag(directions.prior_covariance))
    sigmas, axes = np.concatenate([directions.sigmas, wide]), np.hstack([directions.strong, directions.weak])
    follows = sigmas[:k, None] < FOLLOWS * sigmas

    def slopes(ways: Array) -> Array:
        triangles = [np.linalg.qr(R @ axes, mode="r")[:k] for R in roots(axes @ (sigmas[:, None] * ways))]
        return np.array([np.where(follows, -R / np.diag(R)[:, None], 0.0) * sigmas for R in triangles])

    drawn = slopes(np.random.default_rng(0).standard_normal((m, DRAWS)))
    spread = np.sqrt(directions.sigmas**2 + np.square(drawn).sum(axis=2).mean(axis=0))
    sizes, ways = np.linalg.svd((drawn / spread[:, None]).reshape(-1, m), full_matrices=False)[1:]
    ways = ways[sizes > STRAIGHT * np.sqrt(DRAWS)]
    if not len(ways):
        return np.zeros((k, k))
    H = slopes(np.sqrt(len(ways)) * ways.T) / np.sqrt(len(ways))
    mean = 0.5 * np.einsum("ial,il->a", H, ways)
    return np.asarray(0.5 * np.einsum("ial,ibl->ab", H, H) + np.outer(mean, mean))
