"""Pictures of motions, for the person who holds the device, and of frames: SVG, drawn from numbers.

Lines have the colour of the text around them; what moves or matters has the accent: the page's
CSS variable --accent; its --paper is what is behind.

The sketch of a method's frames is an SVG file. Where it has `<g class="found" data-turn="M" data-x="12" data-y="34">`,
the axes of the child of that transform of calibration.yaml are drawn dashed from that point, where the parent's are,
enlarged where they would not show. With `data-axes="camera"` the parent is drawn as a camera, z forward.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from html import escape

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.display.units import rounded

# Where the eye is: of the world behind, to the right and above; of a body's axes where all three come towards it.
BEHIND, _BEFORE = (0.42, -0.78, 0.46), (0.72, 0.5, 0.48)
_PLAIN, _LIT, _PAPER = "currentColor", "var(--accent, #0b63ce)", "var(--paper, white)"
_SIZE, _UNIT = 220.0, 50.0
_AXES = np.eye(3)
_NAMES = "xyz"
# A direction counts as covered as far as this from one that was there, rad.
_NEAR = np.deg2rad(30.0)
# Directions closer together than this are drawn as one, rad.
_SAME = np.deg2rad(6.0)
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


class Drawing:
    """Lines and faces in three dimensions, z up, drawn in the order in which they are given.

    Args:
        eye: (3,) direction from which it is seen.
    """

    def __init__(self, eye: Sequence[float]) -> None:
        self.eye = np.asarray(eye) / np.linalg.norm(eye)
        right = np.cross(_AXES[2], self.eye)
        right = right / np.linalg.norm(right)
        self.projection = np.stack([right, -np.cross(self.eye, right)])  # (2, 3): to the right and down
        self._parts: list[str] = []

    def line(self, points: Iterable[Array], lit: bool = False, width: float = 1.5, arrows: str = "") -> None:
        """Draw a line through points (3,); `arrows` at its "start", its "end" or both."""
        flat = self._flat(np.array(list(points)))
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in flat)
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{_LIT if lit else _PLAIN}" stroke-width="{width}" '
            'stroke-linecap="round" stroke-linejoin="round"/>'
        )
        if "end" in arrows:
            self._head(flat[-1], flat[-1] - flat[-3 if len(flat) > 2 else -2], lit, width)
        if "start" in arrows:
            self._head(flat[0], flat[0] - flat[2 if len(flat) > 2 else 1], lit, width)

    def face(self, corners: Array, lit: bool = False) -> None:
        """Draw a filled polygon with corners (n, 3)."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in self._flat(corners))
        colour, opacity = (_LIT, 0.4) if lit else (_PLAIN, 0.1)
        self._parts.append(
            f'<polygon points="{path}" fill="{_PAPER}"/>'  # what is behind does not shine through
            f'<polygon points="{path}" fill="{colour}" fill-opacity="{opacity}" stroke="{_PLAIN}" stroke-width="1.5" '
            'stroke-linejoin="round"/>'
        )

    def arc(self, axis: Array, middle: Array, radius: float, degrees: tuple[float, float], arrows: str) -> None:
        """Draw an arc about an axis (3,) with the centre `middle` (3,); 0 deg is where it is nearest to the eye."""
        towards = self.eye - (self.eye @ axis) * axis
        towards = towards / np.linalg.norm(towards)
        across = np.cross(axis, towards)
        angles = np.deg2rad(np.linspace(*degrees, 41))[:, None]
        self.line(middle + radius * (np.cos(angles) * towards + np.sin(angles) * across), True, 4.0, arrows)

    def word(self, at: Array, text: str, lit: bool = False, size: float = 15.0) -> None:
        """Write a word centred at a point (3,)."""
        ((x, y),) = self._flat(at[None])
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" font-weight="600" text-anchor="middle" '
            f'dominant-baseline="central" fill="{_LIT if lit else _PLAIN}">{escape(text)}</text>'
        )

    def word_on(self, middle: Array, along: Array, up: Array, text: str) -> None:
        """Write a word in a plane: it runs along one direction (3,), its top towards another (3,)."""
        ((x, y),), right, down = self._flat(middle[None]), self.projection @ along, -self.projection @ up
        matrix = " ".join(f"{v:.3f}" for v in (*right, *down, x, y))
        self._parts.append(
            f'<text transform="matrix({matrix})" font-size="34" font-weight="700" text-anchor="middle" '
            f'dominant-baseline="central" fill="{_PLAIN}">{escape(text)}</text>'
        )

    def svg(self, label: str) -> str:
        """Return the picture as SVG; screen readers read the label."""
        half = 0.5 * _SIZE
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-half:g} {-half:g} {_SIZE:g} {_SIZE:g}" role="img" '
            f'aria-label="{escape(label)}">{"".join(self._parts)}</svg>'
        )

    def _flat(self, points: Array) -> Array:
        """Project points (n, 3) onto the picture (n, 2)."""
        return _UNIT * np.asarray(points) @ self.projection.T

    def _head(self, tip: Array, along: Array, lit: bool, width: float) -> None:
        forward = along / max(float(np.linalg.norm(along)), 1e-9)
        aside = np.array([-forward[1], forward[0]])
        length = 6.0 + 2.0 * width
        corners = [
            tip + 0.4 * length * forward,
            tip - length * (0.6 * forward - 0.5 * aside),
            tip - length * (0.6 * forward + 0.5 * aside),
        ]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        self._parts.append(f'<polygon points="{path}" fill="{_LIT if lit else _PLAIN}"/>')


@cache
def swaying(axes: str, who: str, size: tuple[float, float, float] = (0.8, 1.1, 0.45)) -> str:
    """Return an SVG picture of a body that sways about some of its axes.

    Args:
        axes: of "xyz".
        who: sways, in a word.
        size: half its edges along x, y and z.
    """
    out = Drawing(_BEFORE)
    _block_with_axes(out, np.array(size), axes)
    return out.svg(f"the {who}, swaying about {' and '.join(axes)}")


def resting(nRb: Array, compass: bool = False, lit: Array | None = None) -> str:
    """Return an SVG picture of a cube at rest in the attitude nRb (4,), with an arrow up and maybe one north.

    `lit` (3,) is a direction in the body to be drawn out of the cube.
    """
    out = Drawing(BEHIND)
    if compass:
        out.line([np.array([1.6, -0.9, -1.0]), np.array([1.6, 0.7, -1.0])], False, 2.5, "end")
        out.word(np.array([1.6, 1.1, -1.0]), "N", False, 17.0)
    names = [f"{sign}{axis}" for axis in _NAMES for sign in "+-"]
    normals = so3.rotate(nRb, np.repeat(_AXES, 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None])
    top = int(np.argmax(normals[:, 2]))
    for i in np.argsort(normals @ out.eye)[3:]:
        _side(out, nRb, normals[i], names[i], i == top and lit is None)
    if lit is None:  # beside the name of the top
        foot, up = np.array([-0.6, 0.6, 1.0]), _AXES[2]
    else:
        body = lit / np.linalg.norm(lit)
        up = so3.rotate(nRb, body)
        foot = up / np.abs(body).max()  # where it leaves the cube
    out.line([foot, foot + 0.55 * up], True, 4.0, "end")
    out.word(foot + 0.83 * up, "up", True)
    return out.svg(f"a cube resting with {names[top]} up")


def along(direction: Array, name: str) -> str:
    """Return an SVG picture of the device in its own axes, with a named arrow along a direction (3,)."""
    unit = direction / np.linalg.norm(direction)
    out = Drawing(_BEFORE)
    hidden = bool(unit @ out.eye < 0.0)
    reach = 0.7 / np.abs(unit).max()

    def arrow() -> None:
        out.line([reach * unit, (reach + 1.0) * unit], True, 4.0, "end")
        out.word((reach + 1.25) * unit, name, True)

    if hidden:
        arrow()
    _block_with_axes(out, np.array([0.7, 0.7, 0.7]))
    if not hidden:
        arrow()
    return out.svg(f"the device, and {name} in its axes")


def covered(directions: Array, what: str) -> str:
    """Return an SVG map of covered directions (n, 3) of a body: upper and lower half of the sphere, seen from above.

    Lambert's equal-area map; painted is what is within 30 deg of a direction that was there, an ellipse in good
    approximation.
    """
    radius = 90.0
    kept: list[Array] = []
    for one in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        if not kept or np.max(np.array(kept) @ one) < np.cos(_SAME):
            kept.append(one)
    parts = []
    for half, (sign, middle) in enumerate(((1.0, -100.0), (-1.0, 100.0))):
        clip = f"half{half}"
        parts.append(
            f'<clipPath id="{clip}"><circle cx="{middle:g}" cy="0" r="{radius:g}"/></clipPath>'
            f'<circle cx="{middle:g}" cy="0" r="{radius:g}" fill="{_PLAIN}" fill-opacity=".08" stroke="{_PLAIN}" '
            'stroke-opacity=".4"/>'
        )
        paint, dots = "", ""
        for x, y, z in kept:
            colatitude = float(np.arccos(np.clip(sign * z, -1.0, 1.0)))
            if colatitude > 0.5 * np.pi + _NEAR:
                continue
            reach, turn = radius * np.sqrt(2.0) * np.sin(0.5 * colatitude), float(np.arctan2(y, x))
            at = f"{middle + reach * np.cos(turn):.1f} {-reach * np.sin(turn):.1f}"
            size, ratio = radius * np.sqrt(2.0) * np.sin(0.5 * _NEAR), float(np.cos(0.5 * colatitude))
            paint += (
                f'<ellipse rx="{size * ratio:.1f}" ry="{size / ratio:.1f}" '
                f'transform="translate({at}) rotate({-np.rad2deg(turn):.0f})"/>'
            )
            dots += f'<circle r="3" transform="translate({at})"/>' if colatitude <= 0.5 * np.pi else ""
        parts.append(
            f'<g clip-path="url(#{clip})" fill="{_LIT}"><g opacity=".35">{paint}</g>{dots}</g>'
            f'<g font-size="16" font-weight="600" text-anchor="middle" dominant-baseline="central" fill="{_PLAIN}">'
            f'<text x="{middle:g}" y="0">{"+" if sign > 0.0 else "-"}z</text>'
            f'<text x="{middle + 78:g}" y="0">+x</text><text x="{middle - 78:g}" y="0">-x</text>'
            f'<text x="{middle:g}" y="-78">+y</text><text x="{middle:g}" y="78">-y</text></g>'
        )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-200 -100 400 200" role="img" aria-label="{escape(what)}">'
        f"{''.join(parts)}</svg>"
    )


def sketch_with(svg: str, turns: Mapping[str, Array]) -> str:
    """Return a sketch with rotation vectors (3,), rad, drawn in their places, by name; other places are unchanged."""

    def drawn(match: re.Match[str]) -> str:
        if match[1] not in turns:
            return match[0]
        turn = turns[match[1]] * (_ENLARGED if _is_enlarged(turns[match[1]]) else 1.0)
        ends = _LENGTH * (_DIRECTIONS[match[4] or "body"] @ so3.matrix(so3.exp(turn)))
        lines = "".join(
            f'<path d="M{match[2]} {match[3]}l{x:.1f} {y:.1f}" stroke="var(--{axis})" stroke-width="2" '
            'stroke-dasharray="3 3" fill="none"/>'
            for axis, (x, y) in zip(_NAMES, ends.T, strict=True)
        )
        return f"{match[0]}<g>{lines}</g>"

    return _PLACE.sub(drawn, svg)


def rotation_text(turn: Array) -> str:
    """Return a rotation vector (3,), rad, as text: the angle, the vector, and whether it is drawn larger than it is."""
    angle = float(np.linalg.norm(turn))
    if angle < _NOTHING:
        return "not turned"
    numbers = ", ".join(rounded(float(v), 3) for v in np.rad2deg(turn))
    scale = "; drawn ten times as large" if _is_enlarged(turn) else ""
    return f"{rounded(math.degrees(angle), 3)} deg, rotation vector [{numbers}] deg{scale}"


def _is_enlarged(turn: Array) -> bool:
    return bool(_NOTHING < np.linalg.norm(turn) < _SMALL)


def _side(out: Drawing, nRb: Array, normal: Array, name: str, lit: bool) -> None:
    """Draw a side of a cube in the attitude nRb (4,), with its name as upright as possible."""
    edges = so3.rotate(nRb, np.delete(_AXES, _NAMES.index(name[1]), axis=0))
    out.face(np.array([normal + a * edges[0] + b * edges[1] for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]), lit)
    tops = np.vstack([edges, -edges])
    up = tops[np.argmin(tops @ out.projection[1])]
    out.word_on(normal, np.cross(up, normal), up, name)


def _block_with_axes(out: Drawing, half: Array, lit: str = "") -> None:
    """Draw a block with its three axes as arrows towards the eye; lit axes have arrows of rotation both ways."""
    for k in range(3):
        corners = np.full((4, 3), half[k])
        for column, signs in zip(((k + 1) % 3, (k + 2) % 3), ((1, 1, -1, -1), (1, -1, -1, 1)), strict=True):
            corners[:, column] = half[column] * np.array(signs)
        out.face(corners)
    for k, axis in enumerate(_AXES):
        is_lit = _NAMES[k] in lit
        end = half[k] + (1.0 if is_lit else 0.6)
        out.line([half[k] * axis, end * axis], is_lit, 3.0 if is_lit else 1.5, "end")
        out.word((end + 0.28) * axis, _NAMES[k], is_lit, 17.0)
        if is_lit:
            out.arc(axis, (half[k] + 0.55) * axis, 0.38, (-130.0, 130.0), "start end")
