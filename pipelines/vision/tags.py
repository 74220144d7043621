"""AprilTags in pictures, with corners to a few hundredths of a pixel and their covariance.

OpenCV's ArucoDetector finds and reads the tags. Their edges are then measured anew: along each of the four edges the
grey profile across it is cut in many places, the place of the step in each profile follows from its area (its first
moment, which the integration over pixels leaves unbiased), a line goes through these places in the space of directions,
where lens distortion does not bend it, and the corners are where the lines meet.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.parallel import allowed
from alidade.pipelines.vision.camera import Camera

Picture = NDArray[np.uint8]

# OpenCV's picture of 36h11 is turned by 180 degrees: its corners 0, 1, 2, 3 (clockwise from its top left) are the
# official bottom right, bottom left, top left, top right. This order makes them the library's.
_OFFICIAL = [1, 0, 3, 2]

# OpenCV's adaptive threshold, px: a narrow window shows small tags; a wide one, in the picture made smaller, those that
# are blurred or dark. One detector for each: a detector with three windows, its default, takes twice as long, and loses
# a tag when it takes the outline of the white margin that one window shows for the same quad as the tag of another.
_NARROW = 5
_WIDE, _SMALLER, _LEAST_SIDE = 11, 0.7, 16
_CUTS = 48  # profiles across an edge
_SAMPLES = 25  # grey values in a profile
_CELLS = 8  # a tag's black square is this many cells wide
_REACH_CELLS = 0.45  # profiles end half way to the next cell's edge, whose blur must stay outside
_REACH_PX = 6.0
_ROUNDS = 6  # at most
_SETTLED_PX = 0.01  # moves of the corners that end the rounds; the next would be a quarter of it or less
_CONTRAST = 8.0  # least difference of white and black, grey levels
_CORRELATION_PX = 1.5  # cuts closer than this share their noise (bilinear sampling of white noise)
# Systematic error of a line, px, when the profile is just as long as the blurred step; where it is cut short, levels
# and neighbouring cells mix. Measured on rendered tags; it grows with the power 1.5 of (length of step / profile).
_CUT_SHORT = 0.01


@dataclass(frozen=True, eq=False)
class Detections:
    """The tags found in one picture.

    Attributes:
        ids: (n,) tag ids.
        corners: (n, 4, 2) px, in the AprilTag library's order: bottom left, bottom right, top right, top left of the
            official picture. Integer coordinates are pixel centres.
        covariance: (n, 4, 2, 2) px^2 of each corner, from the scatter of the edge points about their lines. Infinite
            where an edge could not be measured (outside the picture, too blurred, seen too flat): that corner is
            OpenCV's, which may be off by pixels.
    """

    ids: NDArray[np.int64]
    corners: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.ids)


def edge_lengths(corners: Array) -> Array:
    """Mean length (n,) of the four edges of each tag, px, from its corners (n, 4, 2)."""
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1))


def detect(picture: Picture, family: str = "36h11", camera: Camera | None = None) -> Detections:
    """Find the tags of a family in a grey picture (height, width) and measure their corners.

    With a camera the edges are straight in space; without, they are taken as straight in the picture.

    Raises:
        InputError: the family is not 36h11, or the camera's picture has another size.
    """
    if family != "36h11":
        raise InputError(f"tag_family {family!r}: only 36h11 is supported")
    height, width = picture.shape
    if camera is None:
        camera = Camera(width, height, np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]))
    elif (camera.width, camera.height) != (width, height):
        raise InputError(f"pictures are {width}x{height}, camera_info says {camera.width}x{camera.height}")
    ids, corners = _read(picture)
    if not len(ids):
        return Detections(ids, corners, np.zeros((0, 4, 2, 2)))
    return Detections(ids, *_refine(picture, corners, camera))


def _read(picture: Picture) -> tuple[NDArray[np.int64], Array]:
    """Ids (n,) and rough corners (n, 4, 2), px, of all tags, without duplicates between both detectors."""
    ids, corners = np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
    for detector in _detectors(max(picture.shape)):
        found, numbers, _ = detector.detectMarkers(picture)
        if numbers is None or not len(numbers):
            continue
        more, at = numbers.astype(np.int64).ravel(), np.concatenate(found).astype(float)[:, _OFFICIAL]
        apart = np.linalg.norm(at.mean(axis=1)[:, None] - corners.mean(axis=1), axis=-1)
        side = np.linalg.norm(at[:, 0] - at[:, 1], axis=-1)
        new = ~((more[:, None] == ids) & (apart < side[:, None])).any(axis=1)
        ids, corners = np.concatenate([ids, more[new]]), np.concatenate([corners, at[new]])
    return ids, corners


@cache
def _detectors(width: int) -> tuple[Any, Any]:
    """Build two tag detectors for a picture width, px: one with a narrow threshold window, one with a wide."""
    import cv2

    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    narrow, wide = _parameters(_NARROW), _parameters(_WIDE)
    # OpenCV looks for quads in the picture times side / (side + width ratio), and reads their bits in that of its
    # smaller copies in which they are still some `side` px wide.
    wide.useAruco3Detection = True
    wide.minSideLengthCanonicalImg = _LEAST_SIDE
    wide.minMarkerLengthRatioOriginalImg = _LEAST_SIDE * (1.0 / _SMALLER - 1.0) / width
    return cv2.aruco.ArucoDetector(tags, narrow), cv2.aruco.ArucoDetector(tags, wide)


def _parameters(window: int) -> Any:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    # Small tags: more pixels a cell when the bits are read, and 4 of 36 bits may be wrong (36h11 detects 5 wrong ones).
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.errorCorrectionRate = 0.8
    # The outline of the white margin, 0.03 to 0.04 of the tag's perimeter away, is another quad: by default the two are
    # detected as one, and the tag is lost when the outline comes near the picture's border.
    parameters.minMarkerDistanceRate = 0.03
    parameters.minDistanceToBorder = 0
    return parameters


def _refine(picture: Picture, plain: Array, camera: Camera) -> tuple[Array, Array]:
    """Refine corners (n, 4, 2), px, from edges, with covariances; edge k runs from corner k to k + 1."""
    n = len(plain)
    corners = plain
    centre = np.repeat(plain.mean(axis=1), 4, axis=0)
    blur = np.full(4 * n, np.inf)
    for round_ in range(_ROUNDS):
        start, end = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
        cuts = _cut(picture, start, end, centre, blur)
        blur = cuts.blur
        line, variance = _fit(camera, cuts, start, end)
        line, variance = line.reshape(n, 4, 3), variance.reshape(n, 4, 2)
        # Corner k lies on edge k (at its start) and on edge k - 1 (at its end).
        meet = np.cross(np.roll(line, 1, axis=1), line)
        with np.errstate(all="ignore"):
            met = camera.project(meet * np.sign(meet[..., 2:]))
        lost = ~(np.linalg.norm(met - plain, axis=-1) < _limit(plain))
        lost |= ~np.isfinite(variance[..., 0] + np.roll(variance[..., 1], 1, axis=1))
        before, corners = corners, np.where(lost[..., None], plain, met)
        if round_ and np.abs(corners - before).max() < _SETTLED_PX:  # the first knows no blur
            break
    covariance = _corner_covariance(cuts.normal.reshape(n, 4, 2), variance)
    covariance[lost] = np.inf * np.ones((2, 2))
    return corners, covariance


def _limit(plain: Array) -> Array:
    """Largest shift (n, 1), px, of a corner by the edge refinement: half a cell, within 2 to 5 px."""
    side = edge_lengths(plain)[:, None]
    return np.asarray(np.clip(0.5 * side / _CELLS, 2.0, 5.0))


@dataclass(frozen=True, eq=False)
class _Cuts:
    """Edge profiles across each tag edge, with the position of the step in each.

    Attributes:
        points: (e, c, 2) px.
        weights: (e, c) 0 or 1.
        normal: (e, 2) outward.
        pitch: (e,) px between cuts.
        fullness: (e,) the share of the profile that the blurred step needs; more than 1: cut short.
        blur: (e,) sigma of the step, px.
        level_variance: (e,) px^2, what noise in the black and white levels does to a point.
    """

    points: Array
    weights: Array
    normal: Array
    pitch: Array
    fullness: Array
    blur: Array
    level_variance: Array


def _cut(picture: Picture, start: Array, end: Array, centre: Array, blur: Array) -> _Cuts:
    """Sample profiles across the edges from `start` to `end`, (e, 2), px, of tags about `centre`; black is inside.

    The levels are those beyond the step's `blur`, (e,) px; with infinite blur, the ends of the profiles.
    """
    length = np.linalg.norm(end - start, axis=1)
    along = (end - start) / length[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    middle = 0.5 * (start + end)
    depth = ((middle - centre) * normal).sum(axis=1)
    normal *= np.sign(depth)[:, None]
    reach = np.clip(_REACH_CELLS * 2 * np.abs(depth) / _CELLS, 1.2, _REACH_PX)
    inset = np.minimum(reach + 1.0, 0.3 * length)
    s = np.linspace(-0.5, 0.5, _CUTS)
    feet = middle[:, None] + (s * (length - 2 * inset)[:, None])[..., None] * along[:, None]
    unit = np.linspace(-1.0, 1.0, _SAMPLES)
    t = reach[:, None] * unit
    grey, inside = _sample(picture, feet[:, :, None] + t[:, None, :, None] * normal[:, None, None])
    weights = inside.all(axis=2).astype(float)

    # The step with its blur lies within `near`; beyond it are the levels.
    near = np.minimum(_half_length(blur), reach)
    beyond = np.abs(unit) >= (near / reach)[:, None] * (1 - 1e-9)
    beside = np.stack([beyond & (unit < 0), beyond & (unit > 0)])
    (black, white), noise = _levels(grey, beside, s)
    contrast = white - black
    weights *= contrast > _CONTRAST
    share = np.where(beyond[:, None], unit < 0, (white[..., None] - grey) / np.maximum(contrast, _CONTRAST)[..., None])
    # The area of the black share is the length of the profile's black part (trapezoidal rule).
    step = 2 * reach / (_SAMPLES - 1)
    place = step[:, None] * share.sum(axis=2) - reach[:, None] - 0.5 * step[:, None]
    points = feet + place[..., None] * normal[:, None]

    mean = (share * weights[..., None]).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)[:, None]
    slope, middle_t = -np.diff(mean), 0.5 * (t[:, 1:] + t[:, :-1])
    about = (slope * middle_t).sum(axis=1)
    sigma = np.sqrt(np.maximum((slope * middle_t**2).sum(axis=1) - about**2, 0.1))
    level = np.median(np.maximum(contrast, _CONTRAST), axis=1)
    level_variance = (near / level) ** 2 * (noise**2).sum(axis=0)
    return _Cuts(
        points, weights, normal, (length - 2 * inset) / (_CUTS - 1), _half_length(sigma) / reach, sigma, level_variance
    )


def _half_length(blur: Array) -> Array:
    """Half length, px, of the profile that a step with Gaussian blur of sigma `blur` px needs."""
    return 3.0 * blur + 0.7


def _sample(picture: Picture, where: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Grey values by bilinear interpolation, and a mask of the positions inside the picture."""
    height, width = picture.shape
    x, y = where[..., 0], where[..., 1]
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    inside = (column >= 0) & (column < width - 1) & (row >= 0) & (row < height - 1)
    column, row = np.clip(column, 0, width - 2), np.clip(row, 0, height - 2)
    right, down = x - column, y - row
    flat = picture.ravel()
    i = row * width + column
    a, b, c, d = (flat[i + k].astype(float) for k in (0, 1, width, width + 1))
    upper, lower = a + (b - a) * right, c + (d - c) * right
    return upper + (lower - upper) * down, inside


def _levels(grey: Array, where: NDArray[np.bool_], s: Array) -> tuple[Array, Array]:
    """Grey levels (k, e, c) beside each cut, fitted by a line along the edge, and their scatter (k, e).

    Means of the samples `where`, (k, e, samples). The line goes through medians, which dirt does not move.
    """
    beside = np.einsum("ecs,kes->kec", grey, where / where.sum(axis=2, keepdims=True))
    third = len(s) // 3
    first, last = np.median(beside[..., :third], axis=-1), np.median(beside[..., -third:], axis=-1)
    slope = (last - first) / (s[-third:].mean() - s[:third].mean())
    line = slope[..., None] * s
    level = np.median(beside - line, axis=-1)[..., None] + line
    return level, 1.4826 * np.median(np.abs(beside - level), axis=-1)


def _fit(camera: Camera, cuts: _Cuts, start: Array, end: Array) -> tuple[Array, Array]:
    """Fit edge planes through the camera centre: unit normals (e, 3), and variance at both ends (e, 2), px^2.

    Total least squares on the directions of the points, reweighted (Tukey's biweight) against dirt on the edge.
    """
    rays = camera.rays(cuts.points)
    weights = cuts.weights * np.isfinite(rays[..., 0])
    rays = np.where(weights[..., None] > 0, rays, 0.0)
    # Pixels per radian across the edge, near enough for weights and variances.
    scale = float(camera.focal.mean())
    w = weights
    for _ in range(3):
        moment = np.einsum("ec,eci,ecj->eij", w, rays, rays)
        normal = np.linalg.eigh(moment)[1][..., 0]
        miss = scale * np.einsum("eci,ei->ec", rays, normal)
        spread = 1.4826 * np.median(np.abs(np.where(weights > 0, miss, 0.0)), axis=1) + 1e-3
        w = weights * np.clip(1 - (miss / (4.7 * spread[:, None])) ** 2, 0, 1) ** 2
    return normal, _line_variance(cuts, w, miss, start, end)


def _line_variance(cuts: _Cuts, w: Array, miss: Array, start: Array, end: Array) -> Array:
    """Transverse variance of a fitted line at the edge's ends, px^2; cuts within a pixel share noise."""
    length = np.linalg.norm(end - start, axis=1)
    along = (end - start) / length[:, None]
    at = ((cuts.points - start[:, None]) * along[:, None]).sum(axis=2)
    total = np.maximum(w.sum(axis=1), 1e-9)
    mean = (w * at).sum(axis=1) / total
    square = np.maximum((w * (at - mean[:, None]) ** 2).sum(axis=1) / total, 1e-9)
    # Levels come from medians, which are pi / 2 times as uncertain as means.
    noise = (w * miss**2).sum(axis=1) / np.maximum(total - 2, 1.0) + 0.5 * np.pi * cuts.level_variance
    independent = np.maximum(total * np.minimum(cuts.pitch / _CORRELATION_PX, 1.0), 1.0)
    ends = np.stack([-mean, length - mean], axis=1)
    variance = (noise / independent)[:, None] * (1 + ends**2 / square[:, None]) + (
        _CUT_SHORT * cuts.fullness[:, None] ** 1.5
    ) ** 2
    return np.where(total[:, None] > 0.5 * _CUTS, variance, np.inf)


def _corner_covariance(normal: Array, variance: Array) -> Array:
    """Covariances (n, 4, 2, 2) of corners, px^2, from edge normals and edge-end variances, (n, 4, 2) each."""
    lines = np.stack([np.roll(normal, 1, axis=1), normal], axis=2)
    across = np.stack([np.roll(variance[..., 1], 1, axis=1), variance[..., 0]], axis=2)
    inverse = np.linalg.inv(lines)
    return np.asarray(np.einsum("nkij,nkj,nklj->nkil", inverse, across, inverse))


UNREADABLE = "picture does not decode"

# Pictures below which starting processes, a second or so, is not worth while.
_MANY = 100
# Pictures under way for each process: memory does not grow with their number.
_AHEAD = 4


def detections(
    images: Iterable[tuple[int, bytes]], family: str = "36h11", camera: Camera | None = None
) -> Iterator[tuple[int, Detections | None]]:
    """Yield the stamp and the detected tags of each picture, in order; None for an undecodable picture.

    Raises InputError as `detect` does.
    """
    stream = iter(images)
    first = list(islice(stream, _MANY + 1)) if (jobs := allowed()) > 1 else []
    if len(first) <= _MANY:
        for t_ns, encoded in chain(first, stream):
            yield t_ns, _find(encoded, family, camera)
        return
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _prepare)
    under_way: deque[tuple[int, Future[Detections | None]]] = deque()
    try:
        for t_ns, encoded in chain(first, stream):
            under_way.append((t_ns, pool.submit(_find, encoded, family, camera)))
            if len(under_way) >= _AHEAD * jobs:
                t, found = under_way.popleft()
                yield t, found.result()
        yield from ((t, found.result()) for t, found in under_way)
    finally:
        pool.shutdown(cancel_futures=True)


def decode(encoded: bytes) -> Picture | None:
    """Decode a PNG, JPEG, ... file to a grey picture; None if undecodable."""
    import cv2

    data = np.frombuffer(encoded, dtype=np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    return None if picture is None else np.asarray(picture)


def _prepare() -> None:
    """Set up a worker process: one OpenCV thread, interruptions left to the main process."""
    import cv2

    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _find(encoded: bytes, family: str, camera: Camera | None) -> Detections | None:
    picture = decode(encoded)
    return None if picture is None else detect(picture, family, camera)
