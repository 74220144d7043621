"""Follows a growing recording: looks at it again and again, and hands what is new to the incremental solver.

Every look reads the whole recording anew, which keeps one reader and its checks for both files that grow and files that
are finished. The steps taken already are left out where they cannot change (Problem.steps_after); where they can, as
with turns and poses still under way, the few steps there are are taken anew. A look is followed by a pause that grows
with what the look cost, so that following never takes more than a third of a core for reading.
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from pipelines.errors import InputError
from pipelines.follow.guidance import View, view_of
from pipelines.follow.sources import Source
from pipelines.graph.problem import Problem, Step
from pipelines.judgement.checklist import ChecklistItem
from pipelines.recording.reading import open_recording
from pipelines.reports.result import Calibration
from pipelines.session import Session
from pipelines.solvers.checkpoint import load_checkpoint, save_checkpoint
from pipelines.solvers.incremental import Run

# Steps of the last second of what is there may still change, see Problem.steps_after. s
_UNSETTLED = 1.0
# At least so long from one look to the next, s, and so many times what a look cost.
_PAUSE, _REST = 1.0, 2.0
# The file's size is looked at so often, s.
_POLL = 0.2
# While a long recording is caught up with, the view is renewed this often, s.
_VIEW = 1.0
_FINGERPRINT = 4096


@dataclass(frozen=True)
class Settings:
    """How to follow.

    Attributes:
        method, config: override the recording's own.
        window: s, of the incremental solver; None keeps the whole history.
        patience: s, without anything new, after which what is there is taken as all there will be.
        checkpoint: file the run is saved in from time to time, and resumed from.
    """

    method: str | None = None
    config: Path | None = None
    window: float | None = 1.0
    patience: float = 30.0
    checkpoint: Path | None = None


class Follower:
    """A recording being followed.

    Args:
        source: of the recording.
        settings: how.
        show: is given the view of what is known whenever it changes.
        say: is given sentences for the person recording.
        stopped: whether to go on no longer; asked often.
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
        self._run: Run | None = None
        self._epoch_ns = 0
        self._identity: dict[str, str] = {}
        self._resumable = settings.checkpoint is not None and settings.checkpoint.exists()
        self._shown = 0.0
        self._waiting = ""
        self._checklist: tuple[ChecklistItem, ...] = ()
        if settings.checkpoint is not None and settings.window is None:
            raise InputError("--window all has no checkpoints: it forgets nothing; give seconds")

    def follow(self) -> Calibration:
        """Until the recording is finished, stops growing, or `stopped`; then the calibration by all there is.

        Raises:
            InputError: the file does not appear, is no MCAP, cannot be used in the end, or the checkpoint is of
                another recording, config or version.
            IndeterminateError: states other than the parameters are not determined.
        """
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
            if new and now >= due and size > 0:
                started, new = time.monotonic(), False
                self._look()
                cost = time.monotonic() - started
                due = time.monotonic() + max(_PAUSE, _REST * cost)
            time.sleep(_POLL)

    # -- one look

    def _look(self) -> None:
        """Take what is settled of what is there now."""
        try:
            session = self._read()
            problem = session.problem()
            self._collect(session)
        except InputError as error:
            self._wait(str(error))
            return
        self._take(problem, _settled(self._new_steps(session, problem)))

    def _wait(self, reason: str) -> None:
        """The recording cannot be read yet, or holds too little; raises InputError when it never will."""
        if "not an MCAP file" in reason:
            raise InputError(reason)
        reason = reason.removeprefix(f"{self.source.path}: ")
        if reason != self._waiting:
            self._waiting = reason
            self._say(f"not enough yet: {reason}")

    def _read(self) -> Session:
        return Session.read(open_recording(self.source.where), self.settings.method, self.settings.config)

    def _new_steps(self, session: Session, problem: Problem) -> Iterator[Step]:
        """The steps not taken yet, for a run that is the one to take them: a new one if the past has changed."""
        identity = self._identify(session)
        if problem.steps_after is None or identity != self._identity or session.origin.epoch_ns != self._epoch_ns:
            self._run = None
        self._identity, self._epoch_ns = identity, session.origin.epoch_ns
        if self._run is None and problem.steps_after is not None:
            self._run = self._resumed(problem)
        if self._run is None:
            self._run = Run(problem, self.settings.window)
            return problem.steps(1)
        assert problem.steps_after is not None
        steps = deque(_first(problem.steps_after(self._run.time)))
        if steps and steps[0].keyframes.start != self._run.keyframes:
            self._say("what was recorded before now reads otherwise: beginning anew")
            self._run = Run(problem, self.settings.window)
            return problem.steps(1)
        self._run.update_problem(problem)
        return problem.steps_after(self._run.time)

    def _collect(self, session: Session) -> None:
        self._checklist = tuple(session.method.checklist(session.data, session.config))

    def _take(self, problem: Problem, steps: Iterable[Step]) -> None:
        run = self._run
        assert run is not None
        goes_on = problem.steps_after is not None
        for step in steps:
            run.add_step(step)
            if run.just_marginalized and goes_on:
                self._save(run)
            if goes_on and time.monotonic() - self._shown > _VIEW:
                self._view()
        self._view()

    def _view(self) -> None:
        assert self._run is not None
        self._show(view_of(self._epoch_ns, self._run, self._checklist))
        self._shown = time.monotonic()

    # -- the checkpoint

    def _save(self, run: Run) -> None:
        if self.settings.checkpoint is None:
            return
        try:
            save_checkpoint(self.settings.checkpoint, run, self._identity)
        except InputError as error:  # a full disk is no reason to stop
            self._say(str(error))

    def _resumed(self, problem: Problem) -> Run | None:
        if not self._resumable or self.settings.checkpoint is None:
            return None
        self._resumable = False
        run = load_checkpoint(self.settings.checkpoint, problem, self._identity)
        self._say(f"resumed at {run.time:.1f} s from {self.settings.checkpoint}")
        return run

    def _identify(self, session: Session) -> dict[str, str]:
        """What a checkpoint belongs to, in words."""
        with self.source.parts[0].open("rb") as stream:
            head = hashlib.sha256(stream.read(_FINGERPRINT)).hexdigest()[:12]
        return {
            "recording": f"one that starts at {session.origin.epoch_ns} ns ({head})",
            "method": session.method.name,
            "config": session.config.model_dump_json(exclude_defaults=True),
            "window": f"{self.settings.window} s",
            "version": f"alidade {metadata.version('alidade')} with gtsam {metadata.version('gtsam')}",
        }

    # -- the end

    def _end(self, finished: bool, size: int) -> Calibration:
        """Everything there is."""
        if size <= 0:
            wait = "" if finished else f", after {self.settings.patience:g} s of waiting"
            raise InputError(f"{self.source.name}: nothing there, or nothing in it{wait}")
        if not finished:
            why = "stopped" if self._stopped() else f"nothing new for {self.settings.patience:g} s"
            self._say(f"{why}: the recording is not finished, the result is that of what is there")
        started = time.perf_counter()
        session = self._read()
        problem = session.problem()
        read = time.perf_counter() - started
        started = time.perf_counter()
        self._collect(session)
        self._take(problem, self._new_steps(session, problem))
        assert self._run is not None
        estimate = self._run.finish(time.perf_counter() - started)
        (calibration,) = session.judged([(estimate, problem)], {"read": read})
        return calibration


def _first(steps: Iterable[Step]) -> Iterator[Step]:
    """The first step, if there is one."""
    for step in steps:
        yield step
        return


def _settled(steps: Iterable[Step]) -> Iterator[Step]:
    """The steps that are a second older than the last."""
    held: deque[Step] = deque()
    for step in steps:
        held.append(step)
        while held[0].time <= step.time - _UNSETTLED:
            yield held.popleft()
