"""Numerical differentiation of vectorised models, for the property tests of all factors."""

from __future__ import annotations

import numpy as np

from factors import so3
from factors.vectorized import Array, Kind, Model


def perturbed(block: Array, kind: Kind, delta: Array) -> Array:
    """The block moved by a tangent vector."""
    return so3.multiply(block, so3.exp(delta)) if kind == "rotation" else block + delta


def assert_jacobians_match(
    model: Model, kinds: list[Kind], blocks: list[Array], steps: list[float] | None = None, rtol: float = 2e-6
) -> None:
    """Analytic Jacobians equal central differences, measured against the largest entry of each block's Jacobian."""
    analytic = model(*blocks)[1]()
    assert len(analytic) == len(blocks) == len(kinds)
    for j, kind in enumerate(kinds):
        size = 3 if kind == "rotation" else kind
        step = 1e-5 if steps is None else steps[j]
        numeric = np.empty_like(analytic[j])
        for axis, d in enumerate(step * np.eye(size)):
            ahead = [perturbed(b, kind, d) if i == j else b for i, b in enumerate(blocks)]
            behind = [perturbed(b, kind, -d) if i == j else b for i, b in enumerate(blocks)]
            numeric[..., axis] = (model(*ahead)[0] - model(*behind)[0]) / (2.0 * step)
        np.testing.assert_allclose(
            analytic[j], numeric, atol=rtol * max(np.abs(numeric).max(), 1e-12), rtol=0, err_msg=f"block {j}"
        )


def assert_rows_are_independent(model_of: object, blocks: list[Array]) -> None:
    """A batch of one equals the row of many; `model_of(rows)` builds the model on some rows."""
    n = len(blocks[0])
    everything = model_of(np.arange(n))(*blocks)  # type: ignore[operator]
    for i in range(n):
        one = model_of(np.array([i]))(*[b[i : i + 1] for b in blocks])  # type: ignore[operator]
        np.testing.assert_allclose(one[0][0], everything[0][i], rtol=1e-9, atol=1e-9)
        for a, b in zip(one[1](), everything[1](), strict=True):
            np.testing.assert_allclose(a[0], b[i], rtol=1e-9, atol=1e-7)
