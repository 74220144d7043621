"""First-order Gauss-Markov processes: errors that are correlated over a time.

Source: Gelb (ed.), "Applied Optimal Estimation", MIT Press 1974, chapter 3: exponentially correlated random variables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors.array import Array
from alidade.factors.model import Block, Model, Residuals

# Bounds of what counts as left of a process: backward in time the process is divided by what is left, and its
# transitions are whitened by what is not.
_LEAST, _MOST = 1e-2, 1.0 - 1e-9


def remaining(interval: Array, correlation_time: float) -> Array:
    """Share exp(-interval / correlation_time), (n,), of a process that is left after some intervals (n,), s."""
    return np.clip(np.exp(-np.asarray(interval) / correlation_time), _LEAST, _MOST)


@dataclass(frozen=True)
class GaussMarkovFactor(Model):
    """Transitions of a stationary process u of three numbers, u_k = phi u_k-1 + sigma sqrt(1 - phi^2) n_k, n_k white.

    phi = exp(-interval / correlation_time). Blocks: u_k-1 and u_k (3 each); or u alone, at its start.

    Attributes:
        time: (n,) of u_k, s.
        sigma: of each number of the process, in its unit.
        correlation_time: s.
        interval: (n,) s from u_k-1 to u_k; None: u begins.
    """

    time: Array
    sigma: float
    correlation_time: float
    interval: Array | None = None
    rows: int = 3
    stacked: ClassVar = ("time", "interval")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: the process before and after, or at its start."""
        return (3,) if self.interval is None else (3, 3)

    def __call__(self, *processes: Array) -> Residuals:
        """Residual (u_k - phi u_k-1) / (sigma sqrt(1 - phi^2)), (n, 3); of the start u / sigma."""
        n, scales = len(self.time), self._scales
        residuals = sum((scale[:, None] * u for scale, u in zip(scales, processes, strict=True)), np.zeros((n, 3)))
        return residuals, lambda: tuple(scale[:, None, None] * np.eye(3) for scale in scales)

    @property
    def _scales(self) -> tuple[Array, ...]:
        """Factors (n,) of the process before and after in the whitened residual; of the start one."""
        if self.interval is None:
            return (np.full(len(self.time), 1.0 / self.sigma),)
        phi = remaining(self.interval, self.correlation_time)
        unit = 1.0 / (self.sigma * np.sqrt(1.0 - phi**2))
        return -phi * unit, unit
