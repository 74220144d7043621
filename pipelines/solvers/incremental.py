"""Incremental: the same steps, fed one by one to iSAM2.

By default in a fixed-lag window, where old states are marginalised out and an update costs the same in hour ten as in
minute one; the calibration variables stay. With window None it is plain iSAM2 over the whole history.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import gtsam
import numpy as np

from factors.chi_square import gate
from factors.vectorized import VectorizedFactor
from pipelines.methods.base import (
    Array,
    Attitudes,
    ChiSquare,
    Estimate,
    Factor,
    History,
    Problem,
    Residuals,
    Step,
)
from pipelines.solvers.batch import CHUNK, graph_of, optimize
from pipelines.solvers.marginals import ordering_of, reported, reported_covariance

DEFAULT_WINDOW = 1.0

# At these times since the first step, s, everything so far is solved in batch and the smoother starts again from there:
# factors that leave the window keep their last linearisation point for good, so it has to be a good one, and outliers
# of the first moments are not to be told by innovations. Later the calibration moves too little to matter.
_ANCHORS = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 40.0)
# After so many rejections in a row the smoother may have lost its way: until the last anchor, start it anew at once.
_DOUBTED = 5
# After so many it is the prediction that is wrong: take the measurement.
_MOST_REJECTED = 10
# Move of a variable, in its own units (rad, rad/s, s), that makes iSAM2 linearise its factors anew.
_RELINEARIZE = 1e-2
# Estimates kept for plots, at most so many a second.
_HISTORY_RATE = 5.0


class _Smoother:
    """iSAM2 with a window (s) or without (None), behind one face."""

    def __init__(self, window: float | None) -> None:
        params = gtsam.ISAM2Params()
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

    def update(self, factors: Sequence[Factor], values: gtsam.Values, stamps: dict[int, float]) -> None:
        """Add factors and new variables."""
        if self._lagged is None:
            self._plain.update(graph_of(factors), values)
            return
        self._kept = (self._kept | set(values.keys())) - stamps.keys()
        if stamps:
            # Without a time of their own gtsam would order them among the variables about to be forgotten, and now and
            # then before one of these, which then cannot be taken out of the Bayes tree.
            stamps = {**stamps, **dict.fromkeys(self._kept, max(stamps.values()))}
        self._lagged.update(graph_of(factors), values, cast(Any, stamps))

    def estimate(self) -> gtsam.Values:
        """Current values of all variables held."""
        return (self._plain if self._lagged is None else self._lagged).calculateEstimate()

    def covariance(self, keys: Sequence[int]) -> Array:
        """Joint marginal covariance of the variables, in their order."""
        isam = self._plain if self._lagged is None else self._lagged.getISAM2()
        joint = isam.jointMarginalCovariance(list(keys))
        return np.block([[joint.at(i, j) for j in keys] for i in keys])


@dataclass
class _Innovations:
    """Innovations of one family as they come, whitened by their own covariance: their norm squared is the NIS."""

    time: list[float] = field(default_factory=list)
    whitened: list[Array] = field(default_factory=list)
    used: list[bool] = field(default_factory=list)

    def add(self, moment: float, whitened: Array, used: bool) -> None:
        self.time.append(moment)
        self.whitened.append(whitened)
        self.used.append(used)


def solve_incremental(problem: Problem, window: float | None = DEFAULT_WINDOW) -> Estimate:
    """The filtered estimate after the last step, with its history.

    Measurements whose innovation lies outside the gate, measured against the innovation's own covariance, are left
    out. The chi-square is the sum of the squared innovations.

    Args:
        problem: the graph.
        window: s, how long states are kept; None keeps all.
    """
    run = _Run(problem, window)
    start = time.perf_counter()
    for step in problem.steps(1):
        run.take(step)
    return run.finish(time.perf_counter() - start)


class _Run:
    """One pass of a smoother through the steps."""

    def __init__(self, problem: Problem, window: float | None) -> None:
        self.problem = problem
        self.window = window
        self.smoother = _Smoother(window)
        self.stand_ins: dict[int, int] = {}
        self.innovations: dict[str, _Innovations] = {}
        self.rejected_in_a_row = 0
        self.history: list[tuple[float, Array, Array]] = []
        self.attitudes: list[Attitudes] = []
        # Steps since the first, kept until the last anchor; then None.
        self.past: list[Step] | None = []
        self.anchors = list(_ANCHORS)
        self.started = False

    def take(self, step: Step) -> None:
        """One more step."""
        self.stand_ins.update(step.stand_ins)
        if self.past is not None:
            self.past.append(step)
        if self.started:
            self._advance(step)
        if not self.past:
            return
        due = step.time - self.past[0].time >= self.anchors[0]
        if due or self.rejected_in_a_row >= _DOUBTED:
            self._anchor(self.past)
            self.rejected_in_a_row = 0
        if due:
            self.anchors.pop(0)
            if not self.anchors:
                self.past = None

    @property
    def keys(self) -> list[int]:
        """The variables that now hold the parameters."""
        return [self.stand_ins.get(p.key, p.key) for p in self.problem.parameters]

    def _anchor(self, steps: Sequence[Step]) -> None:
        """Solve everything so far in batch and start the smoother from it, without the outliers."""
        gathered = list(self._gathered(steps))
        values = gtsam.Values()
        stamps: dict[int, float] = {}
        for step in gathered:
            values.insert(step.initial)
            stamps.update(step.timestamps)
        values = optimize([f for step in gathered for f in step.factors], values, self.keys, self.problem.loss).values
        factors = [f for step in steps for f in step.factors]
        used = [f.measurement is None or bool(f.measurement.used(values).all()) for f in factors]
        if self.problem.loss is not None:
            self.problem.loss.mu = 0.0  # from here on whole measurements are in or out
        self.smoother = _Smoother(self.window)
        self.smoother.update([f for f, good in zip(factors, used, strict=True) if good], values, stamps)
        if not self.started:
            for f, good in zip(factors, used, strict=True):
                if f.measurement is not None:
                    self._note(f, f.measurement.residuals(values), good)
        self.started = True
        self.attitudes.clear()
        self._record(steps[-1].time, [k for step in steps for k in step.keyframes], values)

    def _gathered(self, steps: Sequence[Step]) -> Iterator[Step]:
        """The same steps with many measurements in each, which solve faster, and single ones at the end."""
        now = -np.inf
        for step in self.problem.steps(CHUNK):
            if step.time > steps[-1].time:
                break
            now = step.time
            yield step
        yield from (step for step in steps if step.time > now)

    def _advance(self, step: Step) -> None:
        """Predict the new states, then take the measurements that agree with the prediction."""
        values = self.smoother.estimate()
        new = step.initial if step.predict is None else step.predict(values)
        values.insert(new)
        processes = [f for f in step.factors if f.measurement is None]
        factors = processes + [
            f for f in step.factors if f.measurement and self._agrees(f, f.measurement, processes, values, new)
        ]
        self.smoother.update(factors, new, dict(step.timestamps))
        self._record(step.time, step.keyframes, self.smoother.estimate())

    def _agrees(
        self,
        factor: Factor,
        measurement: VectorizedFactor,
        processes: Sequence[Factor],
        values: gtsam.Values,
        new: gtsam.Values,
    ) -> bool:
        """Whether the innovation lies within the gate, if the problem expects outliers; notes it."""
        error, A = measurement.rows(values)
        S = A @ self._predicted(measurement.keys, processes, values, new) @ A.T + np.eye(len(error))
        whitened = np.linalg.solve(np.linalg.cholesky(S), error)
        agrees = self.problem.loss is None or bool(whitened @ whitened < gate(len(error)) ** 2)
        self.rejected_in_a_row = 0 if agrees else self.rejected_in_a_row + 1
        if self.rejected_in_a_row > _MOST_REJECTED:
            agrees, self.rejected_in_a_row = True, 0
        self._note(factor, whitened.reshape(-1, measurement.model.rows), agrees)
        return agrees

    def _predicted(
        self, keys: Sequence[int], processes: Sequence[Factor], values: gtsam.Values, new: gtsam.Values
    ) -> Array:
        """Joint covariance of variables, the new ones among them as the processes predict them from the old ones."""
        dims = values.dims()
        process = graph_of(processes).linearize(values)
        fresh = list(new.keys())
        involved = set(process.keyVector())
        held = [k for k in dict.fromkeys([*keys, *involved]) if k not in fresh]
        P = self.smoother.covariance(held)
        where = _slices(held + fresh, dims)
        if fresh:
            order = [k for k in held if k in involved] + fresh
            A = process.jacobian(ordering_of(order))[0]
            columns = _slices(order, dims)
            width = P.shape[0]
            inverse = np.linalg.pinv(A[:, columns[fresh[0]].start :])
            carry = np.zeros((inverse.shape[0], width))
            for key in order[: -len(fresh)]:
                carry[:, where[key]] = -inverse @ A[:, columns[key]]
            across = carry @ P
            P = np.block([[P, across.T], [across, across @ carry.T + inverse @ inverse.T]])
        pick = np.concatenate([np.arange(P.shape[0])[where[key]] for key in keys])
        return P[np.ix_(pick, pick)]

    def _note(self, factor: Factor, whitened: Array, used: bool) -> None:
        assert factor.measurement is not None
        record = self.innovations.setdefault(factor.family, _Innovations())
        for moment, row in zip(factor.measurement.model.time, whitened, strict=True):
            record.add(float(moment), row, used)

    def _record(self, now: float, keyframes: Sequence[int], values: gtsam.Values) -> None:
        if self.problem.attitudes is not None:
            self.attitudes.append(self.problem.attitudes(keyframes, values))
        if not self.history or now - self.history[-1][0] >= 1.0 / _HISTORY_RATE:
            numbers = reported(self.problem, values, self.stand_ins)
            self.history.append((now, numbers, np.sqrt(np.diag(self._covariance(values)))))

    def _covariance(self, values: gtsam.Values) -> Array:
        information = np.asarray(np.linalg.inv(self.smoother.covariance(self.keys)), dtype=float)
        return reported_covariance(self.problem.parameters, information, values, self.keys)

    def finish(self, seconds: float) -> Estimate:
        """The estimate after the last step."""
        if not self.started and self.past:
            self._anchor(self.past)
        values = self.smoother.estimate()
        residuals = {
            family: Residuals(np.array(r.time), np.array(r.whitened), np.array(r.used))
            for family, r in self.innovations.items()
        }
        families = {
            family: (float((r.whitened[r.used] ** 2).sum()), float(r.whitened[r.used].size))
            for family, r in residuals.items()
        }
        times, numbers, sigmas = (np.array(column) for column in zip(*self.history, strict=True))
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=reported(self.problem, values, self.stand_ins),
            covariance=self._covariance(values),
            converged=True,
            message="all steps taken",
            residuals=residuals,
            chi_square=ChiSquare(sum(v for v, _ in families.values()), sum(d for _, d in families.values()), families),
            history=History(times, numbers, sigmas),
            attitudes=_joined(self.attitudes) if self.problem.attitudes is not None else None,
            rejected={family: int((~r.used).sum()) for family, r in residuals.items()},
            seconds={"solve": seconds},
        )


def _slices(keys: Sequence[int], dims: Mapping[int, int]) -> dict[int, slice]:
    """Where each variable stands when they are stacked in this order."""
    ends = np.cumsum([dims[key] for key in keys])
    return {key: slice(int(end) - dims[key], int(end)) for key, end in zip(keys, ends, strict=True)}


def _joined(pieces: Iterable[Attitudes]) -> Attitudes:
    pieces = list(pieces)
    return Attitudes(np.concatenate([a.time for a in pieces]), np.concatenate([a.wxyz for a in pieces]))
