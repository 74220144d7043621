"""Tag detection with refined corners: time, memory and corner errors beside OpenCV's."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.simulation.rendering import Picture, Renderer, expose, tag_quad
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import detect
from benchmarks.measure import Ratio, costs, peak_mib

_FACING = so3.exp([np.pi, 0.0, 0.0])
_SIZE = 0.1
_CORNERS = 0.5 * _SIZE * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
_OFFICIAL = [1, 0, 3, 2]  # of OpenCV's corners
# distance (m), blur (px), noise (grey levels)
_CASES = {"near": (0.4, 0.6, 2.0), "far": (1.7, 0.7, 2.0), "blurred": (0.6, 2.0, 2.0), "noisy": (0.5, 0.7, 8.0)}
_PICTURES = 40
_HARD = 400


def _aruco(method: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = method
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)


def _by_opencv(detector: cv2.aruco.ArucoDetector, picture: Picture) -> Array | None:
    corners, ids, _ = detector.detectMarkers(picture)
    return None if ids is None or len(ids) != 1 else np.asarray(corners[0][0][_OFFICIAL], dtype=float)


def _pictures(camera: Camera, case: tuple[float, float, float]) -> list[tuple[Picture, Array]]:
    """Rendered tags and their true corners."""
    distance, blur, noise = case
    renderer, out = Renderer(camera), []
    for k in range(_PICTURES):
        rng = np.random.default_rng(k)
        z = distance * rng.uniform(0.8, 1.2)
        room = np.maximum(np.array([300.0, 220.0]) - 0.8 * _SIZE * 600 / z, 5.0)
        position = np.append(rng.uniform(-1, 1, 2) * room / 600 * z, z)
        tilt, roll = rng.normal(scale=0.3, size=2), rng.uniform(-np.pi, np.pi)
        cRt = so3.compose(so3.exp([*tilt, 0.0]), so3.exp([0.0, 0.0, roll]), _FACING)
        light = renderer.radiance([tag_quad(k, _SIZE, cRt, position)], 60.0)
        out.append((expose(light, blur, noise, rng), camera.project(position + so3.rotate(cRt, _CORNERS))))
    return out


def corner_errors(camera: Camera) -> Iterator[Ratio]:
    """RMS error, px per axis, over that of OpenCV's best way to find corners."""
    methods = (cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX, cv2.aruco.CORNER_REFINE_APRILTAG)
    detectors = [_aruco(method) for method in methods]
    for name, case in _CASES.items():
        pictures = _pictures(camera, case)
        best = min(_rms([(_by_opencv(d, picture), true) for picture, true in pictures]) for d in detectors)
        ours = _rms([(_by_us(camera, picture), true) for picture, true in pictures])
        compared = f"corner error, {ours:.3f} px per axis, over the best of OpenCV, {best:.3f} px"
        yield Ratio(f"detection.error.{name}", compared, ours / best)


def hard_tags(camera: Camera) -> Ratio:
    """Small, dark, blurred and noisy tags found, over those that OpenCV finds by three windows, its default."""
    renderer, plain, ours, theirs = Renderer(camera), _aruco(cv2.aruco.CORNER_REFINE_NONE), 0, 0
    for k in range(_HARD):
        rng = np.random.default_rng(k)
        distance = 600.0 * _SIZE / rng.uniform(18.0, 60.0)
        cRt = so3.compose(so3.exp([*rng.normal(scale=0.3, size=2), 0.0]), so3.exp([0, 0, rng.uniform(-3, 3)]), _FACING)
        position = np.append(rng.uniform(-0.3, 0.3, 2) * distance, distance)
        light = renderer.radiance([tag_quad(k, _SIZE, cRt, position)], 60.0) * rng.uniform(0.15, 1.0)
        picture = expose(light, rng.uniform(0.5, 3.0), rng.uniform(1.0, 6.0), rng)
        ours += k in detect(picture, camera=camera).ids
        ids = plain.detectMarkers(picture)[1]
        theirs += ids is not None and k in ids
    compared = f"hard tags found, {ours} of {_HARD}, over those by three windows, {theirs}"
    return Ratio("detection.hard", compared, ours / theirs, "higher", 0.05, 1.0)


def _by_us(camera: Camera, picture: Picture) -> Array | None:
    found = detect(picture, camera=camera)
    return found.corners[0] if len(found) == 1 else None


def _rms(pairs: list[tuple[Array | None, Array]]) -> float:
    errors = np.array([found - true for found, true in pairs if found is not None])
    return float(np.sqrt((errors**2).mean()))


def cube_picture() -> tuple[Camera, Picture]:
    """1280x960, three tags of a cube before a textured background."""
    K = np.array([[1150.0, 0, 641.3], [0, 1150.0, 477.8], [0, 0, 1]])
    camera = Camera(1280, 960, K, "plumb_bob", np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    rng = np.random.default_rng(0)
    cRb, position = so3.multiply(so3.exp([0.6, -0.5, 0.3]), _FACING), np.array([0.05, 0.02, 0.6])
    # Three faces of a cube: z, x and y of the body stick out of them.
    faces = so3.exp([[0.0, 0, 0], [0, np.pi / 2, 0], [-np.pi / 2, 0, 0]])
    out = so3.rotate(faces, [0.0, 0.0, 0.08])
    quads = [tag_quad(16 + k, 0.12, so3.multiply(cRb, faces[k]), position + so3.rotate(cRb, out[k])) for k in range(3)]
    clutter = cv2.GaussianBlur(rng.normal(scale=200.0, size=(960, 1280)), (0, 0), 4.0) + 90.0
    return camera, expose(Renderer(camera).radiance(quads, clutter), 0.7, 2.0, rng)


def run() -> Iterator[Ratio]:
    """Pictures a second, memory over many of them, corner errors."""
    cv2.setNumThreads(1)
    camera, picture = cube_picture()
    assert len(detect(picture, camera=camera)) >= 2
    plain = _aruco(cv2.aruco.CORNER_REFINE_NONE)
    a, b = costs([partial(detect, picture, camera=camera), partial(plain.detectMarkers, picture)], rounds=20)
    compared = (
        f"1280x960 with refined corners, {1.0 / a.seconds:.0f} pictures/s (60 wanted), over OpenCV's plain detector"
    )
    yield Ratio("detection.time", compared, a.seconds / b.seconds, ours=a, theirs=b)
    peaks = []
    for _ in range(2):
        for _ in range(100):
            detect(picture, camera=camera)
        peaks.append(peak_mib())
    yield Ratio(
        "detection.memory",
        "peak after 200 pictures over that after 100",
        peaks[1] / peaks[0],
        tolerance=0.02,
        wanted=1.02,
    )
    K = np.array([[600.0, 0, 320.3], [0, 605.0, 239.1], [0, 0, 1]])
    camera = Camera(640, 480, K, "plumb_bob", np.array([-0.25, 0.1, 1e-3, -5e-4, 0.02]))
    yield from corner_errors(camera)
    yield hard_tags(camera)
