"""Bundle adjustment of tags: poses of pictures, poses of tags on the body, and what is adjusted beside these.

A corner at q in a tag's frame is at P = cRb (position of the tag + bRt q) + position of the picture in the camera's
frame. A shutter that rolls sees it when its row is exposed, at an attitude cRb Exp(w t) and a position v t farther.

Levenberg's and Marquardt's method on normal equations from which the pictures are eliminated (Schur complement), so
that a step costs what the tags cost: 0.05 s for 18 tags in 220 pictures. gtsam's elimination of the same arrays takes
0.06 s, the chain's (`alidade.pipelines.solvers.chain`) 0.2 s, custom factors in Python 0.6 s a step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import SQUARE, TagBody

# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0
# Of a shutter that may roll, s from one row to the next: what pictures do not determine has this sigma.
LINE_TIME = 3e-5
_STEPS, _POSE_STEPS = 40, 15
_DIAGONAL = np.arange(6)
# A step that changes the cost by less than this share ends the adjustment.
_SETTLED = 1e-10
# A picture whose step changes its cost by less than this share stays there.
_STEADY = 1e-6
# A corner behind the camera, sigmas: a residual that no step may leave there. Beside the camera, farther than so many
# px, how it moves has no digits left.
_BEHIND, _FARTHEST = 1e4, 1e6
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


@dataclass(frozen=True, eq=False)
class Rows:
    """Reprojection errors of tag corners in sigmas; their Jacobians are computed on demand.

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


@dataclass(frozen=True, eq=False)
class Additional:
    """Additional parameters of a bundle with their prior sigmas; a sigma of 0 fixes a parameter.

    Attributes:
        given: the cameras that the priors are about; their shutters are taken not to roll.
        sigmas: (c, n + 1) of fx, fy, cx, cy, px, of the distortion coefficients, and of the line time, s; with cameras
            of fewer coefficients the columns before the last are 0.
    """

    given: tuple[Camera, ...]
    sigmas: Array

    @classmethod
    def of(cls, bundle: Bundle, shutters: bool = False, intrinsics: bool = False) -> Additional:
        """Free line times, sigma 30 us about zero, and intrinsics, near their calibration: focal 0.5 %, centre 5 px.

        Each coefficient of the distortion has the sigma that moves the picture's farthest corner by a pixel.
        """
        out = np.zeros((len(bundle.cameras), max(len(camera.intrinsics) for camera in bundle.cameras) + 1))
        out[:, -1] = LINE_TIME if shutters else 0.0
        for row, camera in zip(out, bundle.cameras if intrinsics else (), strict=False):
            frame = np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
            rays = camera.rays(frame)
            # Where distortion turns back before the corner, the half way there serves.
            rays = np.where(np.isfinite(rays), rays, camera.rays(0.5 * (frame + camera.centre)))
            moves = np.linalg.norm(camera.by_intrinsics(rays), axis=-2).max(axis=0)
            row[:2], row[2:4] = _FOCAL * camera.focal, _CENTRE_PX
            row[4 : len(moves)] = _DISTORTION_PX / np.maximum(moves[4:], 1e-9)
        return cls(bundle.cameras, out)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask (k,) of the additional parameters that are estimated."""
        return np.asarray(self.sigmas.ravel() > 0.0)

    @property
    def precision(self) -> Array:
        """Prior information of those that are estimated."""
        return np.asarray(self.sigmas.ravel()[self.free] ** -2.0)

    def off(self, bundle: Bundle) -> Array:
        """Deviation of a bundle's estimated parameters from their prior means."""
        out = np.zeros_like(self.sigmas)
        for row, now, given in zip(out, bundle.cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        out[:, -1] = bundle.line_time
        return out.ravel()[self.free]

    def moved(self, bundle: Bundle, step: Array) -> Bundle:
        """Add a step (k,) to the bundle's additional parameters."""
        rows = step.reshape(self.sigmas.shape)
        cameras = tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row[:-1].any() else camera
            for camera, row in zip(bundle.cameras, rows, strict=True)
        )
        return replace(bundle, cameras=cameras, line_time=bundle.line_time + rows[:, -1])

    def rows(self, bundle: Bundle, sights: Sights, rows: Rows) -> Array:
        """Jacobian (m, 8, k) of the reprojection errors by the additional parameters."""
        m = len(sights)
        out = np.zeros((m, 4, 2, *self.sigmas.shape))
        by_time = (rows.by_point @ rows.velocity[..., None])[..., 0] * bundle.lines(sights)[..., None]
        for k in np.unique(bundle.camera[sights.picture]).tolist():
            mine = bundle.camera[sights.picture] == k
            by = bundle.cameras[k].by_intrinsics(rows.points[mine])
            out[mine, :, :, k, : by.shape[-1]] = np.nan_to_num(by) / sights.sigma[mine, None, None, None]
            out[mine, :, :, k, -1] = by_time[mine]
        return out.reshape(m, 8, -1)


def free_columns(bundle: Bundle, fixed: int, additional: Additional) -> NDArray[np.bool_]:
    """Mask (p,) of the shared unknowns, six a tag, then the additional ones, that are estimated."""
    return np.concatenate([np.repeat(np.arange(len(bundle.body.ids)) != fixed, 6), additional.free])


def shared_rows(bundle: Bundle, sights: Sights, rows: Rows, additional: Additional) -> Array:
    """Jacobian (m, 8, p) of the errors by the shared unknowns: the tags' poses, then additional parameters."""
    m, tags, k = len(sights), len(bundle.body.ids), additional.sigmas.size
    out = np.zeros((m, 8, 6 * tags + k))
    columns = 6 * sights.tag[:, None] + np.arange(6)
    np.put_along_axis(out, np.broadcast_to(columns[:, None], (m, 8, 6)), rows.by_tag, axis=2)
    if additional.free.any():
        out[..., 6 * tags :] = additional.rows(bundle, sights, rows)
    return out


def of_pictures(sights: Sights, rows: Rows, weights: Array, f: int) -> tuple[Array, Array]:
    """Information (f, 6, 6) and gradient (f, 6, 1) of the pictures' poses, the tags fixed."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    return sights.by_picture(At @ rows.by_picture, f), sights.by_picture(At @ rows.miss[..., None], f)


def pose_steps(
    bundle: Bundle, sights: Sights, rows: Rows, columns: Array, weights: Array, damping: float = 0.0
) -> tuple[Array, Array]:
    """Least-squares pose changes (f, 6, p) of the pictures for columns (m, 8, p) of errors, and their right sides."""
    m, f = len(sights), len(bundle.cRb)
    own, _ = of_pictures(sights, rows, weights, f)
    weighted = weights[:, None, None] * rows.by_picture
    A = sparse.bsr_array((weighted, sights.picture, np.arange(m + 1)), shape=(8 * m, 6 * f)).tocsr()
    across = (A.T @ columns.reshape(8 * m, -1)).reshape(f, 6, -1)
    own[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping
    own[own[:, 0, 0] == 0.0] = np.eye(6)
    return np.asarray(np.linalg.solve(own, across), dtype=float), across


def _step(
    bundle: Bundle, sights: Sights, rows: Rows, weights: Array, fixed: int, additional: Additional, damping: float
) -> tuple[Array, Array]:
    """Step of the shared unknowns (p,) and the pictures' poses (f, 6); the damping is relative (Levenberg)."""
    free = free_columns(bundle, fixed, additional)
    J = shared_rows(bundle, sights, rows, additional)[..., free]
    q, columns = J.shape[2], np.concatenate([J, rows.miss[..., None]], axis=2)
    poses, across = pose_steps(bundle, sights, rows, columns, weights, damping)
    system = (weights[:, None, None] * J).reshape(-1, q).T @ columns.reshape(-1, q + 1)
    priors, diagonal = np.arange(q - additional.free.sum(), q), np.arange(q)
    system[priors, priors] += additional.precision
    system[priors, -1] += additional.precision * additional.off(bundle)
    # A tag of which nothing is left stays where it is.
    own = system[diagonal, diagonal]
    system[diagonal, diagonal] = np.where(own > 0.0, (1.0 + damping) * own, 1.0)
    system -= across[..., :-1].reshape(-1, q).T @ poses.reshape(-1, q + 1)
    shared = np.zeros(len(free))
    shared[free] = step = -np.linalg.solve(system[:, :-1], system[:, -1])
    return shared, -(poses[..., -1] + poses[..., :-1] @ step)


def moved(bundle: Bundle, shared: Array, pictures: Array, additional: Additional) -> Bundle:
    """Apply a step to a bundle: `shared` (p,) for tags and additional parameters, `pictures` (f, 6)."""
    tags = len(bundle.body.ids)
    step = shared[: 6 * tags].reshape(tags, 6)
    body = replace(
        bundle.body,
        bRt=so3.multiply(bundle.body.bRt, so3.exp(step[:, :3])),
        position=bundle.body.position + step[:, 3:],
    )
    return additional.moved(replace(with_poses_moved(bundle, pictures), body=body), shared[6 * tags :])


def with_poses_moved(bundle: Bundle, step: Array) -> Bundle:
    """Apply a step (f, 6) to the pictures' poses."""
    turned = so3.multiply(bundle.cRb, so3.exp(step[:, :3]))
    return replace(bundle, cRb=turned, position=bundle.position + step[:, 3:])


def adjusted(
    bundle: Bundle, sights: Sights, fixed: int, additional: Additional, far: float = np.inf, steps: int = _STEPS
) -> tuple[Bundle, Rows]:
    """Minimise the bundle's reprojection errors by the Levenberg-Marquardt method.

    Args:
        bundle: where to start.
        sights: what is seen.
        fixed: index of the tag that stays.
        additional: what is adjusted beside poses.
        far: sum of squares of a tag in a picture beyond which it counts less and less (Geman, McClure).
        steps: at most.
    """
    rows, damping = linearized(bundle, sights), 1e-4
    cost = _cost(rows, bundle, additional, far)
    for _ in range(steps):
        step = _step(bundle, sights, rows, weights(rows, far), fixed, additional, damping)
        after = moved(bundle, *step, additional)
        there = linearized(after, sights)
        now = _cost(there, after, additional, far)
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
    """Weights (m,) of the Geman-McClure loss; 1 for an infinite bound `far`."""
    return np.ones(len(rows.miss)) if np.isinf(far) else np.asarray((far / (far + rows.squares)) ** 2)


def loss(squares: Array, far: float) -> Array:
    """Geman-McClure loss of sums of squares."""
    return squares if np.isinf(far) else np.asarray(squares * (far / (far + squares)))


def _cost(rows: Rows, bundle: Bundle, additional: Additional, far: float) -> float:
    priors = additional.precision * additional.off(bundle) ** 2
    return float(loss(rows.squares, far).sum() + priors.sum())


def refined_pictures(bundle: Bundle, sights: Sights, far: float = np.inf) -> tuple[Bundle, Array, Array]:
    """Refine each picture's pose with fixed tags; also return costs (f,) and pose information (f, 6, 6)."""
    f = len(bundle.cRb)

    def evaluated(there: Bundle, seen: Sights) -> tuple[Array, Array, Array]:
        rows = linearized(there, seen)
        costs = np.bincount(seen.picture, loss(rows.squares, far), f)
        return np.asarray(costs, dtype=float), *of_pictures(seen, rows, weights(rows, far), f)

    (cost, own, gradient), damping = evaluated(bundle, sights), np.full(f, 1e-3)
    going = own[:, 0, 0] > 0.0
    for _ in range(_POSE_STEPS):
        seen = sights[going[sights.picture]]
        if not len(seen):
            break
        damped = own[going]
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[going, None]
        step = np.zeros((f, 6))
        step[going] = -np.linalg.solve(damped, gradient[going])[..., 0]
        now, new, slope = evaluated(with_poses_moved(bundle, step), seen)
        better = going & (now < cost)
        bundle = with_poses_moved(bundle, np.where(better[:, None], step, 0.0))
        own[better], gradient[better] = new[better], slope[better]
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        going &= np.abs(cost - now) > _STEADY * cost
        cost = np.where(better, now, cost)
    return bundle, cost, own
