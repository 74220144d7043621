"""The renderer against sampling each pixel many times with OpenCV's camera model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.simulation.rendering import Quad, Renderer, encode, expose, tag_bits, tag_quad
from alidade.pipelines.vision.camera import Camera

K = np.array([[300.0, 0.0, 81.3], [0.0, 305.0, 58.6], [0.0, 0.0, 1.0]])
CAMERAS = {
    "pinhole": Camera(160, 120, K),
    "plumb_bob": Camera(160, 120, K, "plumb_bob", np.array([-0.3, 0.1, 1e-3, -2e-3, 0.0])),
    "equidistant": Camera(160, 120, K, "equidistant", np.array([0.1, -0.02, 0.0, 0.0])),
}
FACING = so3.exp([np.pi, 0.0, 0.0])
each_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def _directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """z = 1 directions by OpenCV's iteration."""
    points = pixels.reshape(-1, 1, 2)
    if camera.distortion_model == "equidistant":
        flat = cv2.fisheye.undistortPoints(points, camera.K, camera.coefficients)
    else:
        end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        flat = cv2.undistortPoints(points, camera.K, camera.coefficients, criteria=end)
    return np.column_stack([flat[:, 0], np.ones(len(points))])


def _sampled(camera: Camera, quad: Quad, pixels: np.ndarray, background: float, parts: int = 200) -> np.ndarray:
    """Mean grey of the pixels' areas by brute force."""
    s = (np.arange(parts) + 0.5) / parts - 0.5
    offsets = np.stack(np.meshgrid(s, s), axis=-1).reshape(-1, 2)
    R, rows, columns = so3.matrix(quad.cRq), *quad.texture.shape
    means = []
    for pixel in pixels:
        rays = _directions(camera, pixel + offsets)
        points = rays * ((R[:, 2] @ quad.position) / (rays @ R[:, 2]))[:, None] - quad.position
        column = np.floor((points @ R[:, 0] / quad.size[0] + 0.5) * columns).astype(int)
        row = np.floor((0.5 - points @ R[:, 1] / quad.size[1]) * rows).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        texel = quad.texture[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        means.append(np.where(inside, texel, background).mean())
    return np.array(means)


@each_camera
@pytest.mark.parametrize(
    "turn",
    [[0.3, -0.4, 0.5], *(pytest.param(turn, marks=pytest.mark.slow) for turn in ([0.0, 0.0, 0.0], [-0.7, 0.2, 2.2]))],
)
def test_pixels_are_means_over_their_areas(camera: Camera, turn: list[float]) -> None:
    rng = np.random.default_rng(1)
    quad = tag_quad(7, 0.1, so3.multiply(so3.exp(turn), FACING), [0.004, -0.003, 0.4])
    light = Renderer(camera).radiance([quad], background=90.0)
    row, column = np.nonzero(np.abs(light - 20) * np.abs(light - 220) * np.abs(light - 90) > 1.0)
    pick = rng.choice(len(row), 40, replace=False)
    difference = light[row, column][pick] - _sampled(camera, quad, np.column_stack([column, row])[pick] * 1.0, 90.0)
    # With 200 grey levels of contrast, 2 levels are 0.01 px of edge; and they must not lean to one side.
    assert np.sqrt((difference**2).mean()) < 2.0
    assert abs(difference.mean()) < 0.5


@each_camera
def test_fine_textures_are_averaged(camera: Camera) -> None:
    rng = np.random.default_rng(2)
    quad = Quad(
        rng.uniform(0, 255, (300, 400)),
        (0.2, 0.15),
        so3.multiply(so3.exp([0.2, 0.3, 0.4]), FACING),
        np.array([0, 0, 0.6]),
    )
    light = Renderer(camera).radiance([quad])
    pixels = rng.integers([60, 40], [100, 80], (30, 2))
    difference = light[pixels[:, 1], pixels[:, 0]] - _sampled(camera, quad, pixels * 1.0, 90.0)
    assert np.sqrt((difference**2).mean()) < 2.0


def test_official_pictures_stand_upright() -> None:
    # The family's first codes, row by row from the top left of the official picture.
    for tag_id, code in enumerate((0xD5D628584, 0xD97F18B49, 0xDD280910E)):
        bits = np.array(list(f"{code:036b}")).reshape(6, 6) == "1"
        np.testing.assert_array_equal(tag_bits(tag_id)[2:8, 2:8], bits)
        assert tag_bits(tag_id)[0].all()
        assert not tag_bits(tag_id)[1, 1:9].any()
    # Seen facing it, the top left cell of the picture is at the top left.
    camera = CAMERAS["pinhole"]
    light = Renderer(camera).radiance([tag_quad(0, 0.08, FACING, [0.0, 0.0, 0.4])])
    step = 0.01 * 300 / 0.4
    for row, column in np.ndindex(6, 6):
        x, y = K[0, 2] + (column - 2.5) * step, K[1, 2] + (row - 2.5) * step
        assert (light[round(y), round(x)] > 100) == tag_bits(0)[2 + row, 2 + column]


def test_near_hides_far_and_touching_faces_leave_no_seam() -> None:
    renderer = Renderer(CAMERAS["plumb_bob"])
    grey = [np.full((1, 1), v) for v in (50.0, 150.0)]
    near = Quad(grey[0], (0.05, 0.05), FACING, np.array([0.0, 0.0, 0.4]))
    far = Quad(grey[1], (1.0, 1.0), FACING, np.array([0.0, 0.0, 0.8]))
    light = renderer.radiance([far, near], background=0.0)
    assert light[58, 81] == 50.0
    assert light.min() > 49.999
    halves = [Quad(grey[1], (0.5, 1.0), FACING, np.array([x, 0.0, 0.8])) for x in (-0.25, 0.25)]
    np.testing.assert_allclose(renderer.radiance(halves, background=0.0)[20:100, 20:140], 150.0, atol=1e-6)
    behind = Quad(grey[1], (1.0, 1.0), so3.identity(), np.array([0.0, 0.0, 0.8]))
    np.testing.assert_array_equal(renderer.radiance([behind], background=7.0), 7.0)


def test_exposure_is_seeded_and_files_decode() -> None:
    light = np.tile(np.linspace(0, 255, 160), (120, 1))
    first, second = (expose(light, 0.7, 3.0, np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    noise = first[:, 40:120] - expose(light, 0.7)[:, 40:120].astype(float)
    assert abs(noise.std() - 3.0) < 0.1
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(encode(first), np.uint8), cv2.IMREAD_UNCHANGED), first)
    assert encode(first, "jpeg")[:2] == b"\xff\xd8"
