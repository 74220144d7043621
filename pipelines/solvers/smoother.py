"""Smoothers of gtsam: iSAM2 over the whole history, and a fixed-lag smoother in square-root form."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import cast

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.noise_estimation import acting, level_weights

# Move of a variable, in its own unit (rad, rad/s, s), above which iSAM2 linearises its factors again.
_RELINEARIZE_MOVE = 1e-2


class Smoother(ABC):
    """Incremental smoother of the calibration variables and of recent states."""

    @abstractmethod
    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        """Add factors and new variables; `stamps` are times of last use, s, of variables that leave the window.

        Raises RuntimeError, after which the smoother cannot be used, if the system is singular.
        """

    @abstractmethod
    def linearization_point(self) -> gtsam.Values:
        """Values about which new factors are linearised; the caller may add new variables to them."""

    @abstractmethod
    def estimate(self) -> gtsam.Values:
        """Current values of all variables, in a container to which the caller may add."""

    @abstractmethod
    def moves(self, keys: Sequence[int]) -> Array:
        """Moves (d,) of variables, in the order of `keys`, from the linearisation point to the estimate."""

    @abstractmethod
    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal covariance (d, d) of variables, in the order of `keys`."""


class Isam2(Smoother):
    """iSAM2 over the whole history, which relinearises the factors of variables that have moved."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(_RELINEARIZE_MOVE)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        # Tight processes beside loose priors: Cholesky loses the small ones.
        params.setFactorization("QR")
        # Back-substitution goes on however small a change is: 0.001, gtsam's limit, is much for a bias in rad/s.
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._isam = gtsam.ISAM2(params)
        self._estimate = gtsam.Values()

    def update(self, factors: Sequence[Factor], values: gtsam.Values, _stamps: Mapping[int, float]) -> None:
        self._isam.update(graph_of(factors), values)
        self._estimate = self._isam.calculateEstimate()

    def linearization_point(self) -> gtsam.Values:
        return self.estimate()

    def estimate(self) -> gtsam.Values:
        return gtsam.Values(self._estimate)

    def moves(self, keys: Sequence[int]) -> Array:
        dims = self._estimate.dims()
        return np.zeros(sum(dims[key] for key in keys))

    def covariance(self, keys: Sequence[int]) -> Array:
        joint = self._isam.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(i, j) for j in keys] for i in keys])


class FixedLagSmoother(Smoother):
    """Fixed-lag smoother in square-root form: a dense block of active variables, conditionals of the others.

    Active are the variables of the last moment and those that never age: a few dozen numbers that every measurement
    joins, one dense block. The others were eliminated from it in time order and stay as conditionals until their time
    leaves the window; a factor on one of them takes it back into the block, with all that are younger. All factors are
    linear about the first value of each variable (first-estimates Jacobians, Huang, Mourikis, Roumeliotis,
    "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 2010).

    Args:
        window: time for which variables are kept after their last use, s or whatever the stamps count.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._stamps: dict[int, float] = {}
        self._past: list[tuple[int, gtsam.GaussianConditional]] = []  # a variable, given younger ones; oldest first
        self._present: gtsam.GaussianConditional | None = None  # of the active variables
        self._first = gtsam.Values()  # the first value of each variable, about which it is linear
        self._moves = gtsam.VectorValues()  # from there to the estimate

    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._first.insert(values)
        self._stamps.update(stamps)
        graph = linear_graph_of(factors, self._first)
        first = self._oldest({key for f in factors for key in f.keys}.union(stamps))
        graph.push_back(self._conditionals(first))
        del self._past[first:]
        self._eliminate(graph)
        self._forget()
        self._moves = self._solution()

    def _solution(self) -> gtsam.VectorValues:
        """Moves of all variables from their first values, the linearisation point."""
        assert self._present is not None
        bayes_net = gtsam.GaussianBayesNet()
        for conditional in (*(conditional for _, conditional in self._past), self._present):
            bayes_net.push_back(conditional)
        return bayes_net.optimize()

    def _eliminate(self, graph: gtsam.GaussianFactorGraph) -> None:
        """Eliminate a linear system in time order, the variables no longer active first."""
        latest = max(self._stamps.values(), default=0.0)
        keys = graph.keyVector()
        for key in sorted((k for k in keys if self._stamps.get(k, latest) < latest), key=self._stamps.__getitem__):
            conditional, rest = gtsam.EliminateQR(graph, ordering_of([key]))
            self._past.append((key, conditional))
            graph = gtsam.GaussianFactorGraph()
            graph.add(rest)
        active = [key for key in keys if self._stamps.get(key, latest) >= latest]
        self._present, _ = gtsam.EliminateQR(graph, ordering_of(active))

    def _forget(self) -> None:
        """Remove the variables last used before the window begins."""
        earliest = max(self._stamps.values(), default=0.0) - self._window
        while self._past and self._stamps[self._past[0][0]] < earliest:
            key, _ = self._past.pop(0)
            self._first.erase(key)
            del self._stamps[key]

    def linearization_point(self) -> gtsam.Values:
        return gtsam.Values(self._first)

    def estimate(self) -> gtsam.Values:
        return self._first.retract(self._moves)

    def moves(self, keys: Sequence[int]) -> Array:
        return np.concatenate([self._moves.at(key) for key in keys])

    def active_variables(self) -> tuple[gtsam.GaussianFactorGraph, gtsam.Values]:
        """Marginal Gaussian of the active variables, and the values about which it is linear."""
        return self._conditionals(len(self._past)), self._first

    def covariance(self, keys: Sequence[int]) -> Array:
        assert self._present is not None
        first = self._oldest(keys)
        order = [*(key for key, _ in self._past[first:]), *self._present.keys()]
        R, _ = self._conditionals(first).jacobian(ordering_of(order))
        where = slices(order, self._first.dims())
        inverse = np.linalg.inv(R)
        rows = np.concatenate([inverse[where[key]] for key in keys])
        return np.asarray(rows @ rows.T)

    def _oldest(self, keys: Collection[int]) -> int:
        """Index of the first conditional of any of the keys; the number of conditionals if none has one."""
        return next((i for i, (key, _) in enumerate(self._past) if key in keys), len(self._past))

    def _conditionals(self, first: int) -> gtsam.GaussianFactorGraph:
        """Graph of the conditionals from index `first` on, and of the active variables' Gaussian."""
        graph = gtsam.GaussianFactorGraph()
        for _, conditional in self._past[first:]:
            graph.push_back(conditional)
        if self._present is not None:
            graph.push_back(self._present)
        return graph


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """Convert keys to a gtsam ordering."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def slices(keys: Sequence[int], dims: Mapping[int, int]) -> dict[int, slice]:
    """Slice of each variable in the stacked tangents of `keys`, in that order."""
    found, start = {}, 0
    for key in keys:
        found[key] = slice(start, start + dims[key])
        start += dims[key]
    return found


def graph_of(factors: Sequence[Factor]) -> gtsam.NonlinearFactorGraph:
    """Collect the factors in a gtsam graph, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for f in factors:
        graph.add(f.factor)
    return graph


def linear_graph_of(factors: Sequence[Factor], values: gtsam.Values) -> gtsam.GaussianFactorGraph:
    """Linearise the factors about the values, in their order, to a Gaussian factor graph."""
    graph = gtsam.GaussianFactorGraph()
    for f in factors:
        graph.push_back(f.linearized(values))
    return graph


def linearized(factor: Factor, values: gtsam.Values) -> Factor:
    """Freeze a factor at its linearisation about the values."""
    return Factor(factor.family, gtsam.LinearContainerFactor(factor.linearized(values), values))


def without_loss(factor: Factor) -> Factor:
    """Return the factor without its robust loss."""
    measurement = factor.measurement
    if measurement is None or measurement.loss is None:
        return factor
    return Factor.of(factor.family, measurement.under(None))


def inliers(factor: Factor, values: gtsam.Values, loss: TruncatedLoss | None) -> Factor | None:
    """Restrict the factor to the measurements with robust weight at the values; None if there are none."""
    if factor.measurement is None:
        return factor
    used = factor.measurement.under(loss).used(values)
    if used.all():
        return factor
    if not used.any() or not factor.measurement.divisible:
        return None
    return Factor.of(factor.family, factor.measurement.only(used))


def weigh(factors: Sequence[Factor], levels: Sequence[Level]) -> list[Factor]:
    """Scale the factors' measurement noise to these levels."""
    scaled = acting(levels)
    if not scaled:
        return list(factors)
    families = {family for level in scaled for family in level.noise.families}
    return [_weighed(f, scaled) if f.family in families else f for f in factors]


def _weighed(factor: Factor, levels: Sequence[Level]) -> Factor:
    own = [level for level in levels if factor.family in level.noise.families]
    bound = factor.bound
    if bound is not None:
        stated = np.ones((len(bound.model.time), bound.model.rows)) if bound.weights is None else bound.weights
        return factor.rebound(bound.weighed(level_weights(stated, own, factor.beside, factor.fixed)))
    native = cast(gtsam.NoiseModelFactor, factor.factor)
    for level in own:
        noise = cast(gtsam.noiseModel.Gaussian, native.noiseModel())
        wider = gtsam.noiseModel.Gaussian.Information(noise.information() / level.scale**2)
        native = native.cloneWithNewNoiseModel(wider)
    return Factor(factor.family, native)
