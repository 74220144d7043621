"""Array types (numbers, indices, masks, stamps in ns), and linear interpolation between the rows of an array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]


def interpolated(at: Array, t: Array, values: Array) -> Array:
    """Interpolate rows of numbers (n, d) at t (n,), increasing, linearly: (m, d) at `at` (m,); constant beyond."""
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)
