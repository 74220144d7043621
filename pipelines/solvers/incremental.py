"""Incremental solver: the steps of a problem, fed one by one to a smoother of gtsam.

**Initialisation phase.** A linearisation where little is known turns noise into information, and among few measurements
outliers cannot be identified. So there is no smoother yet: everything so far is solved in batch at times 1, 1.15,
1.15^2, ... s, and until the next solution the estimate is the last one, with batch's weak directions and second-order
terms (alidade.pipelines.solvers.weak_directions). While outliers may be the majority of a family, everything that has
a prior stays there, and so do numbers for which second order does not go far enough, as with two or three attitudes of
a triad. The phase ends when no direction of the calibrated numbers is weak any more and second-order terms are a small
share of every variance; at the latest after 600 s.

**Afterwards** states are marginalised out of a fixed-lag window: an update costs the same in hour ten as in minute one.
From time to time all but the active variables are marginalised out, and a new smoother continues from that Gaussian
alone; a run can be saved there (alidade.pipelines.solvers.checkpoint). Without a window it is iSAM2 over the whole
history. Directions that are weak even then have their priors, as in batch.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import (
    Array,
    Attitudes,
    ChiSquare,
    Estimate,
    Factor,
    History,
    PosteriorHistory,
    Problem,
    Step,
)
from alidade.pipelines.solvers.batch import BatchConfig, Solved, residuals_by_family, solve, whole_estimate
from alidade.pipelines.solvers.chain import IndeterminateError
from alidade.pipelines.solvers.checkpoint import (
    MarginalState,
    SavedRun,
    counted_apart,
    finite_measurements,
    require_finite,
    require_known_variables,
)
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import sigma_ratio
from alidade.pipelines.solvers.gating import InnovationGate, Prediction, RowBuffer, correlation_inflation
from alidade.pipelines.solvers.gtsam_engine import GtsamSystem, undetermined
from alidade.pipelines.solvers.posterior import WIDEST, Reported
from alidade.pipelines.solvers.smoother import (
    FixedLagSmoother,
    Isam2,
    Smoother,
    inliers,
    linearized,
    slices,
    weigh,
    without_loss,
)
from alidade.pipelines.solvers.weak_directions import (
    Posterior,
    WeakDirections,
    at_prior,
    beyond_second_order,
    constrained_step,
)
from alidade.pipelines.solvers.window import Keyframes, Window

DEFAULT_WINDOW = 1.0
# Steps freed with each new one, of those marginalised out: a thousand at once take longer than an update.
_FREED = 10
# Variance, in units of the priors', below which that of a smoother is rounding.
_LEAST_VARIANCE = 1e-24


@dataclass(frozen=True)
class IncrementalConfig:
    """Initialisation phase, marginalisation and history of the incremental solver.

    Attributes:
        first_solve: time from the first step to the first batch solution, s.
        solve_growth: ratio of the times of successive batch solutions.
        max_initialisation: time after which the initialisation phase ends in any case, s: the cost of a batch solution
            grows with it.
        min_steps: number of steps before which the phase does not end: few large steps cost little to solve again.
        max_curvature: largest share of a variance that is of second order with which the phase ends.
        marginalize_every: time between marginalisations afterwards, s.
        history_rate: largest number of estimates kept per second.
        moment_spacing: time between moments of the joint history, as a share of the time since the first.
    """

    first_solve: float = 1.0
    solve_growth: float = 1.15
    max_initialisation: float = 600.0
    min_steps: int = 100
    max_curvature: float = 0.15
    marginalize_every: float = 20.0
    history_rate: float = 5.0
    moment_spacing: float = 0.02


def solve_incremental(
    problem: Problem, window: Window = DEFAULT_WINDOW, config: IncrementalConfig = IncrementalConfig()
) -> Estimate:
    """The filtered estimate after the last step, with its history.

    Measurements whose innovation lies outside the gate, measured against the innovation's own covariance, are left
    out. The chi-square is the sum of the squared innovations.

    Args:
        problem: the graph.
        window: how long states are kept, s or Keyframes; None keeps all.
        config: of the solver.

    Raises:
        InputError: a factor gives no finite numbers, or needs a state that has left the window.
        IndeterminateError: states other than the parameters are not determined.
    """
    solver = IncrementalSolver(problem, window, config)
    start = time.perf_counter()
    for step in problem.steps(1):
        solver.add_step(step)
    return solver.finish(time.perf_counter() - start)


class MomentRecorder:
    """Joint estimates at moments a fixed share of the time apart, so that hours have a few hundred of them.

    Attributes:
        rows: time, values (n,) and covariance (n * n,) of each; none where the beginning is not known.
    """

    def __init__(self, rows: RowBuffer | None = None) -> None:
        self.rows = RowBuffer() if rows is None else rows

    @classmethod
    def after(cls, posterior_history: PosteriorHistory | None) -> MomentRecorder:
        """A recorder that continues from the moments of a batch solution."""
        if posterior_history is None:
            return cls()
        covariance = posterior_history.covariance.reshape(len(posterior_history.time), -1)
        return cls(RowBuffer(np.column_stack([posterior_history.time, posterior_history.values, covariance])))

    def is_due(self, time: float, spacing: float) -> bool:
        """Whether a moment is to be added at a time, s."""
        past = self.rows.array
        return len(past) > 0 and time - past[-1, 0] >= spacing * (time - past[0, 0])

    def add(self, time: float, values: Array, covariance: Array) -> None:
        """Add a moment."""
        self.rows.add(np.concatenate([[time], values, covariance.ravel()])[None])

    def posterior_history(
        self, time: float, values: Array, covariance: Array, steady: NDArray[np.bool_]
    ) -> PosteriorHistory | None:
        """The moments before a time, s, with the estimate then as the last; None: the beginning is not known."""
        past, n = self.rows.array, len(values)
        if not len(past):
            return None
        past = past[past[:, 0] < time]
        return PosteriorHistory(
            np.append(past[:, 0], time),
            np.vstack([past[:, 1 : 1 + n], values]),
            np.concatenate([past[:, 1 + n :].reshape(-1, n, n), covariance[None]]),
            steady,
        )


class IncrementalSolver:
    """One pass of a smoother through the steps.

    Attributes:
        problem: the graph.
        window: how long states are kept, s or Keyframes; None keeps all.
        config: of the solver.
        initialising: whether the run is in its initialisation phase.
        marginal: the Gaussian that the run continues from since everything else was marginalised out; None: never.
        steps_since: the steps added since then.
        current_keys: parameter key -> variable that holds its value now.
        keyframes: number added.
        gate: innovations of all measurements.
        levels: noise levels of the last batch solution.
        trouble: why the last batch solution did not converge; empty: it did.
        history: rows of time, values and sigmas.
        attitudes: rows of time and quaternion.
        recorder: joint estimates at moments after the initialisation phase.
        moments: number of moments, or in the initialisation phase of batch solutions, so far.
        walked: parameter keys whose values other variables held before.
    """

    def __init__(self, problem: Problem, window: Window, config: IncrementalConfig = IncrementalConfig()) -> None:
        self.problem, self.config = problem, config
        self.window = window if window is None or isinstance(window, Keyframes) else float(window)
        self.initialising = True
        self.marginal: MarginalState | None = None
        self.steps_since: list[Step] = []
        self.current_keys: dict[int, int] = {}
        self.keyframes = 0
        self.gate = InnovationGate()
        self.levels = problem.noises
        self.trouble = ""
        self.history = RowBuffer()
        self.attitudes = RowBuffer()
        self.recorder = MomentRecorder()
        self.moments = 0
        self.walked: set[int] = set()
        self._outdated: list[Step] = []  # steps no longer needed, yet to be freed
        self._smoother: Smoother | None = None  # None in the initialisation phase
        self._stamps: dict[int, float] = {}  # of the variables held that age, in the window's unit
        self._times: list[float] = []  # of the keyframes, where they are the window's unit
        self._before = 0.0  # number of keyframes before these
        self._solved: Solved | None = None  # the last batch solution, in the initialisation phase
        self._of = 0, 0.0  # number of its steps, and their time, s
        self._estimate: Estimate | None = None  # made of it
        self._beyond = np.ones(len(problem.quantities), dtype=bool)  # numbers that need more than second order

    @classmethod
    def resumed(
        cls, problem: Problem, saved: SavedRun, config: IncrementalConfig = IncrementalConfig()
    ) -> IncrementalSolver:
        """A run that continues from a saved one."""
        solver = cls(problem, saved.window, config)
        solver.initialising = False
        solver.levels, solver.trouble = saved.levels, saved.trouble
        solver.current_keys, solver.keyframes = dict(saved.current_keys), saved.keyframes
        solver.walked = set(saved.walked)
        solver.history, solver.attitudes = RowBuffer(saved.rows["history"]), RowBuffer(saved.rows["attitudes"])
        solver.recorder = MomentRecorder(RowBuffer(saved.rows["moments"]))
        solver.gate = InnovationGate(
            {family: RowBuffer(rows) for family, rows in saved.innovations.items()},
            dict(saved.unusable),
            dict(saved.information),
            saved.rejected_in_a_row,
        )
        solver._before = 1.0 + max(saved.marginal.stamps.values(), default=-1.0)
        solver._continue_from(saved.marginal)
        return solver

    def saved(self) -> SavedRun:
        """The run as it is to be saved. Raises ValueError unless `can_checkpoint`."""
        if self.marginal is None or self.steps_since or self.window is None:
            raise ValueError("a run can be saved only where its past was just marginalised out")
        return SavedRun(
            window=self.window,
            marginal=self.marginal,
            current_keys=self.current_keys,
            keyframes=self.keyframes,
            walked=frozenset(self.walked),
            levels=self.levels,
            trouble=self.trouble,
            rejected_in_a_row=self.gate.rejected_in_a_row,
            unusable=self.gate.unusable,
            rows={
                "history": self.history.array,
                "attitudes": self.attitudes.array,
                "moments": self.recorder.rows.array,
            },
            innovations={family: rows.array for family, rows in self.gate.families.items()},
            information=self.gate.information,
        )

    @property
    def can_checkpoint(self) -> bool:
        """Whether the run is at a point where it can be saved."""
        return self.marginal is not None and not self.steps_since

    def update_problem(self, problem: Problem) -> None:
        """Continue with the graph of the same recording, grown: the steps added are among its own."""
        self.problem = problem

    @property
    def time(self) -> float:
        """Time of the last step, s; -inf before the first."""
        if self.steps_since:
            return self.steps_since[-1].time
        return -np.inf if self.marginal is None else self.marginal.time

    @property
    def started(self) -> bool:
        """Whether there is an estimate yet."""
        return self._smoother is not None or self._solved is not None

    @property
    def keys(self) -> list[int]:
        """The variables that hold the parameters now."""
        return [self.current_keys.get(p.key, p.key) for p in self.problem.parameters]

    def add_step(self, step: Step) -> None:
        """Add a step. Raises as solve_incremental does; the solver cannot be used any more then."""
        self.walked.update(key for key, held in step.current_keys.items() if self.current_keys.get(key, held) != held)
        self.current_keys.update(step.current_keys)
        self.keyframes = max(self.keyframes, step.keyframes.stop)
        self.steps_since.append(step)
        del self._outdated[-_FREED:]
        if isinstance(self.window, Keyframes):
            self._times.extend(sorted({*step.timestamps.values(), step.time}))
        if self._smoother is not None:
            self._advance(self._smoother, step)
        since = step.time - (self.steps_since[0].time if self.marginal is None else self.marginal.time)
        if self.initialising:
            if since >= max(self.config.first_solve, self.config.solve_growth * self._of[1]):
                self._solve_batch()
        elif since >= self.config.marginalize_every and isinstance(self._smoother, FixedLagSmoother):
            graph, values = self._smoother.active_variables()
            state = MarginalState.of(step.time, graph, values, list(graph.keyVector()), self._stamps)
            self._continue_from(state)

    # -- what is reported

    def values(self) -> Array:
        """The reported numbers (n,) now, weak directions at their priors."""
        return self._constrained()[0]

    def covariance(self) -> Array:
        """Joint covariance (n, n) of `values`."""
        return self._constrained()[1]

    def posterior_history(self) -> PosteriorHistory | None:
        """Joint estimates at moments; in the initialisation phase until its last batch solution."""
        if self.initialising:
            return self.estimate().posterior_history
        steady = np.repeat(
            [p.key not in self.walked for p in self.problem.parameters],
            [len(p.quantities) for p in self.problem.parameters],
        )
        return self.recorder.posterior_history(self.time, *self._constrained(), steady)

    def chi_square(self) -> ChiSquare:
        """Squared residuals of the last batch solution, after the initialisation phase squared innovations."""
        found = self.estimate().chi_square if self.initialising else None
        return self.gate.chi_square() if found is None else found

    def finish(self, seconds: float) -> Estimate:
        """The estimate after the last step, as batch has it. More steps may follow."""
        if self.initialising and len(self.steps_since) > self._of[0]:
            self._solve_batch()  # which may end the initialisation phase
        if self.initialising:
            self._estimate = self._estimate_of(self._batch())
        return replace(self.estimate(), seconds={"solve": seconds})

    def estimate(self) -> Estimate:
        """The estimate now. Raises IndeterminateError when it is no finite number."""
        if not self.initialising:
            return self._filtered()
        if self._estimate is None:
            solved = self._batch()
            self._estimate = self._estimate_of(replace(solved, posterior=self._posterior_of(solved)))
        return self._estimate

    def _estimate_of(self, solved: Solved) -> Estimate:
        """Everything that is reported of a batch solution, with what was known over time."""
        estimate = whole_estimate(solved, BatchConfig())
        return replace(
            estimate,
            solver="incremental",
            message=self.trouble or "all steps taken",
            history=self._history(estimate.inflation),
            rejected=self.gate.rejected(),
        )

    def _history(self, inflation: Array | None) -> History:
        """What was known over time, with sigmas (n,) times as wide."""
        rows, n = self.history.array.copy(), len(self.problem.quantities)
        history = History(rows[:, 0], rows[:, 1 : 1 + n], rows[:, 1 + n :])
        return history if inflation is None else history.inflated(inflation)

    def _filtered(self) -> Estimate:
        """The estimate of the smoother."""
        values, covariance = self._constrained()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise IndeterminateError(f"the estimate at {self.time:.3f} s is not a finite number")
        to_tangents = np.asarray(np.linalg.pinv(self._reported().jacobian), dtype=float)
        grown, lengths = correlation_inflation(self.problem, covariance, self.gate, to_tangents)
        inflation = sigma_ratio(np.diag(covariance), np.diag(grown))
        attitudes = self.attitudes.array.copy()
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=values,
            covariance=grown,
            inflation=inflation,
            colours=lengths,
            converged=not self.trouble,
            message=self.trouble or "all steps taken",
            residuals=self.gate.residuals(),
            chi_square=self.gate.chi_square(),
            history=self._history(inflation),
            posterior_history=self.posterior_history(),
            attitudes=None if self.problem.attitudes is None else Attitudes(attitudes[:, 0], attitudes[:, 1:]),
            rejected=self.gate.rejected(),
            levels=self.levels,
        )

    def _batch(self) -> Solved:
        """The last batch solution of the initialisation phase."""
        if self._solved is None:
            self._solve_batch()
        assert self._solved is not None
        return self._solved

    def _posterior_of(self, solved: Solved) -> Posterior:
        """The posterior of a batch solution; at its prior while outliers may be the majority of a family.

        So are numbers for which second order does not go far enough yet.
        """
        is_undecided = bool(self.trouble) or self.gate.too_few_to_decide()
        return at_prior(solved.posterior, self._beyond[solved.posterior.reported.free] | is_undecided)

    def _constrained(self) -> tuple[Array, Array]:
        """Values (n,) and covariance (n, n) of the reported numbers, weak directions at their priors.

        Raises:
            IndeterminateError: the smoother's covariance is singular.
        """
        if self.initialising:
            posterior = self._posterior_of(self._batch())
            return posterior.reported.numbers, posterior.covariance
        reported = self._reported()
        variances, axes = np.linalg.eigh(self._smoothed_covariance(reported))
        R = axes.T / np.sqrt(np.clip(variances, _LEAST_VARIANCE, WIDEST**2))[:, None]
        directions = WeakDirections.of(R, reported.prior, reported.calibrated)
        values = reported.numbers.copy()
        values[reported.free] += reported.scale * constrained_step(directions, R, np.zeros(len(R)), reported.u)
        return values, reported.covariance(directions.covariance())

    def _smoothed_covariance(self, reported: Reported) -> Array:
        """The smoother's covariance (m, m) of the free reported numbers, in units of their usual priors' sigmas."""
        assert self._smoother is not None
        J = reported.jacobian[reported.free] / reported.scale[:, None]
        try:
            covariance = J @ self._smoother.covariance(self.keys) @ J.T
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is singular: {error}") from error
        if not np.isfinite(covariance).all():
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is not finite")
        return np.asarray(covariance)

    def _reported(self) -> Reported:
        """The reported numbers of the smoother, with their Jacobian by the tangents of the variables that hold them."""
        assert self._smoother is not None
        values, keys = self._smoother.estimate(), self.keys
        dims = values.dims()  # made anew of all variables at every call
        where, unit = slices(keys, dims), np.eye(sum(dims[key] for key in keys))
        return Reported.at(self.problem, values, keys, [unit[where[key]] for key in keys])

    # -- step by step

    def _advance(self, smoother: Smoother, step: Step) -> None:
        """Predict the new states, then update with the measurements that agree with the prediction."""
        try:
            about = smoother.linearization_point()
            new = step.initial if step.predict is None else step.predict(smoother.estimate())
            about.insert(new)
            stamps = self._ages(step.timestamps)
            smoother.update(self._selected(smoother, step, about, new), new, stamps)
        except (RuntimeError, ValueError, np.linalg.LinAlgError):
            # Singular, if only by rounding, or a variable that no process determines. The smoother is spoilt, but the
            # marginal and the steps since are not.
            self._solve_batch()
            return
        values = smoother.estimate()
        self._stamps = {k: t for k, t in {**self._stamps, **stamps}.items() if values.exists(k)}
        if self.problem.attitudes is not None:
            self._add_attitudes(self.problem.attitudes(step.keyframes, values))
        self._record()

    def _selected(self, smoother: Smoother, step: Step, about: gtsam.Values, new: gtsam.Values) -> list[Factor]:
        """The processes of a step and the measurements used, for a window linear about the values."""
        factors = weigh(step.factors, self.levels)
        require_known_variables(factors, about, step.time)
        processes = [f for f in factors if f.measurement is None]
        if self.window is not None:
            processes = [linearized(f, about) for f in processes]
        require_finite(processes, about, step.time)
        prediction = Prediction(smoother, processes, about, new)
        # Of a single family all information that was measured is its own.
        parameters = self.keys if len(self.gate.families) > 1 else []
        measurements = []
        for f in factors:
            if f.measurement is not None:
                used = self.gate.select(f, prediction, self.problem.loss is not None, parameters)
                if used is not None:
                    measurements.append(without_loss(used))
        if self.window is not None:
            measurements = [linearized(f, about) for f in measurements]
        return processes + measurements

    def _ages(self, timestamps: Mapping[int, float]) -> dict[int, float]:
        """Times of last use, s, in the window's unit: the number of the keyframe, or as they are."""
        if not isinstance(self.window, Keyframes):
            return dict(timestamps)
        number = self._before + np.searchsorted(self._times, list(timestamps.values()))
        return dict(zip(timestamps, number.tolist(), strict=True))

    def _add_attitudes(self, attitudes: Attitudes) -> None:
        self.attitudes.add(np.column_stack([attitudes.time, attitudes.wxyz]))

    def _record(self) -> None:
        """Add the estimate now to the history, and after the initialisation phase to the moments."""
        if not len(self.history) or self.time - self.history.array[-1, 0] >= 1.0 / self.config.history_rate:
            numbers, covariance = self._constrained()
            self.history.add(np.concatenate([[self.time], numbers, np.sqrt(np.diag(covariance))])[None])
            if not self.initialising and self.recorder.is_due(self.time, self.config.moment_spacing):
                self.recorder.add(self.time, numbers, covariance)
                self.moments += 1

    # -- batch solutions

    def _solve_batch(self) -> None:
        """Solve everything since the marginal in batch; once that is linear enough, start the smoother from it."""
        solved = self._batch_solution(self._all_steps_since())
        if self.marginal is None:
            self.gate.adopt(residuals_by_family(solved.engine, solved.solution.values))
        if self.initialising:
            since = self.time - self.steps_since[0].time
            self._solved, self._of, self._estimate = solved, (len(self.steps_since), since), None
            self.moments += 1
            if self._beyond.any():
                # Second order that has once gone far enough does so from then on.
                beyond = beyond_second_order(solved.compiled, solved.posterior)
                self._beyond[solved.posterior.reported.free] &= beyond
            if since < self.config.max_initialisation and not self._is_linear(solved):
                self._record()
                return
            self.recorder = MomentRecorder.after(self.estimate().posterior_history)
            self.initialising, self._solved, self._estimate = False, None, None
        if self.problem.attitudes is not None:
            from_start = self.marginal is None
            if from_start:
                self.attitudes.clear()
            values = solved.compiled.layout.to_gtsam(solved.solution.values)
            keyframes = solved.compiled.keyframes if from_start else self.steps_since[-1].keyframes
            self._add_attitudes(self.problem.attitudes(keyframes, values))
        self._start_from(solved)
        self._record()

    def _is_linear(self, solved: Solved) -> bool:
        """Whether a smoother can continue from a solution: no weak direction, a small share of second order."""
        if self.trouble or len(self.steps_since) < self.config.min_steps or self.gate.too_few_to_decide():
            return False
        posterior = solved.posterior
        return not posterior.directions.weak.shape[1] and posterior.second_order_share() < self.config.max_curvature

    def _all_steps_since(self) -> list[Step]:
        """The steps since the marginal, the marginal as the first of them."""
        if self.marginal is None:
            return self.steps_since
        start = Step(self.marginal.time, self.marginal.estimate, [self.marginal.factor])
        start.current_keys.update(self.current_keys)
        return [start, *self.steps_since]

    def _batch_solution(self, steps: Sequence[Step]) -> Solved:
        """The most probable values of some steps; noise levels are estimated until something was marginalised out.

        Raises:
            InputError: a factor gives no finite numbers.
            IndeterminateError: something is not determined.
        """
        problem = replace(self.problem, finer=None, elsewhere=None)
        compiled = Compiled.of(problem, steps=steps)
        if not np.isfinite(compiled.engine.cost(compiled.initial)):
            compiled = Compiled.of(problem, steps=self._finite(steps, compiled.layout.to_gtsam(compiled.initial)))
        try:
            solved = solve(compiled, levels=None if self.marginal is None else self.levels)
        except (IndeterminateError, np.linalg.LinAlgError) as error:
            raise IndeterminateError(f"the first {self.time:.3f} s do not determine the parameters: {error}") from error
        self.levels = solved.levels
        found = solved.solution
        self.trouble = "" if found.converged else f"the first {self.time:.1f} s: {found.message}"
        return solved

    def _finite(self, steps: Sequence[Step], values: gtsam.Values) -> list[Step]:
        """The steps without measurements that give no finite numbers at the values; these are counted.

        Raises:
            InputError: another factor gives none, or a measurement before the first solution.
        """
        if self.started:
            kept = [finite_measurements(step, values) for step in steps]
            if self.marginal is None:
                self.gate.unusable = counted_apart(steps, kept)
            steps = kept
        for step in steps:
            require_finite(step.factors, values, step.time)
        return list(steps)

    def _start_from(self, solved: Solved) -> None:
        """Start the smoother from a solution: from its active variables alone, or without a window from all of it."""
        values = solved.compiled.layout.to_gtsam(solved.solution.values)
        stamps = self._ages({key: time for step in self.steps_since for key, time in step.timestamps.items()})
        if self.marginal is not None:
            stamps = {**self.marginal.stamps, **stamps}
        if self.window is None:
            factors = (f for step in self.steps_since for f in weigh(step.factors, self.levels))
            used = [without_loss(f) for f in (inliers(f, values, self.problem.loss) for f in factors) if f is not None]
            self._start(used, values, stamps)
            return
        at = solved.solution.values
        system, _ = replace(solved.engine, is_chain=False).at(at)
        assert isinstance(system, GtsamSystem)
        self._continue_from(MarginalState.of(self.time, system.graph, values, active_variables(values, stamps), stamps))

    def _continue_from(self, state: MarginalState) -> None:
        """Continue from a Gaussian alone."""
        self.marginal, self._outdated, self.steps_since = state, self.steps_since, []
        self._start([state.factor], state.estimate, state.stamps)

    def _start(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._smoother = Isam2() if self.window is None else FixedLagSmoother(self.window)
        self._stamps = dict(stamps)
        try:
            self._smoother.update(factors, values, stamps)
        except RuntimeError as error:
            raise undetermined(error) from None


def active_variables(values: gtsam.Values, stamps: Mapping[int, float]) -> list[int]:
    """Keys of the variables that later steps may refer to: those of the last moment and those that never age."""
    latest = max(stamps.values(), default=-np.inf)
    return [key for key in values.keys() if stamps.get(key, np.inf) >= latest]
