"""Bundle adjustment of tags: poses of pictures, poses of tags on the body, and what is adjusted beside these.

Levenberg's and Marquardt's method on normal equations from which the pictures are eliminated (Schur complement), so
that a step costs what the tags cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.sights import Bundle, Rows, Sights, linearized

# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0
# Of a shutter that may roll, s from one row to the next: what pictures do not determine has this sigma.
LINE_TIME = 3e-5


@dataclass(frozen=True, eq=False)
class Additional:
    """Prior sigmas of additional parameters; 0 of those that are fixed.

    Attributes:
        given: the cameras that the priors are about; their shutters are taken not to roll.
        intrinsics: (c, n) of fx, fy, cx, cy, px, and of the distortion coefficients; with cameras of fewer coefficients
            the last columns are 0.
        line_time: (c,) s.
    """

    given: tuple[Camera, ...]
    intrinsics: Array
    line_time: Array

    @property
    def sigma(self) -> Array:
        """Prior sigmas (k,) of all additional parameters, the intrinsics first."""
        return np.concatenate([self.intrinsics.ravel(), self.line_time])

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask (k,) of the additional parameters that are estimated."""
        return np.asarray(self.sigma > 0.0)

    def parts(self, numbers: Array) -> tuple[Array, Array]:
        """Numbers (..., k) as those of the intrinsics (..., c, n) and the line times (..., c)."""
        c, n = self.intrinsics.shape
        return numbers[..., : c * n].reshape(*numbers.shape[:-1], c, n), numbers[..., c * n :]

    def off(self, bundle: Bundle) -> Array:
        """Deviation (k,) of a bundle's intrinsics and line times from their priors."""
        out = np.zeros_like(self.intrinsics)
        for row, now, given in zip(out, bundle.cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        return np.concatenate([out.ravel(), bundle.line_time])

    def moved(self, bundle: Bundle, step: Array) -> Bundle:
        """The bundle with a step (k,) added to its additional parameters."""
        intrinsics, line_time = self.parts(step)
        cameras = tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row.any() else camera
            for camera, row in zip(bundle.cameras, intrinsics, strict=True)
        )
        return replace(bundle, cameras=cameras, line_time=bundle.line_time + line_time)

    def rows(self, bundle: Bundle, sights: Sights, rows: Rows) -> Array:
        """Jacobian (m, 8, k) of the errors."""
        m = len(sights)
        out = np.zeros((m, 4, 2, len(self.sigma)))
        intrinsics, line_time = self.parts(out)
        by_time = (rows.by_point @ rows.velocity[..., None])[..., 0] * bundle.lines(sights)[..., None]
        for k, camera in enumerate(bundle.cameras):
            mine = bundle.camera[sights.picture] == k
            by = camera.by_intrinsics(rows.points[mine])
            intrinsics[mine, :, :, k, : by.shape[-1]] = np.nan_to_num(by) / sights.sigma[mine, None, None, None]
            line_time[mine, :, :, k] = by_time[mine]
        return out.reshape(m, 8, -1)


def nothing(bundle: Bundle) -> Additional:
    """Additional parameters of a bundle, all fixed."""
    cameras = bundle.cameras
    widest = max(len(camera.intrinsics) for camera in cameras)
    return Additional(cameras, np.zeros((len(cameras), widest)), np.zeros(len(cameras)))


def shutters(bundle: Bundle) -> Additional:
    """Line times as additional parameters, with a prior of 30 us about none, as a phone's."""
    return replace(nothing(bundle), line_time=np.full(len(bundle.cameras), LINE_TIME))


def with_intrinsics(bundle: Bundle) -> Additional:
    """Line times and cameras about what their calibration says: focal lengths to 0.5 %, the centre to 5 px.

    Each coefficient of the distortion has the sigma that moves the picture's farthest corner by a pixel.
    """
    out = shutters(bundle)
    for row, camera in zip(out.intrinsics, bundle.cameras, strict=True):
        frame = np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
        rays = camera.rays(frame)
        # Where distortion turns back before the corner, the half way there serves.
        rays = np.where(np.isfinite(rays), rays, camera.rays(0.5 * (frame + camera.centre)))
        moves = np.linalg.norm(camera.by_intrinsics(rays), axis=-2).max(axis=0)
        row[:2], row[2:4] = _FOCAL * camera.focal, _CENTRE_PX
        row[4 : len(moves)] = _DISTORTION_PX / np.maximum(moves[4:], 1e-9)
    return out


_STEPS = 40
_DIAGONAL = np.arange(6)
# A step that changes the cost by less than this share ends the adjustment.
_SETTLED = 1e-10
# A picture whose step changes its cost by less than this share stays there.
_STEADY = 1e-6


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with the pictures eliminated.

    Attributes:
        free: (p,) which of the numbers shared by pictures are adjusted: six a tag, then the additional ones.
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
        """Step of the shared numbers (p,), zero where fixed, and of the pictures (f, 6)."""
        moved = -np.linalg.solve(self.information, self.projection)
        pictures = -np.einsum("fij,fj->fi", self.inverse, self.gradient + self.across @ moved)
        shared = np.zeros(len(self.free))
        shared[self.free] = moved
        return shared, pictures


def shared_rows(bundle: Bundle, sights: Sights, rows: Rows, additional: Additional) -> Array:
    """Jacobian (m, 8, p) of the errors by all that pictures share: the tags' poses, then additional parameters."""
    m, tags = len(sights), len(bundle.body.ids)
    out = np.zeros((m, 8, 6 * tags))
    columns = 6 * sights.tag[:, None] + np.arange(6)
    np.put_along_axis(out, np.broadcast_to(columns[:, None], (m, 8, 6)), rows.by_tag, axis=2)
    return np.concatenate([out, additional.rows(bundle, sights, rows)], axis=2) if additional.free.any() else out


def normal_equations(
    bundle: Bundle, sights: Sights, rows: Rows, weights: Array, fixed: int, additional: Additional, damping: float = 0.0
) -> Normal:
    """Normal equations of weighted errors; tag number `fixed` stays, Levenberg's damping is relative."""
    f = len(bundle.cRb)
    own, gradient, At = of_pictures(sights, rows, weights, f)
    J = shared_rows(bundle, sights, rows, additional)
    free = np.concatenate([np.repeat(np.arange(len(bundle.body.ids)) != fixed, 6), additional.free])[: J.shape[2]]
    J = J[..., free]
    across = sights.by_picture(At @ J, f)
    flat, weighted = J.reshape(-1, J.shape[2]), (weights[:, None, None] * J).reshape(-1, J.shape[2])
    information, vector = weighted.T @ flat, weighted.T @ rows.miss.ravel()
    priors = np.arange(J.shape[2] - additional.free.sum(), J.shape[2])
    precision = additional.sigma[additional.free] ** -2.0
    information[priors, priors] += precision
    vector[priors] += precision * additional.off(bundle)[additional.free]
    own[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping
    diagonal = np.diag_indices_from(information)
    # A tag of which nothing is left stays where it is.
    information[diagonal] = np.where(information[diagonal] > 0.0, (1.0 + damping) * information[diagonal], 1.0)
    inverse = np.zeros_like(own)
    seen = own[:, 0, 0] > 0.0
    inverse[seen] = np.linalg.inv(own[seen])
    flat = (inverse @ across).reshape(6 * f, -1)
    information = information - across.reshape(6 * f, -1).T @ flat
    vector = vector - flat.T @ gradient.ravel()
    return Normal(free, np.asarray(information, dtype=float), vector, across, inverse, gradient)


def of_pictures(sights: Sights, rows: Rows, weights: Array, f: int) -> tuple[Array, Array, Array]:
    """Information (f, 6, 6) and gradient (f, 6) of the pictures' poses, and the weighted Jacobians' transposes."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    gradient = sights.by_picture((At @ rows.miss[..., None])[..., 0], f)
    return sights.by_picture(At @ rows.by_picture, f), gradient, At


def moved(bundle: Bundle, shared: Array, pictures: Array, additional: Additional) -> Bundle:
    """The bundle a step on: `shared` (p,) of tags and, if any, additional parameters, `pictures` (f, 6)."""
    tags = len(bundle.body.ids)
    step = shared[: 6 * tags].reshape(tags, 6)
    body = replace(
        bundle.body,
        bRt=so3.multiply(bundle.body.bRt, so3.exp(step[:, :3])),
        position=bundle.body.position + step[:, 3:],
    )
    there = replace(
        bundle,
        body=body,
        cRb=so3.multiply(bundle.cRb, so3.exp(pictures[:, :3])),
        position=bundle.position + pictures[:, 3:],
    )
    return additional.moved(there, shared[6 * tags :]) if len(shared) > 6 * tags else there


def adjusted(
    bundle: Bundle, sights: Sights, fixed: int, additional: Additional, far: float = np.inf, steps: int = _STEPS
) -> tuple[Bundle, Rows]:
    """The bundle of least squares, by Levenberg's and Marquardt's method.

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
        normal = normal_equations(bundle, sights, rows, weights(rows, far), fixed, additional, damping)
        after = moved(bundle, *normal.step(), additional)
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
    """Weights (m,) of Geman's and McClure's loss; 1 without bound."""
    return np.ones(len(rows.miss)) if np.isinf(far) else np.asarray((far / (far + rows.squares)) ** 2)


def loss(squares: Array, far: float) -> Array:
    """Geman's and McClure's loss of sums of squares."""
    return squares if np.isinf(far) else np.asarray(squares * (far / (far + squares)))


def _cost(rows: Rows, bundle: Bundle, additional: Additional, far: float) -> float:
    free = additional.free
    priors = (additional.off(bundle)[free] / additional.sigma[free]) ** 2
    return float(loss(rows.squares, far).sum() + priors.sum())


def refined_pictures(
    bundle: Bundle, sights: Sights, far: float = np.inf, steps: int = 15
) -> tuple[Bundle, Array, Array]:
    """Pictures one by one with the tags where they are; costs (f,) and information (f, 6, 6) of their poses too."""
    f = len(bundle.cRb)
    rows = linearized(bundle, sights)
    cost, damping = _costs(rows, sights, far, f), np.full(f, 1e-3)
    own, gradient, _ = of_pictures(sights, rows, weights(rows, far), f)
    going = own[:, 0, 0] > 0.0
    for _ in range(steps):
        seen = sights[going[sights.picture]]
        if not len(seen):
            break
        damped = own[going]
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[going, None]
        step = np.zeros((f, 6))
        step[going] = -np.linalg.solve(damped, gradient[going, :, None])[..., 0]
        after = replace(
            bundle,
            cRb=so3.multiply(bundle.cRb, so3.exp(step[:, :3])),
            position=bundle.position + step[:, 3:],
        )
        there = linearized(after, seen)
        now = _costs(there, seen, far, f)
        better = going & (now < cost)
        bundle = replace(
            bundle,
            cRb=np.where(better[:, None], after.cRb, bundle.cRb),
            position=np.where(better[:, None], after.position, bundle.position),
        )
        new, slope, _ = of_pictures(seen, there, weights(there, far), f)
        own[better], gradient[better] = new[better], slope[better]
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        going &= np.abs(cost - now) > _STEADY * cost
        cost = np.where(better, now, cost)
    return bundle, cost, own


def _costs(rows: Rows, sights: Sights, far: float, f: int) -> Array:
    """(f,) of the pictures."""
    return np.asarray(np.bincount(sights.picture, loss(rows.squares, far), f), dtype=float)
