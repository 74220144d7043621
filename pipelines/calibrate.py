"""From a recording to calibrations: reading, solving, judging."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

from pipelines.consistency import Halves, find_causes, held_out, mostly_rejected, split_halves
from pipelines.errors import InputError
from pipelines.methods.base import Estimate, Problem
from pipelines.observability import Cause, assess
from pipelines.registry import Method, method
from pipelines.reports.result import Calibration
from pipelines.sessions.config import ATTACHMENT, Config, load_config
from pipelines.sessions.info import resolve_method, session_facts
from pipelines.sessions.reading import Recording, open_recording

SOLVERS = ("batch", "incremental", "published")


def calibrate(
    path: Path,
    solvers: Sequence[str],
    method_name: str | None = None,
    config_file: Path | None = None,
    window: float | None = 1.0,
) -> list[Calibration]:
    """One calibration a solver, from one reading of the recording.

    Args:
        path: the recording.
        solvers: of SOLVERS.
        method_name: overrides the config's.
        config_file: overrides the recording's own config key by key.
        window: s, of the incremental solver; None keeps the whole history.

    Raises:
        InputError: recording or config cannot be used.
        IndeterminateError: states other than the parameters are not determined.
    """
    start = time.perf_counter()
    recording = open_recording(path)
    config = load_config(recording.attachment(ATTACHMENT), config_file)
    name = resolve_method(method_name, recording, config)
    chosen = method(name)
    data = chosen.read(recording, config)
    facts = session_facts(recording, config)
    sha256, truth = recording.sha256(), _truth(recording)
    read = time.perf_counter() - start
    calibrations = []
    causes: tuple[Cause, ...] | None = None
    beside = _published(chosen, data, config) if "incremental" in solvers else None
    for solver in solvers:
        estimate, problem = _solve(solver, chosen, data, config, window)
        quantities = tuple(q for q in problem.quantities if q.name in estimate.names)
        assessment = assess(quantities, estimate.covariance, estimate.chi_square, problem.advice)
        if solver != "published" and (assessment.status == "inconsistent" or mostly_rejected(estimate)):
            causes = find_causes(chosen, data, config, estimate) if causes is None else causes
            assessment = assessment.explained(causes)
        calibrations.append(
            Calibration(
                problem=problem,
                estimate=estimate,
                assessment=assessment,
                recording=path.name,
                sha256=sha256,
                facts=facts,
                config_text=config.model_dump_json(indent=1, exclude_defaults=True),
                truth=truth,
                seconds={"read": read},
                plots=chosen.plots(data) if chosen.plots else None,
                beside=beside if solver == "incremental" else None,
            )
        )
    return calibrations


def self_agreement(
    path: Path, method_name: str | None = None, config_file: Path | None = None
) -> tuple[dict[str, Halves], dict[str, float]]:
    """What either half of a recording says, and how well held-out measurements are predicted (arguments as above)."""
    recording = open_recording(path)
    config = load_config(recording.attachment(ATTACHMENT), config_file)
    chosen = method(resolve_method(method_name, recording, config))
    data = chosen.read(recording, config)
    return split_halves(chosen, data, config), held_out(chosen.problem(data, config))


def _solve(solver: str, chosen: Method, data: object, config: Config, window: float | None) -> tuple[Estimate, Problem]:
    problem = chosen.problem(data, config)
    if solver == "published":
        return chosen.published(data, config, problem), problem
    if solver == "incremental":
        from pipelines.solvers.incremental import solve_incremental

        return solve_incremental(problem, window), problem
    from pipelines.solvers.batch import solve_batch

    return solve_batch(problem), problem


def _published(chosen: Method, data: object, config: Config) -> Estimate | None:
    """The published solver's estimate, where it can serve the recording: it needs more than the graphs."""
    try:
        return chosen.published(data, config, chosen.problem(data, config))
    except InputError:
        return None


def _truth(recording: Recording) -> dict[str, object] | None:
    attachment = recording.attachment("truth.json")
    return None if attachment is None else dict(json.loads(attachment))
