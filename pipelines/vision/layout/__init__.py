"""Where the tags sit on a body, from pictures of it: bundle adjustment of their corners, with covariance.

The tag with the lowest id stays where it is given and so defines the body's frame; the sizes given define its scale.
Tags are placed by a vote of all pictures (`placing`), then poses of tags and pictures are adjusted together (`bundle`),
with the time that shutters take to roll and, if asked for, the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines import progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.bundle import LINE_TIME, Additional, Fit, fitted, moved, refined_pictures
from alidade.pipelines.vision.layout.covariance import Covariance, covariance
from alidade.pipelines.vision.layout.placing import adjusted_whole, flip_resolved, joint
from alidade.pipelines.vision.layout.sights import Gathered, Shots, Sights, gathered, linearized
from alidade.pipelines.vision.pose import TagBody, part

__all__ = ["LINE_TIME", "Layout", "Shots", "TagSeen", "estimate_layout"]

# More sights of a tag than this share left out as false: it is not one rigid tag.
_MOSTLY_FALSE = 0.5


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
    pictures, reached = joint(sights, tags) > 0, np.arange(tags) == 0
    for _ in range(tags):
        reached = reached | (pictures & reached).any(axis=1)
    return reached


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
    known = covariance(fit, views.view)
    if known.correction is not None:
        stay = np.zeros((len(fit.bundle.cRb), 6))
        there = moved(fit.bundle, known.correction, stay, fit.additional)
        bundle, *_ = refined_pictures(there, fit.sights)
        fit = replace(fit, bundle=bundle, rows=linearized(bundle, fit.sights))
    body, tags = fit.bundle.body, 6 * (len(fit.bundle.body.ids) - 1)
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
        cameras=fit.bundle.cameras,
        given_cameras=views.start.cameras,
        camera_sigma=known.sigma[:, :-1] if known.sigma[:, :-1].any() else None,
        with_camera=_with_camera(known, fit, tags),
        line_time=fit.bundle.line_time,
        line_time_sigma=known.sigma[:, -1],
        bend=known.bend,
    )


def _with_camera(known: Covariance, fit: Fit, tags: int) -> Array | None:
    """Covariance of tags and camera in a layout's form; focal share as the mean of both focal lengths' shares."""
    cameras = fit.bundle.cameras
    if not fit.additional.sigmas[:, :-1].any() or len(cameras) > 1:
        return None
    pick = np.zeros((tags + 3, len(known.whole)))
    pick[:tags, :tags] = np.eye(tags)
    pick[tags, tags : tags + 2] = 0.5 / cameras[0].focal
    pick[tags + 1, tags + 2] = pick[tags + 2, tags + 3] = 1.0
    return np.asarray(pick @ known.whole @ pick.T)
