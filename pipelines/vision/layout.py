"""Where the tags sit on a body, from pictures of it: bundle adjustment of their corners, with covariance.

The tag with the lowest id stays where it is given and so defines the body's frame; the sizes given define its scale.
pycolmap adjusts free corners and poses from a start chained along tags seen together; then each tag is made the rigid
square it is, and poses of tags and pictures are adjusted once more, which also gives their covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors import so3
from pipelines.errors import InputError
from pipelines.vision.camera import Camera
from pipelines.vision.pose import BodyPose, TagBody, _colmap_camera, estimate_pose
from pipelines.vision.tags import Detections

Array = NDArray[np.float64]

_STEPS = 10
# Tags that miss the layout by more than this many times the median are false detections.
_FAR = 6.0


@dataclass(frozen=True, eq=False)
class Layout:
    """A body of tags as found.

    Attributes:
        body: the tags that could be placed.
        covariance: (6 (n - 1), 6 (n - 1)) of the tags after the first: for each [delta, epsilon], attitude bRt
            Exp(delta) in rad, position + epsilon in m.
        sigma_px: standard deviation of a corner, px per axis, from the residuals.
        frames: number of pictures used.
        unplaced: ids of tags never seen together with a placed one.
    """

    body: TagBody
    covariance: Array
    sigma_px: float
    frames: int
    unplaced: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Views:
    """Tags in pictures: index of the picture and of the tag (m,), corners (m, 4, 2) px; cRb (f, 4), position (f, 3)."""

    frame: NDArray[np.intp]
    tag: NDArray[np.intp]
    corners: Array
    cRb: Array
    position: Array


def estimate_layout(camera: Camera, given: TagBody, pictures: Sequence[Detections]) -> Layout:
    """The layout of a body.

    Args:
        camera: the camera.
        given: ids, sizes and, for the tag with the lowest id, its attitude and position; those of the others are not
            looked at.
        pictures: the tags found in each.

    Raises:
        InputError: no picture shows two tags of the body of which one can be placed.
    """
    start = _chained(camera, given, pictures)
    if len(start.ids) < 2:
        raise InputError(
            f"no picture shows tag {given.ids[0]} together with another tag of the body well enough to place it; take "
            "pictures of its edges and corners from near"
        )
    views = _views(camera, start, pictures)
    body, views = _adjusted(camera, start, views)
    body, views, covariance, sigma = _rigid(camera, body, views)
    unplaced = tuple(sorted(set(given.ids.tolist()) - set(body.ids.tolist())))
    return Layout(body, covariance, sigma, len(views.cRb), unplaced)


def _chained(camera: Camera, given: TagBody, pictures: Sequence[Detections]) -> TagBody:
    """A start: each tag placed by the best single picture that shows it with one that is placed already."""
    best: dict[tuple[int, int], tuple[float, BodyPose, BodyPose]] = {}
    for found in pictures:
        poses = {}
        for tag in sorted(set(found.ids.tolist()) & set(given.ids.tolist())):
            pose = estimate_pose(camera, _alone(given, tag), found)
            if pose is not None and pose.decided:
                poses[tag] = pose
        for a, b in combinations(poses, 2):
            cost = sum(float(np.trace(poses[tag].covariance[:3, :3])) for tag in (a, b))
            if (a, b) not in best or cost < best[a, b][0]:
                best[a, b] = cost, poses[a], poses[b]
                best[b, a] = cost, poses[b], poses[a]
    first = int(given.ids[0])
    placed = {first: (given.bRt[0], given.position[0])}
    while True:
        reachable = {pair: found for pair, found in best.items() if pair[0] in placed and pair[1] not in placed}
        if not reachable:
            break
        (a, b), (_, pose_a, pose_b) = min(reachable.items(), key=lambda item: item[1][0])
        aRc = so3.inverse(pose_a.cRb)
        bRa, at = placed[a]
        offset = so3.rotate(aRc, pose_b.position - pose_a.position)
        placed[b] = so3.compose(bRa, aRc, pose_b.cRb), at + so3.rotate(bRa, offset)
    ids = np.array(sorted(placed), dtype=np.int64)
    size = given.size[np.searchsorted(given.ids, ids)]
    attitudes, positions = (np.array([placed[i][k] for i in ids.tolist()]) for k in (0, 1))
    return TagBody(ids, size, attitudes, positions, given.family)


def _alone(body: TagBody, tag: int) -> TagBody:
    """A body of this tag only, in its own frame."""
    size = body.size[body.ids == tag]
    return TagBody(np.array([tag]), size, so3.identity(1), np.zeros((1, 3)), body.family)


def _views(camera: Camera, body: TagBody, pictures: Sequence[Detections]) -> _Views:
    """The pictures whose pose is told by the layout; of one tag alone nothing is learnt."""
    frame: list[int] = []
    tag: list[int] = []
    corners: list[Array] = []
    cRb: list[Array] = []
    position: list[Array] = []
    for found in pictures:
        pose = estimate_pose(camera, body, found)
        if pose is None or pose.ambiguous or len(pose.ids) < 2:
            continue
        rows = [int(np.flatnonzero(found.ids == i)[0]) for i in pose.ids]
        frame += [len(cRb)] * len(rows)
        tag += np.searchsorted(body.ids, pose.ids).tolist()
        corners.append(found.corners[rows])
        cRb.append(pose.cRb)
        position.append(pose.position)
    if not cRb:
        raise InputError("no picture shows two tags of the body at once")
    return _Views(np.array(frame), np.array(tag), np.concatenate(corners), np.array(cRb), np.array(position))


def _adjusted(camera: Camera, body: TagBody, views: _Views) -> tuple[TagBody, _Views]:
    """Corners and poses by pycolmap, each tag then the rigid square nearest to its corners."""
    import pycolmap

    world = pycolmap.Reconstruction()
    colmap = copy(_colmap_camera(camera))  # the original is shared
    colmap.camera_id = 1
    world.add_camera_with_trivial_rig(colmap)
    config = pycolmap.BundleAdjustmentConfig()
    tracks: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for f in range(len(views.cRb)):
        rows = np.flatnonzero(views.frame == f)
        for k, row in enumerate(rows):
            for corner in range(4):
                tracks.setdefault((int(views.tag[row]), corner), []).append((f + 1, 4 * k + corner))
        points = views.corners[rows].reshape(-1, 2)
        image = pycolmap.Image(name=f"{f}", keypoints=points, camera_id=1, image_id=f + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(so3.matrix(views.cRb[f])), views.position[f])
        world.add_image_with_trivial_frame(image, pose)
        config.add_image(f + 1)
    points = body.corners
    ids = {}
    for (tag, corner), seen in tracks.items():
        track = pycolmap.Track()
        for image_id, index in seen:
            track.add_element(image_id, index)
        ids[tag, corner] = world.add_point3D(points[tag, corner], track)
        if tag == 0:
            config.add_constant_point(ids[tag, corner])
    config.set_constant_cam_intrinsics(1)
    pycolmap.create_default_bundle_adjuster(_options(), config, world).solve()
    for (tag, corner), point in ids.items():
        points[tag, corner] = world.points3D[point].xyz
    poses = [world.images[f + 1].cam_from_world() for f in range(len(views.cRb))]
    cRb = so3.from_matrix(np.array([p.rotation.matrix() for p in poses]))
    return _squares(body, points), replace(views, cRb=cRb, position=np.array([p.translation for p in poses]))


def _options() -> Any:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.gradient_tolerance = 1e-8
    return options


def _squares(body: TagBody, corners: Array) -> TagBody:
    """The body with each tag, but for the first, at the rigid square nearest to its corners (n, 4, 3)."""
    bRt, position = body.bRt.copy(), corners.mean(axis=1)
    position[0] = body.position[0]
    local = so3.rotate(so3.inverse(body.bRt)[:, None], body.corners - body.position[:, None])
    bRt[1:] = so3.align((corners - position[:, None])[1:], local[1:])
    return TagBody(body.ids, body.size, bRt, position, body.family)


def _rigid(camera: Camera, body: TagBody, views: _Views) -> tuple[TagBody, _Views, Array, float]:
    """Gauss-Newton on the poses of tags and pictures; also the tags' covariance and the corners' sigma."""
    for step in range(_STEPS):
        miss, by_frame, by_tag = _linearized(camera, body, views)
        size = np.sqrt((miss**2).mean(axis=1))
        if step == 1:
            good = size < _FAR * np.median(size)
            views = replace(views, frame=views.frame[good], tag=views.tag[good], corners=views.corners[good])
            miss, by_frame, by_tag = miss[good], by_frame[good], by_tag[good]
        information, projection, solve_frames = _reduced(miss, by_frame, by_tag, views, len(body.ids))
        moved = np.concatenate([np.zeros(6), -np.linalg.solve(information, projection)]).reshape(-1, 6)
        frames = solve_frames(moved)
        body = replace(body, bRt=so3.multiply(body.bRt, so3.exp(moved[:, :3])), position=body.position + moved[:, 3:])
        cRb = so3.multiply(views.cRb, so3.exp(frames[:, :3]))
        views = replace(views, cRb=cRb, position=views.position + frames[:, 3:])
        if np.abs(moved).max() < 1e-9:
            break
    unknowns = 6 * (len(body.ids) - 1) + 6 * len(np.unique(views.frame))
    variance = float((miss**2).sum() / (miss.size - unknowns))
    return body, views, np.asarray(variance * np.linalg.inv(information)), float(np.sqrt(variance))


def _linearized(camera: Camera, body: TagBody, views: _Views) -> tuple[Array, Array, Array]:
    """Reprojection errors (m, 8) px and their Jacobians (m, 8, 6) by the pictures' poses and by the tags'."""
    cRb, bRt = views.cRb[views.frame], body.bRt[views.tag]
    local = so3.rotate(so3.inverse(body.bRt)[:, None], body.corners - body.position[:, None])[views.tag]
    in_body = body.position[views.tag][:, None] + so3.rotate(bRt[:, None], local)
    points = so3.rotate(cRb[:, None], in_body) + views.position[views.frame][:, None]
    miss = camera.project(points) - views.corners
    h = 1e-6
    ahead, behind = (camera.project(points[..., None, :] + s * h * np.eye(3)) for s in (1.0, -1.0))
    by_point = np.swapaxes((ahead - behind) / (2.0 * h), -1, -2)
    in_b = by_point @ so3.matrix(cRb)[:, None]
    m = len(miss)
    frames = np.concatenate([-in_b @ so3.hat(in_body), by_point], axis=-1)
    tags = np.concatenate([-in_b @ so3.matrix(bRt)[:, None] @ so3.hat(local), in_b], axis=-1)
    return miss.reshape(m, 8), frames.reshape(m, 8, 6), tags.reshape(m, 8, 6)


def _reduced(miss: Array, by_frame: Array, by_tag: Array, views: _Views, tags: int) -> tuple[Array, Array, Any]:
    """Normal equations of all tags but the first, the pictures' poses eliminated (Schur complement).

    The third result gives the pictures' steps (f, 6) from those of the tags (n, 6).
    """
    f = len(views.cRb)
    own, gradient, across = np.zeros((f, 6, 6)), np.zeros((f, 6)), np.zeros((f, 6, 6 * tags))
    information, projection = np.zeros((6 * tags, 6 * tags)), np.zeros(6 * tags)
    for frame, tag, e, a, b in zip(views.frame, views.tag, miss, by_frame, by_tag, strict=True):
        at = slice(6 * tag, 6 * tag + 6)
        own[frame] += a.T @ a
        gradient[frame] += a.T @ e
        across[frame, :, at] += a.T @ b
        information[at, at] += b.T @ b
        projection[at] += b.T @ e
    used = np.unique(views.frame)
    inverse = np.zeros_like(own)
    inverse[used] = np.linalg.inv(own[used])
    information -= np.einsum("fia,fij,fjb->ab", across, inverse, across, optimize=True)
    projection -= np.einsum("fia,fij,fj->a", across, inverse, gradient)

    def frames(moved: Array) -> Array:
        return -np.einsum("fij,fj->fi", inverse, gradient + across @ moved.ravel())

    return information[6:, 6:], projection[6:], frames
