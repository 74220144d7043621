"""iSAM2, in a fixed-lag window or over everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gtsam
import numpy as np

from factors.loss import TruncatedLoss
from pipelines.graph.problem import Array, Factor
from pipelines.solvers.batch import graph_of

# Move of a variable, in its own units (rad, rad/s, s), that makes iSAM2 linearise its factors anew.
_RELINEARIZE = 1e-2


class Smoother:
    """iSAM2 with a window (s) or without (None), behind one face.

    Args:
        window: s.
        fixed: each variable stays linearised where it began.
    """

    def __init__(self, window: float | None, fixed: bool = False) -> None:
        params = gtsam.ISAM2Params()
        params.enableRelinearization = not fixed
        params.setRelinearizeThreshold(_RELINEARIZE)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        # Tight processes beside loose priors: Cholesky loses the small ones.
        params.setFactorization("QR")
        # Back-substitution goes on however small a change is: 0.001, gtsam's limit, is much for a bias in rad/s.
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._lagged = None if window is None else gtsam.IncrementalFixedLagSmoother(window, params)
        self._plain = gtsam.ISAM2(params)
        self._kept: set[int] = set()  # variables that stay for good
        self._estimate = gtsam.Values()

    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        """Add factors and new variables. Raises RuntimeError, which spoils the smoother, if the system is singular."""
        if self._lagged is None:
            self._plain.update(graph_of(factors), values)
            self._estimate = self._plain.calculateEstimate()
            return
        self._kept = (self._kept | set(values.keys())) - stamps.keys()
        if stamps:
            # Without a time of their own gtsam would order them among the variables about to be forgotten, and now and
            # then before one of these, which then cannot be taken out of the Bayes tree.
            stamps = {**stamps, **dict.fromkeys(self._kept, max(stamps.values()))}
        self._lagged.update(graph_of(factors), values, cast(Any, stamps))
        self._estimate = self._lagged.calculateEstimate()

    def point(self) -> gtsam.Values:
        """The values about which the variables are linearised; the caller may add to them."""
        isam = self._plain if self._lagged is None else self._lagged.getISAM2()
        return gtsam.Values(isam.getLinearizationPoint())

    def estimate(self) -> gtsam.Values:
        """Current values of all variables held; the caller may add to them."""
        return gtsam.Values(self._estimate)

    def linearized(self) -> tuple[gtsam.GaussianFactorGraph, gtsam.Values]:
        """All factors held, and about which values they are linear.

        Those that stand for forgotten variables know no others: iSAM2 never moves the variables in them.
        """
        isam = self._plain if self._lagged is None else self._lagged.getISAM2()
        point = isam.getLinearizationPoint()
        return isam.getFactorsUnsafe().linearize(point), point

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal covariance of the variables, in their order."""
        isam = self._plain if self._lagged is None else self._lagged.getISAM2()
        joint = isam.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(i, j) for j in keys] for i in keys])


def linearized(factor: Factor, values: gtsam.Values) -> Factor:
    """The factor as it is about the values, for good.

    iSAM2 would not move the point either unless a variable moved by _RELINEARIZE, but ask a Python factor for the same
    numbers again at every update. What moves farther in the first moments is made good by the next re-initialisation,
    which solves the steps' own factors.
    """
    return Factor(factor.family, gtsam.LinearContainerFactor(factor.factor.linearize(values), values))


def unweighed(factor: Factor) -> Factor:
    """The factor without its loss, for a smoother that takes whole measurements or leaves them out."""
    measurement = factor.measurement
    if measurement is None or measurement.loss is None:
        return factor
    return Factor.of(factor.family, measurement.under(None))


def used_part(factor: Factor, values: gtsam.Values, loss: TruncatedLoss | None) -> Factor | None:
    """The factor on the measurements that the loss lets count at the values; None if there are none."""
    if factor.measurement is None:
        return factor
    used = factor.measurement.under(loss).used(values)
    if used.all():
        return factor
    if not used.any() or not factor.measurement.divisible:
        return None
    return Factor.of(factor.family, factor.measurement.only(used))
