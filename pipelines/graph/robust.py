"""Statistics that outliers do not disturb."""

from __future__ import annotations

import numpy as np

from pipelines.graph.problem import Array


def robust_sigma(values: Array) -> float:
    """Standard deviation of zero-mean normal numbers, told from their median so that outliers do not count."""
    return float(np.median(np.abs(values), overwrite_input=True)) / 0.6745 if values.size else 0.0
