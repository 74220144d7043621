"""What is seen of tags on a body, where they would be seen, and how that follows all poses.

A corner at q in a tag's frame is at P = cRb (position of the tag + bRt q) + position of the picture in the camera's
frame. A shutter that rolls sees it when its row is exposed, at an attitude cRb Exp(w t) and a position v t farther.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.so3 import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import SQUARE, TagBody

Index = NDArray[np.intp]

# A corner behind the camera, sigmas: a residual that no step may leave there. Beside the camera, farther than so many
# px, how it moves has no digits left.
_BEHIND, _FARTHEST = 1e4, 1e6


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
        time: (f,) s, NaN where it is not known.
        motion: (f, 6) per s, of the body in each picture, as far as it is known: turn w, rad in b, and velocity v, m in
            the camera's frame.
        line_time: (c,) s, from one row of a picture to the next; a picture's pose is that at its middle row.
    """

    cameras: tuple[Camera, ...]
    camera: Index
    body: TagBody
    cRb: Array
    position: Array
    time: Array
    motion: Array
    line_time: Array

    @classmethod
    def of(cls, cameras: tuple[Camera, ...], camera: Index, body: TagBody, cRb: Array, position: Array) -> Bundle:
        """As if nothing moved while a picture is taken."""
        f = len(cRb)
        return cls(cameras, camera, body, cRb, position, np.full(f, np.nan), np.zeros((f, 6)), np.zeros(len(cameras)))

    def lines(self, sights: Sights) -> Array:
        """(m, 4) by how many rows corners are below the middle of their picture."""
        middle = np.array([0.5 * (camera.height - 1) for camera in self.cameras])
        return np.asarray(sights.corners[..., 1] - middle[self.camera[sights.picture], None])


@dataclass(frozen=True, eq=False)
class Rows:
    """Reprojection errors in sigmas, and their Jacobians, which are found when they are first asked for.

    Attributes:
        miss: (m, 8) predicted - seen.
        points: (m, 4, 3) m, the corners in the camera's frame when they were seen.
        by_point: (m, 4, 2, 3) how errors follow these.
        cRb: (m, 1, 4) of the picture, at its middle row.
        turn: (m, 4, 4) of the body from then until its corner is seen, None where no shutter rolls.
        turned: (m, 4, 3) m, the corners in the body's frame, turned so.
        bRt: (m, 4) of the tag.
        local: (m, 4, 3) m, the corners in the tag's frame.
        motion: (m, 1, 6) of the body, as a bundle has it.
    """

    miss: Array
    points: Array
    by_point: Array
    cRb: Array
    turn: Array | None
    turned: Array
    bRt: Array
    local: Array
    motion: Array

    @cached_property
    def squares(self) -> Array:
        """(m,) sums of squares."""
        return np.asarray((self.miss**2).sum(axis=1))

    @cached_property
    def by_picture(self) -> Array:
        """(m, 8, 6) by [delta, epsilon] of pictures: cRb Exp(delta), position + epsilon."""
        by = np.concatenate([-self._by_turned @ so3.hat(self.turned), self.by_point], axis=-1)
        return by.reshape(-1, 8, 6)

    @cached_property
    def by_tag(self) -> Array:
        """(m, 8, 6) by [delta, epsilon] of tags: bRt Exp(delta), position + epsilon."""
        in_b = self._by_turned if self.turn is None else self._by_turned @ so3.matrix(self.turn)
        in_t = in_b @ so3.matrix(self.bRt)[:, None]
        return np.concatenate([-in_t @ so3.hat(self.local), in_b], axis=-1).reshape(-1, 8, 6)

    @property
    def velocity(self) -> Array:
        """(m, 4, 3) m/s, of the corners in the camera's frame."""
        w, v = np.split(self.motion, 2, axis=-1)
        return np.asarray(so3.rotate(self.cRb, so3.cross(w, self.turned)) + v)

    @cached_property
    def _by_turned(self) -> Array:
        return np.asarray(self.by_point @ so3.matrix(self.cRb))


def linearized(bundle: Bundle, sights: Sights) -> Rows:
    """Errors (predicted - seen) of all sights and how they follow the poses."""
    m, body = len(sights), bundle.body
    cRb, bRt, motion = bundle.cRb[sights.picture][:, None], body.bRt[sights.tag], bundle.motion[sights.picture][:, None]
    w, v = np.split(motion, 2, axis=-1)
    t = (bundle.line_time[bundle.camera[sights.picture], None] * bundle.lines(sights))[..., None]
    local = SQUARE * body.size[sights.tag][:, None, None]
    in_body = body.position[sights.tag][:, None] + so3.rotate(bRt[:, None], local)
    turn = so3.exp(w * t) if t.any() else None
    turned = in_body if turn is None else so3.rotate(turn, in_body)
    points = so3.rotate(cRb, turned) + bundle.position[sights.picture][:, None] + v * t
    seen, by_point = np.empty((m, 4, 2)), np.empty((m, 4, 2, 3))
    for k, camera in enumerate(bundle.cameras):
        mine = bundle.camera[sights.picture] == k
        seen[mine], by_point[mine] = camera.project_with_jacobian(points[mine])
    good = np.asarray((np.abs(seen) < _FARTHEST).all(axis=2) & np.isfinite(by_point).all(axis=(2, 3)))
    weight = 1.0 / sights.sigma[:, None, None]
    miss = np.where(good[..., None], weight * (seen - sights.corners), _BEHIND)
    by_point = np.where(good[..., None, None], weight[..., None] * by_point, 0.0)
    return Rows(miss.reshape(m, 8), points, by_point, cRb, turn, turned, bRt, local, motion)
