"""Bundle adjustment of tags: poses of pictures, poses of tags on the body, and what is adjusted beside these.

Levenberg's and Marquardt's method on normal equations from which the pictures are eliminated (Schur complement), so
that a step costs what the tags cost.

A hand-held body is sharp in some pictures and blurred in others. Each picture has a variance of its own, distributed
about a common one, which makes the errors of a picture one draw of a multivariate t distribution (K. Lange, R. Little,
J. Taylor, "Robust statistical modeling using the t distribution", JASA 1989); its weights are found by iteration. How
the body moves in each picture, for shutters that roll, follows from its poses in the pictures before and after.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.sights import Bundle, Index, Rows, Sights, linearized

# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0
# Of a shutter that may roll, s from one row to the next: what pictures do not determine has this sigma.
LINE_TIME = 3e-5


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


_STEPS, _POSE_STEPS = 40, 15
_DIAGONAL = np.arange(6)
# A step that changes the cost by less than this share ends the adjustment.
_SETTLED = 1e-10
# A picture whose step changes its cost by less than this share stays there.
_STEADY = 1e-6


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


def of_pictures(sights: Sights, rows: Rows, columns: Array, weights: Array, f: int) -> tuple[Array, Array]:
    """Information (f, 6, 6) of the pictures' poses, and their products (f, 6, p) with columns (m, 8, p) of errors."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    return sights.by_picture(At @ rows.by_picture, f), sights.by_picture(At @ columns, f)


def pose_steps(
    bundle: Bundle, sights: Sights, rows: Rows, columns: Array, weights: Array, damping: float = 0.0
) -> tuple[Array, Array]:
    """Least-squares pose changes (f, 6, p) of the pictures for columns (m, 8, p) of errors, and their right sides."""
    own, across = of_pictures(sights, rows, columns, weights, len(bundle.cRb))
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
        return np.asarray(costs, dtype=float), *of_pictures(seen, rows, rows.miss[..., None], weights(rows, far), f)

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


# Degrees of freedom of the t distribution.
_NU = 4.0
_ROUNDS, _SIGMA_SETTLED = 12, 1e-3
# A tag in a picture whose corners miss by this many times the picture's sigma is a false detection.
_FAR = 4.0
_MEDIAN_OF_SEVEN = 6.35
# Pictures farther apart than this, s, have no information about each other's motion.
_APART = 0.25
# A polynomial is laid through so many pictures before and after, and through all within this time, s.
_BESIDE, _NEAR = 2, 0.12
_DEGREE = 4


@dataclass(frozen=True, eq=False)
class Fit:
    """Adjusted bundle with its residuals.

    Attributes:
        bundle: with all poses.
        sights: those used; sigma is that of the picture.
        rows: their errors, in these sigmas.
        weight: (f,) of the pictures, about 1; the inverse of their variance over the common one.
        sigma: of a corner in a common picture, in the sigmas given.
        sigma_px: of a corner in a common picture, per axis.
        whole: indices of the sights that were looked at, used or not, in a table of the caller's.
        additional: what was adjusted beside poses.
    """

    bundle: Bundle
    sights: Sights
    rows: Rows
    weight: Array
    sigma: float
    sigma_px: float
    whole: Index
    additional: Additional

    @property
    def curvature(self) -> Array:
        """Ratio (f,) of a picture's true to its weighted information: below 1, as weights depend on errors."""
        squares = np.bincount(self.sights.picture, self.rows.squares, len(self.weight))
        free = np.maximum(freedom(self.sights, len(self.weight)), 1.0)
        return np.asarray(np.maximum(1.0 - 2.0 * squares / ((_NU + free) * free), 0.1))

    def rms_px(self, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Weighted root mean square reprojection error of some sights, px per axis."""
        weight, squares = self.weight[self.sights.picture], self.sights.sigma**2 * self.rows.squares / 8.0
        return float(np.sqrt((weight * squares)[keep].sum() / weight[keep].sum()))


def fitted(bundle: Bundle, sights: Sights, whole: Index, additional: Additional) -> Fit:
    """Adjust the bundle by maximum likelihood and reject false detections; the first tag stays.

    Args:
        bundle: a start.
        sights: with sigmas that are right among each other.
        whole: which of them are looked at.
        additional: what is adjusted beside poses.
    """
    sights, used = sights[whole], np.ones(len(whole), dtype=bool)
    # Where the start is it is not yet drawn to what is false.
    squares, sigma = linearized(bundle, sights).squares, None
    for _ in range(_ROUNDS):
        false = _false(sights[used], squares, sigma)
        if sigma is not None and not false.any():
            break
        used[np.flatnonzero(used)[false]] = False
        used[np.flatnonzero(used)[~sights[used].together]] = False
        fit = _reweighted(bundle, sights[used], whole, additional)
        bundle, sigma = fit.bundle, fit.sigma
        squares = fit.rows.squares * (sigma**2 / fit.weight[fit.sights.picture])
    return fit


def _false(sights: Sights, squares: Array, sigma: float | None) -> NDArray[np.bool_]:
    """Mask (m,) of false detections: sights with far larger errors than the others in the same picture."""
    if sigma is None:
        # The median of a chi-square of seven degrees of freedom; a picture's pose takes one or so of a tag's eight.
        sigma = float(np.sqrt(np.median(squares) / _MEDIAN_OF_SEVEN))
    count = np.bincount(sights.picture)[sights.picture]
    others = np.bincount(sights.picture, squares)[sights.picture] - squares
    # Of the picture without this tag, with what is known of pictures beforehand.
    variance = (_NU * sigma**2 + others) / (_NU + np.maximum(8.0 * (count - 1) - 6.0, 0.0))
    return np.asarray(squares > 8.0 * _FAR**2 * variance)


def _reweighted(bundle: Bundle, sights: Sights, whole: Index, additional: Additional) -> Fit:
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    free = freedom(sights, f)
    shared = 6.0 * (tags - 1) + additional.free.sum()
    # The share of the tags in what a picture determines is theirs, not the noise's.
    free *= 1.0 - shared / max(free.sum(), shared + 1.0)
    sigma, weight = 1.0, np.ones(f)
    for _ in range(_ROUNDS):
        scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
        if additional.sigmas[:, -1].any():
            bundle = with_motion(bundle, np.unique(sights.picture))
        bundle, rows = adjusted(bundle, scaled, 0, additional)
        squares = np.bincount(sights.picture, rows.squares, f) * sigma**2 / weight
        before, (sigma, weight) = sigma, _scale(squares, free)
        if abs(sigma / before - 1.0) < _SIGMA_SETTLED:
            break
    scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
    bundle, rows = adjusted(bundle, scaled, 0, additional)
    sigma_px = sigma * float(np.median(sights.sigma))
    return Fit(bundle, scaled, rows, weight, sigma, sigma_px, whole, additional)


def freedom(sights: Sights, pictures: int) -> Array:
    """Degrees of freedom (f,) of each picture: eight per tag minus six for the pose, at least 0."""
    return np.asarray(np.maximum(8.0 * np.bincount(sights.picture, minlength=pictures) - 6.0, 0.0))


def _scale(squares: Array, freedom: Array) -> tuple[float, Array]:
    """Common sigma and picture weights (f,) by Student's t, from sums of squares and degrees of freedom."""
    variance = float(squares.sum() / freedom.sum())
    for _ in range(200):
        weight = (_NU + freedom) / (_NU + squares / variance)
        before, variance = variance, float((weight * squares).sum() / freedom.sum())
        if abs(variance / before - 1.0) < 1e-6:
            break
    return float(np.sqrt(variance)), np.asarray((_NU + freedom) / (_NU + squares / variance))


def with_motion(bundle: Bundle, pictures: Index) -> Bundle:
    """Estimate the motion during given pictures (in ascending time) from their neighbours; others get zero."""
    motion = np.zeros_like(bundle.motion)
    for run in _runs(bundle, pictures):
        time = bundle.time[run]
        place = np.arange(len(run))
        first = np.minimum(place - _BESIDE, np.searchsorted(time, time - _NEAR)).clip(0)
        last = np.maximum(place + _BESIDE, np.searchsorted(time, time + _NEAR) - 1).clip(max=len(run) - 1)
        for k, a, b in zip(place, first, last, strict=True):
            about = run[a : b + 1]
            turned = so3.local(bundle.cRb[run[k]], bundle.cRb[about])
            away = np.concatenate([turned, bundle.position[about]], axis=1)
            motion[run[k]] = _slope(time[a : b + 1] - time[k], away)
    return replace(bundle, motion=motion)


def _runs(bundle: Bundle, pictures: Index) -> list[Index]:
    """Runs of consecutive pictures of one camera with short gaps in time."""
    gap, camera = np.diff(bundle.time[pictures]), bundle.camera[pictures]
    # Where a time is unknown, NaN, no comparison holds.
    close = (gap > 0.0) & (gap < _APART) & (camera[1:] == camera[:-1])
    return [run for run in np.split(pictures, np.flatnonzero(~close) + 1) if len(run) > 1]


def _slope(t: Array, values: Array) -> Array:
    """Derivative (6,) at t = 0 of the polynomials, of degree four at most, that fit values (n, 6)."""
    scale = np.abs(t).max()
    powers = (t / scale)[:, None] ** np.arange(min(_DEGREE + 1, len(t)))
    return np.asarray(np.linalg.lstsq(powers, values)[0][1] / scale)
