"""Gauss-Markov processes of simulated errors."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from alidade.factors.array import Array


def gauss_markov(white: Array, phi: float, begun: int) -> Array:
    """Process of unit variance and lag-1 correlation phi, from white noise (n, d), without its first `begun` values."""
    return np.asarray(np.sqrt(1.0 - phi**2) * lfilter([1.0], [1.0, -phi], white, axis=0)[begun:])
