"""The findings on an estimate of which a test has the covariance and chi-square alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.observability import Advise, Verdict, finite_covariance, verdicts
from alidade.pipelines.estimation.finding import Finding, Status, status
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import ChiSquare, Estimate, Quantity
from alidade.pipelines.reports import sentences


@dataclass(frozen=True)
class Judged:
    """Findings with what they are on."""

    findings: tuple[Finding, ...]
    quantities: tuple[Quantity, ...]
    covariance: Array

    @property
    def status(self) -> Status:
        return status(self.findings)

    @property
    def verdicts(self) -> dict[str, Verdict]:
        return verdicts(self.quantities, self.covariance, (), np.array([q.prior_mean for q in self.quantities]))

    @property
    def directions(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.kind == "direction")

    @property
    def headline(self) -> str:
        return sentences.headline(self.findings, {q.name: q for q in self.quantities}, self.verdicts)

    @property
    def sigmas(self) -> Array:
        return np.sqrt(np.diag(self.covariance))


def judge(
    quantities: Sequence[Quantity],
    covariance: Array,
    chi_square: ChiSquare | None,
    advise: Advise | None,
    levels: tuple[Level, ...] = (),
) -> Judged:
    """Judge values at the prior means with this covariance."""
    quantities, covariance = tuple(quantities), finite_covariance(quantities, covariance)
    means = np.array([q.prior_mean for q in quantities])
    names = tuple(q.name for q in quantities)
    estimate = Estimate("batch", names, means, covariance, True, "", chi_square=chi_square, levels=levels)
    return Judged(diagnose(estimate, quantities, advise), quantities, covariance)
