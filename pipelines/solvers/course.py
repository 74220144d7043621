"""What a run of the incremental solver knew jointly at moments on its way.

Moments lie a fixed share of what was recorded until then apart, so that hours have a few hundred of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array, Course
from alidade.pipelines.solvers.rows import Rows

# From one moment to the next, as a share of the time since the first.
_APART = 0.02


class Way:
    """The moments so far; none where the beginning is not known.

    Attributes:
        rows: time, values (n,) and covariance (n * n,) of each.
    """

    def __init__(self, rows: Rows | None = None) -> None:
        self.rows = Rows() if rows is None else rows

    @classmethod
    def of(cls, course: Course | None) -> Way:
        """The moments of a batch solution, to be gone on with."""
        if course is None:
            return cls()
        covariance = course.covariance.reshape(len(course.time), -1)
        return cls(Rows(np.column_stack([course.time, course.values, covariance])))

    def due(self, time: float) -> bool:
        """Whether a moment is to be added at a time, s."""
        past = self.rows.array
        return len(past) > 0 and time - past[-1, 0] >= _APART * (time - past[0, 0])

    def add(self, time: float, values: Array, covariance: Array) -> None:
        """One more moment."""
        self.rows.add(np.concatenate([[time], values, covariance.ravel()])[None])

    def until(self, time: float, values: Array, covariance: Array, steady: NDArray[np.bool_]) -> Course | None:
        """The course up to now, s, with what is known now as its last moment; None: its beginning is not known."""
        past, n = self.rows.array, len(values)
        if not len(past):
            return None
        past = past[past[:, 0] < time]
        return Course(
            np.append(past[:, 0], time),
            np.vstack([past[:, 1 : 1 + n], values]),
            np.concatenate([past[:, 1 + n :].reshape(-1, n, n), covariance[None]]),
            steady,
        )
