"""attitude.tum: the trajectory for evo and its kin."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.estimation.problem import Attitudes


def tum(attitudes: Attitudes, epoch_ns: int) -> str:
    """Lines `t tx ty tz qx qy qz qw`, in the order of time; t is Unix time in s to the ns, the position zero."""
    order = np.argsort(attitudes.time, kind="stable")
    stamps = epoch_ns + np.round(attitudes.time[order] * 1e9).astype(np.int64)
    lines = []
    for t_ns, (w, x, y, z) in zip(stamps.tolist(), attitudes.wxyz[order].tolist(), strict=True):
        # In whole numbers: a double holds today's Unix time to a quarter of a microsecond only.
        seconds, rest = divmod(t_ns, 1_000_000_000)
        lines.append(f"{seconds}.{rest:09d} 0 0 0 {x:.12f} {y:.12f} {z:.12f} {w:.12f}\n")
    return "".join(lines)
