"""Where the tags sit on a body, from pictures of it: bundle adjustment of their corners, with covariance.

The tag with the lowest id stays where it is given and so defines the body's frame; the sizes given define its scale.
Tags are placed by a vote of all pictures (`placing`), then poses of tags and pictures are adjusted together (`bundle`),
with the time that shutters take to roll and, if asked for, the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.bundle import (
    LINE_TIME,
    Additional,
    Bundle,
    Gathered,
    Sights,
    free_columns,
    linearized,
    moved,
    refined_pictures,
)
from alidade.pipelines.vision.layout.fit import Fit, covariance, fitted
from alidade.pipelines.vision.layout.placing import adjusted_whole, flip_resolved, joint
from alidade.pipelines.vision.pose import TagBody, part, seen_once
from alidade.pipelines.vision.tags import Detections

__all__ = ["LINE_TIME", "Layout", "Shots", "TagSeen", "estimate_layout"]

# More sights of a tag than this share left out as false: it is not one rigid tag.
_MOSTLY_FALSE = 0.5
# Corners that differ by less than this many sigmas, root mean square, stand still; noise alone makes it 1.4.
_STILL = 2.0
# No corner is taken to be better than this, px.
_LEAST_PX = 0.03


@dataclass(frozen=True)
class TagSeen:
    """Statistics of a tag: number of pictures, root mean square error (px per axis), rejected sights.

    `inflation` is by how much its errors from picture to picture exceed what independent corners would give.
    """

    pictures: int
    rms_px: float
    rejected: int
    inflation: float


@dataclass(frozen=True, eq=False)
class Layout:
    """Estimated layout of a body of tags.

    Attributes:
        body: the tags that could be placed.
        covariance: (6 (n - 1), 6 (n - 1)) of the tags after the first: for each [delta, epsilon], attitude bRt
            Exp(delta) in rad, position + epsilon in m.
        sigma_px: standard deviation of a corner in a common picture, px per axis, from the residuals.
        rms_px: root mean square error of the corners, px per axis, pictures weighted as in the adjustment.
        frames: number of pictures used.
        seen: of each placed tag, by id.
        unplaced: id -> why it could not be placed, and what to do.
        cameras, given_cameras: as used in the end, and as given.
        camera_sigma: (c, n) of their intrinsics, None if not adjusted.
        line_time, line_time_sigma: (c,) s, from one row of a picture to the next, where it moves and pictures are close
            enough in time; about 0 with a sigma of 30 us.
        bend: sigma of a tag's corners against a flat square, each way, as a share of its size.
        with_camera: (6 (n - 1) + 3, the same) covariance of the tags, of the focal length, as a share, and of the
            centre, px, where the one camera that there is was adjusted; else None.
    """

    body: TagBody
    covariance: Array
    sigma_px: float
    rms_px: float
    frames: int
    seen: Mapping[int, TagSeen]
    unplaced: Mapping[int, str]
    cameras: tuple[Camera, ...]
    given_cameras: tuple[Camera, ...]
    camera_sigma: Array | None
    with_camera: Array | None
    line_time: Array
    line_time_sigma: Array
    bend: float


def estimate_layout(shots: Sequence[Shots], given: TagBody, refine_camera: bool = False) -> Layout:
    """Estimate the layout of a body of tags from pictures.

    Args:
        shots: recordings of it; those whose cameras say the same are of one camera.
        given: ids, sizes and, for the tag with the lowest id, its attitude and position; those of the others are not
            looked at.
        refine_camera: adjust the cameras' intrinsics too, about those given.

    Raises:
        InputError: no picture shows the first tag with another, or the pictures do not distinguish the layout from its
            mirror image.
    """
    views = gathered(shots, given)
    unplaced = _unconnected(views, given)
    body: TagBody | None = None
    while True:
        placed = part(given, ~np.isin(given.ids, list(unplaced)))
        views = gathered(shots, placed) if unplaced else views
        with progress.doing("placing tags"):
            fit = adjusted_whole(views, None if body is None else part(body, np.isin(body.ids, placed.ids)))
        wrong = _unusable(views, fit)
        if not wrong:
            break
        if int(given.ids[0]) in wrong:
            raise InputError(f"tag {given.ids[0]}, which defines the body's frame: {wrong[int(given.ids[0])]}")
        unplaced, body = unplaced | wrong, fit.bundle.body
    additional = Additional.of(fit.bundle, shutters=True, intrinsics=refine_camera)
    return _layout(views, fitted(fit.bundle, views.sights, fit.whole, additional), unplaced)


def _unconnected(views: Gathered, given: TagBody) -> dict[int, str]:
    """Ids of tags without a chain of common pictures to the first tag, with the reason in words."""
    n, sights = len(given.ids), views.sights
    times = np.bincount(sights.tag, minlength=n)
    reached = _reached(sights, n)
    if reached.sum() < 2:
        shown = "in no picture" if not times[0] else f"in {times[0]} pictures, never with another tag of the body"
        raise InputError(
            f"no picture shows tag {given.ids[0]} together with another tag of the body ({shown}); it defines the "
            "body's frame: take pictures of its edges and corners from near, or leave it out of the config"
        )
    return {
        int(given.ids[k]): "in no picture"
        if not times[k]
        else f"in {times[k]} pictures, never with one that is placed; take pictures that show both"
        for k in np.flatnonzero(~reached)
    }


def _reached(sights: Sights, tags: int) -> NDArray[np.bool_]:
    """Mask (n,) of tags connected to the first tag by a chain of common pictures."""
    from scipy.sparse.csgraph import connected_components

    _, chain = connected_components(joint(sights, tags))
    return np.asarray(chain == chain[0])


def _unusable(views: Gathered, fit: Fit) -> dict[int, str]:
    """Ids of tags with an ambiguous or inconsistent pose, with the reason in words."""
    body, sights = fit.bundle.body, views.sights
    n = len(body.ids)
    shown, used = np.bincount(sights.tag, minlength=n), np.bincount(fit.sights.tag, minlength=n)
    looked_at, reached = np.bincount(sights.tag[fit.whole], minlength=n), _reached(fit.sights, n)
    out = {}
    for k, tag in enumerate(body.ids.tolist()):
        if looked_at[k] and used[k] < (1.0 - _MOSTLY_FALSE) * looked_at[k]:
            out[tag] = (
                f"disagrees with the others in {looked_at[k] - used[k]} of {looked_at[k]} pictures; is its size right, "
                "is it glued down, is there another tag of this id?"
            )
        elif not reached[k]:
            out[tag] = (
                f"in {shown[k]} pictures, but in none with placed tags that resolves the flip of all it shows; take "
                "pictures from nearer, or that show more tags"
            )
        elif not flip_resolved(fit, views.view, k):
            out[tag] = (
                f"in {used[k]} pictures that fit its planar flip as well; take pictures of it with its neighbours from "
                "nearer and from other sides"
            )
    return out


def _layout(views: Gathered, fit: Fit, unplaced: Mapping[int, str]) -> Layout:
    known, additional = covariance(fit, views.view), fit.additional
    free = free_columns(fit.bundle, 0, additional)
    step, sigma = np.zeros((2, len(free)))
    step[free], sigma[free] = known.step, np.sqrt(np.diag(known.whole))
    bundle, *_ = refined_pictures(moved(fit.bundle, step, np.zeros((len(fit.bundle.cRb), 6)), additional), fit.sights)
    fit = replace(fit, bundle=bundle, rows=linearized(bundle, fit.sights))
    body, tags = bundle.body, 6 * (len(bundle.body.ids) - 1)
    camera_sigma, line_time_sigma = np.split(sigma[tags + 6 :].reshape(additional.sigmas.shape), [-1], axis=1)
    seen = {}
    for k, tag in enumerate(body.ids.tolist()):
        mine = fit.sights.tag == k
        rejected = int((views.sights.tag[fit.whole] == k).sum()) - int(mine.sum())
        seen[tag] = TagSeen(int(mine.sum()), fit.rms_px(mine), rejected, float(known.inflation[k]))
    return Layout(
        body=body,
        covariance=known.whole[:tags, :tags],
        sigma_px=fit.sigma_px,
        rms_px=fit.rms_px(),
        frames=len(np.unique(fit.sights.picture)),
        seen=seen,
        unplaced=dict(sorted(unplaced.items())),
        cameras=bundle.cameras,
        given_cameras=views.start.cameras,
        camera_sigma=camera_sigma if camera_sigma.any() else None,
        with_camera=_with_camera(known.whole, bundle.cameras, tags) if camera_sigma.any() else None,
        line_time=bundle.line_time,
        line_time_sigma=line_time_sigma[:, 0],
        bend=known.bend,
    )


def _with_camera(whole: Array, cameras: Sequence[Camera], tags: int) -> Array | None:
    """Covariance of tags and one camera in a layout's form; focal share as the mean of both focal lengths' shares."""
    if len(cameras) > 1:
        return None
    pick = np.zeros((tags + 3, len(whole)))
    pick[:tags, :tags] = np.eye(tags)
    pick[tags, tags : tags + 2] = 0.5 / cameras[0].focal
    pick[tags + 1, tags + 2] = pick[tags + 2, tags + 3] = 1.0
    return np.asarray(pick @ whole @ pick.T)


@dataclass(frozen=True, eq=False)
class Shots:
    """A camera with the tags found in each of its pictures, in time order, and times, s, if known."""

    camera: Camera
    pictures: Sequence[Detections]
    time: Sequence[float] | None = None


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
