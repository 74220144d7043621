"""Pose of a rigid body of AprilTags from one picture, with its covariance; planar flips are resolved or reported."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import Detections, edge_lengths

if TYPE_CHECKING:
    from alidade.pipelines.settings import Board

# First damping, relative; most steps; the last one moves corners by less than this (norm, px).
_DAMPING, _MAX_STEPS, _SETTLED_PX = 1e-3, 50, 1e-6


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Body pose with minimal reprojection errors.

    Attributes:
        cRb: (4,) attitude of the body in the camera.
        position: (3,) of the body's origin in the camera, m.
        covariance: (6, 6) of delta in cRb Exp(delta) and of the position, for corners with a sigma of 1 px.
        miss: (n, 2) px.
    """

    cRb: Array
    position: Array
    covariance: Array
    miss: Array

    @property
    def square(self) -> float:
        """Sum of squared reprojection errors `miss`, px^2."""
        return float((self.miss**2).sum())


def refine(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """Refine a pose to the local minimum of the reprojection errors; None if there is none.

    By pycolmap, or by ourselves where it has no wheel.

    Args:
        camera: with its distortion.
        corners: (n, 3) in the body's frame, m.
        pixels: (n, 2) where they are seen.
        cRb: (4,) attitude of the body in the camera to begin with.
        position: (3,) of its origin, m.
    """
    return (refine_by_pycolmap if _has_pycolmap() else refine_here)(camera, corners, pixels, cRb, position)


def reprojection_errors(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> Array:
    """Reprojection errors (..., 2), px, projected minus seen, of body corners (..., 3)."""
    return np.asarray(camera.project(position + so3.rotate(cRb, corners)) - pixels)


@cache
def _has_pycolmap() -> bool:
    return importlib.util.find_spec("pycolmap") is not None


def refine_by_pycolmap(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """Refine a pose as `refine`, by pycolmap (Ceres)."""
    import pycolmap

    # A pose that the corners leave open is no fault; its covariance has it.
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.gradient_tolerance = 1e-5
    # Its loss is Cauchy's. This wide (px) it is least squares; much wider, its log(1 + r^2 / scale^2) loses the digits.
    options.loss_function_scale = 100.0
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(pycolmap.Rotation3d(so3.matrix(cRb)), position),
        pixels,
        corners,
        np.ones(len(corners), dtype=bool),
        _colmap_camera(camera),
        options,
        return_covariance=True,
    )
    if found is None:
        return None
    pose = found["cam_from_world"]
    cRb, position = so3.from_matrix(pose.rotation.matrix()), np.array(pose.translation)
    miss = reprojection_errors(camera, corners, pixels, cRb, position)
    if not np.isfinite(miss).all():
        return None
    # pycolmap turns from the left, Exp(2 h) cRb, with h half an angle in c; here cRb Exp(delta): delta = 2 cRb^T h.
    T = np.eye(6)
    T[:3, :3] = 2.0 * so3.matrix(cRb).T
    return PoseFit(cRb, position, T @ found["covariance"] @ T.T, miss)


@lru_cache(maxsize=8)
def _colmap_camera(camera: Camera) -> Any:
    """Convert the camera to pycolmap; the pixel-centre convention cancels, as points and K agree."""
    import pycolmap

    k = np.concatenate([camera.focal, camera.centre, camera.coefficients])
    if camera.distortion_model == "equidistant":
        return pycolmap.Camera(model="OPENCV_FISHEYE", width=camera.width, height=camera.height, params=k)
    k = np.pad(k, (0, 12 - len(k)))
    return pycolmap.Camera(model="FULL_OPENCV", width=camera.width, height=camera.height, params=k)


def refine_here(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """Refine a pose as `refine`, by Levenberg-Marquardt steps with OpenCV's derivatives of the projection."""
    damping = _DAMPING
    miss, J = _linearized(camera, corners, pixels, cRb, position)
    if not np.isfinite(J).all():
        return None
    try:
        for _ in range(_MAX_STEPS):
            H, gradient = J.T @ J, J.T @ miss
            step = -np.linalg.solve(H + np.diag(damping * np.diag(H)), gradient)
            trial = so3.multiply(cRb, so3.exp(step[:3])), position + step[3:]
            tried, by_pose = _linearized(camera, corners, pixels, *trial)
            if tried @ tried <= miss @ miss and np.isfinite(by_pose).all():
                (cRb, position), miss, J, damping = trial, tried, by_pose, 0.1 * damping
            else:
                damping *= 10.0
            if step @ H @ step < _SETTLED_PX**2:
                break
        covariance: Array = np.asarray(np.linalg.inv(J.T @ J), dtype=float)
    except np.linalg.LinAlgError:
        return None
    return PoseFit(cRb, position, covariance, miss.reshape(pixels.shape))


def _linearized(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> tuple[Array, Array]:
    """Reprojection errors (2 n,) of corners (n, 3), px, with their Jacobian (2 n, 6) by attitude and position."""
    R = so3.matrix(cRb)
    seen, by_point = camera.project_with_jacobian(position + corners @ R.T)
    by_turn = np.cross(corners[:, None, :], by_point @ R)  # d(R Exp(delta) x) = R (delta x x)
    return (seen - pixels).ravel(), np.concatenate([by_turn, by_point], axis=-1).reshape(-1, 6)


# Corners of a tag of size 1 in its own frame (x right, y up, z out of the face), in the AprilTag library's order.
SQUARE = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
# OpenCV's IPPE_SQUARE wants top left, top right, bottom right, bottom left.
_IPPE_ORDER = [3, 2, 1, 0]
# Odds of the flipped pose above which a pose is called ambiguous.
_AMBIGUOUS = 1e-3
# Two refined poses closer than this (rad) are one.
_SAME = 1e-4
# Directions this near to the camera's own plane (cosine) have no z = 1 coordinates to start from.
_FORWARD = 0.05
# Tags with a corner less certain than this (sigma, px) only count when there are no better ones.
_POOR_PX = 0.25
# A tag is wrong when the misfit of all, RMS, is this many sigmas of corners and places with it, and this many times
# smaller without it: of four tags 50 mm wide one that is 10 mm off, not one that is 3 mm off.
_WRONG_SIGMAS, _WRONG_GAIN = 5.0, 4.0


@dataclass(frozen=True, eq=False)
class TagBody:
    """Tags fixed to one rigid body b.

    Attributes:
        ids: (n,).
        size: (n,) edge of the black square, m.
        bRt: (n, 4) attitude of each tag's frame (x right, y up, z out of the face, as seen facing it) in b.
        position: (n, 3) centre of each tag in b, m.
        family: tag family.
        accuracy: of the positions, one sigma, m.
    """

    ids: NDArray[np.int64]
    size: Array
    bRt: Array
    position: Array
    family: str = "36h11"
    accuracy: float = 0.0

    @classmethod
    def from_board(cls, board: Board) -> TagBody:
        """Build the body from a config's `tags`. Raises InputError without tags."""
        tags = sorted(board.tags.items())
        if not tags:
            raise InputError("config: no tags are given; name them as {id: {size, rotation, position}}")
        return cls(
            ids=np.array([i for i, _ in tags], dtype=np.int64),
            size=np.array([tag.size for _, tag in tags], dtype=float),
            bRt=so3.normalize(np.array([tag.rotation for _, tag in tags], dtype=float).reshape(-1, 4)),
            position=np.array([tag.position for _, tag in tags], dtype=float).reshape(-1, 3),
            family=board.tag_family,
        )

    @property
    def corners(self) -> Array:
        """Corners (n, 4, 3) in b, m, in the AprilTag library's order."""
        local = SQUARE * self.size[:, None, None]
        return np.asarray(self.position[:, None] + so3.rotate(self.bRt[:, None], local))


@dataclass(frozen=True, eq=False)
class BodyPose:
    """Pose of a body in the camera's optical frame c: a point of b is at `cRb * p + position`.

    Attributes:
        cRb: (4,) attitude.
        position: (3,) origin of b in c, m.
        covariance: (6, 6) of [delta, epsilon]: cRb * Exp(delta) (rad, in b), position + epsilon (m, in c).
        ids: (n,) tags used.
        tag_rms_px: (n,) reprojection error of each tag, px per axis.
        rms_px: the same over all tags.
        rejected: ids of tags that disagree grossly with the others.
        ambiguity: odds (likelihood ratio, 0 to 1) of the flipped pose against this one; 0 where there is none.
        ambiguous: the flip could not be resolved, neither from the corners nor from an expected attitude.
    """

    cRb: Array
    position: Array
    covariance: Array
    ids: NDArray[np.int64]
    tag_rms_px: Array
    rms_px: float
    rejected: tuple[int, ...]
    ambiguity: float
    ambiguous: bool

    @property
    def decided(self) -> bool:
        """Whether the corners alone distinguish the pose from its flip."""
        return self.ambiguity <= _AMBIGUOUS


def estimate_pose(
    camera: Camera,
    body: TagBody,
    detections: Detections,
    sigma_px: float | None = None,
    expected: ArrayLike | None = None,
) -> BodyPose | None:
    """Estimate the body's pose from its tags' corners; None if no tag is seen well and only once.

    Reprojection errors are minimised with the camera's distortion; each tag's two planar solutions
    (T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation", 2014; OpenCV's IPPE_SQUARE) are the starts.

    Args:
        camera: the camera.
        body: tags by id.
        detections: tags in the picture.
        sigma_px: standard deviation of corners, px per axis; None takes the detections' own, or what the misfit shows
            if that is more (a layout that is not exact).
        expected: (4,) attitude cRb expected beforehand; it settles a flip that the corners leave open if the one pose
            is more than twice as near to it as the other.
    """
    mine, seen = seen_once(camera, body, detections)
    variances = np.diagonal(detections.covariance[seen], axis1=-2, axis2=-1)
    worst = variances.max(axis=(1, 2))
    good = np.isfinite(worst) & ((worst < _POOR_PX**2) | (worst == worst.min(initial=np.inf)))
    if not good.any():
        return None
    tags, pixels = part(body, mine[good]), detections.corners[seen[good]]
    sigma, is_raised = (float(np.sqrt(variances[good].mean())), True) if sigma_px is None else (sigma_px, False)
    solution = _solve(camera, tags, pixels, sigma, is_raised, expected)
    expected_px = np.hypot(sigma, body.accuracy * float((edge_lengths(pixels) / tags.size).mean()))
    if solution is None or len(mine) < 3 or solution.rms_px < _WRONG_SIGMAS * expected_px:
        return solution
    # One wrong tag spoils the fit of all: it is the one without which the others agree.
    rests = [np.arange(len(tags.ids)) != k for k in range(len(tags.ids))]
    others = [_solve(camera, part(tags, keep), pixels[keep], sigma, is_raised, expected) for keep in rests]
    best = min((o for o in others if o is not None), key=lambda o: o.rms_px, default=solution)
    if best.rms_px * _WRONG_GAIN > solution.rms_px:
        return solution
    rejected = tuple(set(tags.ids.tolist()) - set(best.ids.tolist()))
    return replace(best, rejected=rejected)


def seen_once(camera: Camera, body: TagBody, detections: Detections) -> tuple[Index, Index]:
    """Indices, in the body and in the picture, of the body's tags that are seen once, in front of the camera."""
    ids, first, counts = np.unique(detections.ids, return_index=True, return_counts=True)
    seen = first[(counts == 1) & np.isin(ids, body.ids)]
    seen = seen[(camera.rays(detections.corners[seen])[..., 2] > _FORWARD).all(axis=1)]
    return (body.ids == detections.ids[seen, None]).argmax(axis=1), seen


def part(body: TagBody, keep: NDArray[Any]) -> TagBody:
    """Return the body with selected tags only."""
    return replace(body, ids=body.ids[keep], size=body.size[keep], bRt=body.bRt[keep], position=body.position[keep])


def _solve(
    camera: Camera, tags: TagBody, pixels: Array, sigma: float, is_raised: bool, expected: ArrayLike | None
) -> BodyPose | None:
    """Solve the pose for corner noise `sigma`, px per axis, raised to the level of the misfit if `is_raised`."""
    fits = sorted(_minima(camera, tags, pixels), key=lambda fit: fit.square)
    if not fits:
        return None
    best = fits[0]
    # A sigma that is too small must not make the flip look impossible.
    variance = max(sigma**2, best.square / (pixels.size - 6))
    odds = float(np.exp(-0.5 * (fits[1].square - best.square) / variance)) if len(fits) > 1 else 0.0
    ambiguous = odds > _AMBIGUOUS
    if ambiguous and expected is not None:
        far = [float(angles(fit.cRb, np.asarray(expected, dtype=float))) for fit in fits]
        best = fits[int(np.argmin(far))]
        ambiguous = 2 * min(far) >= max(far)
    return BodyPose(
        cRb=best.cRb,
        position=best.position,
        covariance=best.covariance * (variance if is_raised else sigma**2),
        ids=tags.ids,
        tag_rms_px=np.sqrt((best.miss.reshape(pixels.shape) ** 2).mean(axis=(1, 2))),
        rms_px=float(np.sqrt((best.miss**2).mean())),
        rejected=(),
        ambiguity=odds,
        ambiguous=ambiguous,
    )


def angles(p: Array, q: Array) -> Array:
    """Angles (...,), rad, of the rotations between attitudes (..., 4)."""
    return np.asarray(np.linalg.norm(so3.local(p, q), axis=-1))


def planar_solutions(camera: Camera, size: Array, pixels: Array) -> tuple[Array, Array]:
    """Both pose solutions of each single tag: cRt (n, 2, 4) and position in c (n, 2, 3), m.

    Args:
        camera: the camera.
        size: (n,) m.
        pixels: (n, 4, 2) corners.
    """
    import cv2

    rays = camera.rays(pixels)
    flat = rays[..., :2] / rays[..., 2:]
    vectors, places = np.zeros((len(size), 2, 3)), np.zeros((len(size), 2, 3))
    for k, edge in enumerate(size):
        square = (edge * SQUARE)[_IPPE_ORDER]
        _, turned, origins, _ = cv2.solvePnPGeneric(
            square, flat[k][_IPPE_ORDER], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        if len(turned):
            vectors[k], places[k] = np.squeeze(turned, axis=-1), np.squeeze(origins, axis=-1)
            continue
        # It gives up where there is next to no perspective: a tag faced squarely is where both flips meet.
        extent = float(np.linalg.norm(flat[k] - np.roll(flat[k], 1, axis=0), axis=1).mean())
        vectors[k], places[k] = [np.pi, 0.0, 0.0], np.append(flat[k].mean(axis=0), 1.0) * edge / extent
    return so3.exp(vectors), places


def _minima(camera: Camera, tags: TagBody, pixels: Array) -> list[PoseFit]:
    """Refine the best start pose, and the best on the other side of the planar flip.

    Starts are both planar solutions of each tag, as poses of the body.
    """
    cRt, place = planar_solutions(camera, tags.size, pixels)
    cRb = so3.multiply(cRt, so3.inverse(tags.bRt)[:, None])
    position = place - so3.rotate(cRb, tags.position[:, None])
    miss = reprojection_errors(camera, tags.corners, pixels, cRb[:, :, None, None], position[:, :, None, None])
    squares = (miss**2).sum(axis=(2, 3, 4))
    squares[~np.isfinite(squares)] = np.inf

    def refined(costs: Array) -> PoseFit | None:
        k = np.unravel_index(costs.argmin(), costs.shape)
        return refine(camera, tags.corners.reshape(-1, 3), pixels.reshape(-1, 2), cRb[k], position[k])

    first = refined(squares)
    if first is None:
        return []
    away = angles(cRb, first.cRb)
    second = refined(np.where(away < away[:, ::-1], np.inf, squares))
    return [first] if second is None or angles(second.cRb, first.cRb) < _SAME else [first, second]
