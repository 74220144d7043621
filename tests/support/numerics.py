"""A property of all vectorised models, for the tests of factors."""

from __future__ import annotations

import numpy as np

from alidade.factors.array import Array


def assert_rows_are_independent(model_of: object, blocks: list[Array]) -> None:
    """A batch of one equals the row of many; `model_of(rows)` builds the model on some rows."""
    n = len(blocks[0])
    everything = model_of(np.arange(n))(*blocks)  # type: ignore[operator]
    for i in range(n):
        one = model_of(np.array([i]))(*[b[i : i + 1] for b in blocks])  # type: ignore[operator]
        np.testing.assert_allclose(one[0][0], everything[0][i], rtol=1e-9, atol=1e-9)
        for a, b in zip(one[1](), everything[1](), strict=True):
            np.testing.assert_allclose(a[0], b[i], rtol=1e-9, atol=1e-7)
