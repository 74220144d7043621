"""Samples on an even grid: where some were lost, and how far apart the others are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A step longer than this many intervals may be a loss; it is one if so many stamps on either side agree.
_STEP, _AROUND = 1.5, 8
# So many samples lost in a row are filled in, if no more than this part of all is; otherwise a piece ends.
_HOLE, _MOST_FILLED = 5, 0.02


def even_pieces(t: Array, values: Array) -> tuple[list[Array], float, int]:
    """Pieces of evenly spaced samples, their interval, s, and the number of samples filled in.

    Jittering stamps count as evenly spaced; the stamps beside a hole distinguish lost samples from late stamps. Short
    holes are filled by straight lines, long ones split the record.

    Args:
        t: (N,) s, increasing.
        values: (N, k).
    """
    interval = float(np.median(np.diff(t)))
    lost = _lost(t, interval)
    interval = float((t[-1] - t[0]) / (len(t) - 1 + lost.sum()))
    fill = (lost > 0) & (lost <= _HOLE)
    if lost[fill].sum() > _MOST_FILLED * len(t):
        fill[:] = False
    ends = np.flatnonzero((lost > 0) & ~fill) + 1
    pieces = []
    for rows in np.split(np.arange(len(t)), ends):
        if len(rows) < 2:
            continue
        place = np.append(0, np.cumsum(1 + np.where(fill, lost, 0)[rows[:-1]]))
        part = values[rows]
        if place[-1] >= len(rows):
            grid = np.arange(place[-1] + 1)
            part = np.stack([np.interp(grid, place, column) for column in part.T], axis=1)
        pieces.append(part)
    return pieces, interval, int(lost[fill].sum())


def _lost(t: Array, interval: float) -> NDArray[np.intp]:
    """Samples lost between each and the next (N-1,)."""
    out = np.zeros(len(t) - 1, dtype=np.intp)
    late = t - interval * np.arange(len(t))
    for i in np.flatnonzero(np.diff(t) > _STEP * interval):
        before, after = late[max(0, i + 1 - _AROUND) : i + 1], late[i + 1 : i + 1 + _AROUND]
        out[i] = max(0, round(float(np.median(after) - np.median(before)) / interval))
    return out
