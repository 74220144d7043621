"""Intervals in which most measurements of a family are rejected, as findings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from alidade.pipelines.estimation.disturbances import intervals
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Estimate


def disturbances(estimate: Estimate) -> Iterator[Finding]:
    """One finding for each interval, in time order."""
    for family, residuals in estimate.residuals.items():
        order = np.argsort(residuals.time, kind="stable")
        time, rejected = residuals.time[order], ~residuals.used[order]
        for first, last in intervals(rejected):
            evidence = {
                "family": family,
                "since_s": float(time[first]),
                "time_s": float(time[last - 1]),
                "rejected": int(rejected[first:last].sum()),
            }
            yield Finding("disturbance", Severity.NOTE, evidence)
