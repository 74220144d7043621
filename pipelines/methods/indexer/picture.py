"""A picture of an indexer with what is to be turned."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from alidade.factors import so3
from alidade.pipelines.display.drawing import BEHIND, Drawing

# Half the width and height of the outer frame, radius of the platform.
_WIDE, _HIGH, _PLATFORM = 1.1, 1.0, 0.75


Axis = Literal["outer", "inner"]


@cache
def turning(axis: Axis, other_deg: float, ways: str = "start end") -> str:
    """An axis turned while the other one stands at an angle.

    Args:
        axis: that turns.
        other_deg: where the other one stands.
        ways: "end" forward, "start" back, or both.
    """
    out = Drawing(BEHIND)
    ex, ez = np.eye(3)[0], np.eye(3)[2]
    outer = so3.exp(np.deg2rad(other_deg if axis == "inner" else 0.0) * ex)
    inner = so3.exp(np.deg2rad(other_deg if axis == "outer" else 0.0) * ez)

    # What is fixed: two posts that carry the outer axis.
    for side in (-1.0, 1.0):
        post, foot = 1.45 * side * ex, 1.45 * side * ex - 1.3 * ez
        out.line([post, foot], width=2.5)
        out.line([foot - 0.3 * np.eye(3)[1], foot + 0.3 * np.eye(3)[1]], width=2.5)
        out.line([post, _WIDE * side * ex], axis == "outer", 3.5)
    # The frame that turns about it, with a mark at the end of the inner axis that is up at 0 deg.
    corners = np.array([[a * _WIDE, 0.0, b * _HIGH] for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))])
    out.line(so3.rotate(outer, corners), width=2.5)
    up = so3.rotate(outer, ez)
    for end in (-1.0, 1.0):
        out.line([end * _HIGH * up, 0.0 * up], axis == "inner", 3.5 if axis == "inner" else 1.5)
    # The platform, with a mark that is to the right at 0 deg.
    circle = np.deg2rad(np.linspace(0.0, 360.0, 49))[:, None]
    attitude = so3.multiply(outer, inner)
    out.face(so3.rotate(attitude, _PLATFORM * np.hstack([np.cos(circle), np.sin(circle), 0.0 * circle])))
    out.line(so3.rotate(attitude, np.array([[0.15, 0.0, 0.0], [_PLATFORM, 0.0, 0.0]])), width=3.0, arrows="end")
    if axis == "outer":
        out.arc(ex, 1.75 * ex, 0.4, (-120.0, 120.0), ways)
    else:
        out.arc(up, 1.3 * up, 0.4, (-120.0, 120.0), ways)
    standing = "inner" if axis == "outer" else "outer"
    out.word(np.array([0.0, 0.0, -2.0]), f"{standing} axis at {other_deg:g} deg")
    return out.svg(f"the {axis} axis turning, the {standing} one at {other_deg:g} deg")
