"""What is seen of tags on a body, where they would be seen, and how that follows all poses.

A corner at q in a tag's frame is at P = cRb (position of the tag + bRt q) + position of the picture in the camera's
frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factors import so3
from pipelines.vision.camera import Camera
from pipelines.vision.pose import SQUARE, TagBody

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# A corner behind the camera, sigmas: a residual that no step may leave there.
_BEHIND = 1e4


@dataclass(frozen=True, eq=False)
class Sights:
    """Tags in pictures, by ascending picture.

    Attributes:
        picture, tag: (m,) indices.
        corners: (m, 4, 2) px.
        sigma: (m,) of a corner, px per axis.
    """

    picture: Index
    tag: Index
    corners: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.picture)

    def __getitem__(self, keep: Index | NDArray[np.bool_]) -> Sights:
        return Sights(self.picture[keep], self.tag[keep], self.corners[keep], self.sigma[keep])


@dataclass(frozen=True, eq=False)
class Bundle:
    """All that is adjusted.

    Attributes:
        cameras: one or more.
        camera: (f,) index of the camera of each picture.
        body: the tags.
        cRb, position: (f, 4), (f, 3) m, where the body stands in the camera's frame in each picture.
    """

    cameras: tuple[Camera, ...]
    camera: Index
    body: TagBody
    cRb: Array
    position: Array


@dataclass(frozen=True, eq=False)
class Rows:
    """Reprojection errors (m, 8) in sigmas and their Jacobians.

    By [delta, epsilon]: cRb Exp(delta), position + epsilon of pictures, `by_picture` (m, 8, 6), and bRt Exp(delta),
    position + epsilon of tags, `by_tag` (m, 8, 6). `points` (m, 4, 3) are the corners in the camera's frame, m.
    """

    miss: Array
    by_picture: Array
    by_tag: Array
    points: Array

    @cached_property
    def squares(self) -> Array:
        """(m,) sums of squares."""
        return np.asarray((self.miss**2).sum(axis=1))


def linearized(bundle: Bundle, sights: Sights) -> Rows:
    """Errors (predicted - seen) of all sights and how they follow the poses."""
    m, body = len(sights), bundle.body
    cRb, bRt = bundle.cRb[sights.picture], body.bRt[sights.tag]
    local = SQUARE * body.size[sights.tag][:, None, None]
    in_body = body.position[sights.tag][:, None] + so3.rotate(bRt[:, None], local)
    points = so3.rotate(cRb[:, None], in_body) + bundle.position[sights.picture][:, None]
    seen, by_point = np.empty((m, 4, 2)), np.empty((m, 4, 2, 3))
    for k, camera in enumerate(bundle.cameras):
        mine = bundle.camera[sights.picture] == k
        seen[mine], by_point[mine] = camera.project(points[mine]), camera.by_point(points[mine])
    good = np.asarray(np.isfinite(seen).all(axis=2) & np.isfinite(by_point).all(axis=(2, 3)))
    weight = 1.0 / sights.sigma[:, None, None]
    miss = np.where(good[..., None], weight * (seen - sights.corners), _BEHIND)
    by_point = np.where(good[..., None, None], weight[..., None] * by_point, 0.0)
    in_b = by_point @ so3.matrix(cRb)[:, None]
    by_picture = np.concatenate([-in_b @ so3.hat(in_body), by_point], axis=-1)
    by_tag = np.concatenate([-in_b @ so3.matrix(bRt)[:, None] @ so3.hat(local), in_b], axis=-1)
    return Rows(miss.reshape(m, 8), by_picture.reshape(m, 8, 6), by_tag.reshape(m, 8, 6), points)
