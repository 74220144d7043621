"""The sketch of a method's frames with the rotations that were found drawn in.

A sketch is an SVG file of the method. Where it has `<g class="found" data-turn="M" data-x="120" data-y="235">`, the
axes of the child of that transform of calibration.yaml are drawn dashed from that point, where the parent's are,
enlarged where they would not show. With `data-axes="camera"` the parent is drawn as a camera, z forward.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from alidade.factors import so3
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.display.units import rounded
from alidade.pipelines.reports.calibration import SavedTransform

# Where x, y, z of a frame point in a sketch, as columns, and how long they are, px.
_DIRECTIONS = {
    "body": np.array([[-0.52, 0.95, 0.0], [0.42, 0.10, -1.0]]),
    "camera": np.array([[0.95, 0.0, -0.52], [0.10, 1.0, 0.42]]),
}
_LENGTH = 62.0
# What rounding leaves of a mount that is fixed straight, rad.
_NOTHING = 1e-9
# A turn of less than this, rad, is drawn so many times as large.
_SMALL, _ENLARGED = math.radians(3.0), 10.0
_PLACE = re.compile(r'<g class="found" data-turn="(\w+)" data-x="(\d+)" data-y="(\d+)"(?: data-axes="(\w+)")?>')


def sketch_with(svg: str, transforms: Mapping[str, SavedTransform]) -> str:
    """Return the sketch with the rotations drawn in their places, by name; places without a rotation are unchanged."""

    def drawn(match: re.Match[str]) -> str:
        found = transforms.get(match[1])
        return match[0] + (_axes(found, float(match[2]), float(match[3]), match[4] or "body") if found else "")

    return _PLACE.sub(drawn, svg)


def angle(transform: SavedTransform) -> float:
    """Return the angle of a rotation, rad."""
    return float(np.linalg.norm(so3.log(np.array(transform.wxyz))))


def rotation_text(transform: SavedTransform) -> str:
    """Return a rotation as text: the angle, and the rotation vector."""
    if angle(transform) < _NOTHING:
        return "not turned"
    vector = np.rad2deg(so3.log(np.array(transform.wxyz)))
    numbers = ", ".join(rounded(float(v), 3) for v in vector)
    return f"{rounded(math.degrees(angle(transform)), 3)} deg, rotation vector [{numbers}] deg"


def enlarged(transform: SavedTransform) -> bool:
    """Whether a rotation is drawn larger than it is."""
    return _NOTHING < angle(transform) < _SMALL


def _axes(transform: SavedTransform, x: float, y: float, directions: str) -> str:
    turn = so3.log(np.array(transform.wxyz)) * (_ENLARGED if enlarged(transform) else 1.0)
    ends = _LENGTH * (_DIRECTIONS[directions] @ so3.matrix(so3.exp(turn)))
    lines = "".join(
        f'<path d="M{x:.0f} {y:.0f}l{dx:.1f} {dy:.1f}" stroke="var(--{axis})" stroke-width="2" '
        'stroke-dasharray="3 3" fill="none"/>'
        for axis, (dx, dy) in zip(AXES, ends.T, strict=True)
    )
    return f"<g>{lines}</g>"
