"""What has been collected of what each method needs, for the person recording.

These are rules of thumb about the motion; whether it was enough is what the sigmas say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from pipelines.graph.problem import Array

if TYPE_CHECKING:
    from pipelines.config import Config
    from pipelines.methods.cube.recording import CubeData
    from pipelines.methods.head.recording import HeadData
    from pipelines.methods.indexer.recording import IndexerData
    from pipelines.methods.los.recording import LosData

# A turn within this time, s, counts as motion about an axis ...
_STRETCH = 5.0
# ... from this angle on, rad: sway of a carrier, turns of a head and of the platform it sits in.
_SWAY, _NOD, _MANOEUVRE = np.deg2rad(2.0), np.deg2rad(10.0), np.deg2rad(5.0)
# Poses that determine the twelve numbers of a triad, and those of published practice: each of six faces thrice.
_FEWEST_POSES, _POSES_A_FACE = 4, 3
_AXES = "xyz"
_FACES = tuple(f"{sign}{axis}" for axis in _AXES for sign in "+-")


@dataclass(frozen=True)
class Collected:
    """One thing a method needs.

    Attributes:
        what: its name.
        have: how much there is, in words.
        wanted: what is still to be done, empty when it is enough.
    """

    what: str
    have: str
    wanted: str = ""


def collected_los(data: LosData, _: Config) -> Sequence[Collected]:
    """Sway about each axis of the carrier, and whether the target was in sight."""
    seen = f"{len(data.image_t)} LOS errors over {np.ptp(data.image_t):.0f} s"
    sway = _turned(data.gyro_t, data.gyro)
    spread = np.rad2deg(np.ptp(data.gimbal, axis=0))
    return (
        Collected("target", seen),
        *_motion("sway", sway, _SWAY, "sway the carrier about its"),
        Collected("gimbal", f"azimuth over {spread[0]:.0f}, elevation over {spread[1]:.0f} deg"),
    )


def collected_head(data: HeadData, _: Config) -> Sequence[Collected]:
    """Motion of the head, and of the platform where there is one."""
    found = [Collected("vision", f"{len(data.vision_t)} attitudes over {np.ptp(data.vision_t):.0f} s")]
    found += _motion("head", _turned(data.head_t, data.head_gyro), _NOD, "turn the head about its")
    if data.platform_t is not None and data.platform_gyro is not None:
        turned = _turned(data.platform_t, data.platform_gyro)
        found += _motion("platform", turned, _MANOEUVRE, "turn the platform about its")
    return found


def collected_indexer(data: IndexerData, _: Config) -> Sequence[Collected]:
    """Turns forward and back about each axis, by the angle at which the other one stands."""
    from pipelines.methods.indexer.runs import axis_motion

    turns: dict[tuple[str, int], list[int]] = {}
    for run in axis_motion(data).runs:
        if run.axis in ("outer", "inner"):
            # The publication has each axis turn with the other one at 0 and at 180 degrees.
            position = (run.axis, round(np.rad2deg(run.other) / 180.0) % 2 * 180)
            turns.setdefault(position, [0, 0])[0 if run.direction > 0 else 1] += run.whole_turns
    found = []
    for axis, other in (("outer", "inner"), ("inner", "outer")):
        for angle in (0, 180):
            forward, back = turns.get((axis, angle), [0, 0])
            lacking = [word for word, n in (("forward", forward), ("back", back)) if n < 3]
            wanted = f"three whole turns {' and '.join(lacking)}" if lacking else ""
            what = f"{axis} axis, {other} one at {angle} deg"
            found.append(Collected(what, f"{forward} turns forward, {back} back", wanted))
    return found


def collected_cube(data: CubeData, config: Config) -> Sequence[Collected]:
    """Poses and the faces that were up, tags seen, and the next best pose."""
    from pipelines.methods.cube.poses import static_poses

    poses = static_poses(data, config)
    up = poses.accel / np.linalg.norm(poses.accel, axis=1, keepdims=True)
    axis = np.argmax(np.abs(up), axis=1)
    faces = [f"{'+' if row[k] > 0.0 else '-'}{_AXES[k]}" for row, k in zip(up, axis, strict=True)]
    count = {face: faces.count(face) for face in _FACES}
    few = [face for face, n in count.items() if n < _POSES_A_FACE]
    tags = sorted({int(tag) for seen in poses.tags if seen is not None for tag in seen.ids})
    wanted = f"at least {_FEWEST_POSES}" if len(up) < _FEWEST_POSES else ""
    found = [
        Collected("poses", f"{len(up)} at rest", wanted),
        Collected(
            "faces up",
            ", ".join(f"{face} {n}" for face, n in count.items()),
            f"{_POSES_A_FACE} poses each recommended, too few of {', '.join(few)}" if few else "",
        ),
    ]
    if data.camera is not None:
        found.append(Collected("tags seen", ", ".join(map(str, tags)) or "none", "" if tags else "show the cube"))
    if few:
        found.append(Collected("next", f"{len(up) + 1}. pose", next_pose(up, poses.mag)))
    return found


def next_pose(up: Array, mag: Array | None) -> str:
    """The one of 24 attitudes along the axes that says most about accelerometer and magnetometer.

    What a pose with nominal vector n adds to what a triad's twelve numbers are known by is x'N^-1x, x = (n, 1), N the
    sum of xx' over the poses there are.
    """
    field, dip = None, 0.0  # directions of the earth's field, and the sine of its angle above the horizon
    if mag is not None and np.isfinite(mag).all(axis=1).any():
        seen = np.isfinite(mag).all(axis=1)
        field = mag[seen] / np.linalg.norm(mag[seen], axis=1, keepdims=True)
        dip = float(np.median((field * up[seen]).sum(axis=1)))
    known = _information(up)
    known_field = None if field is None else _information(field)
    best, most = "", -1.0
    axes = [sign * unit for unit in np.eye(3) for sign in (1.0, -1.0)]
    for (i, above), (k, north) in permutations(enumerate(axes), 2):
        if i // 2 == k // 2:
            continue
        gain = _gain(known, above)
        if known_field is not None:
            gain += _gain(known_field, dip * above + np.sqrt(max(1.0 - dip**2, 0.0)) * north)
        if gain > most * (1.0 + 1e-9):
            ahead = f" and {_FACES[k]} to the north" if known_field is not None else ""
            best, most = f"rest it with {_FACES[i]} up{ahead}", gain
    return best


def _information(vectors: Array) -> Array:
    rows = np.column_stack([vectors, np.ones(len(vectors))])
    return np.asarray(rows.T @ rows + 1e-3 * np.eye(4))


def _gain(information: Array, vector: Array) -> float:
    row = np.append(vector, 1.0)
    return float(row @ np.linalg.solve(information, row))


def _motion(name: str, turned: Array, enough: float, what: str) -> list[Collected]:
    return [
        Collected(
            f"{name} about {axis}",
            f"{np.rad2deg(angle):.1f} deg",
            "" if angle >= enough else f"{what} {axis} by {np.rad2deg(enough):.0f} deg and more",
        )
        for axis, angle in zip(_AXES, turned, strict=True)
    ]


def _turned(t: Array, gyro: Array) -> Array:
    """(3,) rad: how far it turned about each axis within a few seconds, at most."""
    rate = gyro - np.median(gyro, axis=0)
    angle = np.vstack([np.zeros(3), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t)[:, None], axis=0)])
    starts = np.searchsorted(t, np.arange(t[0], t[-1], _STRETCH))
    highest, lowest = np.maximum.reduceat(angle, starts), np.minimum.reduceat(angle, starts)
    return np.asarray((highest - lowest).max(axis=0))
