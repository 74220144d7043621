"""What the person recording a cube is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.display.drawing import covered
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.cube.data import CubeData
from alidade.pipelines.methods.cube.faces import SIDES, Side
from alidade.pipelines.methods.cube.picture import rested
from alidade.pipelines.methods.cube.poses import static_poses
from alidade.pipelines.settings import Config

# Poses that determine the twelve numbers of a triad, and those of published practice: each of six faces thrice.
_FEWEST_POSES, _POSES_A_FACE = 4, 3
_FACES: tuple[Side, ...] = tuple(SIDES)


def checklist(data: CubeData, config: Config) -> Sequence[ChecklistItem]:
    """Poses and the faces that were up, tags seen, and the next best pose."""
    poses = static_poses(data, config)
    up = poses.accel / np.linalg.norm(poses.accel, axis=1, keepdims=True)
    faces = np.argmax(up @ np.array(list(SIDES.values())).T, axis=1)
    count = {face: int((faces == k).sum()) for k, face in enumerate(_FACES)}
    few = [face for face, n in count.items() if n < _POSES_A_FACE]
    tags = sorted({int(tag) for seen in poses.tags if seen is not None for tag in seen.ids})
    wanted = f"at least {_FEWEST_POSES}" if len(up) < _FEWEST_POSES else ""
    found = [
        ChecklistItem("poses", f"{len(up)} at rest", wanted, min(len(up) / _FEWEST_POSES, 1.0)),
        ChecklistItem(
            "faces up",
            ", ".join(f"{face} {n}" for face, n in count.items()),
            f"{_POSES_A_FACE} poses each recommended, too few of {', '.join(few)}" if few else "",
            sum(min(n, _POSES_A_FACE) for n in count.values()) / (_POSES_A_FACE * len(count)),
            chart=covered(up, "sides up") if len(up) else "",
        ),
    ]
    if data.camera is not None:
        found.append(ChecklistItem("tags seen", ", ".join(map(str, tags)) or "none", "" if tags else "show the cube"))
    if few:
        pose = next_pose(up, poses.mag)
        found.append(ChecklistItem("next", f"{len(up) + 1}. pose", pose.words, motion=pose))
    return found


def next_pose(up: Array, mag: Array | None) -> Motion:
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
    best, most = Motion(""), -1.0
    axes = [sign * unit for unit in np.eye(3) for sign in (1.0, -1.0)]
    for (i, above), (k, north) in permutations(enumerate(axes), 2):
        if i // 2 == k // 2:
            continue
        gain = _gain(known, above)
        if known_field is not None:
            gain += _gain(known_field, dip * above + np.sqrt(max(1.0 - dip**2, 0.0)) * north)
        if gain > most * (1.0 + 1e-9):
            ahead = f" and {_FACES[k]} to the north" if known_field is not None else ""
            picture = rested(_FACES[i], None if known_field is None else _FACES[k])
            best, most = Motion(f"rest the cube with {_FACES[i]} up{ahead}", picture), gain
    return best


def _information(vectors: Array) -> Array:
    rows = np.column_stack([vectors, np.ones(len(vectors))])
    return np.asarray(rows.T @ rows + 1e-3 * np.eye(4))


def _gain(information: Array, vector: Array) -> float:
    row = np.append(vector, 1.0)
    return float(row @ np.linalg.solve(information, row))
