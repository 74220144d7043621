"""A short turn about one axis, and its table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.support.recorded import T0


def turning(n: int = 500) -> tuple[Any, Any, Any]:
    """Stamps at 100 Hz, rates and unit quaternions of a body that turns."""
    rng = np.random.default_rng(5)
    t_ns = T0 + 10_000_000 * np.arange(n)
    wxyz = rng.normal(size=(n, 4))
    return t_ns, rng.normal(size=(n, 3)), wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)


def write_csv(path: Path, names: list[str], t_ns: Any, rows: Any) -> Path:
    lines = [",".join([str(t), *map(repr, row)]) for t, row in zip(t_ns.tolist(), rows.tolist(), strict=True)]
    path.write_text("\r\n".join([",".join(names), *lines, ""]))
    return path
