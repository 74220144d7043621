"""Faults of a camera's description, by which no tag fits: order of corners, size of the picture, rectified pictures.

Each is found from the reprojection errors of poses with several tags, before anything else is estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import TagBody, estimate_pose
from alidade.pipelines.vision.tags import Detections

# Poses that are tried, and the fewest that decide.
_POSES, _FEWEST = 5, 3
# A correction explains the misfit if errors fall by this factor; the median over poses scatters by a tenth of that.
_BETTER = 2.0
# Corners as a message of apriltag_ros has them, seen on the upright tag.
_CORNERS = ("bottom left", "bottom right", "top right", "top left")
# Sizes of pictures over that of the camera_info: by halves, thirds and quarters.
_SCALES = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)

# The fault, what to do about it, and the camera and the order of corners without it.
_Case = tuple[str, str, Camera, Sequence[int]]


def camera_fault(camera: Camera, body: TagBody, seen: Sequence[Detections], sigma_px: float) -> str | None:
    """Find the camera fault that explains why tags do not fit their layout, with a remedy; None if none does.

    Args:
        camera: as recorded.
        body: the layout.
        seen: tags of static poses; those with one tag alone are left out.
        sigma_px: of a corner; errors up to twice that are none of the camera's.
    """
    several = [each for each in seen if len(each.ids) > 1]
    if len(several) < _FEWEST:
        return None
    several = several[:: -(-len(several) // _POSES)]
    recorded = _error(camera, body, several)
    if recorded <= 2.0 * sigma_px:
        return None
    errors = [(_error(other, body, several, order), what, to_do) for what, to_do, other, order in _cases(camera)]
    best, what, to_do = min(errors)
    if best > 2.0 * sigma_px or best * _BETTER > recorded:
        return None
    return f"{what} (tags then fit their layout to {best:.2g} px RMS, as recorded to {recorded:.2g} px); {to_do}"


def _cases(camera: Camera) -> Iterator[_Case]:
    upright = range(4)
    for first, step in product(upright, (1, -1)):
        order = [(first + step * k) % 4 for k in upright]
        if order != list(upright):
            what = f"the corners of all tags come as {', '.join(_CORNERS[order.index(k)] for k in upright)}"
            yield what, f"record them as {', '.join(_CORNERS)}, as apriltag_ros does", camera, order
    for scale in _SCALES:
        size = f"{camera.width * scale:.0f}x{camera.height * scale:.0f}"
        what = (
            f"camera_info ({camera.width}x{camera.height}) is not of these pictures: {size} fits, K times {scale:.3g}"
        )
        to_do = "record the camera_info of the pictures that tags are detected in"
        yield what, to_do, replace(camera, K=np.diag([scale, scale, 1.0]) @ camera.K), upright
    for name, K in {"K": camera.K, "P": camera.rectified}.items():
        if K is not None:
            what = f"the corners are of rectified pictures, camera_info of the raw ones: D = 0 with K = {name} fits"
            to_do = "record the camera_info of the rectified pictures, or detect tags in the raw ones"
            yield what, to_do, Camera(camera.width, camera.height, K), upright


def _error(camera: Camera, body: TagBody, seen: Sequence[Detections], order: Sequence[int] = range(4)) -> float:
    """Median reprojection error, px per axis; infinite if most poses reject a tag or have no solution."""
    rows = list(order)
    poses = [
        estimate_pose(camera, body, replace(each, corners=each.corners[:, rows], covariance=each.covariance[:, rows]))
        for each in seen
    ]
    return float(np.median([np.inf if pose is None or pose.rejected else pose.rms_px for pose in poses]))
