"""Bundle adjustment of rigid tags: poses of pictures, poses of tags on the body and, if asked for, the cameras.

A corner at q in a tag's frame is at P = cRb (position of the tag + bRt q) + position of the picture in the camera's
frame. Pictures are eliminated from the normal equations (Schur complement), so that a step costs what the tags cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factors import so3
from pipelines.vision.camera import Camera
from pipelines.vision.pose import SQUARE, TagBody

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_STEPS = 40
_DIAGONAL = np.arange(6)
# A step that changes the cost by less than this share ends the adjustment.
_SETTLED = 1e-10
# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0
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


@dataclass(frozen=True, eq=False)
class Cameras:
    """What of the cameras is adjusted: (c, n) prior sigmas of fx, fy, cx, cy, px, and of the distortion coefficients.

    Attributes:
        given: the cameras that the priors are about.
        sigma: (c, n); 0 where nothing is adjusted; with cameras of fewer coefficients the last columns are 0.
    """

    given: tuple[Camera, ...]
    sigma: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """(c * n,)."""
        return np.asarray(self.sigma.ravel() > 0.0)

    def off(self, cameras: tuple[Camera, ...]) -> Array:
        """(c * n,) how far cameras are from those given."""
        out = np.zeros_like(self.sigma)
        for row, now, given in zip(out, cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        return out.ravel()

    def moved(self, cameras: tuple[Camera, ...], step: Array) -> tuple[Camera, ...]:
        """Cameras with a step (c * n,) added."""
        steps = step.reshape(self.sigma.shape)
        return tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row.any() else camera
            for camera, row in zip(cameras, steps, strict=True)
        )


def fixed_cameras(cameras: tuple[Camera, ...]) -> Cameras:
    """Cameras as given."""
    return Cameras(cameras, np.zeros((len(cameras), max(len(c.intrinsics) for c in cameras))))


def free_cameras(cameras: tuple[Camera, ...]) -> Cameras:
    """Cameras about what their calibration says: focal lengths to 0.5 %, the centre to 5 px, a pixel of distortion.

    Each coefficient of the distortion has the sigma that moves the picture's farthest corner by a pixel.
    """
    out = fixed_cameras(cameras).sigma
    for row, camera in zip(out, cameras, strict=True):
        frame = np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
        rays = camera.rays(frame)
        # Where distortion turns back before the corner, the half way there serves.
        rays = np.where(np.isfinite(rays), rays, camera.rays(0.5 * (frame + camera.centre)))
        moves = np.linalg.norm(camera.by_intrinsics(rays), axis=-2).max(axis=0)
        row[:2], row[2:4] = _FOCAL * camera.focal, _CENTRE_PX
        row[4 : len(moves)] = _DISTORTION_PX / np.maximum(moves[4:], 1e-9)
    return Cameras(cameras, out)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with the pictures eliminated.

    Attributes:
        free: (p,) which of the numbers shared by pictures are adjusted: six a tag, then the cameras'.
        information: (q, q) of those that are free.
        projection: (q,) their gradient.
        across: (f, 6, q) picture's poses against them.
        inverse: (f, 6, 6) of the pictures' own blocks.
        gradient: (f, 6) of the pictures.
    """

    free: NDArray[np.bool_]
    information: Array
    projection: Array
    across: Array
    inverse: Array
    gradient: Array

    def step(self) -> tuple[Array, Array]:
        """Of the shared numbers (p,), zero where fixed, and of the pictures (f, 6)."""
        moved = -np.linalg.solve(self.information, self.projection)
        pictures = -np.einsum("fij,fj->fi", self.inverse, self.gradient + self.across @ moved)
        shared = np.zeros(len(self.free))
        shared[self.free] = moved
        return shared, pictures


def camera_rows(bundle: Bundle, sights: Sights, rows: Rows, cameras: Cameras) -> Array:
    """Jacobian (m, 8, c * n) of the errors by the cameras' intrinsics."""
    m, (count, n) = len(sights), cameras.sigma.shape
    out = np.zeros((m, 4, 2, count, n))
    for k, camera in enumerate(bundle.cameras):
        mine = bundle.camera[sights.picture] == k
        by = camera.by_intrinsics(rows.points[mine])
        out[mine, :, :, k, : by.shape[-1]] = np.nan_to_num(by) / sights.sigma[mine, None, None, None]
    return out.reshape(m, 8, count * n)


def shared_rows(bundle: Bundle, sights: Sights, rows: Rows, cameras: Cameras) -> Array:
    """Jacobian (m, 8, p) of the errors by all that pictures share: the tags' poses, then the cameras."""
    m, tags = len(sights), len(bundle.body.ids)
    out = np.zeros((m, 8, 6 * tags))
    columns = 6 * sights.tag[:, None] + np.arange(6)
    np.put_along_axis(out, np.broadcast_to(columns[:, None], (m, 8, 6)), rows.by_tag, axis=2)
    return np.concatenate([out, camera_rows(bundle, sights, rows, cameras)], axis=2) if cameras.free.any() else out


def normal_equations(
    bundle: Bundle, sights: Sights, rows: Rows, weights: Array, fixed: int, cameras: Cameras, damping: float = 0.0
) -> Normal:
    """Normal equations of weighted errors; tag number `fixed` stays, Levenberg's damping is relative."""
    f = len(bundle.cRb)
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    own, gradient = np.zeros((f, 6, 6)), np.zeros((f, 6))
    np.add.at(own, sights.picture, At @ rows.by_picture)
    np.add.at(gradient, sights.picture, (At @ rows.miss[..., None])[..., 0])
    information, vector, across = _of_tags(bundle, sights, rows, weights, At)
    free = np.repeat(np.arange(len(bundle.body.ids)) != fixed, 6)
    if cameras.free.any():
        information, vector, across = _with_cameras(
            bundle, sights, rows, weights, cameras, (information, vector, across)
        )
        free = np.concatenate([free, cameras.free])
    information, vector, across = information[np.ix_(free, free)], vector[free], across[..., free]
    own[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping
    information[np.diag_indices_from(information)] *= 1.0 + damping
    inverse = np.zeros_like(own)
    seen = own[:, 0, 0] > 0.0
    inverse[seen] = np.linalg.inv(own[seen])
    flat = (inverse @ across).reshape(6 * f, -1)
    information = information - across.reshape(6 * f, -1).T @ flat
    vector = vector - flat.T @ gradient.ravel()
    return Normal(free, np.asarray(information, dtype=float), vector, across, inverse, gradient)


def _of_tags(bundle: Bundle, sights: Sights, rows: Rows, weights: Array, At: Array) -> tuple[Array, Array, Array]:
    """The tags' information, gradient and what they share with pictures, before these are eliminated."""
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    Bt = np.swapaxes(rows.by_tag, 1, 2) * weights[:, None, None]
    blocks, gradient, across = np.zeros((tags, 6, 6)), np.zeros((tags, 6)), np.zeros((f, tags, 6, 6))
    np.add.at(blocks, sights.tag, Bt @ rows.by_tag)
    np.add.at(gradient, sights.tag, (Bt @ rows.miss[..., None])[..., 0])
    np.add.at(across, (sights.picture, sights.tag), At @ rows.by_tag)
    information = np.zeros((tags, 6, tags, 6))
    information[np.arange(tags), :, np.arange(tags)] = blocks
    n = 6 * tags
    return information.reshape(n, n), gradient.ravel(), across.transpose(0, 2, 1, 3).reshape(f, 6, n)


def _with_cameras(
    bundle: Bundle,
    sights: Sights,
    rows: Rows,
    weights: Array,
    cameras: Cameras,
    tags: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """What `_of_tags` gives, with the cameras' numbers and their priors after the tags'."""
    information, gradient, across = tags
    C = camera_rows(bundle, sights, rows, cameras)
    Ct = np.swapaxes(C, 1, 2) * weights[:, None, None]
    f, n = len(bundle.cRb), C.shape[2]
    with_pictures, with_tags = np.zeros((f, n, 6)), np.zeros((len(bundle.body.ids), n, 6))
    np.add.at(with_pictures, sights.picture, Ct @ rows.by_picture)
    np.add.at(with_tags, sights.tag, Ct @ rows.by_tag)
    mixed = with_tags.transpose(1, 0, 2).reshape(n, -1)
    precision = np.where(cameras.free, cameras.sigma.ravel(), 1.0) ** -2.0
    own = (Ct @ C).sum(axis=0) + np.diag(precision)
    pull = (Ct @ rows.miss[..., None])[..., 0].sum(axis=0) + precision * cameras.off(bundle.cameras)
    return (
        np.block([[information, mixed.T], [mixed, own]]),
        np.concatenate([gradient, pull]),
        np.concatenate([across, with_pictures.transpose(0, 2, 1)], axis=2),
    )


def moved(bundle: Bundle, shared: Array, pictures: Array, cameras: Cameras) -> Bundle:
    """The bundle a step on: `shared` (p,) of tags and cameras, `pictures` (f, 6)."""
    tags = len(bundle.body.ids)
    step = shared[: 6 * tags].reshape(tags, 6)
    body = replace(
        bundle.body,
        bRt=so3.multiply(bundle.body.bRt, so3.exp(step[:, :3])),
        position=bundle.body.position + step[:, 3:],
    )
    return Bundle(
        cameras.moved(bundle.cameras, shared[6 * tags :]) if len(shared) > 6 * tags else bundle.cameras,
        bundle.camera,
        body,
        so3.multiply(bundle.cRb, so3.exp(pictures[:, :3])),
        bundle.position + pictures[:, 3:],
    )


def adjusted(
    bundle: Bundle, sights: Sights, fixed: int, cameras: Cameras, far: float = np.inf, steps: int = _STEPS
) -> tuple[Bundle, Rows]:
    """The bundle of least squares, by Levenberg's and Marquardt's method.

    Args:
        bundle: where to start.
        sights: what is seen.
        fixed: index of the tag that stays.
        cameras: what of the cameras is adjusted.
        far: sum of squares of a tag in a picture beyond which it counts less and less (Geman, McClure).
        steps: at most.
    """
    rows, damping = linearized(bundle, sights), 1e-4
    cost = _cost(rows, bundle, cameras, far)
    for _ in range(steps):
        normal = normal_equations(bundle, sights, rows, weights(rows, far), fixed, cameras, damping)
        after = moved(bundle, *normal.step(), cameras)
        there = linearized(after, sights)
        now = _cost(there, after, cameras, far)
        if not now < cost:
            if damping > 1e6 or cost - now >= -_SETTLED * cost:
                break
            damping *= 10.0
            continue
        done = cost - now < _SETTLED * cost
        bundle, rows, cost, damping = after, there, now, 0.1 * damping
        if done:
            break
    return bundle, rows


def weights(rows: Rows, far: float) -> Array:
    """(m,) of Geman's and McClure's loss; 1 without bound."""
    return np.ones(len(rows.miss)) if np.isinf(far) else np.asarray((far / (far + rows.squares)) ** 2)


def loss(squares: Array, far: float) -> Array:
    """Geman's and McClure's of sums of squares."""
    return squares if np.isinf(far) else np.asarray(squares * (far / (far + squares)))


def _cost(rows: Rows, bundle: Bundle, cameras: Cameras, far: float) -> float:
    free = cameras.free
    priors = (cameras.off(bundle.cameras)[free] / cameras.sigma.ravel()[free]) ** 2
    return float(loss(rows.squares, far).sum() + priors.sum())


def refined_pictures(
    bundle: Bundle, sights: Sights, far: float = np.inf, steps: int = 15
) -> tuple[Bundle, Array, Array]:
    """Pictures one by one with the tags where they are; costs (f,) and information (f, 6, 6) of their poses too."""
    f = len(bundle.cRb)
    damping = np.full(f, 1e-3)
    rows = linearized(bundle, sights)
    cost = np.asarray(np.bincount(sights.picture, loss(rows.squares, far), f), dtype=float)
    for _ in range(steps):
        own, gradient = _own(rows, sights, weights(rows, far), f)
        damped = own.copy()
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[:, None]
        damped[own[:, 0, 0] <= 0.0] = np.eye(6)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        after = replace(
            bundle,
            cRb=so3.multiply(bundle.cRb, so3.exp(step[:, :3])),
            position=bundle.position + step[:, 3:],
        )
        there = linearized(after, sights)
        now = np.bincount(sights.picture, loss(there.squares, far), f)
        better = now < cost
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        done = not (cost - now > 1e-6 * cost).any()
        bundle = replace(
            bundle,
            cRb=np.where(better[:, None], after.cRb, bundle.cRb),
            position=np.where(better[:, None], after.position, bundle.position),
        )
        mine = better[sights.picture][:, None]
        rows = Rows(
            np.where(mine, there.miss, rows.miss),
            np.where(mine[..., None], there.by_picture, rows.by_picture),
            rows.by_tag,
            rows.points,
        )
        cost = np.minimum(now, cost)
        if done:
            break
    return bundle, np.asarray(cost, dtype=float), _own(rows, sights, weights(rows, far), f)[0]


def _own(rows: Rows, sights: Sights, weight: Array, f: int) -> tuple[Array, Array]:
    """Information (f, 6, 6) and gradient (f, 6) of the pictures' poses."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weight[:, None, None]
    own, gradient = np.zeros((f, 6, 6)), np.zeros((f, 6))
    np.add.at(own, sights.picture, At @ rows.by_picture)
    np.add.at(gradient, sights.picture, (At @ rows.miss[..., None])[..., 0])
    return own, gradient
