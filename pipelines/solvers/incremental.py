"""Incremental: the same steps, fed one by one to iSAM2.

By default in a fixed-lag window, where old states are marginalised out and an update costs the same in hour ten as in
minute one; the calibration variables stay. With window None it is plain iSAM2 over the whole history.

Now and then the smoother is folded: what it knows of the variables it goes on with becomes one Gaussian, and a new
smoother goes on from that alone. A run can be saved there and taken up again in another process, see
pipelines.solvers.checkpoint: both go on from the same numbers.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.chi_square import gate
from factors.vectorized import VectorizedFactor
from pipelines.graph.problem import (
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
from pipelines.solvers.batch import CHUNK, Solution, graph_of, optimize
from pipelines.solvers.marginals import IndeterminateError, ordering_of, reported, reported_covariance
from pipelines.solvers.rows import Rows
from pipelines.solvers.state import State, explained, require_known, require_sound

DEFAULT_WINDOW = 1.0

# At these times since the first step, s, everything so far is solved in batch and the smoother starts again from there:
# factors that leave the window keep their last linearisation point for good, so it has to be a good one, and outliers
# of the first moments are not to be told by innovations. Later the calibration moves too little to matter.
_ANCHORS = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 40.0)
# From then on the smoother is folded this often, s.
FOLD = 20.0
# After so many rejections in a row the smoother may have lost its way: until the last anchor, start it anew at once ...
_DOUBTED = 5
# ... unless that was tried when there was hardly less, by this factor, to go by.
_MORE = 1.2
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


def solve_incremental(problem: Problem, window: float | None = DEFAULT_WINDOW) -> Estimate:
    """The filtered estimate after the last step, with its history.

    Measurements whose innovation lies outside the gate, measured against the innovation's own covariance, are left
    out. The chi-square is the sum of the squared innovations.

    Args:
        problem: the graph.
        window: s, how long states are kept; None keeps all.

    Raises:
        InputError: a factor gives no finite numbers, or needs a state that has left the window.
        IndeterminateError: states other than the parameters are not determined.
    """
    run = Run(problem, window)
    start = time.perf_counter()
    for step in problem.steps(1):
        run.take(step)
    return run.finish(time.perf_counter() - start)


class Run:
    """One pass of a smoother through the steps.

    Attributes:
        problem: the graph.
        window: s, how long states are kept; None keeps all.
        base: what was known when the smoother was last folded; None: never.
        past: the steps since then.
        stand_ins: parameter key -> variable that holds its value now.
        keyframes: how many were taken.
        innovations: family -> rows of time, 1 if used, and the innovation whitened by its own covariance, whose norm
            squared is the NIS.
        history: rows of time, values and sigmas.
        attitudes: rows of time and quaternion.
        unusable: family -> number of measurements left out because they gave no finite numbers.
    """

    def __init__(self, problem: Problem, window: float | None) -> None:
        self.problem = problem
        self.window = window
        self.base: State | None = None
        self.past: list[Step] = []
        self.stand_ins: dict[int, int] = {}
        self.keyframes = 0
        self.innovations: dict[str, Rows] = {}
        self.history = Rows()
        self.attitudes = Rows()
        self.unusable: dict[str, int] = {}
        self.rejected_in_a_row = 0
        self._smoother: _Smoother | None = None  # None before the first anchor
        self._stamps: dict[int, float] = {}  # of the variables held that age
        self._anchors = list(_ANCHORS)
        self._anchored = 0  # steps solved at the last anchor
        self._trouble = ""

    @classmethod
    def resumed(cls, problem: Problem, window: float, base: State) -> Run:
        """A run that goes on from where another one was folded."""
        run = cls(problem, window)
        run._anchors = []
        run._fold(base)
        run.grown(problem)
        return run

    def grown(self, problem: Problem) -> None:
        """Go on with the graph of the same recording, grown: the steps taken are among its own."""
        self.problem = problem
        if problem.loss is None:
            return
        if self._smoother is not None:
            problem.loss.mu = 0.0
        for step in self.past:
            for f in step.factors:
                if f.measurement is not None and f.measurement.loss is not None:
                    f.measurement.loss = problem.loss

    @property
    def time(self) -> float:
        """Time of the last step taken, s; -inf before the first."""
        if self.past:
            return self.past[-1].time
        return -np.inf if self.base is None else self.base.time

    @property
    def started(self) -> bool:
        """Whether there is an estimate yet."""
        return self._smoother is not None

    @property
    def just_folded(self) -> bool:
        """Whether the run is at a point where it can be saved."""
        return self.base is not None and not self.past

    @property
    def keys(self) -> list[int]:
        """The variables that now hold the parameters."""
        return [self.stand_ins.get(p.key, p.key) for p in self.problem.parameters]

    def take(self, step: Step) -> None:
        """One more step. Raises as solve_incremental does; the run is of no use any more then."""
        self.stand_ins.update(step.stand_ins)
        self.keyframes = max(self.keyframes, step.keyframes.stop)
        self.past.append(step)
        if self._smoother is not None:
            self._advance(self._smoother, step)
        else:
            self._stamps.update(step.timestamps)
        since = step.time - (self.past[0].time if self.base is None else self.base.time)
        if self._anchors:
            due = since >= self._anchors[0]
            if due:
                self._anchors.pop(0)
            doubted = self.rejected_in_a_row >= _DOUBTED and len(self.past) > _MORE * self._anchored
            if due or doubted:
                self._anchor()
        elif since >= FOLD and self._smoother is not None:
            alive = self._alive(self._smoother.estimate(), self._stamps)
            if alive is not None:
                self._fold(State.of(step.time, *self._smoother.linearized(), alive, self._stamps))

    def values(self) -> Array:
        """The parameters now, as reported."""
        return reported(self.problem, self._estimate(), self.stand_ins)

    def covariance(self) -> Array:
        """Joint covariance of the parameters now."""
        assert self._smoother is not None
        try:
            information = np.asarray(np.linalg.inv(self._smoother.covariance(self.keys)), dtype=float)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is singular: {error}") from error
        if not np.isfinite(information).all():
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is not finite")
        return reported_covariance(self.problem.parameters, information, self._estimate(), self.keys)

    def chi_square(self) -> ChiSquare:
        """The sum of the squared innovations of the measurements used."""
        families = {}
        for family, rows in self.innovations.items():
            used = rows.array[rows.array[:, 1] > 0.0, 2:]
            families[family] = float((used**2).sum()), float(used.size)
        return ChiSquare(sum(v for v, _ in families.values()), sum(d for _, d in families.values()), families)

    def _estimate(self) -> gtsam.Values:
        if self._smoother is None:
            self._anchor()
        assert self._smoother is not None
        return self._smoother.estimate()

    # -- solving in batch, and folding

    def _anchor(self) -> None:
        """Solve everything since the base in batch and start the smoother from it, without the outliers."""
        gathered = list(self._gathered())
        factors = [f for step in gathered for f in step.factors]
        values = gtsam.Values()
        stamps: dict[int, float] = {}
        if self.base is not None:
            factors.append(self.base.factor)
            values.insert(self.base.estimate)
            stamps.update(self.base.stamps)
        for step in gathered:
            values.insert(step.initial)
            stamps.update(step.timestamps)
        solution = optimize(factors, values, self.keys, self.problem.loss)
        if not solution.converged:
            require_sound(factors, values, self.time)
        self._trouble = "" if solution.converged else f"the first {self.time:.1f} s: {solution.message}"
        if self._smoother is None:
            for f in factors:
                if f.measurement is not None:
                    self._note(f, f.measurement.residuals(solution.values), f.measurement.used(solution.values))
        self._restart(solution, stamps)
        if self.base is None or self.just_folded:
            self.attitudes.clear()
        else:
            gathered = gathered[-1:]
        self._record([k for step in gathered for k in step.keyframes], solution.values)
        self._anchored, self.rejected_in_a_row = len(self.past), 0

    def _gathered(self) -> Iterator[Step]:
        """The steps since the base; those since the start with many measurements in each, which solve faster."""
        now = -np.inf
        for step in self.problem.steps(CHUNK) if self.base is None else ():
            if step.time > self.time:
                break
            now = step.time
            yield step
        yield from (step for step in self.past if step.time > now)

    def _restart(self, solution: Solution, stamps: Mapping[int, float]) -> None:
        """Start the smoother from a solution: from what it says of the variables it goes on with, or from all of it."""
        values, loss = solution.values, self.problem.loss
        alive = self._alive(values, stamps)
        if alive is not None:
            state = State.of(self.time, solution.system.linearize(values), values, alive, stamps)
            if self._anchors:
                self._start([state.factor], state.estimate, state.stamps)
            else:
                self._fold(state)
        else:
            factors = [f for step in self.past for f in step.factors]
            used = [f for f in factors if f.measurement is None or f.measurement.used(values).all()]
            self._start(used, values, stamps)
        if loss is not None:
            loss.mu = 0.0  # from here on whole measurements are in or out

    def _fold(self, state: State) -> None:
        """Go on from a state alone."""
        self.base, self.past = state, []
        self._start([state.factor], state.estimate, state.stamps)

    def _start(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._smoother = _Smoother(self.window)
        self._stamps = dict(stamps)
        try:
            self._smoother.update(factors, values, stamps)
        except RuntimeError as error:
            raise IndeterminateError(explained(error)) from None

    def _alive(self, values: gtsam.Values, stamps: Mapping[int, float]) -> list[int] | None:
        """The variables that later steps may refer to, if there are others to forget.

        Those are the ones used in the last moment and those that never age.
        """
        latest = max(stamps.values(), default=-np.inf)
        alive = [key for key in values.keys() if stamps.get(key, np.inf) >= latest]
        return alive if self.window is not None and len(alive) < values.size() else None

    # -- step by step

    def _advance(self, smoother: _Smoother, step: Step) -> None:
        """Predict the new states, then take the measurements that agree with the prediction."""
        try:
            values = smoother.estimate()
            new = step.initial if step.predict is None else step.predict(values)
            values.insert(new)
            processes = [f for f in step.factors if f.measurement is None]
            require_sound(processes, values, step.time)
            measurements = [
                f for f in step.factors if f.measurement and self._agrees(f, f.measurement, processes, values, new)
            ]
            if self.window is not None and self.rejected_in_a_row == 0:
                measurements = [_linear(f, values) for f in measurements]
            smoother.update(processes + measurements, new, step.timestamps)
        except (RuntimeError, np.linalg.LinAlgError):
            # Singular, if only by rounding. The smoother is spoilt, but all it knew is in the base and the steps since.
            self._anchor()
            return
        values = smoother.estimate()
        self._stamps = {k: t for k, t in {**self._stamps, **step.timestamps}.items() if values.exists(k)}
        self._record(step.keyframes, values)

    def _agrees(
        self,
        factor: Factor,
        measurement: VectorizedFactor,
        processes: Sequence[Factor],
        values: gtsam.Values,
        new: gtsam.Values,
    ) -> bool:
        """Whether the innovation lies within the gate, if the problem expects outliers; notes it."""
        require_known([factor], values, self.time)
        error, A = measurement.rows(values)
        if not (np.isfinite(error).all() and np.isfinite(A).all()):
            self.unusable[factor.family] = self.unusable.get(factor.family, 0) + len(measurement.model.time)
            return False
        S = A @ self._predicted(measurement.keys, processes, values, new) @ A.T + np.eye(len(error))
        whitened = np.linalg.solve(np.linalg.cholesky(S), error)
        agrees = self.problem.loss is None or bool(whitened @ whitened < gate(len(error)) ** 2)
        self.rejected_in_a_row = 0 if agrees else self.rejected_in_a_row + 1
        if self.rejected_in_a_row > _MOST_REJECTED:
            agrees, self.rejected_in_a_row = True, 0
        rows = whitened.reshape(-1, measurement.model.rows)
        self._note(factor, rows, np.full(len(rows), agrees))
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
        assert self._smoother is not None
        P = self._smoother.covariance(held)
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

    def _note(self, factor: Factor, whitened: Array, used: NDArray[np.bool_]) -> None:
        assert factor.measurement is not None
        time = factor.measurement.model.time
        rows = self.innovations.setdefault(factor.family, Rows())
        rows.add(np.column_stack([time, used, whitened.reshape(len(time), -1)]))

    def _record(self, keyframes: Sequence[int], values: gtsam.Values) -> None:
        if self.problem.attitudes is not None:
            attitudes = self.problem.attitudes(keyframes, values)
            self.attitudes.add(np.column_stack([attitudes.time, attitudes.wxyz]))
        if not len(self.history) or self.time - self.history.array[-1, 0] >= 1.0 / _HISTORY_RATE:
            self.history.add(np.concatenate([[self.time], self.values(), np.sqrt(np.diag(self.covariance()))])[None])

    def finish(self, seconds: float) -> Estimate:
        """The estimate after the last step taken. More steps may follow."""
        values, covariance = self.values(), self.covariance()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise IndeterminateError(f"the estimate at {self.time:.3f} s is not a finite number")
        residuals = {
            family: Residuals(rows.array[:, 0].copy(), rows.array[:, 2:].copy(), rows.array[:, 1] > 0.0)
            for family, rows in self.innovations.items()
        }
        history, n = self.history.array.copy(), len(values)
        attitudes = self.attitudes.array.copy()
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=values,
            covariance=covariance,
            converged=not self._trouble,
            message=self._trouble or "all steps taken",
            residuals=residuals,
            chi_square=self.chi_square(),
            history=History(history[:, 0], history[:, 1 : 1 + n], history[:, 1 + n :]),
            attitudes=None if self.problem.attitudes is None else Attitudes(attitudes[:, 0], attitudes[:, 1:]),
            rejected={f: int((~r.used).sum()) + self.unusable.get(f, 0) for f, r in residuals.items()},
            seconds={"solve": seconds},
        )


def _linear(factor: Factor, values: gtsam.Values) -> Factor:
    """The factor as it is about the values, for good.

    iSAM2 would not move the point either unless a variable moved by _RELINEARIZE, but ask a Python factor for the same
    numbers again at every update. What moves farther in the first moments is made good at the next anchor, which solves
    the steps' own factors.
    """
    return Factor(factor.family, gtsam.LinearContainerFactor(factor.factor.linearize(values), values))


def _slices(keys: Sequence[int], dims: Mapping[int, int]) -> dict[int, slice]:
    """Where each variable stands when they are stacked in this order."""
    ends = np.cumsum([dims[key] for key in keys])
    return {key: slice(int(end) - dims[key], int(end)) for key, end in zip(keys, ends, strict=True)}
