"""Calibrations of recordings, one a solver."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from alidade.pipelines.applications.session import open_session
from alidade.pipelines.recording.opening import Where
from alidade.pipelines.reports.result import Calibration


def calibrate(
    path: Where, solvers: Sequence[str], method: str | None = None, config: Path | None = None, report: bool = False
) -> list[Calibration]:
    """One calibration a solver, from one reading of a recording; with what a report explains only where asked for."""
    return open_session(path, method, config).calibrations(solvers, report=report)
