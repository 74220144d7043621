"""Pose of a rigid body of AprilTags from one picture, with its covariance; planar flips are resolved or reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.factors import so3
from alidade.factors.so3 import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.refinement import PoseFit, refine, reprojection_errors
from alidade.pipelines.vision.tags import Detections

if TYPE_CHECKING:
    from alidade.pipelines.settings import Board


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
# A tag is wrong when the fit is this many sigmas off with it, and this many times better without it.
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
    """

    ids: NDArray[np.int64]
    size: Array
    bRt: Array
    position: Array
    family: str = "36h11"

    @classmethod
    def from_board(cls, board: Board) -> TagBody:
        """The body that a config's `tags` describe.

        Raises:
            InputError: no tags, or one without a size.
        """
        tags = sorted(board.tags.items())
        if not tags:
            raise InputError("config: no tags are given; name them as {id: {size, rotation, position}}")
        for i, tag in tags:
            if not tag.size > 0:
                raise InputError(f"config: size of tag {i} is {tag.size}; it must be the black square's edge in m")
        return cls(
            ids=np.array([i for i, _ in tags], dtype=np.int64),
            size=np.array([tag.size for _, tag in tags], dtype=float),
            bRt=so3.normalize(np.array([tag.rotation for _, tag in tags], dtype=float).reshape(-1, 4)),
            position=np.array([tag.position for _, tag in tags], dtype=float).reshape(-1, 3),
            family=board.tag_family,
        )

    @property
    def corners(self) -> Array:
        """(n, 4, 3) corners in b, m, in the AprilTag library's order."""
        local = SQUARE * self.size[:, None, None]
        return np.asarray(self.position[:, None] + so3.rotate(self.bRt[:, None], local))


@dataclass(frozen=True, eq=False)
class BodyPose:
    """Where a body stands in the camera's optical frame c: a point of b is at `cRb * p + position`.

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
        """The corners alone distinguish the pose from its flip."""
        return self.ambiguity <= _AMBIGUOUS


def estimate_pose(
    camera: Camera,
    body: TagBody,
    detections: Detections,
    sigma_px: float | None = None,
    expected: ArrayLike | None = None,
) -> BodyPose | None:
    """The body's pose from the corners of its tags; None when none is seen well (or only ids that are seen twice).

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
    ids, counts = np.unique(detections.ids, return_counts=True)
    use = [i for i in ids[counts == 1].tolist() if i in body.ids]
    tags, pixels, variance = _matched(camera, body, detections, use)
    if not len(tags.ids):
        return None
    noise = _Noise(np.sqrt(variance) if sigma_px is None else sigma_px, raised=sigma_px is None)
    solution = _solve(camera, tags, pixels, noise, expected)
    if solution is None or len(use) < 3 or solution.rms_px < _WRONG_SIGMAS * noise.sigma:
        return solution
    # One wrong tag spoils the fit of all: it is the one without which the others agree.
    rests = [np.arange(len(tags.ids)) != k for k in range(len(tags.ids))]
    others = [_solve(camera, part(tags, keep), pixels[keep], noise, expected) for keep in rests]
    best = min((o for o in others if o is not None), key=lambda o: o.rms_px, default=solution)
    if best.rms_px * _WRONG_GAIN > solution.rms_px:
        return solution
    rejected = tuple(set(tags.ids.tolist()) - set(best.ids.tolist()))
    return BodyPose(**{**vars(best), "rejected": rejected})


@dataclass(frozen=True)
class _Noise:
    """Sigma of a corner, px per axis; `raised`: to what the misfit shows, if that is more."""

    sigma: float
    raised: bool


def _matched(camera: Camera, body: TagBody, detections: Detections, use: Sequence[int]) -> tuple[TagBody, Array, float]:
    """The body's tags that are seen, their corners, (n, 4, 2) px, and the mean variance of these, px^2."""
    seen = np.array([int(np.flatnonzero(detections.ids == i)[0]) for i in use], dtype=np.intp)
    variances = np.diagonal(detections.covariance[seen], axis1=-2, axis2=-1)
    worst = variances.max(axis=(1, 2))
    good = np.isfinite(worst) & ((worst < _POOR_PX**2) | (worst == worst.min(initial=np.inf)))
    good &= (camera.rays(detections.corners[seen])[..., 2] > _FORWARD).all(axis=1)
    seen, variances = seen[good], variances[good]
    keep = np.array([int(np.flatnonzero(body.ids == i)[0]) for i in detections.ids[seen]], dtype=np.intp)
    return part(body, keep), detections.corners[seen], float(variances.mean()) if len(seen) else 0.0


def part(body: TagBody, keep: NDArray[Any]) -> TagBody:
    """The body with some of its tags only."""
    return TagBody(body.ids[keep], body.size[keep], body.bRt[keep], body.position[keep], body.family)


def _solve(camera: Camera, tags: TagBody, pixels: Array, noise: _Noise, expected: ArrayLike | None) -> BodyPose | None:
    fits = sorted(_minima(camera, tags, pixels, _starts(camera, tags, pixels)), key=lambda fit: fit.square)
    if not fits:
        return None
    best = fits[0]
    # A sigma that is too small must not make the flip look impossible.
    variance = max(noise.sigma**2, best.square / (pixels.size - 6))
    odds = float(np.exp(-0.5 * (fits[1].square - best.square) / variance)) if len(fits) > 1 else 0.0
    ambiguous = odds > _AMBIGUOUS
    if ambiguous and expected is not None:
        far = [_angle(fit.cRb, np.asarray(expected, dtype=float)) for fit in fits]
        best = fits[int(np.argmin(far))]
        ambiguous = 2 * min(far) >= max(far)
    return BodyPose(
        cRb=best.cRb,
        position=best.position,
        covariance=best.covariance * (variance if noise.raised else noise.sigma**2),
        ids=tags.ids,
        tag_rms_px=np.sqrt((best.miss.reshape(pixels.shape) ** 2).mean(axis=(1, 2))),
        rms_px=float(np.sqrt((best.miss**2).mean())),
        rejected=(),
        ambiguity=odds,
        ambiguous=ambiguous,
    )


def _angle(p: Array, q: Array) -> float:
    return float(np.linalg.norm(so3.log(so3.multiply(so3.inverse(p), q))))


def _starts(camera: Camera, tags: TagBody, pixels: Array) -> list[list[tuple[float, Array, Array]]]:
    """For each tag its planar solutions as body poses: (sum of squares over all tags in px^2, cRb, position)."""
    corners = tags.corners
    starts = []
    for k, (attitudes, places) in enumerate(zip(*planar_solutions(camera, tags.size, pixels), strict=True)):
        pair = []
        for cRt, place in zip(attitudes, places, strict=True):
            cRb = so3.multiply(cRt, so3.inverse(tags.bRt[k]))
            origin = place - so3.rotate(cRb, tags.position[k])
            miss = reprojection_errors(camera, corners, pixels, cRb, origin)
            square_sum = float((miss**2).sum())
            pair.append((square_sum if np.isfinite(square_sum) else np.inf, cRb, origin))
        starts.append(pair)
    return starts


def planar_solutions(camera: Camera, size: Array, pixels: Array) -> tuple[Array, Array]:
    """Both poses that each tag by itself may have: cRt (n, 2, 4) and its place in c (n, 2, 3), m.

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


def _minima(
    camera: Camera, tags: TagBody, pixels: Array, starts: list[list[tuple[float, Array, Array]]]
) -> list[PoseFit]:
    """The refined best start, and the refined best start of those that lie on the other side of the flip."""
    _, cRb, position = min((start for pair in starts for start in pair), key=lambda start: start[0])
    corners, seen = tags.corners.reshape(-1, 3), pixels.reshape(-1, 2)
    first = refine(camera, corners, seen, cRb, position)
    if first is None:
        return []
    far = [max(pair, key=lambda start: _angle(start[1], first.cRb)) for pair in starts if len(pair) > 1]
    if not far:
        return [first]
    _, cRb, position = min(far, key=lambda start: start[0])
    second = refine(camera, corners, seen, cRb, position)
    if second is None or _angle(second.cRb, first.cRb) < _SAME:
        return [first]
    return [first, second]
