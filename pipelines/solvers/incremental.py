"""Incremental: the same steps, fed one by one to a smoother.

By default in a fixed-lag window, where old states are marginalised out and an update costs the same in hour ten as in
minute one; the calibration variables stay. With window None it is iSAM2 over the whole history.

Now and then everything but the variables in use is marginalised out of the smoother: what it knows of them becomes one
Gaussian, and a new smoother goes on from that alone. A run can be saved there and taken up again in another process,
see alidade.pipelines.solvers.checkpoint: both go on from the same numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import (
    Array,
    Attitudes,
    ChiSquare,
    Course,
    Estimate,
    Factor,
    History,
    Problem,
    Step,
)
from alidade.pipelines.solvers.assembly import CHUNK, Assembly
from alidade.pipelines.solvers.coloured import growth, inflated_by_innovations
from alidade.pipelines.solvers.course import Way
from alidade.pipelines.solvers.curvature import second_order
from alidade.pipelines.solvers.gauss_newton import Solution
from alidade.pipelines.solvers.history import sequential_history
from alidade.pipelines.solvers.innovations import Innovations, Prediction
from alidade.pipelines.solvers.linearity import BENT, is_linear
from alidade.pipelines.solvers.marginals import (
    HELD,
    IndeterminateError,
    information_of,
    joint_covariance,
    reported,
    reported_covariance,
)
from alidade.pipelines.solvers.noise_levels import weigh
from alidade.pipelines.solvers.pull import without_pull
from alidade.pipelines.solvers.rows import Rows
from alidade.pipelines.solvers.smoother import FixedLag, Smoother, Unlimited, linearized, unweighed, used_part
from alidade.pipelines.solvers.spurious import Spurious, information_of_noise
from alidade.pipelines.solvers.state import State, explained, require_known, require_sound
from alidade.pipelines.solvers.system import Linear
from alidade.pipelines.solvers.weighing import optimize, with_levels
from alidade.pipelines.solvers.window import Keyframes, Window
from alidade.pipelines.solvers.withheld import covariance_without, values_without, with_prior

DEFAULT_WINDOW = 1.0

# A run is young until what it has seen may be folded into a Gaussian. From _FIRST s on everything so far is solved in
# batch again whenever it has grown by _GROWTH, so that nothing stays linearised where little was known, and outliers of
# the first moments, which innovations cannot tell, are judged by all there is.
_FIRST, _GROWTH = 1.0, 1.25
# It is so at least for _YOUNG s, then until the error is quadratic as far as parameters may still move, but not longer
# than _OLDEST s, lest the cost grow for ever where something never moves.
_YOUNG, _OLDEST = 40.0, 600.0
# ... and for so many steps: few large ones cost little to solve again.
_FEW_STEPS = 100
# It is solved at once when a parameter has moved by _LOST of its prior's sigma, as where motion begins after a rest, or
# when what is known of the parameters bends and a sigma has come down to _HALF, as where another axis begins to move.
# If there is _MORE to go by than before, it is while what is known bends, after _YOUNG s only if a sigma has come down
# to _BETTER, when they have moved by _MOVED of the sigmas they had then and by _FAR of their priors', or when ...
_LOST, _HALF, _MORE, _BETTER, _MOVED, _FAR = 0.5, 0.5, 1.05, 0.9, 0.2, 0.02
# ... so many steps in a row were rejected, or more than this share of measurements: the run may have lost its way. If
# the last solution was not already due to that, it is solved at once.
_DOUBTED, _TOO_MANY = 5, 0.25
# Where so many are rejected of fewer than this, which of them are wrong cannot be told: what is, may agree by chance.
_FEW = 20
# Later the past is marginalised out this often, s.
MARGINALIZE_EVERY = 20.0
# Of the steps marginalised out so many are freed with each new one: a thousand at once take longer than an update.
_FREED = 10
# Estimates kept for plots, at most so many a second.
_HISTORY_RATE = 5.0


def solve_incremental(problem: Problem, window: Window = DEFAULT_WINDOW) -> Estimate:
    """The filtered estimate after the last step, with its history.

    Measurements whose innovation lies outside the gate, measured against the innovation's own covariance, are left
    out. The chi-square is the sum of the squared innovations.

    Args:
        problem: the graph.
        window: how long states are kept, s or Keyframes; None keeps all.

    Raises:
        InputError: a factor gives no finite numbers, or needs a state that has left the window.
        IndeterminateError: states other than the parameters are not determined.
    """
    run = Run(problem, window)
    start = time.perf_counter()
    for step in problem.steps(1):
        run.add_step(step)
    return run.finish(time.perf_counter() - start)


def _no_course() -> Course | None:
    """Of a run that was never solved in batch, or has a way of its own."""
    return None


@dataclass(frozen=True)
class _Solved:
    """A batch solution of a young run.

    Attributes:
        since: s, from the first step to the last.
        steps: their number.
        values, sigmas: (n,) of the reported numbers.
        first: (n,) these sigmas without what is of second order.
        doubted: whether too many measurements had been rejected since the one before.
    """

    since: float
    steps: int
    values: Array
    sigmas: Array
    first: Array
    doubted: bool


class Run:
    """One pass of a smoother through the steps.

    Attributes:
        problem: the graph.
        window: how long states are kept, s or Keyframes; None keeps all.
        base: what was known when the past was last marginalised out; None: never.
        past: the steps since then.
        current_keys: parameter key -> variable that holds its value now.
        keyframes: how many were added.
        innovations: of all measurements.
        levels: of the noises, as the last batch solution has them.
        history: rows of time, values and sigmas.
        attitudes: rows of time and quaternion.
        way: what was known jointly at some moments, of a run that is not young.
        moments: how often another one has come to the course; of a young run, how often it was solved in batch.
        trouble: why the last batch solution did not converge; empty: it did.
        walked: parameter keys whose values other variables held before.
    """

    def __init__(self, problem: Problem, window: Window) -> None:
        self.problem = problem
        self.window = window
        self.base: State | None = None
        self.past: list[Step] = []
        self.current_keys: dict[int, int] = {}
        self.keyframes = 0
        self.innovations = Innovations()
        self.levels = problem.noises
        self.history = Rows()
        self.attitudes = Rows()
        self.way = Way()
        self.moments = 0
        self.walked: set[int] = set()
        self._outdated: list[Step] = []  # steps no longer needed, yet to be freed
        self._smoother: Smoother | None = None  # None before the first batch solution
        self._stamps: dict[int, float] = {}  # of the variables held that age, in the window's unit
        self._times: list[float] = []  # of the keyframes, where they are the window's unit
        self._before = 0.0  # so many were taken before these
        self._young = True
        self._solved: _Solved | None = None  # the last batch solution while young
        self._looked = 0.0  # from so many s on it is to be seen again whether the past may be folded
        self.trouble = ""
        # Of a young run: information that is its states' noise, and covariance that linear systems do not know of.
        self._noise: Array | None = None
        self._bent: Array | None = None
        # (n,) of a young run, numbers of which the covariance of second order has not gone far enough yet.
        self._beyond = np.ones(len(problem.quantities), dtype=bool)
        self._course: Callable[[], Course | None] = _no_course  # of the last batch solution while young

    @classmethod
    def resumed(
        cls, problem: Problem, window: Keyframes | float, base: State, levels: tuple[Level, ...], trouble: str
    ) -> Run:
        """A run that continues from the marginal of another one, with its noise levels and its trouble."""
        run = cls(problem, window)
        run._young = False
        run._before = 1.0 + max(base.stamps.values(), default=-1.0)
        run.levels, run.trouble = levels, trouble
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
        self.walked.update(key for key, held in step.current_keys.items() if self.current_keys.get(key, held) != held)
        self.current_keys.update(step.current_keys)
        self.keyframes = max(self.keyframes, step.keyframes.stop)
        self.past.append(step)
        del self._outdated[-_FREED:]
        if isinstance(self.window, Keyframes):
            self._times.extend(sorted({*step.timestamps.values(), step.time}))
        if self._smoother is not None:
            self._advance(self._smoother, step)
        else:
            self._stamps.update(self._aged(step.timestamps))
        since = step.time - (self.past[0].time if self.base is None else self.base.time)
        if self._young:
            if self._due(since):
                self._reinitialize()
        elif since >= MARGINALIZE_EVERY and isinstance(self._smoother, FixedLag):
            known, about = self._smoother.in_use()
            self._continue_from(State.of(step.time, known, about, list(known.keyVector()), self._stamps))

    def values(self) -> Array:
        """The parameters now, as reported, at their priors those of which nothing can be told yet."""
        return values_without(self._values(), self.withheld, self.problem)

    def covariance(self) -> Array:
        """Joint covariance of these."""
        return covariance_without(self._covariance(), self.withheld, self.problem)

    @property
    def withheld(self) -> NDArray[np.bool_]:
        """(n,) numbers of a young run of which nothing can be told yet; those without a prior are never withheld."""
        if not self._young:
            return np.zeros(len(self.problem.quantities), dtype=bool)
        return with_prior(self.problem) & (self._beyond | self.innovations.undecided(_FEW, _TOO_MANY))

    def _values(self) -> Array:
        return reported(self.problem, self._estimate(), self.current_keys)

    def _covariance(self) -> Array:
        assert self._smoother is not None
        try:
            information = information_of(self._smoother.covariance(self.keys))
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is singular: {error}") from error
        if not np.isfinite(information).all():
            raise IndeterminateError(f"the parameters' covariance at {self.time:.3f} s is not finite")
        found = reported_covariance(self.problem.parameters, information, self._estimate(), self.keys, self._noise)
        return found if self._bent is None else found + self._bent

    def course(self) -> Course | None:
        """What was known at some moments, weighed as it is now; of a young run, until its last batch solution."""
        if self._young:
            return self._course()
        steady = np.repeat(
            [p.key not in self.walked for p in self.problem.parameters],
            [len(p.quantities) for p in self.problem.parameters],
        )
        return self.way.until(self.time, self.values(), self.covariance(), steady)

    def chi_square(self) -> ChiSquare:
        """The sum of the squared innovations of the measurements used."""
        return self.innovations.chi_square()

    def finish(self, seconds: float) -> Estimate:
        """The estimate after the last step added, with nothing withheld, as batch has it. More steps may follow."""
        if self._young and self._solved is not None and len(self.past) > self._solved.steps:
            self._reinitialize()
        return replace(self._estimated(self._values(), self._covariance()), seconds={"solve": seconds})

    def estimate(self) -> Estimate:
        """The estimate now. Raises IndeterminateError when it is no finite number."""
        return self._estimated(self.values(), self.covariance())

    def _estimated(self, values: Array, covariance: Array) -> Estimate:
        if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
            raise IndeterminateError(f"the estimate at {self.time:.3f} s is not a finite number")
        history, n = self.history.array.copy(), len(values)
        innovations = self.innovations.residuals()
        grown, colours = inflated_by_innovations(self.problem, covariance, innovations)
        inflation = growth(np.diag(covariance), np.diag(grown))
        attitudes = self.attitudes.array.copy()
        return Estimate(
            solver="incremental",
            names=tuple(q.name for q in self.problem.quantities),
            values=values,
            covariance=grown,
            inflation=inflation,
            colours=colours,
            converged=not self.trouble,
            message=self.trouble or "all steps taken",
            residuals=innovations,
            chi_square=self.chi_square(),
            history=History(history[:, 0], history[:, 1 : 1 + n], history[:, 1 + n :]).inflated(inflation),
            course=self.course(),
            attitudes=None if self.problem.attitudes is None else Attitudes(attitudes[:, 0], attitudes[:, 1:]),
            rejected=self.innovations.rejected(),
            levels=self.levels,
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
            about = smoother.point()
            # Linearised all about one value of each parameter: else what they cannot be told apart by would seem to be
            # known (first-estimates Jacobians, Huang, Mourikis and Roumeliotis 2010).
            new = step.initial if step.predict is None else step.predict(about if self._young else smoother.estimate())
            about.insert(new)
            stamps = self._aged(step.timestamps)
            smoother.update(self._accepted(smoother, step, about, new), new, stamps)
        except (RuntimeError, np.linalg.LinAlgError):
            # Singular, if only by rounding. The smoother is spoilt, but all it knew is in the base and the steps since.
            self._reinitialize()
            return
        values = smoother.estimate()
        self._stamps = {k: t for k, t in {**self._stamps, **stamps}.items() if values.exists(k)}
        self._record(step.keyframes, values)

    def _accepted(self, smoother: Smoother, step: Step, about: gtsam.Values, new: gtsam.Values) -> list[Factor]:
        """The processes of a step and the measurements to be used, in a window linear about the values."""
        factors = weigh(step.factors, self.levels)
        require_known(factors, about, step.time)
        processes = [f for f in factors if f.measurement is None]
        if self.window is not None:
            processes = [linearized(f, about) for f in processes]
        require_sound(processes, about, step.time)
        prediction = Prediction(smoother, processes, about, new)
        measurements = []
        for f in factors:
            if f.measurement is not None:
                used = self.innovations.accept(f, prediction, gated=self.problem.loss is not None)
                if used is not None:
                    measurements.append(unweighed(used))
        if self.window is not None:
            measurements = [linearized(f, about) for f in measurements]
        return processes + measurements

    def _aged(self, timestamps: Mapping[int, float]) -> dict[int, float]:
        """Times of last use, s, in the window's unit: the number of the keyframe, or as they are."""
        if not isinstance(self.window, Keyframes):
            return dict(timestamps)
        number = self._before + np.searchsorted(self._times, list(timestamps.values()))
        return dict(zip(timestamps, number.tolist(), strict=True))

    def _record(self, keyframes: Sequence[int], values: gtsam.Values) -> None:
        if self.problem.attitudes is not None:
            attitudes = self.problem.attitudes(keyframes, values)
            self.attitudes.add(np.column_stack([attitudes.time, attitudes.wxyz]))
        if not len(self.history) or self.time - self.history.array[-1, 0] >= 1.0 / _HISTORY_RATE:
            numbers, covariance = self.values(), self.covariance()
            self.history.add(np.concatenate([[self.time], numbers, np.sqrt(np.diag(covariance))])[None])
            if not self._young and self.way.due(self.time):
                self.way.add(self.time, numbers, covariance)
                self.moments += 1

    # -- batch re-initialisation, and marginalising out

    def _reinitialize(self) -> None:
        """Solve everything since the base in batch and start the smoother from it, without the outliers."""
        from_start, whole, doubted = self.base is None, self._whole(), self._doubted
        solution, about, noise = self._solution(whole)
        self.trouble = "" if solution.converged else f"the first {self.time:.1f} s: {solution.message}"
        values, system = solution.values, solution.system
        if from_start:
            with system.at(values):
                self.innovations.revise(system.factors, values)
        last = self.past[-1].keyframes if self.past else range(0)
        since = self.time - self.past[0].time if from_start and self.past else 0.0
        self._begin(solution, about, noise, whole.timestamps, since)
        if from_start:
            self.moments += 1
            ends = whole.boundaries
            self._course = cache(
                lambda: sequential_history(
                    self.problem, system.linearize(values), system.ordering, values, ends, ends[0].time
                )
            )
            if not self._young:
                self.way, self._course = Way.of(self._course()), _no_course
            self.attitudes.clear()
        self._record(whole.keyframes if from_start else last, values)
        variance = np.diag(self._covariance())
        first = self._first_order(variance)
        self._solved = _Solved(since, len(self.past), self._values(), np.sqrt(variance), first, doubted)
        self.innovations.begin_count()

    def _whole(self) -> Assembly:
        """The steps since the base as one graph, and what was known there."""
        whole = Assembly.of(self._since_base())
        whole.timestamps = self._aged(whole.timestamps)
        if self.base is not None:
            whole.factors.append(self.base.factor)
            whole.initial.insert(self.base.estimate)
            whole.timestamps = {**self.base.stamps, **whole.timestamps}
        return whole

    def _solution(self, whole: Assembly) -> tuple[Solution, Linear, Spurious | None]:
        """The likeliest values and noise levels, linearised there, and what of the information is noise."""
        solution = optimize(
            weigh(whole.factors, self.levels),
            whole.initial,
            self.keys,
            self.problem.loss,
            held=self.problem.assumed,
        )
        about = None
        if solution.converged:
            solution, self.levels, about, _ = with_levels(self.problem, whole.factors, solution, self.levels)
        if not solution.converged:
            require_sound(whole.factors, whole.initial, self.time)
        if about is None:
            about = solution.system.linearized(solution.values)
        noise = self._spurious(about) if self._young else None
        if solution.converged:
            unpulled = without_pull(self.problem, solution, noise, self.current_keys)
            if unpulled is not solution:
                solution, about = unpulled, unpulled.system.linearized(unpulled.values)
                noise = self._spurious(about)
        return solution, about, noise

    def _begin(
        self, solution: Solution, about: Linear, noise: Spurious | None, stamps: Mapping[int, float], since: float
    ) -> None:
        """Start the smoother from a solution `since` s after the first step, and fold the past if it may be."""
        grown = self._young and since >= max(_YOUNG, self._looked) and len(self.past) >= _FEW_STEPS
        if grown and since >= _OLDEST:
            self._young = False
        self._restart(about, stamps)
        corrected = self._correct(about, noise)
        if grown and self._young:
            self._looked = _GROWTH * since
            # Corrections are not carried on once the past is folded.
            if not corrected and is_linear(self.problem, solution, self.keys, in_use(about.values, stamps)):
                self._young = False
                self._restart(about, stamps)

    def _correct(self, about: Linear, noise: Spurious | None) -> bool:
        """Find what of a young run's covariance its linear system has wrong, and whether that matters.

        Of a run that is not young nothing is known.
        """
        self._noise = self._bent = None
        if not self._young:
            return False
        if noise is not None:
            self._noise = noise.information
        bent = second_order(self.problem, about, self._covariance(), self.current_keys)
        self._bent = None if bent is None else bent.covariance
        # What has been told once is told from then on.
        if bent is None:
            self._beyond[:] = False
        elif self._beyond.any():
            self._beyond &= bent.beyond()
        return noise is not None or (bent is not None and bent.share() > BENT)

    def _spurious(self, about: Linear) -> Spurious | None:
        """What of the information of a linearised solution is its states' noise."""
        covariance = joint_covariance(self.problem, about, self.current_keys)
        return information_of_noise(self.problem, about, covariance, self.current_keys)

    def _due(self, since: float) -> bool:
        """Whether a young run is to be solved in batch again, `since` s after its first step."""
        solved = self._solved
        if solved is None:
            return since >= _FIRST
        # The past is folded as soon as it may be, not when it happens to be solved again.
        if since >= _GROWTH * solved.since or solved.since < _YOUNG <= since:
            return True
        moved, scales = np.abs(self._values() - solved.values), self._scales
        left = self._left(solved)
        if left < _HALF or (moved > _LOST * scales).any() or (self._doubted and not solved.doubted):
            return True
        if len(self.past) < _MORE * solved.steps:
            return False
        if self._bent is not None and (since < _YOUNG or left < _BETTER):
            return True
        if self._doubted:
            return True
        return bool((moved > np.maximum(_MOVED * solved.sigmas, _FAR * scales)).any())

    @property
    def _doubted(self) -> bool:
        """Whether too many measurements were rejected since the last batch solution."""
        return self.innovations.doubtful(_DOUBTED, _TOO_MANY)

    def _left(self, solved: _Solved) -> float:
        """To what share any sigma has come down since; 1 unless what is known bends."""
        if self._bent is None:
            return 1.0
        free = solved.first > 0.0
        first = self._first_order(np.diag(self._covariance()))
        return float((first[free] / solved.first[free]).min(initial=1.0))

    def _first_order(self, variance: Array) -> Array:
        """(n,) sigmas as linear systems have them, of reported numbers that have these variances (n,) in all."""
        return np.sqrt(variance if self._bent is None else np.maximum(variance - np.diag(self._bent), 0.0))

    @property
    def _scales(self) -> Array:
        """(n,) of the priors; of assumptions, which are small whatever they are, none."""
        return np.array([np.inf if q.group == "assumption" else q.scale for q in self.problem.quantities])

    def _since_base(self) -> Iterator[Step]:
        """The steps since the base; those since the start with many measurements in each, which solve faster."""
        now = -np.inf
        for step in self.problem.steps(CHUNK) if self.base is None else ():
            if step.time > self.time:
                break
            now = step.time
            yield step
        yield from (step for step in self.past if step.time > now)

    def _restart(self, about: Linear, stamps: Mapping[int, float]) -> None:
        """Start the smoother from a solution: from what it says of the variables it goes on with, or from all of it."""
        values, loss = about.values, about.system.loss
        if self.window is None:
            past = (f for step in self.past for f in weigh(step.factors, self.levels))
            factors = [unweighed(f) for f in (used_part(f, values, loss) for f in past) if f is not None]
            # What rests pull at in these is balanced from then on.
            forces = [f for f in about.system.factors if f.family == HELD]
            self._start(factors + forces, values, stamps)
            return
        state = State.of(self.time, about.graph, values, in_use(values, stamps), stamps)
        if self._young:
            self._start([state.factor], state.values, state.stamps)
        else:
            self._continue_from(state)

    def _continue_from(self, state: State) -> None:
        """Go on from a state alone."""
        self.base, self._outdated, self.past = state, self.past, []
        self._noise = self._bent = None
        self._start([state.factor], state.estimate, state.stamps)

    def _start(self, factors: Sequence[Factor], values: gtsam.Values, stamps: Mapping[int, float]) -> None:
        self._smoother = Unlimited() if self.window is None else FixedLag(self.window, self._young)
        self._stamps = dict(stamps)
        try:
            self._smoother.update(factors, values, stamps)
        except RuntimeError as error:
            raise IndeterminateError(explained(error)) from None


def in_use(values: gtsam.Values, stamps: Mapping[int, float]) -> list[int]:
    """The variables that later steps may refer to: those used in the last moment and those that never age."""
    latest = max(stamps.values(), default=-np.inf)
    return [key for key in values.keys() if stamps.get(key, np.inf) >= latest]
