"""Statistics and least squares that outliers do not disturb."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from alidade.factors.array import Array

# Of numeric differentiation, in units of each number.
_STEP = 1e-6
# Numbers that a step moves by less than this part of their sigmas stay where they are.
_SETTLED = 0.05


def robust_sigma(values: Array) -> float:
    """Standard deviation of zero-mean normal numbers, estimated from the median absolute value."""
    return float(np.median(np.abs(values), overwrite_input=True)) / 0.6745 if values.size else 0.0


def fitted(
    near: Callable[[Array], Callable[[Array], Array]], x: Array, prior: Array, sigma: float, most: int
) -> tuple[Array, Array]:
    """Iterate robust least-squares steps until convergence; return x (m,) and its covariance (m, m).

    Args:
        near: what misses (n, d), as a function of x near some x.
        x: where it begins.
        prior: (m,) inverse sigmas of x about zero.
        sigma: the least that what misses is taken to scatter by.
        most: steps.
    """
    for _ in range(most):
        miss = near(x)
        error = miss(x)
        size = np.linalg.norm(error, axis=1)
        scale = max(float(np.median(size)), sigma)
        weight = 1.0 / (scale * np.sqrt(1.0 + (size / (3.0 * scale)) ** 2))[:, None]
        columns = [(weight * (miss(x + d) - error)).ravel() / _STEP for d in _STEP * np.eye(len(x))]
        A = np.vstack([np.stack(columns, axis=1), np.diag(prior)])
        step = np.linalg.lstsq(A, np.concatenate([(weight * error).ravel(), prior * x]))[0]
        x, covariance = x - step, np.linalg.inv(A.T @ A)
        if (np.abs(step) < _SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    return x, covariance
