"""What is seen of tags on a body, where they would be seen, and how that follows all poses.

A corner at q in a tag's frame is at P = cRb (position of the tag + bRt q) + position of the picture in the camera's
frame. A shutter that rolls sees it when its row is exposed, at an attitude cRb Exp(w t) and a position v t farther.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import SQUARE, TagBody, seen_once
from alidade.pipelines.vision.tags import Detections

Index = NDArray[np.intp]

# A corner behind the camera, sigmas: a residual that no step may leave there. Beside the camera, farther than so many
# px, how it moves has no digits left.
_BEHIND, _FARTHEST = 1e4, 1e6
# Corners that differ by less than this many sigmas, root mean square, stand still; noise alone makes it 1.4.
_STILL = 2.0
# No corner is taken to be better than this, px.
_LEAST_PX = 0.03
_LATER: Any = None


@dataclass(frozen=True, eq=False)
class Sights:
    """Sightings of tags in pictures, by ascending picture.

    Attributes:
        picture, tag: (m,) indices.
        corners: (m, 4, 2) px.
        sigma: (m,) of a corner, px per axis.
        cRt, place: (m, 2, 4), (m, 2, 3) m, both poses of each tag by itself; None before `placing.with_flips`.
    """

    picture: Index
    tag: Index
    corners: Array
    sigma: Array
    cRt: Array = _LATER
    place: Array = _LATER

    def __len__(self) -> int:
        return len(self.picture)

    def __getitem__(self, keep: Index | NDArray[np.bool_]) -> Sights:
        columns: list[Any] = [column if column is None else column[keep] for column in vars(self).values()]
        return Sights(*columns)

    @property
    def together(self) -> NDArray[np.bool_]:
        """Mask (m,) of sights in pictures that show two tags or more."""
        return np.asarray(np.bincount(self.picture)[self.picture] > 1)

    def by_picture(self, values: Array, pictures: int) -> Array:
        """Sum values (m, ...) of the sights over each picture: (pictures, ...)."""
        out = np.zeros((pictures, *values.shape[1:]))
        seen, first = np.unique(self.picture, return_index=True)
        out[seen] = np.add.reduceat(values, first, axis=0)
        return out


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras, tag body and picture poses of a bundle adjustment.

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
        """Build a bundle of pictures without motion during exposure."""
        f = len(cRb)
        return cls(cameras, camera, body, cRb, position, np.full(f, np.nan), np.zeros((f, 6)), np.zeros(len(cameras)))

    def lines(self, sights: Sights) -> Array:
        """Row offsets (m, 4), px, of corners below the middle of their picture."""
        middle = np.array([0.5 * (camera.height - 1) for camera in self.cameras])
        return np.asarray(sights.corners[..., 1] - middle[self.camera[sights.picture], None])


@dataclass(frozen=True, eq=False)
class Rows:
    """Reprojection errors in sigmas, with Jacobians computed on demand.

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
        """Sums of squares (m,) of the residuals."""
        return np.asarray((self.miss**2).sum(axis=1))

    @cached_property
    def by_picture(self) -> Array:
        """Jacobian (m, 8, 6) by picture pose steps [delta, epsilon]: cRb Exp(delta), position + epsilon."""
        by = np.concatenate([-self._by_turned @ so3.hat(self.turned), self.by_point], axis=-1)
        return by.reshape(-1, 8, 6)

    @cached_property
    def by_tag(self) -> Array:
        """Jacobian (m, 8, 6) by tag pose steps [delta, epsilon]: bRt Exp(delta), position + epsilon."""
        in_b = self._by_turned if self.turn is None else self._by_turned @ so3.matrix(self.turn)
        in_t = in_b @ so3.matrix(self.bRt)[:, None]
        return np.concatenate([-in_t @ so3.hat(self.local), in_b], axis=-1).reshape(-1, 8, 6)

    @property
    def velocity(self) -> Array:
        """Velocities (m, 4, 3), m/s, of the corners in the camera's frame."""
        w, v = np.split(self.motion, 2, axis=-1)
        return np.asarray(so3.rotate(self.cRb, so3.cross(w, self.turned)) + v)

    @cached_property
    def _by_turned(self) -> Array:
        return np.asarray(self.by_point @ so3.matrix(self.cRb))


def linearized(bundle: Bundle, sights: Sights) -> Rows:
    """Compute reprojection errors (predicted - seen) of all sights, and their Jacobians by the poses."""
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


# -- from detections


@dataclass(frozen=True, eq=False)
class Shots:
    """A camera with the tags found in each of its pictures, in time order, and times, s, if known."""

    camera: Camera
    pictures: Sequence[Detections]
    time: Sequence[float] | None = None


@dataclass(frozen=True, eq=False)
class Gathered:
    """Sights of all recordings combined.

    Attributes:
        start: the bundle with all pictures' poses at the origin.
        sights: of the body's tags, in pictures that show one.
        view: (f,) pictures in a row in which nothing moved have the same number: their errors are the same, too.
    """

    start: Bundle
    sights: Sights
    view: Index


_Seen = dict[int, tuple[Array, float]]


def gathered(shots: Sequence[Shots], given: TagBody) -> Gathered:
    """Collect the sights of the body's tags; ids seen twice in one picture are left out there."""
    cameras: dict[tuple[object, ...], Camera] = {}
    frames: list[tuple[int, float, int, _Seen]] = []
    for each in shots:
        # Equal calibrations are one camera's.
        key = each.camera.width, each.camera.height, each.camera.distortion_model, *each.camera.intrinsics.tolist()
        cameras.setdefault(key, each.camera)
        first: _Seen = {}
        for found, time in zip(each.pictures, repeat(np.nan) if each.time is None else each.time, strict=False):
            if seen := _usable(each.camera, given, found):
                still = _still(first, seen)
                first = {**seen, **first} if still else seen
                view = (frames[-1][2] if frames else -1) + (not still)
                frames.append((list(cameras).index(key), time, view, seen))
    rows = [(f, tag, *one) for f, (*_, seen) in enumerate(frames) for tag, one in sorted(seen.items())]
    sights = Sights(
        np.array([row[0] for row in rows], dtype=np.intp),
        np.array([row[1] for row in rows], dtype=np.intp),
        np.array([row[2] for row in rows], dtype=float).reshape(-1, 4, 2),
        np.array([row[3] for row in rows], dtype=float),
    )
    camera, times, views = np.array([frame[:3] for frame in frames], dtype=float).reshape(-1, 3).T
    origin = so3.identity(len(frames)), np.zeros((len(frames), 3))
    start = Bundle.of(tuple(cameras.values()), camera.astype(np.intp), given, *origin)
    return Gathered(replace(start, time=times), sights, views.astype(np.intp))


def _usable(camera: Camera, given: TagBody, found: Detections) -> _Seen:
    """Corners (4, 2) and their sigma, px, of each usable tag, by its index in the body."""
    tags, seen = seen_once(camera, given, found)
    sigma = np.sqrt(np.diagonal(found.covariance[seen], axis1=-2, axis2=-1).mean(axis=(1, 2)))
    each = zip(tags.tolist(), found.corners[seen], np.hypot(sigma, _LEAST_PX).tolist(), strict=True)
    return {tag: (corners, px) for tag, corners, px in each if np.isfinite(px)}


def _still(first: _Seen, seen: _Seen) -> bool:
    both = first.keys() & seen.keys()
    if not both:
        return False
    moved = [(seen[tag][0] - first[tag][0]) / first[tag][1] for tag in both]
    return float(np.sqrt(np.mean(np.square(moved)))) < _STILL
