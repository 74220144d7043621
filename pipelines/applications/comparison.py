"""Comparison of all solvers on one recording, and of both halves of the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import ClassVar, Literal

from alidade.pipelines import progress
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.diagnostics.goodness_of_fit import SolverDifference, solver_difference
from alidade.pipelines.reports.result import Calibration

SOLVERS = ("published", "batch", "incremental")

Answer = Literal["yes", "no", "cannot say"]


@dataclass(frozen=True, repr=False)
class Comparison:
    """Calibrations of one recording by several solvers.

    Attributes:
        calibrations: one a solver.
        halves: parameter -> estimates of both halves of the recording, each solved by itself; empty where not tested.
        predicted: family -> size of the errors of held-out measurements, sigmas.
        stopped: a sentence about what the time limit stopped.
        unsolved: "first", "second" of the halves that have no solution.
        tested: whether the halves were solved.
    """

    # Difference of incremental from batch, in sigmas: at one the mean square of the error has doubled.
    MAX_DIFFERENCE: ClassVar = 1.0
    # Probability of a false alarm of the split-half test, all parameters together.
    SIGNIFICANCE: ClassVar = 1e-3

    calibrations: tuple[Calibration, ...]
    halves: Mapping[str, SplitHalf] = field(default_factory=dict)
    predicted: Mapping[str, float] = field(default_factory=dict)
    stopped: str = ""
    unsolved: tuple[str, ...] = ()
    tested: bool = False

    def of(self, solver: str) -> Calibration | None:
        """Return the calibration by the named solver; None if that solver did not run."""
        return next((c for c in self.calibrations if c.estimate.solver == solver), None)

    def difference(self, solver: str) -> SolverDifference | None:
        """Return a solver's largest difference from batch, in that solver's sigmas; None where not comparable."""
        other, batch = self.of(solver), self.of("batch")
        if other is None or batch is None or other.estimate.names != batch.estimate.names:
            return None
        if not (other.estimate.converged and batch.estimate.converged):
            return None
        return solver_difference(other.estimate, batch.estimate, batch.problem.quantities)

    @property
    def limit(self) -> float:
        """Threshold of the split-half test, sigmas."""
        return NormalDist().inv_cdf(1.0 - 0.5 * self.SIGNIFICANCE / max(len(self.halves), 1))

    @property
    def far(self) -> dict[str, float]:
        """Parameter -> difference of both halves, sigmas, where beyond the threshold, largest first."""
        beyond = {name: half.z for name, half in self.halves.items() if abs(half.z) > self.limit}
        return dict(sorted(beyond.items(), key=lambda item: -abs(item[1])))

    @property
    def answer(self) -> Answer:
        """Whether batch and incremental agree, and both halves where these were solved: yes, no or cannot say."""
        online = self.difference("incremental")
        if self.far or (online is not None and abs(online.z) > self.MAX_DIFFERENCE):
            return "no"
        return "cannot say" if online is None or (self.tested and not self.halves) else "yes"

    def write(self, folder: str | Path) -> Path:
        """Write compare.html; returns its path. Raises InputError when it cannot be written."""
        from alidade.pipelines.files import write_whole
        from alidade.pipelines.reports.comparison_report import comparison_report
        from alidade.pipelines.reports.html import render_html

        (path,) = write_whole(Path(folder), {"compare.html": render_html(comparison_report(self))})
        return path

    def __repr__(self) -> str:
        solved = ", ".join(f"{c.estimate.solver} {c.status}" for c in self.calibrations)
        return f"<Comparison of {self.calibrations[0].recording}: {solved}; agree: {self.answer}>"


def compared(session: Session, window: float | None = 1.0, halves: bool = True) -> Comparison:
    """Solve a session by all solvers, and each half by batch. Raises InputError, IndeterminateError."""
    calibrations = tuple(session.calibrations(SOLVERS, window))
    if not halves:
        return Comparison(calibrations)
    with progress.doing("solving parts of the recording"):
        return Comparison(calibrations, *session.cross_validate(), tested=True)
