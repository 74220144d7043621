"""Detections as a table of sights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors import so3
from alidade.factors.so3 import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.sights import Bundle, Index, Sights
from alidade.pipelines.vision.pose import TagBody
from alidade.pipelines.vision.tags import Detections

# Corners that differ by less than this many sigmas, root mean square, stand still; noise alone makes it 1.4.
_STILL = 2.0
# No corner is taken to be better than this, px.
_LEAST_PX = 0.03
# Directions this near to the camera's own plane (cosine) are of no use.
_FORWARD = 0.05


@dataclass(frozen=True, eq=False)
class Shots:
    """A camera and the tags found in each of its pictures, in time order; at what time, s, if that is known."""

    camera: Camera
    pictures: Sequence[Detections]
    time: Sequence[float] | None = None


@dataclass(frozen=True, eq=False)
class Gathered:
    """Sights of all recordings.

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
    """The sights of the body's tags. An id that is seen twice in a picture counts as not seen there."""
    cameras: list[Camera] = []
    pictures: list[_Seen] = []
    camera: list[int] = []
    view: list[int] = []
    time: list[float] = []
    for each in shots:
        known = [k for k, other in enumerate(cameras) if _same(other, each.camera)]
        if not known:
            cameras.append(each.camera)
        number = known[0] if known else len(cameras) - 1
        first: _Seen | None = None
        for k, found in enumerate(each.pictures):
            if not (seen := _usable(each.camera, given, found)):
                continue
            moved = first is None or not _still(first, seen)
            first = seen if moved or first is None else {**seen, **first}
            view.append((view[-1] if view else -1) + moved)
            camera.append(number)
            time.append(np.nan if each.time is None else each.time[k])
            pictures.append(seen)
    rows = [(f, tag, *one) for f, seen in enumerate(pictures) for tag, one in sorted(seen.items())]
    sights = Sights(
        np.array([row[0] for row in rows], dtype=np.intp),
        np.array([row[1] for row in rows], dtype=np.intp),
        np.array([row[2] for row in rows], dtype=float).reshape(-1, 4, 2),
        np.array([row[3] for row in rows], dtype=float),
    )
    f = len(pictures)
    start = Bundle.of(tuple(cameras), np.array(camera, dtype=np.intp), given, so3.identity(f), np.zeros((f, 3)))
    return Gathered(replace(start, time=np.array(time)), sights, np.array(view, dtype=np.intp))


def _same(a: Camera, b: Camera) -> bool:
    """Recordings whose camera info says the same were made by one camera."""
    said = [(c.width, c.height, c.distortion_model, *c.intrinsics.tolist()) for c in (a, b)]
    return said[0] == said[1]


def _usable(camera: Camera, given: TagBody, found: Detections) -> _Seen:
    """Index of a tag of the body -> corners (4, 2) and their sigma, px."""
    ids, counts = np.unique(found.ids, return_counts=True)
    once = set(ids[counts == 1].tolist()) & set(given.ids.tolist())
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1).mean(axis=(1, 2)))
    good = np.isfinite(sigma) & (camera.rays(found.corners)[..., 2] > _FORWARD).all(axis=1)
    return {
        int(np.searchsorted(given.ids, tag)): (found.corners[k], float(np.hypot(sigma[k], _LEAST_PX)))
        for k, tag in enumerate(found.ids.tolist())
        if tag in once and good[k]
    }


def _still(first: _Seen, seen: _Seen) -> bool:
    both = first.keys() & seen.keys()
    if not both:
        return False
    moved = [(seen[tag][0] - first[tag][0]) / first[tag][1] for tag in both]
    return float(np.sqrt(np.mean(np.square(moved)))) < _STILL
