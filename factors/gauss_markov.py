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
        scales = transition_scales(self.sigma, self.correlation_time, self.interval)
        parts = [scale[:, None] * u for scale, u in zip(scales, processes, strict=True)]
        n = len(self.time)
        return sum(parts, np.zeros((n, 3))), lambda: tuple(
            np.broadcast_to(scale[:, None, None] * np.eye(3), (n, 3, 3)) for scale in scales
        )


def transition_scales(sigma: float, correlation_time: float, interval: Array | None) -> tuple[Array, ...]:
    """Factors (n or 1,) of the process before and after a transition in its whitened residual; of a start one."""
    if interval is None:
        return (np.array([1.0 / sigma]),)
    phi = remaining(interval, correlation_time)
    unit = 1.0 / (sigma * np.sqrt(1.0 - phi**2))
    return -phi * unit, unit
