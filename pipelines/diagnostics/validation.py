"""What a calibration is worth on another recording: errors without and with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.problem import Array


@dataclass(frozen=True, eq=False)
class Validation:
    """One kind of error of a recording, before and after compensation; a method may have several.

    Attributes:
        name: what is compared with what.
        unit: SI, that of the errors.
        time: (n,) s from the session's start.
        before: (n, m) errors, one column an axis, with nothing compensated.
        after: (n, m) the same with the calibration applied.
        note: what a reader has to know beside it, a sentence without its full stop; may be empty.
        micro: angles are read in µrad, as in the trade of pointing, not in degrees.
    """

    name: str
    unit: str
    time: Array
    before: Array
    after: Array
    note: str = ""
    micro: bool = False


def rms(errors: Array) -> float:
    """Root mean square of the lengths of errors (n, m)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def peak(errors: Array) -> float:
    """Largest length of errors (n, m)."""
    return float(np.linalg.norm(errors, axis=1).max())
