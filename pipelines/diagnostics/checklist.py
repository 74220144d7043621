"""Checklist for the person recording: collected data against the needs of the method.

These are rules of thumb about the motion; whether it was enough is what the sigmas say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.estimation.finding import Motion

# A turn within this time, s, counts as motion about an axis.
_STRETCH = 5.0


@dataclass(frozen=True)
class ChecklistItem:
    """Motion or position that a method needs, with the share covered so far.

    Attributes:
        what: its name.
        have: how much there is, in words.
        wanted: what is still to be done, empty when it is enough.
        share: how much there is of what is enough, 0 to 1; None where that is no matter of more or less.
        motion: that gives what is wanted, for who holds the device; None where no single motion does.
        chart: of what there is, SVG as `alidade.pipelines.display.drawing` draws it; empty: none.
    """

    what: str
    have: str
    wanted: str = ""
    share: float | None = None
    motion: Motion | None = None
    chart: str = ""


def swayed(name: str, turned: Array, enough: float, what: str, who: str) -> list[ChecklistItem]:
    """Build a checklist item for each axis: angle rotated (3,) rad against the required angle `enough`, rad.

    `what` to do comes before the axis; `who` is to be turned, in a word.
    """
    found = []
    for axis, angle in zip(AXES, turned, strict=True):
        wanted = f"{what} {axis} by {np.rad2deg(enough):.0f} deg and more"
        short = bool(angle < enough)
        found.append(
            ChecklistItem(
                f"{name} about {axis}",
                f"{np.rad2deg(angle):.1f} deg",
                wanted if short else "",
                min(float(angle / enough), 1.0),
                Motion(wanted, swaying(axis, who)) if short else None,
            )
        )
    return found


def turned(t: Array, gyro: Array) -> Array:
    """Largest rotation about each axis within a few seconds, (3,) rad, by integrating gyro rates."""
    rate = gyro - np.median(gyro, axis=0)
    angle = np.vstack([np.zeros(3), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t)[:, None], axis=0)])
    starts = np.searchsorted(t, np.arange(t[0], t[-1], _STRETCH))
    highest, lowest = np.maximum.reduceat(angle, starts), np.minimum.reduceat(angle, starts)
    return np.asarray((highest - lowest).max(axis=0))
