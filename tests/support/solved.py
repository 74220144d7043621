"""Calibrations of recordings, one a solver."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from alidade.pipelines.applications.session import open_session
from alidade.pipelines.recording.opening import Where
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.levenberg import Solution
from alidade.pipelines.solvers.noise_estimation import apply_levels
from alidade.pipelines.solvers.robust import solve_robust


def calibrate(
    path: Where, solvers: Sequence[str], method: str | None = None, config: Path | None = None, report: bool = False
) -> list[Calibration]:
    """One calibration a solver, from one reading of a recording; with what a report explains only where asked for."""
    return open_session(path, method, config).calibrations(solvers, report=report)


def minimum(compiled: Compiled) -> Solution:
    """Return the robust minimum at the noise levels as stated, the rejected measurements removed from the system."""
    engine = apply_levels(compiled.engine, compiled.problem.noises)
    return solve_robust(engine, compiled.initial, compiled.problem.loss).at_inliers()
