"""Incremental: the same steps, fed one by one to iSAM2.

By default in a fixed-lag window, where old states are marginalised out and an update costs the same in hour ten as in
minute one; the calibration variables stay. With window None it is plain iSAM2 over the whole history.

Now and then everything but the variables in use is marginalised out of the smoother: what it knows of them becomes one
Gaussian, and a new smoother goes on from that alone. A run can be saved there and taken up again in another process,
see pipelines.solvers.checkpoint: both go on from the same numbers.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence

import gtsam
import numpy as np

from pipelines.graph.problem import Array, Attitudes, ChiSquare, Estimate, Factor, History, Problem, Step
from pipelines.solvers.assembly import Assembly
from pipelines.solvers.batch import CHUNK, Solution, optimize
from pipelines.solvers.innovations import Innovations, Prediction
from pipelines.solvers.marginals import IndeterminateError, reported, reported_covariance
from pipelines.solvers.rows import Rows
from pipelines.solvers.smoother import Smoother, linearized, unweighed
from pipelines.solvers.state import State, explained, require_known, require_sound

DEFAULT_WINDOW = 1.0

# At these times since the first step, s, everything so far is solved in batch and the smoother starts again from there:
# factors that leave the window keep their last linearisation point for good, so it has to be a good one, and outliers
# of the first moments cannot be told from innovations. Later the calibration moves too little to matter.
_BATCH_TIMES = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 40.0)
# From then on the past is marginalised out this often, s.
MARGINALIZE_EVERY = 20.0
# After so many rejections in a row the smoother may have lost its way: until the last of the batch times, start it anew
# at once ...
_DOUBTED = 5
# ... unless that was tried when there was hardly less, by this factor, to go by.
_MORE = 1.2
# Estimates kept for plots, at most so many a second.
_HISTORY_RATE = 5.0


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
        run.add_step(step)
    return run.finish(time.perf_counter() - start)


class Run:
    """One pass of a smoother through the steps.

    Attributes:
        problem: the graph.
        window: s, how long states are kept; None keeps all.
        base: what was known when the past was last marginalised out; None: never.
        past: the steps since then.
        current_keys: parameter key -> variable that holds its value now.
        keyframes: how many were added.
        innovations: of all measurements.
        history: rows of time, values and sigmas.
        attitudes: rows of time and quaternion.
    """

    def __init__(self, problem: Problem, window: float | None) -> None:
        self.problem = problem
        self.window = window
        self.base: State | None = None
        self.past: list[Step] = []
        self.current_keys: dict[int, int] = {}
        self.keyframes = 0
        self.innovations = Innovations()
        self.history = Rows()
        self.attitudes = Rows()
        self._smoother: Smoother | None = None  # None before the first batch solution
        self._stamps: dict[int, float] = {}  # of the variables held that age
        self._batch_times = list(_BATCH_TIMES)
        self._solved_steps = 0  # by the last batch solution
        self._trouble = ""

    @classmethod
    def resumed(cls, problem: Problem, window: float, base: State) -> Run:
        """A run that goes on from what another one knew."""
        run = cls(problem, window)
        run._batch_times = []
        run._continue_from(base)
        return run

    def update_problem(self, problem: Problem) -> None:
        """Go on with the graph of the same recording, grown: the steps added are among its own."""
        self.problem = problem

    @property
    def time(self) -> float:
        """Time of the last step, s; -inf before the first."""
        if self.past:
            return self.past[-1].time
        return -np.inf if self.base is None else self.base.time

    @property
    def started(self) -> bool:
        """Whether there is an estimate yet."""
        return self._smoother is not None

    @property
    def just_marginalized(self) -> bool:
        """Whether the run is at a point where it can be saved."""
        return self.base is not None and not self.past

    @property
    def keys(self) -> list[int]:
        """The variables that now hold the parameters."""
        return [self.current_keys.get(p.key, p.key) for p in self.problem.parameters]

    def add_step(self, step: Step) -> None:
        """One more step. Raises as solve_incremental does; the run is of no use any more then."""
        self.current_keys.update(step.current_keys)
        self.keyframes = max(self.keyframes, step.keyframes.stop)
        self.past.append(step)
        if self._smoother is not None:
            self._advance(self._smoother, step)
        else:
            self._stamps.update(step.timestamps)
        since = step.time - (self.past[0].time if self.base is None else self.base.time)
        if self._batch_times:
            due = since >= self._batch_times[0]
            if due:
                self._batch_times.pop(0)
            doubted = self.innovations.rejected_in_a_row >= _DOUBTED and len(self.past) > _MORE * self._solved_steps
            if due or doubted:
                self._reinitialize()
        elif since >= MARGINALIZE_EVERY and self._smoother is not None:
            alive = self._alive(self._smoother.estimate(), self._stamps)
            if alive is not None:
                self._continue_from(State.of(step.time, *self._smoother.linearized(), alive, self._stamps))

    def values(self) -> Array:
        """The parameters now, as reported."""
        return reported(self.problem, self._estimate(), self.current_keys)

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
        return self.innovations.chi_square()

    def finish(self, seconds: float) -> Estimate:
        """The estimate after the last step added. More steps may follow."""
        values, covariance = self.values(), self.covariance()
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise IndeterminateError(f"the estimate at {self.time:.3f} s is not a finite number")
        history, n = self.history.array.copy(), len(values)
        attitudes = self.attitudes.array.copy()
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=values,
            covariance=covariance,
            converged=not self._trouble,
            message=self._trouble or "all steps taken",
            residuals=self.innovations.residuals(),
            chi_square=self.chi_square(),
            history=History(history[:, 0], history[:, 1 : 1 + n], history[:, 1 + n :]),
            attitudes=None if self.problem.attitudes is None else Attitudes(attitudes[:, 0], attitudes[:, 1:]),
            rejected=self.innovations.rejected(),
            seconds={"solve": seconds},
        )

    def _estimate(self) -> gtsam.Values:
        if self._smoother is None:
            self._reinitialize()
        assert self._smoother is not None
        return self._smoother.estimate()

    # -- step by step

    def _advance(self, smoother: Smoother, step: Step) -> None:
        """Predict the new states, then take the measurements that agree with the prediction."""
        try:
            values = smoother.estimate()
            new = step.initial if step.predict is None else step.predict(values)
            values.insert(new)
            smoother.update(self._accepted(smoother, step, values, new), new, step.timestamps)
        except (RuntimeError, np.linalg.LinAlgError):
            # Singular, if only by rounding. The smoother is spoilt, but all it knew is in the base and the steps since.
            self._reinitialize()
            return
        values = smoother.estimate()
        self._stamps = {k: t for k, t in {**self._stamps, **step.timestamps}.items() if values.exists(k)}
        self._record(step.keyframes, values)

    def _accepted(self, smoother: Smoother, step: Step, values: gtsam.Values, new: gtsam.Values) -> list[Factor]:
        """The step's processes and those of its measurements that are to be used."""
        processes = [f for f in step.factors if f.measurement is None]
        require_sound(processes, values, step.time)
        prediction = Prediction(smoother, processes, values, new)
        measurements = []
        for f in step.factors:
            if f.measurement is not None:
                require_known([f], values, step.time)
                if self.innovations.accept(f, prediction, gated=self.problem.loss is not None):
                    measurements.append(unweighed(f))
        if self.window is not None and self.innovations.rejected_in_a_row == 0:
            measurements = [linearized(f, values) for f in measurements]
        return processes + measurements

    def _record(self, keyframes: Sequence[int], values: gtsam.Values) -> None:
        if self.problem.attitudes is not None:
            attitudes = self.problem.attitudes(keyframes, values)
            self.attitudes.add(np.column_stack([attitudes.time, attitudes.wxyz]))
        if not len(self.history) or self.time - self.history.array[-1, 0] >= 1.0 / _HISTORY_RATE:
            self.history.add(np.concatenate([[self.time], self.values(), np.sqrt(np.diag(self.covariance()))])[None])

    # -- batch re-initialisation, and marginalising out

    def _reinitialize(self) -> None:
        """Solve everything since the base in batch and start the smoother from it, without the outliers."""
        from_start = self.base is None
        whole = Assembly.of(self._since_base())
        if self.base is not None:
            whole.factors.append(self.base.factor)
            whole.initial.insert(self.base.estimate)
            whole.timestamps = {**self.base.stamps, **whole.timestamps}
        solution = optimize(whole.factors, whole.initial, self.keys, self.problem.loss, held=self.problem.assumed)
        if not solution.converged:
            require_sound(whole.factors, whole.initial, self.time)
        self._trouble = "" if solution.converged else f"the first {self.time:.1f} s: {solution.message}"
        values = solution.values
        if self._smoother is None:
            with solution.system.at(values):
                for f in whole.factors:
                    if f.measurement is not None:
                        self.innovations.note(f, f.measurement.residuals(values), f.measurement.used(values))
        last = self.past[-1].keyframes if self.past else range(0)
        self._restart(solution, whole.timestamps)
        if from_start:
            self.attitudes.clear()
        self._record(whole.keyframes if from_start else last, values)
        self._solved_steps, self.innovations.rejected_in_a_row = len(self.past), 0

    def _since_base(self) -> Iterator[Step]:
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
        values, loss = solution.values, solution.system.loss
        alive = self._alive(values, stamps)
        if alive is None:
            factors = [f for step in self.past for f in step.factors]
            used = [f for f in factors if f.measurement is None or f.measurement.under(loss).used(values).all()]
            self._start([unweighed(f) for f in used], values, stamps)
            return
        state = State.of(self.time, solution.system.linearize(values), values, alive, stamps)
        if self._batch_times:
            self._start([state.factor], state.estimate, state.stamps)
        else:
            self._continue_from(state)

    def _continue_from(self, state: State) -> None:
        """Go on from a state alone."""
        self.base, self.past = state, []
        self._start([state.factor], state.estimate, state.stamps)

    def _start(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._smoother = Smoother(self.window)
        self._stamps = dict(stamps)
        try:
            self._smoother.update(factors, values, stamps)
        except RuntimeError as error:
            raise IndeterminateError(explained(error)) from None

    def _alive(self, values: gtsam.Values, stamps: Mapping[int, float]) -> list[int] | None:
        """The variables that later steps may refer to, None where everything is kept.

        Those are the ones used in the last moment and those that never age.
        """
        if self.window is None:
            return None
        latest = max(stamps.values(), default=-np.inf)
        return [key for key in values.keys() if stamps.get(key, np.inf) >= latest]
