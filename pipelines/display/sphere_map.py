"""Directions in a body on an equal-area map of the sphere, with the gaps between them."""

from __future__ import annotations

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.display.figure import COLORS, GRID, Figure

# Directions farther than this from all there are, rad, are gaps; the second ones wide.
_GAPS = np.deg2rad([30.0, 45.0])
_GAP_COLORS = ("gap", COLORS[1])
_DIRECTIONS = 1500


def described(direction: object) -> str:
    """Return a direction (3,) in words: the nearest axis, and towards which axis the direction leans."""
    unit = np.asarray(direction, dtype=float) / np.linalg.norm(np.asarray(direction, dtype=float))
    first, second = np.argsort(-np.abs(unit))[:2]
    lean = np.rad2deg(np.arccos(np.clip(abs(unit[first]), 0.0, 1.0)))
    words = _side(first, unit[first])
    return words if lean < 5.0 else f"{words}, {lean:.0f} deg towards {_side(second, unit[second])}"


def widest_gap(directions: Array) -> tuple[float, Array]:
    """Return the radius, rad, of the widest gap between unit vectors (n, 3), and the direction (3,) at its centre."""
    away = _distances(directions)
    widest = int(np.argmax(away))
    return float(away[widest]), _SPHERE[widest]


def share_near(directions: Array) -> float:
    """Share of the sphere's area that lies within 30 deg of some of the directions (n, 3)."""
    return float(np.mean(_distances(directions) <= _GAPS[0]))


def sphere_map(directions: Array, names: list[str], what: str) -> Figure:
    """Return a map of unit vectors (n, 3) of the body, with the gaps between them.

    Args:
        directions: as above.
        names: of each, shown when it is pointed at.
        what: they are, in a word.
    """
    away = _distances(directions)
    out = Figure("", "", 420, square=True, bare=True)
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)
    for longitude in (-np.pi, np.pi):
        at_edge = 0.999999 * longitude
        across = np.cos(latitude)
        edge = _map(np.stack([across * np.cos(at_edge), across * np.sin(at_edge), np.sin(latitude)], axis=1))
        out.line(edge[:, 0], edge[:, 1], color=GRID)
    for low, high, color in zip(_GAPS, (*_GAPS[1:], np.inf), _GAP_COLORS, strict=True):
        some = _map(_SPHERE[(away > low) & (away <= high)])
        out.points(some[:, 0], some[:, 1], f"no {what} within {np.rad2deg(low):.0f} deg", color, 6)
    at = _map(directions)
    out.points(at[:, 0], at[:, 1], f"{what}s", COLORS[0], 9, texts=names)
    where = _map(np.vstack([np.eye(3), -np.eye(3)]))
    out.words(where[:, 0], where[:, 1], ("+x", "+y", "+z", "-x", "-y", "-z"))
    return out


def _spread(count: int) -> Array:
    """Directions (count, 3) spread evenly over the sphere, by the golden angle."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn_ = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(turn_), np.sqrt(1.0 - z**2) * np.sin(turn_), z], axis=1)


_SPHERE = _spread(_DIRECTIONS)


def _distances(directions: Array) -> Array:
    """Angles, rad, from each direction of the sphere to the nearest of `directions` (n, 3)."""
    return np.asarray(np.arccos(np.clip((_SPHERE @ directions.T).max(axis=1), -1.0, 1.0)))


def _map(directions: Array) -> Array:
    """Project directions (n, 3) to places (n, 2) on Hammer's equal-area map, +x in the middle, +z on top."""
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    sine = np.clip(directions[:, 2], -1.0, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    z = np.sqrt(1.0 + cosine * np.cos(0.5 * longitude))
    x, y = 2.0 * np.sqrt(2.0) * cosine * np.sin(0.5 * longitude) / z, np.sqrt(2.0) * sine / z
    return np.stack([-x, y], axis=1)


def _side(axis: int, value: float) -> str:
    return f"{'+' if value > 0.0 else '-'}{'xyz'[axis]}"
