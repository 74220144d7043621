"""Random walk of a cube gyro's offset about its mean over the session."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from alidade.pipelines.estimation.priors import linear_factor, vector_about
from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.methods.cube.static_poses import StaticPoses

# A gyro bias that does not walk still does so by this much, rad/s, for the sake of the arithmetic.
_STEADY = 1e-8


def deviation_key(k: int) -> int:
    """Variable of how far the offset is from its mean in pose k, (3,) in nominal units."""
    return int(gtsam.symbol("d", k))


def sum_key(k: int) -> int:
    """Variable of the sum of deviations up to pose k, each with its share of the session, (3,) in nominal units."""
    return int(gtsam.symbol("e", k))


@dataclass(frozen=True)
class GaussMarkovDeviation:
    """Deviation of the gyro's offset from its mean over the session: a random walk that stays bounded.

    A first-order Gauss-Markov process: over short times the walk, over the session the deviation that a walk has from
    its own mean, whose variance is walk^2 times a sixth of the session.

    Attributes:
        sigma: (P,) of each pose's deviation, given the one before it; of the first alone.
        correlation: (P,) with the one before it; 0 for the first.
        weights: (P,) share of the session that a pose stands for.
    """

    sigma: Array
    correlation: Array
    weights: Array

    @classmethod
    def over(cls, poses: StaticPoses, walk: float) -> GaussMarkovDeviation:
        """Deviation for a walk in rad/s/sqrt(s)."""
        start, stop = poses.span.T
        middle = 0.5 * (start + stop)
        length = float(stop[-1] - start[0])
        stationary = max(walk * float(np.sqrt(length / 6.0)), _STEADY)
        correlation = np.append(0.0, np.exp(-np.diff(middle) / (length / 3.0)))
        edges = np.concatenate([start[:1], 0.5 * (middle[1:] + middle[:-1]), stop[-1:]])
        return cls(stationary * np.sqrt(1.0 - correlation**2), correlation, np.diff(edges) / length)

    def factors(self, k: int) -> list[Factor]:
        """Factors of the offset's walk to pose k and of its mean so far; after the last, that c is the mean.

        The mean of the session is zero to `_STEADY`, in variance half by the steps of the sum and half by its end.
        """
        key, share, count = deviation_key(k), self.weights[k], len(self.weights)
        first, none = k == 0, np.zeros(3)
        before = {} if first else {deviation_key(k - 1): -self.correlation[k] * np.eye(3)}
        blocks = {key: np.eye(3), **before}
        walk = linear_factor(blocks, float(self.sigma[k]))
        summed = {} if first else {sum_key(k - 1): -np.eye(3)}
        blocks = {sum_key(k): np.eye(3), key: -share * np.eye(3), **summed}
        step = linear_factor(blocks, _STEADY / float(np.sqrt(2.0 * count)))
        found = [Factor.process_of("bias walk", walk), Factor.process_of("definition", step)]
        if k == count - 1:
            found.append(vector_about(sum_key(k), none, _STEADY / float(np.sqrt(2.0)), "definition"))
        return found
