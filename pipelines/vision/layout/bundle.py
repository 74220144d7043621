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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

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
        """Split numbers (..., k) into intrinsics (..., c, n) and line times (..., c)."""
        c, n = self.intrinsics.shape
        return numbers[..., : c * n].reshape(*numbers.shape[:-1], c, n), numbers[..., c * n :]

    def off(self, bundle: Bundle) -> Array:
        """Deviation (k,) of a bundle's intrinsics and line times from their prior means."""
        out = np.zeros_like(self.intrinsics)
        for row, now, given in zip(out, bundle.cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        return np.concatenate([out.ravel(), bundle.line_time])

    def moved(self, bundle: Bundle, step: Array) -> Bundle:
        """Add a step (k,) to the bundle's additional parameters."""
        intrinsics, line_time = self.parts(step)
        cameras = tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row.any() else camera
            for camera, row in zip(bundle.cameras, intrinsics, strict=True)
        )
        return replace(bundle, cameras=cameras, line_time=bundle.line_time + line_time)

    def rows(self, bundle: Bundle, sights: Sights, rows: Rows) -> Array:
        """Jacobian (m, 8, k) of the reprojection errors by the additional parameters."""
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
    """Return additional parameters of a bundle, all fixed."""
    cameras = bundle.cameras
    widest = max(len(camera.intrinsics) for camera in cameras)
    return Additional(cameras, np.zeros((len(cameras), widest)), np.zeros(len(cameras)))


def shutters(bundle: Bundle) -> Additional:
    """Return free line times, with a prior of 30 us about zero, as for a phone's rolling shutter."""
    return replace(nothing(bundle), line_time=np.full(len(bundle.cameras), LINE_TIME))


def with_intrinsics(bundle: Bundle) -> Additional:
    """Return free line times and intrinsics, near their calibration: focal lengths 0.5 %, centre 5 px.

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
    """Normal equations of a bundle, reduced to the shared unknowns by elimination of the pictures' poses.

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
        """Solve for the step of the shared unknowns (p,), zero where fixed, and of the pictures' poses (f, 6)."""
        moved = -np.linalg.solve(self.information, self.projection)
        pictures = -np.einsum("fij,fj->fi", self.inverse, self.gradient + self.across @ moved)
        shared = np.zeros(len(self.free))
        shared[self.free] = moved
        return shared, pictures


def shared_rows(bundle: Bundle, sights: Sights, rows: Rows, additional: Additional) -> Array:
    """Jacobian (m, 8, p) of the errors by the shared unknowns: the tags' poses, then additional parameters."""
    m, tags = len(sights), len(bundle.body.ids)
    out = np.zeros((m, 8, 6 * tags))
    columns = 6 * sights.tag[:, None] + np.arange(6)
    np.put_along_axis(out, np.broadcast_to(columns[:, None], (m, 8, 6)), rows.by_tag, axis=2)
    return np.concatenate([out, additional.rows(bundle, sights, rows)], axis=2) if additional.free.any() else out


def normal_equations(
    bundle: Bundle, sights: Sights, rows: Rows, weights: Array, fixed: int, additional: Additional, damping: float = 0.0
) -> Normal:
    """Build normal equations of weighted errors; tag `fixed` stays, the damping is relative (Levenberg)."""
    f = len(bundle.cRb)
    own, gradient = of_pictures(sights, rows, weights, f)
    A, J = _blocks(rows.by_picture, sights.picture, f), _blocks(rows.by_tag, sights.tag, len(bundle.body.ids))
    if additional.free.any():
        J = sparse.hstack([J, additional.rows(bundle, sights, rows).reshape(J.shape[0], -1)], "csr")
    free = np.concatenate([np.repeat(np.arange(len(bundle.body.ids)) != fixed, 6), additional.free])[: J.shape[1]]
    J = J[:, free]
    weighted = sparse.diags_array(np.repeat(weights, 8)) @ J
    information, vector = (J.T @ weighted).toarray(), weighted.T @ rows.miss.ravel()
    across = (A.T @ weighted).toarray().reshape(f, 6, -1)
    priors = np.arange(J.shape[1] - additional.free.sum(), J.shape[1])
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


def _blocks(values: Array, columns: Index, count: int) -> Any:
    """Sparse matrix (8 m, 6 count) from each sight's Jacobian (m, 8, 6) by its picture's or tag's pose."""
    m = len(values)
    return sparse.bsr_array((values, columns, np.arange(m + 1)), shape=(8 * m, 6 * count)).tocsr()


def of_pictures(sights: Sights, rows: Rows, weights: Array, f: int) -> tuple[Array, Array]:
    """Information (f, 6, 6) and gradient (f, 6) of the pictures' poses, the tags fixed."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    gradient = sights.by_picture((At @ rows.miss[..., None])[..., 0], f)
    return sights.by_picture(At @ rows.by_picture, f), gradient


def moved(bundle: Bundle, shared: Array, pictures: Array, additional: Additional) -> Bundle:
    """Apply a step to a bundle: `shared` (p,) for tags and additional parameters, `pictures` (f, 6)."""
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
    """Weights (m,) of the Geman-McClure loss; 1 for an infinite bound `far`."""
    return np.ones(len(rows.miss)) if np.isinf(far) else np.asarray((far / (far + rows.squares)) ** 2)


def loss(squares: Array, far: float) -> Array:
    """Geman-McClure loss of sums of squares."""
    return squares if np.isinf(far) else np.asarray(squares * (far / (far + squares)))


def _cost(rows: Rows, bundle: Bundle, additional: Additional, far: float) -> float:
    free = additional.free
    priors = (additional.off(bundle)[free] / additional.sigma[free]) ** 2
    return float(loss(rows.squares, far).sum() + priors.sum())


def refined_pictures(
    bundle: Bundle, sights: Sights, far: float = np.inf, steps: int = 15
) -> tuple[Bundle, Array, Array]:
    """Refine each picture's pose with fixed tags; also return costs (f,) and pose information (f, 6, 6)."""
    f = len(bundle.cRb)
    rows = linearized(bundle, sights)
    cost, damping = _costs(rows, sights, far, f), np.full(f, 1e-3)
    own, gradient = of_pictures(sights, rows, weights(rows, far), f)
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
        new, slope = of_pictures(seen, there, weights(there, far), f)
        own[better], gradient[better] = new[better], slope[better]
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        going &= np.abs(cost - now) > _STEADY * cost
        cost = np.where(better, now, cost)
    return bundle, cost, own


def _costs(rows: Rows, sights: Sights, far: float, f: int) -> Array:
    """Robust cost (f,) of each picture."""
    return np.asarray(np.bincount(sights.picture, loss(rows.squares, far), f), dtype=float)


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

    @property
    def errors_px(self) -> Array:
        """Reprojection errors (m, 4, 2) of the sights used, px."""
        return self.rows.miss.reshape(-1, 4, 2) * self.sights.sigma[:, None, None]

    def rms_px(self, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Weighted root mean square reprojection error of some sights, px per axis."""
        weight = self.weight[self.sights.picture][keep]
        return float(np.sqrt((weight * (self.errors_px**2).mean(axis=(1, 2))[keep]).sum() / weight.sum()))


def fitted(bundle: Bundle, sights: Sights, fixed: int, additional: Additional) -> Fit:
    """Adjust the bundle by maximum likelihood and reject false detections.

    Args:
        bundle: a start.
        sights: with sigmas that are right among each other.
        fixed: index of the tag that stays.
        additional: what is adjusted beside poses.
    """
    used = np.ones(len(sights), dtype=bool)
    # Where the start is it is not yet drawn to what is false.
    squares, sigma = linearized(bundle, sights).squares, None
    for _ in range(_ROUNDS):
        false = _false(sights[used], squares, sigma)
        if sigma is not None and not false.any():
            break
        used[np.flatnonzero(used)[false]] = False
        used[np.flatnonzero(used)[~sights[used].together]] = False
        fit = _reweighted(bundle, sights[used], fixed, additional)
        bundle, sigma = fit.bundle, fit.sigma
        squares = fit.rows.squares * (sigma**2 / fit.weight[fit.sights.picture])
    return replace(fit, whole=np.arange(len(sights)))


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


def _reweighted(bundle: Bundle, sights: Sights, fixed: int, additional: Additional) -> Fit:
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    free = freedom(sights, f)
    shared = 6.0 * (tags - 1) + additional.free.sum()
    # The share of the tags in what a picture determines is theirs, not the noise's.
    free *= 1.0 - shared / max(free.sum(), shared + 1.0)
    sigma, weight = 1.0, np.ones(f)
    for _ in range(_ROUNDS):
        scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
        if additional.line_time.any():
            bundle = with_motion(bundle, np.unique(sights.picture))
        bundle, rows = adjusted(bundle, scaled, fixed, additional)
        squares = np.bincount(sights.picture, rows.squares, f) * sigma**2 / weight
        before, (sigma, weight) = sigma, _scale(squares, free)
        if abs(sigma / before - 1.0) < _SIGMA_SETTLED:
            break
    scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
    bundle, rows = adjusted(bundle, scaled, fixed, additional)
    sigma_px = sigma * float(np.median(sights.sigma))
    return Fit(bundle, scaled, rows, weight, sigma, sigma_px, np.arange(len(sights)), additional)


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
