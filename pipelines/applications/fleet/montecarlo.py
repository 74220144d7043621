"""Monte Carlo studies: errors of many simulated recordings of one scenario, compared with their sigmas.

    study = run_study("head", "head_nominal", seeds=range(200), solvers=SOLVERS, out=Path("study"))
    study.nees("batch").consistent

Every seed is simulated and solved by one task on one core, so that the numbers do not depend on how many workers there
are. The simulated arrays are solved as they are: written to a file and read again they are the same, but for the last
digits of noise densities, which messages carry as variances. A worker sends back numbers only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.fleet import require_extra, statistics
from alidade.pipelines.applications.fleet.engine import Killed, source_version, work_off
from alidade.pipelines.applications.fleet.store import (
    Cell,
    ParameterError,
    Row,
    RunResult,
    Store,
    csv_text,
    quarantined,
    run_isolated,
    settings_key,
)
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import plain_json, write_whole

if TYPE_CHECKING:
    from pydantic import BaseModel

    from alidade.pipelines.methods import Method
    from alidade.pipelines.reports.result import Calibration

SOLVERS = ("published", "batch", "incremental")


@dataclass(frozen=True)
class Study:
    """Simulated and solved runs of one scenario.

    Attributes:
        method: simulated and solved.
        scenario: its name.
        solvers: in the order of the tables.
        results: seed -> solver -> numbers, in the order of the seeds; of those that are finished.
        seeds: how many were asked for.
        kept: how many had been finished by an earlier run.
        interrupted: Ctrl-C came before the end.
    """

    method: str
    scenario: str
    solvers: tuple[str, ...]
    results: Mapping[int, Mapping[str, RunResult]]
    seeds: int
    kept: int
    interrupted: bool

    def estimates(self, solver: str) -> list[RunResult]:
        """Return the results of the runs in which a solver reached an estimate whose truth is known."""
        return [run[solver] for run in self.results.values() if solver in run and run[solver].get("dof")]

    def failures(self, solver: str) -> dict[int, str]:
        """Return seed -> reason why a solver has no estimate."""
        return {
            seed: run[solver]["reason"]
            for seed, run in self.results.items()
            if solver in run and run[solver]["status"] == "failed"
        }

    def statuses(self, solver: str) -> dict[str, int]:
        """Number of runs by status."""
        found = [run[solver]["status"] for run in self.results.values() if solver in run]
        return {status: found.count(status) for status in sorted(set(found))}

    def nees(self, solver: str) -> statistics.Nees:
        """Mean NEES (normalised estimation error squared) of the runs; needs an estimate."""
        found = self.estimates(solver)
        return statistics.mean_nees(np.array([r["nees"] for r in found]), np.array([float(r["dof"]) for r in found]))

    def normalised(self, solver: str) -> Array:
        """Errors over their sigmas, of all runs and parameters."""
        return np.array([p["error"] / p["sigma"] for r in self.estimates(solver) for p in r["parameters"].values()])

    def accuracies(self, solver: str) -> dict[str, tuple[statistics.Accuracy, ParameterError]]:
        """Return parameter -> accuracy over the runs, and the entry of one run, for unit and required accuracy."""
        members: dict[str, list[ParameterError]] = {}
        for result in self.estimates(solver):
            for name, parameter in result["parameters"].items():
                members.setdefault(name, []).append(parameter)
        return {
            name: (
                statistics.accuracy(np.array([p["error"] for p in found]), np.array([p["sigma"] for p in found])),
                found[0],
            )
            for name, found in members.items()
        }


def run_study(
    method: str,
    scenario: str | None,
    seeds: Sequence[int],
    solvers: Sequence[str],
    out: Path,
    scheduler: str | None = None,
    jobs: int | None = None,
    window: float | None = 1.0,
) -> Study:
    """Simulate and solve every seed that has not been finished before.

    Args:
        method: to simulate and solve.
        scenario: name or YAML file; None is the method's nominal one.
        seeds: one run each.
        solvers: of SOLVERS.
        out: folder; results are kept there as they come.
        scheduler: address; None works on this machine.
        jobs: how many local workers.
        window: s, of the incremental solver; None keeps the whole history.

    Raises:
        InputError: no such method, scenario or solver, out cannot be written to, or no cluster can be had.
    """
    require_extra()
    unknown = [solver for solver in solvers if solver not in SOLVERS]
    if unknown or not solvers:
        raise InputError(f"no solver {', '.join(unknown)!r}; the solvers are {', '.join(SOLVERS)}, or all")
    if not seeds:
        raise InputError("--runs: at least one run is needed")
    chosen = methods.method(method)
    settings = chosen.settings(scenario)
    # The first recording identifies scenario and simulator; one that cannot be drawn is refused here.
    store = Store(
        out,
        settings_key(source_version(), *_first(chosen, settings, seeds[0]), list(solvers), window),
        dict[str, RunResult],
    )
    tasks = {
        str(seed): (method, settings, seed, tuple(solvers), window) for seed in seeds if str(seed) not in store.results
    }
    kept = len(seeds) - len(tasks)
    killed: dict[str, dict[str, RunResult]] = {}

    def take(name: str, result: Any) -> None:
        if isinstance(result, Killed):
            killed[name] = dict.fromkeys(solvers, quarantined())
        else:
            store.add(name, result)

    with store:
        interrupted = work_off(simulate_and_solve, tasks, take, "simulating and solving", scheduler, jobs)
    known = {**store.results, **killed}
    results = {seed: known[str(seed)] for seed in seeds if str(seed) in known}
    name = Path(scenario or chosen.default_scenario()).stem
    return Study(method, name, tuple(solvers), results, len(seeds), kept, interrupted)


def simulate_and_solve(
    method: str, scenario: BaseModel, seed: int, solvers: Sequence[str], window: float | None
) -> dict[str, RunResult]:
    """Simulate and solve one seed of a scenario on a worker: solver -> numbers."""
    from alidade.pipelines.applications.session import Session

    chosen = methods.method(method)
    session = Session.of(chosen, chosen.simulate(scenario, seed))
    return {
        solver: run_isolated(_numbers, partial(session.calibrate, solver, window, report=False)) for solver in solvers
    }


def run_table(study: Study) -> list[Row]:
    """Return a row for each seed and solver: status, NEES, chi-square, error and sigma of every parameter, SI."""
    rows: list[Row] = []
    for seed, run in study.results.items():
        for solver, result in run.items():
            row: dict[str, Cell] = {"seed": seed, "solver": solver}
            cells = cast("Mapping[str, Cell]", result)
            row |= {key: cells.get(key) for key in ("status", "exit_code", "reason", "nees", "dof")}
            row |= {key: cells.get(key) for key in ("chi_square", "chi_square_dof")}
            for name, parameter in result["parameters"].items():
                row |= {f"{name}_error": parameter["error"], f"{name}_sigma": parameter["sigma"]}
            rows.append(row)
    return rows


def summary_table(study: Study) -> list[Row]:
    """Return a row for each solver and parameter, and one for all parameters of a solver together, SI."""
    rows: list[Row] = []
    for solver in study.solvers:
        if not study.estimates(solver):
            continue
        nees, shares = study.nees(solver), statistics.coverage(study.normalised(solver))
        rows.append(
            {
                "solver": solver,
                "parameter": "all",
                "runs": nees.runs,
                "mean_nees": nees.mean,
                "nees_low": nees.low,
                "nees_high": nees.high,
                "dof": nees.dof,
                **_coverage_cells(shares),
            }
        )
        for name, (a, _) in study.accuracies(solver).items():
            cells: dict[str, Cell] = {"solver": solver, "parameter": name, "bias": a.bias, "bias_sigma": a.bias_sigma}
            rows.append(cells | {"rms_error": a.rms, "rms_sigma": a.sigma} | _coverage_cells(a.coverage))
    return rows


def _coverage_cells(shares: tuple[float, float, float]) -> dict[str, Cell]:
    return {f"within_{k}_sigma": share for k, share in enumerate(shares, start=1)}


def _first(method: Method, scenario: BaseModel, seed: int) -> tuple[str, str, str, dict[str, float]]:
    """Return what identifies a study's recordings: method, SHA-256 of the data of one seed, config and truth."""
    from alidade.pipelines.applications.session import sha256_of

    simulated = method.simulate(scenario, seed)
    return method.name, sha256_of(simulated.data), simulated.config, dict(simulated.truth)


def _numbers(calibration: Calibration) -> dict[str, Any]:
    """Return errors, sigmas and NEES of the estimated parameters whose truth is known."""
    from alidade.pipelines.reports.result_json import truth_errors

    errors = truth_errors(calibration)
    judged = [p for p in calibration.parameters.values() if p.name in errors and p.sigma > 0.0]
    numbers: dict[str, Any] = {
        "parameters": {
            p.name: {"error": errors[p.name].error, "sigma": p.sigma, "unit": p.unit, "require": p.require}
            for p in judged
        }
    }
    if judged:
        places = [calibration.estimate.names.index(p.name) for p in judged]
        sigmas = np.array([p.sigma for p in judged])
        correlation = calibration.covariance[np.ix_(places, places)] / np.outer(sigmas, sigmas)
        normalised = np.array([errors[p.name].error for p in judged]) / sigmas
        numbers |= {"nees": float(normalised @ np.linalg.solve(correlation, normalised)), "dof": len(judged)}
    if calibration.estimate.chi_square is not None:
        numbers |= {
            "chi_square": calibration.estimate.chi_square.value,
            "chi_square_dof": calibration.estimate.chi_square.dof,
        }
    return numbers


def study_json(study: Study) -> str:
    """JSON of `montecarlo`: the rows of runs.csv and summary.csv."""
    return plain_json(
        "montecarlo",
        {
            "method": study.method,
            "scenario": study.scenario,
            "runs": run_table(study),
            "summary": summary_table(study),
            "wanted": study.seeds,
            "interrupted": study.interrupted,
        },
    )


def write_study(out: Path, study: Study) -> tuple[Path, ...]:
    """Write runs.csv, summary.csv and montecarlo.html, all or none of them; return their paths."""
    from alidade.pipelines.applications.fleet.pages import study_report
    from alidade.pipelines.reports.html import render_html

    return write_whole(
        out,
        {
            "runs.csv": csv_text(run_table(study)),
            "summary.csv": csv_text(summary_table(study)),
            "montecarlo.html": render_html(study_report(study)),
        },
    )
