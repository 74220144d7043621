"""What takes a recording step by step: iSAM2 over everything, or a fixed-lag smoother in square-root form."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import gtsam
import numpy as np

from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.solvers.linear_system import graph_of, linear_graph_of
from alidade.pipelines.solvers.marginals import ordering_of

# Move of a variable, in its own units (rad, rad/s, s), that makes iSAM2 linearise its factors anew.
_RELINEARIZE = 1e-2


class Smoother(Protocol):
    """What a run asks of either."""

    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        """Add factors and new variables; `stamps` are times of last use, of those that age.

        Raises RuntimeError, which spoils the smoother, if the system is singular.
        """

    def point(self) -> gtsam.Values:
        """The values about which new factors are to be linear; the caller may add to them."""

    def estimate(self) -> gtsam.Values:
        """Current values of all variables held; the caller may add to them."""

    def moves(self, keys: Sequence[int]) -> Array:
        """From the point to the estimate (d,), of variables in their order."""

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal covariance of the variables, in their order."""


class Unlimited:
    """iSAM2, which forgets nothing: what has moved is linearised anew."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(_RELINEARIZE)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        # Tight processes beside loose priors: Cholesky loses the small ones.
        params.setFactorization("QR")
        # Back-substitution goes on however small a change is: 0.001, gtsam's limit, is much for a bias in rad/s.
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._isam = gtsam.ISAM2(params)
        self._estimate = gtsam.Values()

    def update(self, factors: Sequence[Factor], values: gtsam.Values, _stamps: Mapping[int, float]) -> None:
        """As Smoother has it."""
        self._isam.update(graph_of(factors), values)
        self._estimate = self._isam.calculateEstimate()

    def point(self) -> gtsam.Values:
        """As Smoother has it."""
        return self.estimate()

    def estimate(self) -> gtsam.Values:
        """As Smoother has it."""
        return gtsam.Values(self._estimate)

    def moves(self, keys: Sequence[int]) -> Array:
        """As Smoother has it."""
        dims = self._estimate.dims()
        return np.zeros(sum(dims[key] for key in keys))

    def covariance(self, keys: Sequence[int]) -> Array:
        """As Smoother has it."""
        joint = self._isam.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(i, j) for j in keys] for i in keys])


class FixedLag:
    """A Gaussian in square-root form: the variables in use, and those of the window before, given these.

    In use are the variables of the last moment and those that never age: a few dozen numbers that every measurement
    joins, so that they are one dense block. The others were eliminated from it in time order and hang on it until their
    time leaves the window; a factor on one of them takes it back, with what is younger. What is in it stays linear
    about the values with which each variable began.

    Args:
        window: how long variables are held after their last use, s or whatever the stamps count.
        fixed: new factors are to be linear about these values, too; else about the estimate of what is a vector.
    """

    def __init__(self, window: float, fixed: bool) -> None:
        self._window, self._fixed = window, fixed
        self._stamps: dict[int, float] = {}
        self._past: list[tuple[int, gtsam.GaussianConditional]] = []  # a variable, given younger ones; oldest first
        self._present: gtsam.GaussianConditional | None = None  # of the variables in use
        self._begun = gtsam.Values()  # each variable with the value about which it is linear
        self._vectors: set[int] = set()  # those with the same tangent space everywhere
        self._moves = gtsam.VectorValues()  # from there to the estimate

    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        """As Smoother has it."""
        self._begun.insert(values)
        self._vectors.update(key for key in values.keys() if _is_vector(values, key))
        self._stamps.update(stamps)
        graph = linear_graph_of(factors, self._begun)
        first = self._oldest({key for f in factors for key in f.factor.keys()}.union(stamps))
        graph.push_back(self._known(first))
        del self._past[first:]
        latest = max(self._stamps.values(), default=0.0)
        keys = graph.keyVector()
        for key in sorted((k for k in keys if self._stamps.get(k, latest) < latest), key=self._stamps.__getitem__):
            conditional, rest = gtsam.EliminateQR(graph, ordering_of([key]))
            self._past.append((key, conditional))
            graph = gtsam.GaussianFactorGraph()
            graph.add(rest)
        in_use = [key for key in keys if self._stamps.get(key, latest) >= latest]
        self._present, _ = gtsam.EliminateQR(graph, ordering_of(in_use))
        while self._past and self._stamps[self._past[0][0]] < latest - self._window:
            key, _ = self._past.pop(0)
            self._begun.erase(key)
            del self._stamps[key]
            self._vectors.discard(key)
        bayes_net = gtsam.GaussianBayesNet()
        for conditional in (*(conditional for _, conditional in self._past), self._present):
            bayes_net.push_back(conditional)
        self._moves = bayes_net.optimize()

    def point(self) -> gtsam.Values:
        """As Smoother has it."""
        point = gtsam.Values(self._begun)
        for key in self._moved():
            point.update(key, point.atVector(key) + self._moves.at(key))
        return point

    def estimate(self) -> gtsam.Values:
        """As Smoother has it."""
        return self._begun.retract(self._moves)

    def moves(self, keys: Sequence[int]) -> Array:
        """As Smoother has it."""
        moved = self._moved()
        return np.concatenate([(0.0 if key in moved else 1.0) * self._moves.at(key) for key in keys])

    def in_use(self) -> tuple[gtsam.GaussianFactorGraph, gtsam.Values]:
        """What is known of the variables in use, all others marginalised out, and values about which it is linear."""
        return self._known(len(self._past)), self._begun

    def covariance(self, keys: Sequence[int]) -> Array:
        """As Smoother has it."""
        assert self._present is not None
        first = self._oldest(keys)
        order = [*(key for key, _ in self._past[first:]), *self._present.keys()]
        R, _ = self._known(first).jacobian(ordering_of(order))
        where = slices(order, self._begun.dims())
        inverse = np.linalg.inv(R)
        rows = np.concatenate([inverse[where[key]] for key in keys])
        return np.asarray(rows @ rows.T)

    def _moved(self) -> set[int]:
        """Variables about whose estimate new factors are linear."""
        return set() if self._fixed or self._present is None else self._vectors.intersection(self._present.keys())

    def _oldest(self, keys: Collection[int]) -> int:
        """Where in the past the oldest of the variables is; its end if none is in it."""
        return next((i for i, (key, _) in enumerate(self._past) if key in keys), len(self._past))

    def _known(self, first: int) -> gtsam.GaussianFactorGraph:
        """What is known of the variables in use and of those of the past from one on."""
        graph = gtsam.GaussianFactorGraph()
        for _, conditional in self._past[first:]:
            graph.push_back(conditional)
        if self._present is not None:
            graph.push_back(self._present)
        return graph


def _is_vector(values: gtsam.Values, key: int) -> bool:
    try:
        values.atVector(key)
    except RuntimeError:
        return False
    return True


def slices(keys: Sequence[int], dims: Mapping[int, int]) -> dict[int, slice]:
    """Where each variable stands when they are stacked in this order."""
    found, start = {}, 0
    for key in keys:
        found[key] = slice(start, start + dims[key])
        start += dims[key]
    return found


def linearized(factor: Factor, values: gtsam.Values) -> Factor:
    """The factor as it is about the values, for good."""
    return Factor(factor.family, gtsam.LinearContainerFactor(factor.linearized(values), values))


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
