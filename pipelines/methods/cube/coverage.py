"""Which directions of the cube were up, on a map of all directions."""

from __future__ import annotations

import numpy as np

from pipelines.graph.problem import Array
from pipelines.methods.cube.tables import described, rows_of
from pipelines.reports.plots import COLORS, figure
from pipelines.reports.result import Calibration, Plot

# Directions farther than this from every pose, rad, are gaps; the second ones wide.
_GAPS = np.deg2rad([30.0, 45.0])
_GAP_COLORS = ("#f6dfae", "#e69f00")
_DIRECTIONS = 1500


def coverage(calibration: Calibration) -> Plot | None:
    """Directions of up in the body, on an equal-area map of the sphere, with the gaps between them."""
    up = np.array([row["up"] for row in rows_of(calibration, "static_poses")])
    if not len(up):
        return None
    away = _distances(up)
    widest = int(np.argmax(away))
    out = figure("", height=420, x_title="")
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61)
    for longitude in (-np.pi, np.pi):
        edge = _map(
            np.stack(
                [
                    np.cos(latitude) * np.cos(longitude * 0.999999),
                    np.cos(latitude) * np.sin(longitude * 0.999999),
                    np.sin(latitude),
                ],
                axis=1,
            )
        )
        out.add_scatter(
            x=edge[:, 0], y=edge[:, 1], mode="lines", line={"color": "#c3ccd4"}, hoverinfo="skip", showlegend=False
        )
    ends = (*_GAPS[1:], np.inf)
    for low, high, color in zip(_GAPS, ends, _GAP_COLORS, strict=True):
        some = _map(_SPHERE[(away > low) & (away <= high)])
        out.add_scatter(
            x=some[:, 0],
            y=some[:, 1],
            mode="markers",
            hoverinfo="skip",
            name=f"no pose within {np.rad2deg(low):.0f} deg",
            marker={"color": color, "size": 6},
        )
    at = _map(up)
    hover = [f"pose {k + 1}: {described(direction)}" for k, direction in enumerate(up)]
    out.add_scatter(
        x=at[:, 0],
        y=at[:, 1],
        mode="markers",
        name="poses",
        text=hover,
        hoverinfo="text",
        marker={"color": COLORS[0], "size": 9, "line": {"color": "white", "width": 1}},
    )
    faces = np.vstack([np.eye(3), -np.eye(3)])
    where = _map(faces)
    out.add_scatter(
        x=where[:, 0],
        y=where[:, 1],
        mode="text",
        text=["+x", "+y", "+z", "-x", "-y", "-z"],
        textfont={"size": 14, "color": "#1b2530"},
        hoverinfo="skip",
        showlegend=False,
    )
    out.update_xaxes(visible=False, range=[-3.0, 3.0])
    out.update_yaxes(visible=False, scaleanchor="x", range=[-1.6, 1.6])
    return Plot(
        "Attitudes covered",
        f"Which direction of the body was up in each of the {len(up)} static poses, on an equal-area map of all "
        f"directions. The middle of the widest gap is {np.rad2deg(away[widest]):.0f} deg from every pose, "
        f"at {described(_SPHERE[widest])}.",
        out,
    )


def _spread(count: int) -> Array:
    """Directions (count, 3) spread evenly over the sphere, by the golden angle."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn_ = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(turn_), np.sqrt(1.0 - z**2) * np.sin(turn_), z], axis=1)


_SPHERE = _spread(_DIRECTIONS)


def _distances(up: Array) -> Array:
    """Angles, rad, from each direction of the sphere to the nearest of `up` (P, 3)."""
    return np.asarray(np.arccos(np.clip((_SPHERE @ up.T).max(axis=1), -1.0, 1.0)))


def _map(directions: Array) -> Array:
    """Places (n, 2) of directions (n, 3) on Hammer's equal-area map, +x in the middle, +z on top."""
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    sine = np.clip(directions[:, 2], -1.0, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    z = np.sqrt(1.0 + cosine * np.cos(0.5 * longitude))
    x, y = 2.0 * np.sqrt(2.0) * cosine * np.sin(0.5 * longitude) / z, np.sqrt(2.0) * sine / z
    return np.stack([-x, y], axis=1)
