"""Robust loss of outlying measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array


@dataclass(frozen=True)
class TruncatedLoss:
    """Truncated least squares on each measurement's whitened norm, or a relaxation by `mu`.

    Beyond `gate` a measurement costs gate**2 / 2, whatever its size, without influence. `mu` = inf is that loss; a
    small mu is a convex surrogate, mu = 0 its limit, plain least squares. Graduated non-convexity goes from one to the
    other. Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020, eqs.
    13 and 14.
    """

    gate: float
    mu: float = np.inf

    def __post_init__(self) -> None:
        """Raise ValueError where gate <= 0 or mu < 0."""
        if not self.gate > 0.0 or not self.mu >= 0.0:
            raise ValueError(f"TruncatedLoss: gate {self.gate:g} must be above 0, mu {self.mu:g} not below")

    def weight(self, square: Array) -> Array:
        """Robust weights in [0, 1] of measurements with squared norms `square`."""
        inside, outside = self._limits()
        if self.mu == 0.0:
            return np.ones_like(square)
        if np.isinf(self.mu):
            return (square < inside).astype(float)
        between = self.gate * np.sqrt(self.mu * (self.mu + 1.0) / np.maximum(square, 1e-300)) - self.mu
        return np.where(square <= inside, 1.0, np.where(square >= outside, 0.0, between))

    def cost(self, square: Array) -> Array:
        """Twice the loss of each measurement; equal to `square` well inside the gate."""
        inside, outside = self._limits()
        beyond = np.full_like(square, self.gate**2)
        if self.mu == 0.0:
            return square
        if np.isinf(self.mu):
            return np.minimum(square, beyond)
        norm = np.sqrt(square)
        between = 2.0 * self.gate * norm * np.sqrt(self.mu * (self.mu + 1.0)) - self.mu * (self.gate**2 + square)
        return np.where(square <= inside, square, np.where(square >= outside, beyond, between))

    def _limits(self) -> tuple[float, float]:
        if self.mu == 0.0:
            return np.inf, np.inf
        if np.isinf(self.mu):
            return self.gate**2, self.gate**2
        return self.gate**2 * self.mu / (self.mu + 1.0), self.gate**2 * (self.mu + 1.0) / self.mu
