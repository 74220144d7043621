"""Follows a growing recording: looks at it again and again, and hands what is new to the incremental solver.

A look costs what is new, not what was there: once the solver has marginalised the past out, data are read and the graph
is built from there on alone (Problem.continuation). Methods whose past may still change, as with turns and poses under
way, and errors taken from pictures of a first target, are read whole; their looks are followed by longer pauses, so
that following never takes more than a third of a core for reading.
"""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import numpy as np

from alidade.pipelines.applications.follow.guidance import WAITING, View, Watch, view_of
from alidade.pipelines.applications.follow.sources import Source
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import Settings as Override
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.errors import InputError, NotARecordingError
from alidade.pipelines.estimation.camera_clock import Clock
from alidade.pipelines.estimation.problem import Problem, Step
from alidade.pipelines.recording.container import file_sha256
from alidade.pipelines.recording.growing import GrowingFiles
from alidade.pipelines.recording.opening import file_identity
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.reports.calibration import load_known
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.checkpoint import load_checkpoint, save_checkpoint
from alidade.pipelines.solvers.incremental import IncrementalSolver
from alidade.pipelines.solvers.window import check_window

# At least so long from one look to the next, s, and so many times what it took to read: steps wait for nothing.
_PAUSE, _REST = 0.05, 2.0
# The files' size is looked at so often, s.
_POLL = 0.01
# The end of a recording is read from so long before the first step taken of it, s: what is logged late, and samples and
# pictures by which those beside them are judged. Where that is too little, more.
_MARGINS = (2.0, 20.0)
# First guesses serve until the recording is so many times as long.
_LONG_AGO = 1.5
# While a long recording is caught up with, the view is renewed this often, s.
_VIEW = 1.0
# Times are differences of stamps, which are whole ns: they differ beyond this, s.
_ROUNDING = 1e-9
_CLOCK = "time_offset", "clock_skew"
_MISPLACED = "by now pictures are taken farther from their stamps than motion around these can be carried"
# A picture serves once gyro and gimbal have been read after it: so long a picture is waited for beyond its time, s.
_SAMPLE = 0.01


@dataclass(frozen=True)
class Settings:
    """Settings of a session that follows a recording.

    Attributes:
        method, config: override the recording's own.
        window: s, of the incremental solver; None keeps the whole history.
        patience: s, without anything new, after which what is there is taken as all there will be.
        checkpoint: file the run is saved in from time to time, and resumed from.
        check: end with the solution of all measurements by batch.
        prior: an earlier calibration of the device to begin from.
        auto_topics, auto_columns: use what `alidade info` proposes of what has been recorded so far.
    """

    method: str | None = None
    config: Override = None
    window: float | None = 1.0
    patience: float = 30.0
    checkpoint: Path | None = None
    check: bool = False
    prior: Path | None = None
    auto_topics: bool = False
    auto_columns: bool = False


class Follower:
    """Calibrates a recording while it is being written.

    `show` is given the view of what is known whenever it changes, `say` sentences for the person recording; `stopped`,
    whether to go on no longer, is asked often.
    """

    def __init__(
        self,
        source: Source,
        settings: Settings,
        show: Callable[[View], None],
        say: Callable[[str], None],
        stopped: Callable[[], bool],
    ) -> None:
        self.source = source
        self.settings, self._show, self._say, self._stopped = settings, show, say, stopped
        self._run: IncrementalSolver | None = None
        self._watch = Watch()
        self._epoch_ns = 0
        self._identity: dict[str, str] = {}
        self._resumable = settings.checkpoint is not None and settings.checkpoint.exists()
        self._shown = 0.0
        self._waiting = ""
        self._checklist: dict[str, ChecklistItem] = {}
        self._growing = GrowingFiles()
        self._session: Session | None = None  # as last read whole
        self._delay_ns, self._attachments = 0, 0
        self._guessed = 0.0  # from a recording of so many s
        self._held: Step | None = None  # the first step that is not settled
        self._misplaced = False  # whether it was said that pictures were taken far from their stamps
        check_window(settings.window)
        if settings.checkpoint is not None and settings.window is None:
            raise InputError("--window all has no checkpoints: it forgets nothing; give seconds")
        if settings.prior is not None:
            load_known(settings.prior)  # refused now, not when the recording has begun

    def follow(self) -> Calibration:
        """Follow the recording until it is finished, stops growing, or `stopped`; then calibrate with all data.

        Raises:
            InputError: the file does not appear, is no MCAP, cannot be used in the end, or the checkpoint is of
                another recording, config or version.
            IndeterminateError: states other than the parameters are not determined.
        """
        # What is there by now stays: to look through it for garbage takes as long as dozens of updates, every minute.
        gc.freeze()
        try:
            calibration = self._followed()
        except InputError as error:
            raise type(error)(self.source.named(str(error))) from error
        return calibration if self.source.is_kept else replace(calibration, recording=self.source.name)

    def _followed(self) -> Calibration:
        source, patience = self.source, self.settings.patience
        size, grown, due = -1, time.monotonic(), 0.0
        while True:
            now = time.monotonic()
            if source.size != size:
                size, grown, new = source.size, now, True
            finished = source.is_finished
            over = finished or self._stopped() or now - grown > patience
            if over:
                return self._end(finished, size)
            if new and now >= due and size > 0 and self._may_settle():
                new = False
                cost = self._look()
                due = time.monotonic() + max(_PAUSE, _REST * cost)
            time.sleep(_POLL)

    # -- one look

    def _look(self) -> float:
        """Read what has been recorded, pass the settled steps to the solver; return the CPU time of reading, s."""
        started = time.thread_time()
        try:
            problem, steps = self._end_alone() or self._whole()
        except NotARecordingError:
            raise
        except (InputError, OSError) as error:  # files may be gone, or too many open, for a while
            self._wait(str(error))
            return time.thread_time() - started
        cost = time.thread_time() - started
        self._take(problem, self._settled(steps, problem.revision_horizon))
        return cost

    def _may_settle(self) -> bool:
        """Whether new data may settle a further step; only then is the recording read again, which takes long."""
        run, held = self._run, self._held
        last_ns = self._growing.last_log_ns(self.source.parts)
        if run is None or held is None or last_ns is None:
            return True
        settled_s = held.time + run.problem.revision_horizon + _SAMPLE
        return last_ns >= self._epoch_ns + self._delay_ns + int(settled_s * 1e9)

    def _settled(self, steps: Iterable[Step], revision_horizon: float) -> Iterator[Step]:
        """Yield the steps older than the last one by the revision horizon, s; keep the first that is not."""
        held: deque[Step] = deque()
        for step in steps:
            held.append(step)
            while len(held) > 1 and held[0].time <= step.time - revision_horizon + _ROUNDING:
                yield held.popleft()
        self._held = held[0] if held else None

    def _whole(self) -> tuple[Problem, Iterator[Step]]:
        """Return the graph of all data so far, and its steps that the run has not processed."""
        recording = Recording(self._growing.refresh(self.source.parts, None))
        session = self._read(recording)
        problem = self._guessed_before(session) or _continuable(session.problem(), session)
        steps = self._new_steps(session, problem)
        self._session, self._checklist = session, {}
        self._delay_ns, self._attachments = _min_delay_ns(session), len(self._growing.attachments)
        self._collect(session)
        return problem, steps

    def _read(self, recording: Recording) -> Session:
        settings = self.settings
        return Session.read(
            recording, settings.method, settings.config, settings.auto_topics, settings.prior, settings.auto_columns
        )

    def _guessed_before(self, session: Session) -> Problem | None:
        """Return the graph with the initial values of a recent look, which take most of the time; None without one."""
        run = self._run
        if run is None or run.problem.continuation is None or run.time > _LONG_AGO * self._guessed:
            self._guessed = 0.0 if run is None else run.time
            return None
        return run.problem.continuation(session.data, -np.inf)

    def _end_alone(self) -> tuple[Problem, Iterator[Step]] | None:
        """Return the graph from the marginalised past on, and its new steps; None where that part is too short."""
        run, session = self._run, self._session
        if run is None or run.state.marginal is None or run.problem.continuation is None or session is None:
            return None
        for margin in _MARGINS:
            since = self._epoch_ns + self._delay_ns + round((run.state.marginal.time - margin) * 1e9)
            recording = Recording(self._growing.refresh(self.source.parts, since), self._epoch_ns)
            if len(self._growing.attachments) != self._attachments:
                return None
            late = session.again(recording)
            problem = run.problem.continuation(late.data, run.state.marginal.time)
            if problem is not None and problem.steps_after is not None:
                self._delay_ns = _min_delay_ns(late)
                self._collect(late)
                run.problem = problem
                return problem, problem.steps_after(run.time)
        return None

    def _wait(self, reason: str) -> None:
        """Report once why the recording cannot be read yet."""
        for path in (self.source.path, *self.source.parts):
            reason = reason.removeprefix(f"{path}: ")
        if reason != self._waiting:
            self._waiting = reason
            self._say(f"{WAITING}{reason}")

    def _new_steps(self, session: Session, problem: Problem) -> Iterator[Step]:
        """Yield the steps that the run has not processed; begin a new run if the past has changed."""
        belongs = self._identify(session)
        # A sensor whose first message comes late may bring variables of its own, and a later motion fix one.
        if self._run is not None and self._run.problem.estimated != problem.estimated:
            self._run = None
        if problem.steps_after is None or belongs != self._identity or session.epoch_ns != self._epoch_ns:
            self._run = None
        self._identity, self._epoch_ns = belongs, session.epoch_ns
        if self._run is None and problem.steps_after is not None:
            self._run = self._resumed(problem)
        if self._run is None:
            self._run = IncrementalSolver(problem, self.settings.window)
            return problem.steps(1)
        assert problem.steps_after is not None
        first = next(problem.steps_after(self._run.time), None)
        if first is not None and first.keyframes.start != self._run.state.keyframes:
            self._say("what was recorded before now reads otherwise: beginning anew")
            self._run = IncrementalSolver(problem, self.settings.window)
            return problem.steps(1)
        self._run.problem = problem
        return problem.steps_after(self._run.time)

    def _collect(self, session: Session) -> None:
        """Update the checklist of collected data; an item that was complete once stays complete."""
        before, self._checklist = self._checklist, {}
        for item in session.method.guidance.checklist(session.data, session.config):
            earlier = before.get(item.what, item)
            self._checklist[item.what] = earlier if item.wanted and not earlier.wanted else item

    def _take(self, problem: Problem, steps: Iterable[Step]) -> None:
        run = self._run
        assert run is not None
        goes_on = problem.steps_after is not None
        for step in steps:
            run.add_step(step)
            if run.can_checkpoint and goes_on:
                self._save(run)
            if goes_on and time.monotonic() - self._shown > _VIEW:
                self._view()
        self._view()

    def _view(self) -> None:
        assert self._run is not None
        if not self._misplaced and _is_misplaced(self._run):
            self._misplaced = True
            self._say(f"{_MISPLACED}; what is shown may be off by that, and is solved anew when the recording ends")
        self._watch.look(self._run)
        self._show(view_of(self._epoch_ns, self._run, tuple(self._checklist.values()), self._watch.change))
        self._shown = time.monotonic()

    # -- the checkpoint

    def _save(self, run: IncrementalSolver) -> None:
        if self.settings.checkpoint is None:
            return
        try:
            save_checkpoint(self.settings.checkpoint, run.state, self._identity)
        except InputError as error:  # a full disk is no reason to stop
            self._say(str(error))

    def _resumed(self, problem: Problem) -> IncrementalSolver | None:
        if not self._resumable or self.settings.checkpoint is None:
            return None
        self._resumable = False
        state = load_checkpoint(self.settings.checkpoint, self._identity)
        if state.estimated != problem.estimated:
            self._say(f"{self.settings.checkpoint}: of a run that estimated other parameters: beginning anew")
            return None
        run = IncrementalSolver.resumed(problem, state)
        self._say(f"resumed at {run.time:.1f} s from {self.settings.checkpoint}")
        return run

    def _identify(self, session: Session) -> dict[str, str]:
        """Return what a checkpoint belongs to, as text: recording, method, config, window, prior, version."""
        return {
            "recording": f"one that starts at {session.epoch_ns} ns ({file_identity(self.source.parts[0])})",
            "method": session.method.name,
            "config": session.config.model_dump_json(exclude_defaults=True),
            "window": str(self.settings.window),
            "prior": "none" if self.settings.prior is None else file_sha256(self.settings.prior),
            "version": f"alidade {metadata.version('alidade')} with gtsam {metadata.version('gtsam')}",
        }

    # -- the end

    def _end(self, finished: bool, size: int) -> Calibration:
        """Calibrate the recording with all its data at the end."""
        if size <= 0:
            wait = "" if finished else f", after {self.settings.patience:g} s of waiting"
            raise InputError(f"{self.source.name}: nothing there, or nothing in it{wait}")
        if not finished:
            why = "stopped" if self._stopped() else f"nothing new for {self.settings.patience:g} s"
            self._say(f"{why}: the recording is not finished, the result is that of what is there")
        started = time.perf_counter()
        session = self._read(open_recording(self.source.where))
        problem = session.problem()
        read = time.perf_counter() - started
        started = time.perf_counter()
        self._collect(session)
        # What was never followed is solved as any finished recording.
        followed = self._run is not None or self.settings.checkpoint is not None
        growing = _continuable(problem, session) if followed else problem
        steps = self._new_steps(session, growing)
        assert self._run is not None
        kept, taken = growing.keyframes, problem.keyframes
        if kept is not None and taken is not None and kept.are_far(taken.clock, session.facts.duration_s):
            self._say(f"{_MISPLACED}: solved anew, with keyframes where they were")
            self._run, steps = IncrementalSolver(problem, self.settings.window), problem.steps(1)
            # It is no run that another process could go on with.
            growing = replace(problem, steps_after=None)
        self._take(growing, steps)
        estimate = self._run.finish(time.perf_counter() - started)
        with session.usual_time(online=True):
            (calibration,) = session.judged([estimate], {"read": read}, self.settings.check)
        return calibration


def _min_delay_ns(session: Session) -> int:
    """Return the least delay of log times after stamps, ns, of the topics that have been read."""
    assert session.recording is not None
    return session.recording.delay_ns


def _is_misplaced(run: IncrementalSolver) -> bool:
    """Whether the estimated clock certainly places pictures of a run far from its keyframes."""
    keyframes, names = run.problem.keyframes, [q.name for q in run.problem.quantities]
    if not run.started or keyframes is None or not set(_CLOCK) <= set(names):
        return False
    own = [names.index(name) for name in _CLOCK]
    clock = Clock(keyframes.clock.begun, *run.values()[own].tolist())
    return keyframes.are_far(clock, run.time, run.covariance()[np.ix_(own, own)])


def _continuable(problem: Problem, session: Session) -> Problem:
    """Return the graph of all data in the form that can be continued while the recording grows, if it has one."""
    return (problem.continuation and problem.continuation(session.data, -np.inf)) or problem
