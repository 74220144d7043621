"""From a recording to calibrations: open, choose the method, solve, judge.

session = open_session(Path("session.mcap"))
session.calibrate("batch").status
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from alidade.pipelines import methods, progress
from alidade.pipelines.applications.discovery import empty, idle, nearest_suggestion, suggestions, with_suggested
from alidade.pipelines.applications.sharing import device_belief, walks
from alidade.pipelines.config import load_config, recorded_config
from alidade.pipelines.diagnostics import noise_levels
from alidade.pipelines.diagnostics.change_test import Moved, Stability, stability
from alidade.pipelines.diagnostics.cross_validation import Halves, held_out, span, split_at, split_halves
from alidade.pipelines.diagnostics.explanation import Causes, explained, told_steps
from alidade.pipelines.diagnostics.hypothesis_tests import find_causes
from alidade.pipelines.diagnostics.observability import assess
from alidade.pipelines.diagnostics.second import other_solution
from alidade.pipelines.diagnostics.self_check import SelfCheck
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import EngineName, Estimate, Problem, Step, Told
from alidade.pipelines.methods import Method
from alidade.pipelines.recording.info import SessionFacts, facts_of, lacking
from alidade.pipelines.recording.message_reader import ENCODING
from alidade.pipelines.recording.opening import Where
from alidade.pipelines.recording.reading import Recording, open_recording
from alidade.pipelines.reports.known import load_known
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import TRUTH, Config
from alidade.pipelines.simulation.simulated import Simulated
from alidade.pipelines.solvers.window import check_window

SOLVERS = ("batch", "incremental", "published")


class Origin(Protocol):
    """Where a session's data come from."""

    @property
    def name(self) -> str:
        """For people."""

    @property
    def epoch_ns(self) -> int:
        """Zero of all times, Unix ns."""

    def sha256(self) -> str:
        """Of what was recorded, hexadecimal."""

    def facts(self, config: Config) -> SessionFacts:
        """Topics, rates, gaps, losses."""

    def truth(self) -> dict[str, object] | None:
        """Parameter -> true value, where known."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording as origin."""

    recording: Recording

    @property
    def name(self) -> str:
        """Of the file."""
        return self.recording.path.name

    @property
    def epoch_ns(self) -> int:
        """First stamp."""
        return self.recording.epoch_ns

    def sha256(self) -> str:
        """Of the file."""
        return self.recording.sha256()

    def facts(self, config: Config) -> SessionFacts:
        """Of the recording, whose stamps are not kept then."""
        facts = session_facts(self.recording, config)
        self.recording.forget_times()
        return facts

    def truth(self) -> dict[str, object] | None:
        """The attachment's. Raises InputError when it is no JSON object."""
        attachment = self.recording.attachment(TRUTH, needed=False)
        try:
            return None if attachment is None else dict(json.loads(attachment, parse_int=float))
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(
                f"{self.recording.path}: the attachment {TRUTH} is no JSON object of parameters and their values"
            ) from error


@dataclass(frozen=True, eq=False)
class Arrays:
    """Data in memory as origin."""

    method: Method
    data: Any
    known: Mapping[str, float] | None = None

    @property
    def name(self) -> str:
        """There is no file."""
        return "arrays"

    @property
    def epoch_ns(self) -> int:
        """The data's own."""
        return int(self.data.epoch_ns)

    def sha256(self) -> str:
        """Of all arrays and numbers, field by field."""
        digest = hashlib.sha256()
        _feed(digest, self.data)
        return digest.hexdigest()

    def facts(self, _: Config) -> SessionFacts:
        """Length of the data; there are no topics."""
        start, stop = span(self.method, self.data)
        return SessionFacts(self.epoch_ns, stop - start, (), (), {self.method.name: ()})

    def truth(self) -> dict[str, object] | None:
        """As given."""
        return None if self.known is None else dict(self.known)


@dataclass(frozen=True, eq=False)
class Session:
    """Data as their method takes them, the config in force, where both come from, and batch's engine."""

    method: Method
    data: Any
    config: Config
    origin: Origin
    engine: EngineName = "auto"

    @classmethod
    def read(
        cls,
        recording: Recording,
        method_name: str | None,
        config_file: Path | Config | None,
        auto_topics: bool = False,
        prior: Path | None = None,
    ) -> Session:
        """Read and check a recording (arguments and exceptions as `calibrate` has them)."""
        config = recorded_config(recording, config_file)
        if auto_topics:
            config = with_suggested(recording, config, method_name)
        chosen = methods.method(resolve_method(method_name, recording, config))
        try:
            data = chosen.read(recording, config)
        except InputError as error:
            if not lacking(chosen.needs, recording, config):
                raise
            nearest = nearest_suggestion(suggestions(recording, config, [chosen.name]))
            raise InputError(f"{error}{f'; nearest is {nearest}' if nearest else ''}") from error
        for sentence in (*idle(recording, config, chosen.name), *empty(recording, config, chosen.name)):
            recording.remark(sentence)
        session = cls(chosen, data, config, Recorded(recording))
        return session if prior is None else session.beginning_from(prior)

    def beginning_from(self, prior: Path) -> Session:
        """The same with what an earlier calibration says of the device as prior; a result.json or calibration.yaml.

        Raises:
            InputError: it cannot be used, is another method's, or was made of this recording.
        """
        known, origin = load_known(prior), self.origin
        belief = device_belief(known, self.method, self.config, origin.sha256(), origin.epoch_ns)
        return replace(self, config=self.config.believing(belief))

    def again(self, recording: Recording) -> Session:
        """The same method and config with another recording, or another part of it. Raises InputError."""
        recording.use(self.config.topics.values(), self.config.columns)
        return replace(self, data=self.method.read(recording, self.config), origin=Recorded(recording))

    @classmethod
    def of(cls, method: Method, simulated: Simulated, config_file: Path | Config | None = None) -> Session:
        """A simulated recording that was never written."""
        config = load_config(simulated.config.encode(), config_file)
        return cls(method, simulated.data, config, Arrays(method, simulated.data, simulated.truth))

    def problem(self) -> Problem:
        """The graph. Raises InputError when the data are too few, or the config says what the method has no use for."""
        return self._problem

    @cached_property
    def _problem(self) -> Problem:
        _check_sheets(self.method, self.config)
        with progress.doing("preparing the graph"):
            return self.method.graph(self.data, self.config)

    @cached_property
    def facts(self) -> SessionFacts:
        """What went in."""
        return self.origin.facts(self.config)

    def calibrate(
        self, solver: str = "batch", window: float | None = 1.0, check: bool = False, report: bool = True
    ) -> Calibration:
        """The calibration by one of SOLVERS; `window` in s is the incremental one's, None keeps the whole history.

        With `check` the incremental one is held against batch. Without `report` there are values, sigmas and verdicts,
        the same to the last digit, and nothing of what else a report explains: where the variances come from, which
        measurements move a number most, what inputs taken for exact would do to it, the method's own findings.

        Raises:
            InputError: no such solver, no such window, or the data cannot be used.
            IndeterminateError: states other than the parameters are not determined.
        """
        (calibration,) = self.calibrations([solver], window, check=check, report=report)
        return calibration

    def calibrations(
        self,
        solvers: Sequence[str],
        window: float | None = 1.0,
        seconds: Mapping[str, float] | None = None,
        check: bool = False,
        report: bool = True,
    ) -> list[Calibration]:
        """One calibration a solver; `seconds` is what came before (phase -> s). For the rest see `calibrate`."""
        if isinstance(solvers, str):
            raise InputError(f"solvers: a list of names is needed, not the text {solvers!r}")
        for solver in solvers:
            if solver not in SOLVERS:
                raise InputError(f"no solver {solver!r}; there are {', '.join(SOLVERS)}")
        check_window(window)
        solved = (self._solve(solver, window, report=report) for solver in solvers)
        return self.judged(solved, seconds or {}, check, report)

    def calibrated_beside(self, others: Callable[[Told], Mapping[str, float]]) -> Calibration:
        """The calibration by batch, what it says of its numbers linear where others have them. Raises as `calibrate`.

        Args:
            others: of what the recording says, linear about its solution, the numbers as they are with the others.
        """
        (calibration,) = self.judged([self._solve("batch", None, others)], {})
        return calibration

    def judged(
        self,
        solved: Iterable[tuple[Estimate, Problem]],
        seconds: Mapping[str, float],
        check: bool = False,
        report: bool = True,
    ) -> list[Calibration]:
        """Estimates, each with the problem it solves, ready to be reported.

        Args:
            solved: as above.
            seconds: what reading took.
            check: hold incremental estimates against batch.
            report: with the method's findings.
        """
        # The facts before anything is solved, so that the stamps need not be kept meanwhile.
        sha256, truth, facts = self.origin.sha256(), self.origin.truth(), self.facts
        found, causes = [], Causes(partial(find_causes, self.method, self.data, self.config))
        for estimate, problem in solved:
            quantities = tuple(q for q in problem.quantities if q.name in estimate.names)
            # The published solvers stand beside as they are.
            ours = estimate.solver != "published"
            change = stability(estimate, quantities) if ours and estimate.converged else None
            moved = self._moved(change) if change is not None and change.changed else None
            # The one covariance that everything reads from here on.
            final = estimate if moved is None else replace(estimate, covariance=moved.widened(estimate, quantities))
            assessment = assess(
                quantities,
                final.covariance,
                estimate.chi_square,
                problem.advice,
                decides=not noise_levels.asked(estimate.levels),
            )
            if ours:
                assessment = explained(assessment, final, quantities, causes)
            if moved is not None and change is not None:
                sentence = f"{change.sentence}{told_steps(moved, quantities)}"
                small = moved.small(quantities)
                assessment = assessment.remarked(sentence) if small else assessment.misfit(sentence)
            checked = None
            if check and estimate.solver == "incremental":
                checked = SelfCheck.of(estimate, self._batch_beside())
                assessment = assessment.remarked(checked.sentence if checked else "")
            if ours:
                assessment = assessment.remarked(other_solution(estimate, quantities))
                assessment = assessment.remarked(*noise_levels.remarks(estimate.levels), *problem.premises)
            found.append(
                Calibration(
                    method=self.method,
                    problem=problem,
                    estimate=final,
                    assessment=assessment,
                    recording=self.origin.name,
                    sha256=sha256,
                    facts=facts,
                    config=self.config,
                    truth=truth,
                    seconds=seconds,
                    plots=partial(self.method.figures, self.data),
                    beside=cache(self._published) if estimate.solver == "incremental" else None,
                    stability=change,
                    self_check=checked,
                    findings=self.method.findings(self.data, self.config, final) if report else {},
                )
            )
        return found

    def _moved(self, change: Stability) -> Moved:
        """What the two sides of a change say."""
        if not self.method.hypotheses().cut:
            return Moved({})
        with progress.doing("looking at both sides of a change"):
            return Moved(split_at(self.method, self.data, self.config, change.time_s))

    def _solve(
        self,
        solver: str,
        window: float | None,
        others: Callable[[Told], Mapping[str, float]] | None = None,
        report: bool = True,
    ) -> tuple[Estimate, Problem]:
        problem = self.problem()
        if solver == "published":
            return self.method.published(self.data, self.config, problem), problem
        if solver == "incremental":
            from alidade.pipelines.solvers.incremental import solve_incremental

            shown = replace(problem, steps=partial(_shown, problem, self.facts.duration_s))
            return solve_incremental(shown, window), problem
        from alidade.pipelines.solvers.batch import solve_batch

        device = walks(self.method, self.config, [q.name for q in problem.quantities])
        with progress.doing("solving"):
            changed = self._changed() if report else ()
            estimate = solve_batch(
                problem, budget=report, changed=changed, device=device, elsewhere=others, engine=self.engine
            )
            return estimate, problem

    def _changed(self) -> Iterator[tuple[str, Problem]]:
        """Each input that the graph takes for exact, and the graph with that input off by its step."""
        for exact in self.method.hypotheses().exact:
            changed = exact.changed(self.data, self.config, exact.step)
            if changed is None:
                continue
            try:
                problem = self.method.graph(*changed)
            except InputError:  # on the edge of what can be used, a step farther than the recording itself
                continue
            yield exact.name, problem

    def _batch_beside(self) -> Estimate:
        """Batch's estimate to compare with: without what its own report would tell of it."""
        from alidade.pipelines.solvers.batch import solve_batch

        with progress.doing("solving"):
            return solve_batch(self.problem())

    def _published(self) -> Estimate | None:
        """The published solver's estimate, where it can serve the recording: it needs more than the graphs."""
        try:
            return self._solve("published", None)[0]
        except InputError:
            return None


def calibrate(
    path: Where,
    solvers: Sequence[str],
    method_name: str | None = None,
    config_file: Path | None = None,
    window: float | None = 1.0,
    strict: bool = False,
    auto_topics: bool = False,
    check: bool = False,
    prior: Path | None = None,
    report: bool = True,
    engine: EngineName = "auto",
) -> list[Calibration]:
    """One calibration a solver, from one reading of the recording.

    Args:
        path: the recording: a file, a folder of parts, a pattern, or a list of parts.
        solvers: of SOLVERS.
        method_name: overrides the config's.
        config_file: overrides the recording's own config key by key.
        window: s, of the incremental solver; None keeps the whole history.
        strict: refuse a recording of which anything is lost.
        auto_topics: take the topics that `alidade info` suggests where those of the method are not there.
        check: hold an incremental calibration against batch.
        prior: an earlier calibration of the device to begin from, result.json or calibration.yaml.
        report: with what only a report tells, see `Session.calibrate`.
        engine: that eliminates batch's linear systems: "chain", "gtsam", or "auto".

    Raises:
        InputError: recording or config cannot be used, or there is no such solver.
        IndeterminateError: states other than the parameters are not determined.
    """
    start = time.perf_counter()
    with progress.doing("reading"):
        session = Session.read(open_recording(path, strict), method_name, config_file, auto_topics, prior)
    seconds = {"read": time.perf_counter() - start}
    return replace(session, engine=engine).calibrations(solvers, window, seconds, check, report)


def self_agreement(
    path: Path, method_name: str | None = None, config_file: Path | None = None
) -> tuple[dict[str, Halves], dict[str, float]]:
    """What either half of a recording says, and how well held-out measurements are predicted (arguments as above)."""
    session = Session.read(open_recording(path), method_name, config_file)
    return split_halves(session.method, session.data, session.config), held_out(session.problem())


def session_facts(recording: Recording, config: Config) -> SessionFacts:
    """Facts about all topics of a recording, and what it lacks for each method."""
    return facts_of(recording, config, {name: methods.method(name).needs for name in methods.names()})


def missing_for(name: str, recording: Recording, config: Config) -> tuple[str, ...]:
    """What a recording with this config lacks for a method, one phrase each; nothing if it can serve it."""
    return lacking(methods.method(name).needs, recording, config)


def resolve_method(option: str | None, recording: Recording, config: Config) -> str:
    """The method to use: the option, else the config's, else the only one the recording has the topics for.

    Raises InputError when the option is no method, and when none or several methods could be meant.
    """
    if option is not None:
        return methods.method(option).name
    if config.method:
        return config.method
    able = methods.without_yielding([name for name in methods.names() if not missing_for(name, recording, config)])
    if len(able) == 1:
        return able[0]
    if able:
        raise InputError(f"{recording.path}: the topics serve {' and '.join(able)}; choose with --method")
    nearest = nearest_suggestion(suggestions(recording, config))
    raise InputError(
        f"{recording.path}: no usable topics for any method; {recording.there()}; needed are ROS 2 messages "
        f"({ENCODING}): `alidade info` tells which for each method, `topics:` in the config can rename"
        + (f"; nearest is {nearest}" if nearest else "")
    )


def _feed(digest: hashlib._Hash, data: Any) -> None:
    """The arrays and numbers of a dataclass, and of those inside it, with their names into a hash."""
    for field in fields(data):
        value = getattr(data, field.name)
        digest.update(field.name.encode())
        if is_dataclass(value):
            _feed(digest, value)
        elif isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, int | float | str):
            digest.update(repr(value).encode())


def _check_sheets(method: Method, config: Config) -> None:
    """Raise InputError when a figure is stated that the method has no use for: it would be ignored in silence."""
    for name in sorted(config.sensors.model_fields_set):
        sheet, figures = getattr(config.sensors, name), method.sheets.get(name, ())
        useless = [each for each in sorted(sheet.model_fields_set - {*figures}) if getattr(sheet, each) != 0.0]
        if not useless:
            continue
        where = f"sensors.{name}.{useless[0]}" if figures else f"sensors.{name}"
        used = [f"sensors.{name}.{each}" for each in figures] or [f"sensors.{each}" for each in method.sheets]
        useful = ", ".join(used) or "no data sheet"
        raise InputError(f"{where}: method {method.name} has no use for it; it uses {useful}")


def _shown(problem: Problem, duration: float, chunk: int) -> Iterator[Step]:
    """The problem's steps; those fed one by one are shown as they are taken, by time in the recording."""
    if chunk > 1:
        return problem.steps(chunk)
    return progress.track(problem.steps(chunk), "step by step", duration, lambda step: step.time)
