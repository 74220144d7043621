"""LOS errors from pictures of a far, fixed target: an AprilTag, or any texture tracked against the first picture.

The camera turns about its own centre, so between two pictures all directions turn alike: d_k = R d_0 for the rays of
matched points, with lens distortion removed. R is fitted to them (S. Umeyama, 1991), and the LOS error and the camera's
roll are read off it. Frames: c optical (x right, y down, z forward); l LOS frame (x right, y forward, z up).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import UNREADABLE, Picture, decode, detect

LOST = "target not found"
POOR = "target's points do not move together"

# Coordinates in l of the axes of c.
_LRC = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_FEATURES, _FEWEST = 300, 20
# KLT window, px, and a feature's largest disagreement with its own way back, px.
_WINDOW, _ROUND_TRIP = 15, 0.5
# A picture is poor when fewer than this share of the target's features agree, or when they scatter more than this, px.
_AGREE, _SCATTER_PX = 0.35, 0.6
# Sigma of a tag's corner, px, below which scatter is not significant.
_FLOOR_PX = 0.01


@dataclass(frozen=True, eq=False)
class LosErrors:
    """LOS errors over pictures.

    Attributes:
        t_ns: (K,) stamps, Unix ns.
        error: (K, 3) rad: phx, phz, and the camera's roll about its line of sight since the first picture.
        covariance: (K, 3, 3) rad^2, of the errors relative to the first picture's.
        dropped: reason -> number of pictures.
    """

    t_ns: NDArray[np.int64]
    error: Array
    covariance: Array
    dropped: dict[str, int]


@dataclass(frozen=True, eq=False)
class _Match:
    """Matched directions (n, 3) in the first and the current picture, with sigma, px."""

    first: Array
    now: Array
    sigma_px: float


def los_errors(images: Iterable[tuple[int, bytes]], camera: Camera) -> LosErrors:
    """Measure LOS errors of the target in the first picture, over a stream of pictures.

    A tag in the first picture is the target (the one nearest the middle), its centre the target's point. Else the whole
    first picture is, and its middle (the optical axis) the point.

    Args:
        images: stamps (ns) and encoded pictures, in time order.
        camera: the camera; pictures of another size raise InputError.

    Raises:
        InputError: no picture decodes, or the first one shows neither a tag nor enough texture.
    """
    target: _Tag | _Texture | None = None
    R = so3.identity()
    rows: list[tuple[int, Array, Array]] = []
    dropped: Counter[str] = Counter()
    for t_ns, encoded in images:
        picture = decode(encoded)
        if picture is None:
            dropped[UNREADABLE] += 1
            continue
        if picture.shape != (camera.height, camera.width):
            raise InputError(
                f"pictures are {picture.shape[1]}x{picture.shape[0]}, camera_info says {camera.width}x{camera.height}"
            )
        if target is None:
            target = _target(picture, camera)
        match = target.find(picture, R)
        if isinstance(match, str):
            dropped[match] += 1
            continue
        R, covariance = _turn(match, camera)
        rows.append((t_ns, *_los(R, target.middle, covariance)))
    if not rows:
        raise InputError(f"no LOS error from the pictures: {dict(dropped) or 'there are none'}")
    t, error, covariances = zip(*rows, strict=True)
    return LosErrors(np.array(t, dtype=np.int64), np.array(error), np.array(covariances), dict(dropped))


def _target(picture: Picture, camera: Camera) -> _Tag | _Texture:
    found = detect(picture, camera=camera)
    good = np.flatnonzero(np.isfinite(found.covariance).all(axis=(1, 2, 3)))
    if len(good):
        off = np.linalg.norm(found.corners[good].mean(axis=1) - camera.centre, axis=1)
        nearest = good[off.argmin()]
        return _Tag(camera, int(found.ids[nearest]), camera.rays(found.corners[nearest]))
    return _Texture(camera, picture)


class _Tag:
    def __init__(self, camera: Camera, tag_id: int, corners: Array) -> None:
        self._camera, self._id, self._first = camera, tag_id, corners
        # Where the diagonals meet.
        middle = np.cross(np.cross(corners[0], corners[2]), np.cross(corners[1], corners[3]))
        self.middle = middle * np.sign(middle @ corners.mean(axis=0)) / np.linalg.norm(middle)

    def find(self, picture: Picture, _: Array) -> _Match | str:
        found = detect(picture, camera=self._camera)
        mine = np.flatnonzero(found.ids == self._id)
        if len(mine) != 1 or not np.isfinite(found.covariance[mine[0]]).all():
            return LOST
        sigma = float(np.sqrt(np.diagonal(found.covariance[mine[0]], axis1=1, axis2=2).mean()))
        return _Match(self._first, self._camera.rays(found.corners[mine[0]]), max(sigma, _FLOOR_PX))


class _Texture:
    def __init__(self, camera: Camera, picture: Picture) -> None:
        import cv2

        self._camera, self._picture = camera, picture
        corners = cv2.goodFeaturesToTrack(picture, _FEATURES, 0.01, 8)
        points = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(float)
        rays = camera.rays(points)
        seen = np.isfinite(rays[:, 0])
        if seen.sum() < _FEWEST:
            raise InputError(
                f"no target in the first picture: no tag 36h11, and {seen.sum()} points of texture where {_FEWEST} are "
                "needed; point the camera at a tag or at something with texture"
            )
        self._points, self._first = points[seen].astype(np.float32), rays[seen]
        x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
        self._rays = camera.rays(np.stack([x, y], axis=-1))
        self.middle = np.array([0.0, 0.0, 1.0])

    def find(self, picture: Picture, ckRc0: Array) -> _Match | str:
        """Track points by KLT from a predicted rotation, again from the rotation found; else search by features."""
        match = self._track(picture, ckRc0)
        if isinstance(match, str):
            start = self._search(picture)
            match = match if start is None else self._track(picture, start)
        if isinstance(match, str):
            return match
        turn, _ = _turn(match, self._camera)
        return self._track(picture, turn)

    def _track(self, picture: Picture, ckRc0: Array) -> _Match | str:
        import cv2

        # The picture as the camera of the first one would have taken it; points then hardly move.
        where = self._camera.project(so3.rotate(ckRc0, self._rays)).astype(np.float32)
        turned = cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
        track = partial(cv2.calcOpticalFlowPyrLK, winSize=(_WINDOW, _WINDOW), maxLevel=3, criteria=end)
        there, found, _ = track(self._picture, turned, self._points[:, None], None)
        back, returned, _ = track(turned, self._picture, there, None)
        there = there[:, 0].astype(float)
        now = so3.rotate(ckRc0, self._camera.rays(there))
        pixels = self._camera.project(now)
        good = (found[:, 0] > 0) & (returned[:, 0] > 0)
        good &= np.linalg.norm(back[:, 0] - self._points, axis=1) < _ROUND_TRIP
        # Points whose window left the picture track its border.
        good &= ((pixels > _WINDOW) & (pixels < (self._camera.width - _WINDOW, self._camera.height - _WINDOW))).all(
            axis=1
        )
        if good.sum() < _FEWEST:
            return LOST
        return self._agreeing(good, there, now)

    def _agreeing(self, good: NDArray[np.bool_], there: Array, now: Array) -> _Match | str:
        """Keep the points consistent with one similarity (RANSAC), or return the reason for too few."""
        import cv2

        rows = np.flatnonzero(good)
        _, agrees = cv2.estimateAffinePartial2D(self._points[rows], there[rows], ransacReprojThreshold=1.5)
        rows = rows[agrees.ravel() > 0] if agrees is not None else rows[:0]
        if len(rows) < _FEWEST or len(rows) < _AGREE * len(self._points):
            return LOST if len(rows) < _FEWEST else POOR
        match = _Match(self._first[rows], now[rows], 0.0)
        turn, _ = _turn(match, self._camera)
        miss = _miss(match, turn, self._camera)
        scatter = 1.4826 * float(np.median(np.abs(miss)))
        if scatter > _SCATTER_PX:
            return POOR
        near = np.linalg.norm(miss, axis=1) < 4.0 * scatter + 1e-3
        return _Match(self._first[rows[near]], now[rows[near]], scatter)

    def _search(self, picture: Picture) -> Array | None:
        """Rotation (4,) of a picture by matched ORB features, without prediction; None if too few match."""
        import cv2

        orb = cv2.ORB.create(800)
        (here, mine), (there, other) = (orb.detectAndCompute(p, None) for p in (self._picture, picture))
        if mine is None or other is None:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(mine, other)
        first = np.array([here[m.queryIdx].pt for m in pairs]).reshape(-1, 2)
        now = np.array([there[m.trainIdx].pt for m in pairs]).reshape(-1, 2)
        if len(pairs) < _FEWEST:
            return None
        _, agrees = cv2.estimateAffinePartial2D(first, now, ransacReprojThreshold=4.0)
        keep = np.zeros(len(pairs), dtype=bool) if agrees is None else agrees.ravel() > 0
        if keep.sum() < _FEWEST:
            return None
        rays = self._camera.rays(first[keep]), self._camera.rays(now[keep])
        return _turn(_Match(*rays, 1.0), self._camera)[0]


def _turn(match: _Match, camera: Camera) -> tuple[Array, Array]:
    """Rotation ckRc0 (4,) from first to current directions, and its covariance in c (3, 3), rad^2."""
    n = len(match.now)
    # A direction has no information about a turn about itself.
    information = n * np.eye(3) - match.now.T @ match.now
    sigma = match.sigma_px / float(camera.focal.mean())
    return so3.align(match.now, match.first), np.asarray(sigma**2 * np.linalg.inv(information))


def _miss(match: _Match, ckRc0: Array, camera: Camera) -> Array:
    """Residuals (n, 2), px, of the current points against the rotated first ones."""
    return camera.project(match.now) - camera.project(so3.rotate(ckRc0, match.first))


def _los(ckRc0: Array, middle: Array, covariance: Array) -> tuple[Array, Array]:
    """Convert a rotation to phx, phz, roll (3,), rad, with covariance; `covariance` is that of a left rotation in c.

    The target's frame t has y towards the target and is not twisted against l in the first picture; the roll is the
    twist of t about the line of sight (the texture turns the other way than the camera).
    """
    l0Rt = so3.shortest([0.0, 1.0, 0.0], _LRC @ middle)

    def read(turn: Array) -> Array:
        R = so3.multiply(so3.exp(turn), ckRc0)
        lRt = so3.multiply(so3.from_matrix(_LRC @ so3.matrix(R) @ _LRC.T), l0Rt)
        d = so3.rotate(lRt, [0.0, 1.0, 0.0])
        twist = 2.0 * np.arctan2(lRt[2], lRt[0])
        roll = -np.arctan2(np.sin(twist), np.cos(twist))
        return np.array([-np.arctan2(d[2], d[1]), np.arctan2(d[0], d[1]), roll])

    step = 1e-6
    J = np.stack([(read(e) - read(-e)) / (2 * step) for e in step * np.eye(3)], axis=1)
    return read(np.zeros(3)), J @ covariance @ J.T
