"""Tag corners: accuracy, bias and covariance on rendered tags; real photos with published detections."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.simulation.rendering import Renderer, expose, tag_quad
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import Detections, detect

SIZE = 0.1
# Official order: bottom left, bottom right, top right, top left; x right, y up.
CORNERS = 0.5 * SIZE * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACING = so3.exp([np.pi, 0.0, 0.0])
CAMERA = Camera(
    640,
    480,
    np.array([[600.0, 0, 320.3], [0, 605.0, 239.1], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.25, 0.1, 1e-3, -5e-4, 0.02]),
)
# distance (m), blur (px), noise (grey levels), largest tilt (rad)
CASES = {
    "near": (0.4, 0.6, 2.0, 0.6),
    "far": (1.7, 0.7, 2.0, 0.6),
    "blurred": (0.6, 2.0, 2.0, 0.6),
    "along the pixel grid": (1.0, 0.5, 1.0, 0.02),
}


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(CAMERA)


def _picture(renderer: Renderer, k: int, case: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A picture of tag k somewhere, and its true corners."""
    distance, blur, noise, tilt = case
    rng = np.random.default_rng(k)
    z = distance * rng.uniform(0.8, 1.2)
    room = np.maximum(np.array([300.0, 220.0]) - 0.8 * SIZE * 600 / z, 5.0)
    position = np.append(rng.uniform(-1, 1, 2) * room / 600 * z, z)
    axis = rng.normal(size=2)
    turn = so3.exp([*(axis / np.linalg.norm(axis) * rng.uniform(0, tilt)), 0.0])
    roll = so3.exp([0.0, 0.0, rng.uniform(-np.pi, np.pi) if tilt > 0.1 else rng.normal(scale=0.01)])
    cRt = so3.compose(turn, roll, FACING)
    picture = expose(renderer.radiance([tag_quad(k, SIZE, cRt, position)], 60.0), blur, noise, rng)
    return picture, CAMERA.project(position + so3.rotate(cRt, CORNERS))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_corners_are_unbiased_and_their_covariance_holds(renderer: Renderer, case: tuple[float, ...]) -> None:
    errors, outward, normalized = [], [], []
    for k in range(25):
        picture, true = _picture(renderer, k, case)
        found = detect(picture, camera=CAMERA)
        assert found.ids.tolist() == [k]
        error = found.corners[0] - true
        errors.append(error)
        outward.append(
            (error * (true - true.mean(axis=0)) / np.linalg.norm(true - true.mean(axis=0), axis=1, keepdims=True)).sum(
                axis=1
            )
        )
        normalized.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance[0]), error))
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.01
    assert abs(np.mean(outward)) < 0.02
    # Two degrees of freedom a corner: sigma is right within a factor of two where the pixel grid's share rules.
    assert 0.5 < np.mean(normalized) < 3.5


def test_without_a_camera_edges_are_straight_in_the_picture() -> None:
    pinhole = Camera(640, 480, CAMERA.K)
    rng = np.random.default_rng(5)
    cRt = so3.compose(so3.exp([0.3, -0.4, 0.0]), FACING)
    picture = expose(Renderer(pinhole).radiance([tag_quad(3, SIZE, cRt, [0.05, 0.02, 0.4])]), 0.7, 2.0, rng)
    true = pinhole.project(np.array([0.05, 0.02, 0.4]) + so3.rotate(cRt, CORNERS))
    np.testing.assert_allclose(detect(picture).corners[0], true, atol=0.06)


def test_shading_and_occluding_dirt_do_not_pull_the_corners(renderer: Renderer) -> None:
    cRt = so3.compose(so3.exp([0.3, -0.2, 0.3]), FACING)
    position = np.array([0.01, -0.02, 0.35])
    light = renderer.radiance([tag_quad(12, SIZE, cRt, position)])
    light = light * np.linspace(0.6, 1.1, 640)
    true = CAMERA.project(position + so3.rotate(cRt, CORNERS))
    x, y = np.rint(0.6 * true[0] + 0.4 * true[1]).astype(int)
    light[y - 3 : y + 4, x - 3 : x + 4] = 120.0
    found = detect(expose(light, 0.8, 2.0, np.random.default_rng(1)), camera=CAMERA)
    np.testing.assert_allclose(found.corners[0], true, atol=0.08)


def test_tags_cut_by_the_picture_border_keep_honest_corners(renderer: Renderer) -> None:
    # The white margin and half the profiles of the left edge lie outside.
    position = np.array([-0.1355, 0.0, 0.3])
    picture = expose(renderer.radiance([tag_quad(4, SIZE, FACING, position)]), 0.6, 1.0, np.random.default_rng(2))
    found = detect(picture, camera=CAMERA)
    true = CAMERA.project(position + so3.rotate(FACING, CORNERS))
    assert true[:, 0].min() < 4.0
    if len(found):
        error = found.corners[0] - true
        assert (np.abs(error) < 5.0 * np.sqrt(np.diagonal(found.covariance[0], axis1=1, axis2=2))).all()


def test_tags_whose_white_margin_nearly_touches_the_border_are_found() -> None:
    # The margin's outline, a quad too, comes as near as 2 to 8 px to the upper and lower borders.
    pinhole = Camera(640, 480, np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]]))
    renderer = Renderer(pinhole)
    for z in (0.1574, 0.1588, 0.1603, 0.1618):
        light = renderer.radiance([tag_quad(5, SIZE, FACING, np.array([0.0, 0.0, z]))])
        assert detect(expose(light, 0.6, 1.0, np.random.default_rng(0)), camera=pinhole).ids.tolist() == [5]


@pytest.mark.parametrize(
    ("side", "blur", "light"),
    [(22.0, 0.7, 1.0), (30.0, 0.7, 0.25), (60.0, 1.5, 0.2), (60.0, 3.0, 1.0), (150.0, 3.0, 0.3)],
    ids=["small", "small, dark", "dark, blurred", "very blurred", "dark, very blurred"],
)
def test_small_dark_and_blurred_tags_are_found_once(side: float, blur: float, light: float) -> None:
    """Six tags before clutter; two of them have the same number."""
    pinhole = Camera(640, 480, np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]]))
    places, numbers = [(x, y) for y in (-120.0, 120.0) for x in (-210.0, 0.0, 210.0)], [1, 2, 3, 4, 5, 1]
    found = 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        z = 600.0 * SIZE / side
        turns = so3.compose(so3.exp(np.append(rng.normal(scale=0.2, size=(6, 2)), np.zeros((6, 1)), axis=1)), FACING)
        quads = [
            tag_quad(number, SIZE, cRt, np.array([x / 600.0 * z, y / 600.0 * z, z]))
            for number, cRt, (x, y) in zip(numbers, turns, places, strict=True)
        ]
        clutter = cv2.GaussianBlur(rng.normal(scale=100.0, size=(480, 640)), (0, 0), 4.0) + 90.0
        seen = detect(
            expose(Renderer(pinhole).radiance(quads, clutter) * light, blur, 2.0 * light, rng), camera=pinhole
        )
        assert not set(seen.ids.tolist()) - set(numbers)
        assert np.bincount(seen.ids, minlength=6).max() <= 2
        found += len(seen)
    assert found >= 11, "of 12"


def test_empty_pictures_and_wrong_questions() -> None:
    blank = np.full((480, 640), 90, dtype=np.uint8)
    assert len(detect(blank)) == 0
    with pytest.raises(InputError, match="36h11"):
        detect(blank, family="25h9")
    with pytest.raises(InputError, match="640x480"):
        detect(blank, camera=Camera(1280, 960, CAMERA.K))


def _published(path: Path) -> list[tuple[int, np.ndarray]]:
    """Tags beside a photo. The library that made them puts pixel centres at half integers."""
    numbers = [[float(v) for v in re.findall(r"-?\d+\.?\d*", line)] for line in path.read_text().splitlines()]
    return [(int(n[0]), np.array(n[1:]).reshape(4, 2) - 0.5) for n in numbers if n]


def _nearest(found: Detections, tag_id: int, corners: np.ndarray) -> np.ndarray:
    """(4,) corner distances to the nearest tag found with this id."""
    same = found.corners[found.ids == tag_id]
    distance = np.linalg.norm(same - corners, axis=2)
    return np.asarray(distance[distance.max(axis=1).argmin()])


def test_published_tags_in_photos(shared_data: Path) -> None:
    errors = []
    for photo in sorted((shared_data / "apriltag_photos").glob("*.jpg")):
        found = detect(np.asarray(cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE)))
        for tag_id, corners in _published(photo.with_suffix(".txt")):
            width = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean()
            if width >= 20:
                errors.append(_nearest(found, tag_id, corners))
    assert len(errors) == 21
    assert np.max(errors) < 4.0
    assert np.median(errors) < 0.5
