"""Checks for vectorised models, ours and a user's own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.factors.array import Array
from alidade.factors.model import Model, check, dimension, retract


def assert_jacobians(
    model: Model, blocks: Sequence[Array], steps: Sequence[float] | None = None, rtol: float = 2e-6
) -> None:
    """Assert that a model's analytic Jacobians equal central differences.

    Args:
        model: n measurements.
        blocks: for each of its blocks the variables' values, (n, 4), (n, 7) or (n, d): random ones find more mistakes.
        steps: of the differences, one a block, in the tangent's units; 1e-5 unless given.
        rtol: difference allowed, relative to the largest entry of each block's Jacobian.

    Raises:
        ValueError: residuals or Jacobians have other shapes than the model declares.
        AssertionError: a Jacobian is wrong; says which.
    """
    check(model)
    analytic = model(*blocks)[1]()
    for j, block in enumerate(model.blocks):
        step = 1e-5 if steps is None else steps[j]
        numeric = np.empty_like(analytic[j])
        for axis, delta in enumerate(step * np.eye(dimension(block))):
            ahead, behind = (
                [retract(b, block, sign * delta) if i == j else b for i, b in enumerate(blocks)] for sign in (1.0, -1.0)
            )
            numeric[..., axis] = (model(*ahead)[0] - model(*behind)[0]) / (2.0 * step)
        largest = max(float(np.abs(numeric).max()), 1e-12)
        np.testing.assert_allclose(
            analytic[j], numeric, atol=rtol * largest, rtol=0, err_msg=f"Jacobian by block {j}, {block!r}"
        )
