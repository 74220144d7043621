"""From a recording to calibrations: reading, solving, judging."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from pipelines import progress
from pipelines.config import ATTACHMENT, TRUTH, Config, load_config
from pipelines.errors import InputError
from pipelines.graph.problem import Estimate, Problem, Step
from pipelines.judgement.consistency import Halves, find_causes, held_out, mostly_rejected, split_halves
from pipelines.judgement.observability import Cause, assess
from pipelines.recording.info import resolve_method, session_facts
from pipelines.recording.reading import Recording, open_recording
from pipelines.registry import Method, method
from pipelines.reports.result import Calibration

SOLVERS = ("batch", "incremental", "published")


def calibrate(
    path: Path,
    solvers: Sequence[str],
    method_name: str | None = None,
    config_file: Path | None = None,
    window: float | None = 1.0,
    strict: bool = False,
) -> list[Calibration]:
    """One calibration a solver, from one reading of the recording.

    Args:
        path: the recording.
        solvers: of SOLVERS.
        method_name: overrides the config's.
        config_file: overrides the recording's own config key by key.
        window: s, of the incremental solver; None keeps the whole history.
        strict: refuse a recording of which anything is lost.

    Raises:
        InputError: recording or config cannot be used.
        IndeterminateError: states other than the parameters are not determined.
    """
    start = time.perf_counter()
    with progress.doing("reading"):
        session = Session.read(open_recording(path, strict), method_name, config_file)
    read = time.perf_counter() - start
    duration = session.recording.duration_s
    solved = (_solve(solver, session.method, session.data, session.config, window, duration) for solver in solvers)
    return calibrations(session, solved, {"read": read})


@dataclass(frozen=True)
class Session:
    """A recording as its method reads it: the config in force, the method and its data."""

    recording: Recording
    config: Config
    name: str
    method: Method
    data: Any

    @classmethod
    def read(cls, recording: Recording, method_name: str | None, config_file: Path | None) -> Session:
        """Read and check (arguments and exceptions as `calibrate` has them)."""
        config = load_config(recording.attachment(ATTACHMENT, needed=config_file is None), config_file)
        name = resolve_method(method_name, recording, config)
        chosen = method(name)
        return cls(recording, config, name, chosen, chosen.read(recording, config))

    def problem(self) -> Problem:
        """The graph."""
        return self.method.problem(self.data, self.config)


def calibrations(
    session: Session, solved: Iterable[tuple[Estimate, Problem]], seconds: Mapping[str, float]
) -> list[Calibration]:
    """Estimates, each with the problem it solves, judged and ready to be reported; `seconds` is what reading took."""
    chosen, data, config = session.method, session.data, session.config
    sha256, truth = session.recording.sha256(), _truth(session.recording)
    facts = session_facts(session.recording, config)
    found = []
    causes: tuple[Cause, ...] | None = None
    for estimate, problem in solved:
        incremental = estimate.solver == "incremental"
        quantities = tuple(q for q in problem.quantities if q.name in estimate.names)
        assessment = assess(quantities, estimate.covariance, estimate.chi_square, problem.advice)
        # The published solvers stand beside as they are.
        ours = estimate.solver != "published"
        if ours and not estimate.converged:
            assessment = assessment.unsolved(estimate.message)
        elif ours and (assessment.status == "inconsistent" or mostly_rejected(estimate)):
            with progress.doing("looking for causes"):
                causes = find_causes(chosen, data, config, estimate) if causes is None else causes
            assessment = assessment.explained(causes)
        found.append(
            Calibration(
                problem=problem,
                estimate=estimate,
                assessment=assessment,
                recording=session.recording.path.name,
                sha256=sha256,
                facts=facts,
                config_text=config.model_dump_json(indent=1, exclude_defaults=True),
                truth=truth,
                seconds=seconds,
                plots=chosen.plots(data) if chosen.plots else None,
                beside=cache(partial(_published, chosen, data, config)) if incremental else None,
                findings=chosen.findings(data, config, estimate) if chosen.findings else {},
            )
        )
    return found


def self_agreement(
    path: Path, method_name: str | None = None, config_file: Path | None = None
) -> tuple[dict[str, Halves], dict[str, float]]:
    """What either half of a recording says, and how well held-out measurements are predicted (arguments as above)."""
    session = Session.read(open_recording(path), method_name, config_file)
    return split_halves(session.method, session.data, session.config), held_out(session.problem())


def _solve(
    solver: str, chosen: Method, data: object, config: Config, window: float | None, duration: float
) -> tuple[Estimate, Problem]:
    problem = chosen.problem(data, config)
    if solver == "published":
        return chosen.published(data, config, problem), problem
    if solver == "incremental":
        from pipelines.solvers.incremental import solve_incremental

        return solve_incremental(replace(problem, steps=partial(_shown, problem, duration)), window), problem
    from pipelines.solvers.batch import solve_batch

    with progress.doing("solving"):
        return solve_batch(problem), problem


def _shown(problem: Problem, duration: float, chunk: int) -> Iterator[Step]:
    """The problem's steps; those fed one by one are shown as they are taken, by time in the recording."""
    if chunk > 1:
        return problem.steps(chunk)
    return progress.track(problem.steps(chunk), "step by step", duration, lambda step: step.time)


def _published(chosen: Method, data: object, config: Config) -> Estimate | None:
    """The published solver's estimate, where it can serve the recording: it needs more than the graphs."""
    try:
        return chosen.published(data, config, chosen.problem(data, config))
    except InputError:
        return None


def _truth(recording: Recording) -> dict[str, object] | None:
    attachment = recording.attachment(TRUTH, needed=False)
    try:
        return None if attachment is None else dict(json.loads(attachment, parse_int=float))
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{recording.path}: the attachment {TRUTH} is no JSON object of parameters and their values"
        ) from error
