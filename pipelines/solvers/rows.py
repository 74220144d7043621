"""Numbers gathered row by row."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.estimation.problem import Array


class Rows:
    """Rows of numbers, all of one width, in an array that doubles when it is full.

    A list of small arrays would take ten times the memory over hours.
    """

    def __init__(self, array: Array | None = None) -> None:
        self._array = np.empty((0, 0)) if array is None else array.copy()
        self._count = len(self._array)

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> Array:
        """(n, width), a view that the next row may make stale."""
        return self._array[: self._count]

    def add(self, rows: Array) -> None:
        """Append rows (n, width)."""
        if not len(rows):
            return
        needed = self._count + len(rows)
        if needed > len(self._array):
            grown = np.empty((max(needed, 2 * len(self._array)), rows.shape[1]))
            if self._count:
                grown[: self._count] = self.array
            self._array = grown
        self._array[self._count : needed] = rows
        self._count = needed

    def clear(self) -> None:
        """Forget all rows."""
        self._count = 0
