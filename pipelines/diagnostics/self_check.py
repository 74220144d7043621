"""The last estimate of an online run beside batch on the same recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.problem import Estimate

# A difference that is told, in sigmas.
_TOLD = 1.0


@dataclass(frozen=True)
class SelfCheck:
    """How far an estimate is from batch's.

    Attributes:
        parameter: that differs most, in units of its own sigma.
        difference: that many sigmas; the sign is that of the estimate less batch.
        sigma_ratio: the smallest of the estimate's sigmas over batch's.
    """

    parameter: str
    difference: float
    sigma_ratio: float

    @classmethod
    def of(cls, estimate: Estimate, batch: Estimate) -> SelfCheck | None:
        """None when nothing is estimated, or batch has no solution."""
        free = np.flatnonzero((estimate.sigmas > 0.0) & (batch.sigmas > 0.0))
        if not len(free) or not batch.converged:
            return None
        difference = (estimate.values - batch.values)[free] / estimate.sigmas[free]
        worst = int(np.argmax(np.abs(difference)))
        ratio = float((estimate.sigmas[free] / batch.sigmas[free]).min())
        return cls(estimate.names[free[worst]], float(difference[worst]), ratio)

    @property
    def sentence(self) -> str:
        """What to know of a difference; empty while it is small."""
        if abs(self.difference) < _TOLD:
            return ""
        return (
            f"Batch on the same recording differs by up to {abs(self.difference):.1f} sigma ({self.parameter}): take "
            "its result."
        )
