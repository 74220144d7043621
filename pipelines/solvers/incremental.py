"""Incremental solver: the steps of a problem, fed one by one to a smoother of gtsam.

**Initialisation phase.** A linearisation where little is known turns noise into information, and among few measurements
outliers cannot be identified. So there is no smoother yet: everything so far is solved in batch at times 1, 1.15,
1.15^2, ... s, and until the next solution the estimate is the last one, with batch's weak directions and second-order
terms (alidade.pipelines.solvers.weak_directions). While outliers may be the majority of a family, everything that has
a prior stays there, and so do numbers for which second order does not go far enough, as with two or three attitudes of
a triad. The phase ends when no direction of the calibrated numbers is weak any more, second-order terms are a small
share of every variance, and noise levels have settled (`marginal_likelihood.levels_settled`): with those of a rest the
smoother would reject the motion. At the latest it ends after 600 s.

**Afterwards** states are marginalised out of a fixed-lag window: an update costs the same in hour ten as in minute one.
From time to time all but the active variables are marginalised out, and a new smoother continues from that Gaussian
alone; a run can be saved there (alidade.pipelines.solvers.checkpoint). Without a window it is iSAM2 over the whole
history. Directions that are weak even then have their priors, as in batch.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import IndeterminateError
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import (
    Attitudes,
    ChiSquare,
    Estimate,
    Factor,
    History,
    PosteriorHistory,
    Problem,
    Step,
)
from alidade.pipelines.solvers.batch import Solved, residuals_by_family, solve, whole_estimate
from alidade.pipelines.solvers.checkpoint import (
    MarginalState,
    RunState,
    require_finite,
    require_known_variables,
    without_infinite,
)
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import added_by_shares, sigma_ratio, variance_shares
from alidade.pipelines.solvers.gating import Prediction, RowBuffer
from alidade.pipelines.solvers.gtsam_engine import GtsamSystem, undetermined
from alidade.pipelines.solvers.marginal_likelihood import levels_settled
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
    constrained,
)
from alidade.pipelines.solvers.window import Keyframes, Window

DEFAULT_WINDOW = 1.0
# Variance, in units of the priors', below which that of a smoother is rounding.
_LEAST_VARIANCE = 1e-24
# Steps freed with each new one, of those marginalised out: a thousand at once take longer than an update.
_FREED = 10
# Time from the first step to the first batch solution, s; ratio of the times of successive ones; and the time after
# which the initialisation phase ends in any case, s: the cost of a batch solution grows with it.
FIRST_SOLVE, SOLVE_GROWTH, _MAX_INITIALISATION = 1.0, 1.15, 600.0
# Steps before which that phase does not end: few large ones cost little to solve again.
MIN_STEPS = 100
# Largest share of a variance that is of second order with which it ends: where motion that comes later makes a sigma
# ten times smaller, it is a tenth. Recordings that are determined have 1e-9 and less, slow beginnings .005.
_MAX_CURVATURE = 1e-3
# Time between marginalisations afterwards, s.
MARGINALIZE_EVERY = 20.0
# Largest number of estimates kept per second; time between moments of the joint history, as a share of the time since
# the first.
_HISTORY_RATE, _MOMENT_SPACING = 5.0, 0.02


def solve_incremental(problem: Problem, window: Window = DEFAULT_WINDOW) -> Estimate:
    """Run the incremental solver; return the filtered estimate after the last step, with its history.

    Measurements whose innovation lies outside the gate, measured against the innovation's own covariance, are left
    out. The chi-square is the sum of the squared innovations.

    Args:
        problem: the graph.
        window: how long states are kept, s or Keyframes; None keeps all.

    Raises:
        InputError: a factor gives no finite numbers, or needs a state that has left the window.
        IndeterminateError: states other than the parameters are not determined.
    """
    solver = IncrementalSolver(problem, window)
    start = time.perf_counter()
    for step in problem.steps(1):
        solver.add_step(step)
    return solver.finish(time.perf_counter() - start)


class IncrementalSolver:
    """Incremental solver: batch solutions in the initialisation phase, then one pass of a smoother.

    Attributes:
        problem: the graph, or a later one of the same recording, grown: the steps added are among its own.
        state: what it knows.
        initialising: whether the run is in its initialisation phase.
        steps_since: the steps added since its past was marginalised out.
        moments: number of moments, or in the initialisation phase of batch solutions, so far.
    """

    def __init__(self, problem: Problem, window: Window) -> None:
        self.problem = problem
        window = window if window is None or isinstance(window, Keyframes) else float(window)
        self.state = RunState(window, problem.noises, problem.estimated)
        self.initialising = True
        self.steps_since: list[Step] = []
        self.moments = 0
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
    def resumed(cls, problem: Problem, saved: RunState) -> IncrementalSolver:
        """Continue a saved run."""
        assert saved.marginal is not None
        solver = cls(problem, saved.window)
        solver.state, solver.initialising = saved, False
        solver._before = 1.0 + max(saved.marginal.stamps.values(), default=-1.0)
        solver._continue_from(saved.marginal)
        return solver

    @property
    def can_checkpoint(self) -> bool:
        """Whether the state can be saved now: its past is marginalised out and no step was added since."""
        return self.state.marginal is not None and not self.steps_since

    @property
    def time(self) -> float:
        """Time of the last step, s; -inf before the first."""
        if self.steps_since:
            return self.steps_since[-1].time
        return -np.inf if self.state.marginal is None else self.state.marginal.time

    @property
    def started(self) -> bool:
        """Whether an estimate exists yet."""
        return self._smoother is not None or self._solved is not None

    @property
    def keys(self) -> list[int]:
        """Keys of the variables that hold the parameters after the last step."""
        return [self.state.current_keys.get(p.key, p.key) for p in self.problem.parameters]

    def add_step(self, step: Step) -> None:
        """Add a step. Raises as solve_incremental does, and the solver is unusable afterwards."""
        state = self.state
        state.walked.update(key for key, held in step.current_keys.items() if state.current_keys.get(key, held) != held)
        state.current_keys.update(step.current_keys)
        state.keyframes = max(state.keyframes, step.keyframes.stop)
        self.steps_since.append(step)
        del self._outdated[-_FREED:]
        if isinstance(self.state.window, Keyframes):
            self._times.extend(sorted({*step.timestamps.values(), step.time}))
        if self._smoother is not None:
            self._advance(self._smoother, step)
        since = step.time - (self.steps_since[0].time if self.state.marginal is None else self.state.marginal.time)
        if self.initialising:
            if since >= max(FIRST_SOLVE, SOLVE_GROWTH * self._of[1]):
                self._solve_batch()
        elif since >= MARGINALIZE_EVERY and isinstance(self._smoother, FixedLagSmoother):
            graph, values = self._smoother.active_variables()
            marginal = MarginalState.of(step.time, graph, values, list(graph.keyVector()), self._stamps)
            self._continue_from(marginal)

    # -- what is reported

    def values(self) -> Array:
        """Reported numbers (n,) after the last step, weak directions at their priors."""
        return self._constrained()[0]

    def covariance(self) -> Array:
        """Joint covariance (n, n) of the reported numbers after the last step."""
        return self._constrained()[1]

    def posterior_history(self) -> PosteriorHistory | None:
        """Joint posteriors at moments; in the initialisation phase, those of the last batch solution."""
        if self.initialising:
            return self.estimate().posterior_history
        steady = np.repeat(
            [p.key not in self.state.walked for p in self.problem.parameters],
            [len(p.quantities) for p in self.problem.parameters],
        )
        (numbers, covariance), past, n = self._constrained(), self.state.moments.array, len(steady)
        if not len(past):
            return None
        past = past[past[:, 0] < self.time]
        return PosteriorHistory(
            np.append(past[:, 0], self.time),
            np.vstack([past[:, 1 : 1 + n], numbers]),
            np.concatenate([past[:, 1 + n :].reshape(-1, n, n), covariance[None]]),
            steady,
        )

    def chi_square(self) -> ChiSquare:
        """Sum of squared residuals of the last batch solution; after initialisation, of squared innovations."""
        found = self.estimate().chi_square if self.initialising else None
        return self.state.gate.chi_square() if found is None else found

    def finish(self, seconds: float) -> Estimate:
        """Return the final estimate, as the batch solver reports it; more steps may follow."""
        if self.initialising and len(self.steps_since) > self._of[0]:
            self._solve_batch()  # which may end the initialisation phase
        if self.initialising:
            self._estimate = self._estimate_of(self._batch(), steps=True)
        return replace(self.estimate(), seconds={"solve": seconds})

    def estimate(self) -> Estimate:
        """Return the estimate after the last step. Raises IndeterminateError if a value is not finite."""
        if not self.initialising:
            return self._filtered()
        if self._estimate is None:
            solved = self._batch()
            self._estimate = self._estimate_of(replace(solved, posterior=self._posterior_of(solved)))
        return self._estimate

    def _estimate_of(self, solved: Solved, steps: bool = False) -> Estimate:
        """Return the estimate of a batch solution, with the run's history and rejected measurements."""
        estimate = whole_estimate(solved, steps=steps, history=True)
        return replace(
            estimate,
            solver="incremental",
            message=self.state.trouble or "all steps taken",
            history=self._history(estimate.inflation),
            rejected=self.state.gate.rejected(),
        )

    def _history(self, inflation: Array | None) -> History:
        """Return values and sigmas at the steps so far, the sigmas inflated by factors (n,)."""
        rows, n = self.state.history.array.copy(), len(self.problem.quantities)
        history = History(rows[:, 0], rows[:, 1 : 1 + n], rows[:, 1 + n :])
        return history if inflation is None else history.inflated(inflation)

    def _filtered(self) -> Estimate:
        """Return the estimate of the smoother, with its history and residuals."""
        reported, directions = self._smoothed()
        values, covariance = reported.numbers, reported.covariance(directions.covariance())
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise IndeterminateError(f"the estimate at {self.time:.3f} s is not a finite number")
        lengths = self.state.gate.correlation_lengths()
        added = added_by_shares(directions, self.state.shares, lengths)
        grown = reported.covariance(directions.covariance() + added)
        inflation = sigma_ratio(np.diag(covariance), np.diag(grown))
        attitudes = self.state.attitudes.array.copy()
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=values,
            covariance=grown,
            inflation=inflation,
            colours=lengths,
            converged=not self.state.trouble,
            message=self.state.trouble or "all steps taken",
            residuals=self.state.gate.residuals(),
            chi_square=self.state.gate.chi_square(),
            history=self._history(inflation),
            posterior_history=self.posterior_history(),
            attitudes=None if self.problem.attitudes is None else Attitudes(attitudes[:, 0], attitudes[:, 1:]),
            rejected=self.state.gate.rejected(),
            levels=self.state.levels,
        )

    def _batch(self) -> Solved:
        """Return the last batch solution of the initialisation phase."""
        if self._solved is None:
            self._solve_batch()
        assert self._solved is not None
        return self._solved

    def _posterior_of(self, solved: Solved) -> Posterior:
        """Posterior of a batch solution; at the prior while outliers may be the majority of a family.

        So are numbers for which second order does not go far enough yet.
        """
        is_undecided = bool(self.state.trouble) or self.state.gate.too_few_to_decide()
        return at_prior(solved.posterior, self._beyond[solved.posterior.reported.free] | is_undecided)

    def _constrained(self) -> tuple[Array, Array]:
        """Return values (n,) and covariance (n, n) of the reported numbers, weak directions at their priors.

        Raises:
            IndeterminateError: the smoother's covariance is singular.
        """
        if self.initialising:
            posterior = self._posterior_of(self._batch())
            return posterior.reported.numbers, posterior.covariance
        reported, directions = self._smoothed()
        return reported.numbers, reported.covariance(directions.covariance())

    def _smoothed(self) -> tuple[Reported, WeakDirections]:
        """Return the smoother's reported numbers, weak directions at their priors, and those directions."""
        reported = self._reported()
        variances, axes = np.linalg.eigh(self._smoothed_covariance(reported))
        R = axes.T / np.sqrt(np.clip(variances, _LEAST_VARIANCE, WIDEST**2))[:, None]
        return constrained(reported, R, np.zeros(len(R)))

    def _smoothed_covariance(self, reported: Reported) -> Array:
        """Covariance (m, m) of the smoother's free reported numbers, in units of their default prior sigmas."""
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
        """Return the smoother's reported numbers, with their Jacobian by the tangents of the parameters' variables."""
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
        """Return the processes and the inlier measurements of a step, linearised if the smoother has a window."""
        factors = weigh(step.factors, self.state.levels)
        require_known_variables(factors, about, step.time)
        processes = [f for f in factors if f.measurement is None]
        if self.state.window is not None:
            processes = [linearized(f, about) for f in processes]
        require_finite(processes, about, step.time)
        prediction = Prediction(smoother, processes, about, new)
        measurements = []
        for f in factors:
            if f.measurement is not None:
                used = self.state.gate.select(f, prediction, self.problem.loss is not None)
                if used is not None:
                    measurements.append(without_loss(used))
        if self.state.window is not None:
            measurements = [linearized(f, about) for f in measurements]
        return processes + measurements

    def _ages(self, timestamps: Mapping[int, float]) -> dict[int, float]:
        """Convert times of last use, s, to the window's unit: keyframe numbers, or s unchanged."""
        if not isinstance(self.state.window, Keyframes):
            return dict(timestamps)
        number = self._before + np.searchsorted(self._times, list(timestamps.values()))
        return dict(zip(timestamps, number.tolist(), strict=True))

    def _add_attitudes(self, attitudes: Attitudes) -> None:
        self.state.attitudes.add(np.column_stack([attitudes.time, attitudes.wxyz]))

    def _record(self) -> None:
        """Append the current estimate to the history and, after the initialisation phase, to the moments."""
        if not len(self.state.history) or self.time - self.state.history.array[-1, 0] >= 1.0 / _HISTORY_RATE:
            numbers, covariance = self._constrained()
            self.state.history.add(np.concatenate([[self.time], numbers, np.sqrt(np.diag(covariance))])[None])
            past = self.state.moments.array
            spacing = _MOMENT_SPACING * (self.time - past[0, 0]) if len(past) else np.inf
            if not self.initialising and len(past) and self.time - past[-1, 0] >= spacing:
                self.state.moments.add(np.concatenate([[self.time], numbers, covariance.ravel()])[None])
                self.moments += 1

    # -- batch solutions

    def _solve_batch(self) -> None:
        """Solve all steps since the marginal in batch; if the result is linear enough, start the smoother."""
        before = self.state.levels
        solved = self._batch_solution(self._all_steps_since())
        if self.state.marginal is None:
            self.state.gate.adopt(residuals_by_family(solved.engine, solved.solution.values))
        if self.initialising:
            since = self.time - self.steps_since[0].time
            earlier = self.steps_since[0].time + self._of[1]
            self._solved, self._of, self._estimate = solved, (len(self.steps_since), since), None
            self.moments += 1
            if self._beyond.any():
                # Second order that has once gone far enough does so from then on.
                beyond = beyond_second_order(solved.compiled, solved.posterior)
                self._beyond[solved.posterior.reported.free] &= beyond
            if since < _MAX_INITIALISATION and not self._can_continue(solved, before, earlier):
                self._record()
                return
            history = self.estimate().posterior_history
            if history is not None:
                covariance = history.covariance.reshape(len(history.time), -1)
                self.state.moments = RowBuffer(np.column_stack([history.time, history.values, covariance]))
            self.initialising, self._solved, self._estimate = False, None, None
        from_start = self.state.marginal is None
        if from_start:
            self.state.shares = variance_shares(solved.posterior)
        if self.problem.attitudes is not None:
            if from_start:
                self.state.attitudes.clear()
            values = solved.compiled.layout.to_gtsam(solved.solution.values)
            keyframes = solved.compiled.keyframes if from_start else self.steps_since[-1].keyframes
            self._add_attitudes(self.problem.attitudes(keyframes, values))
        self._start_from(solved)
        self._record()

    def _can_continue(self, solved: Solved, before: Sequence[Level], since: float) -> bool:
        """Whether a smoother can continue from a solution: no weak direction, little second order, settled levels.

        Args:
            solved: the solution.
            before: noise levels of the solution before.
            since: its time, s.
        """
        if self.state.trouble or len(self.steps_since) < MIN_STEPS or self.state.gate.too_few_to_decide():
            return False
        posterior = solved.posterior
        if posterior.directions.weak.shape[1] or posterior.second_order_share() >= _MAX_CURVATURE:
            return False
        if not (self.problem.marginal_likelihood and solved.compiled.engine.is_chain):
            return True
        return levels_settled(solved.compiled, solved.levels, solved.solution, before, since)

    def _all_steps_since(self) -> list[Step]:
        """Return the steps since the marginal, preceded by a step that holds the marginal itself."""
        if self.state.marginal is None:
            return self.steps_since
        start = Step(self.state.marginal.time, self.state.marginal.estimate, [self.state.marginal.factor])
        start.current_keys.update(self.state.current_keys)
        return [start, *self.steps_since]

    def _batch_solution(self, steps: Sequence[Step]) -> Solved:
        """Solve some steps robustly in batch; noise levels are estimated until a marginal exists.

        Raises:
            InputError: a factor gives no finite numbers.
            IndeterminateError: something is not determined.
        """
        problem = replace(self.problem, refined_graph=None, elsewhere=None)
        compiled = Compiled.of(problem, steps=steps)
        if not np.isfinite(compiled.engine.cost(compiled.initial)):
            compiled = Compiled.of(problem, steps=self._finite(steps, compiled.layout.to_gtsam(compiled.initial)))
        try:
            solved = solve(compiled, levels=None if self.state.marginal is None else self.state.levels)
        except (IndeterminateError, np.linalg.LinAlgError) as error:
            raise IndeterminateError(f"the first {self.time:.3f} s do not determine the parameters: {error}") from error
        self.state.levels = solved.levels
        found = solved.solution
        self.state.trouble = "" if found.converged else f"the first {self.time:.1f} s: {found.message}"
        return solved

    def _finite(self, steps: Sequence[Step], values: gtsam.Values) -> list[Step]:
        """Remove and count the measurements of steps whose residuals at the values are not finite.

        Raises:
            InputError: another factor gives none, or a measurement before the first solution.
        """
        if self.started:
            steps, unusable = without_infinite(steps, values)
            if self.state.marginal is None:
                self.state.gate.unusable = unusable
        for step in steps:
            require_finite(step.factors, values, step.time)
        return list(steps)

    def _start_from(self, solved: Solved) -> None:
        """Start the smoother from a batch solution: from its active variables, or without a window from all."""
        values = solved.compiled.layout.to_gtsam(solved.solution.values)
        stamps = self._ages({key: time for step in self.steps_since for key, time in step.timestamps.items()})
        if self.state.marginal is not None:
            stamps = {**self.state.marginal.stamps, **stamps}
        if self.state.window is None:
            factors = (f for step in self.steps_since for f in weigh(step.factors, self.state.levels))
            used = [without_loss(f) for f in (inliers(f, values, self.problem.loss) for f in factors) if f is not None]
            self._start(used, values, stamps)
            return
        at = solved.solution.values
        system, _ = replace(solved.engine, is_chain=False).at(at)
        assert isinstance(system, GtsamSystem)
        self._continue_from(MarginalState.of(self.time, system.graph, values, active_variables(values, stamps), stamps))

    def _continue_from(self, state: MarginalState) -> None:
        """Restart the smoother from a marginal as the only information."""
        self.state.marginal, self._outdated, self.steps_since = state, self.steps_since, []
        self._start([state.factor], state.estimate, state.stamps)

    def _start(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._smoother = Isam2() if self.state.window is None else FixedLagSmoother(self.state.window)
        self._stamps = dict(stamps)
        try:
            self._smoother.update(factors, values, stamps)
        except RuntimeError as error:
            raise undetermined(error) from None


def active_variables(values: gtsam.Values, stamps: Mapping[int, float]) -> list[int]:
    """Keys of variables that later steps may involve: those of the last moment and those that never age."""
    latest = max(stamps.values(), default=-np.inf)
    return [key for key in values.keys() if stamps.get(key, np.inf) >= latest]
