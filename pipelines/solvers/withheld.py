"""Numbers of which nothing can be told yet are withheld: reported where their priors have them.

Whatever value and sigma a solution has for them would be wrong. A prior is right, if wide: E[NEES] = tr(P^-1 Sigma) is
the number of parameters for a P of any blocks of the true covariance Sigma that have no correlation with each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array, Problem


def with_prior(problem: Problem) -> NDArray[np.bool_]:
    """(n,) which of the reported numbers can be withheld: those that have a prior and are not fixed."""
    return np.array([bool(q.prior_sigma) for q in problem.quantities], dtype=bool)


def values_without(values: Array, withheld: NDArray[np.bool_], problem: Problem) -> Array:
    """The reported numbers (n,), those withheld at their priors' means."""
    return np.where(withheld, [q.prior_mean for q in problem.quantities], values)


def covariance_without(covariance: Array, withheld: NDArray[np.bool_], problem: Problem) -> Array:
    """Their covariance (n, n), of those withheld their priors', and none with others."""
    told = np.outer(~withheld, ~withheld)
    priors = [(q.prior_sigma or 0.0) ** 2 + q.extra_sigma**2 for q in problem.quantities]
    return np.where(told, covariance, np.diag(np.where(withheld, priors, 0.0)))
