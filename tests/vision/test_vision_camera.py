"""Camera models against OpenCV's, and their inverses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera

K = np.array([[620.0, 0.0, 322.7], [0.0, 615.0, 236.4], [0.0, 0.0, 1.0]])
RNG = np.random.default_rng(0)
POINTS = RNG.uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.5], (500, 3))
PINHOLES = {
    "none": ("", []),
    "plumb_bob": ("plumb_bob", [-0.28, 0.09, 1.2e-3, -7e-4, 0.02]),
    "barrel": ("plumb_bob", [-0.4, 0.2, 0.0, 0.0]),
    "rational": ("rational_polynomial", [0.5, 0.1, 1e-3, 5e-4, 0.01, 0.7, 0.2, 0.03]),
}
FISHEYE = Camera(640, 480, K, "equidistant", np.array([0.05, -0.01, 0.003, -0.001]))


@pytest.mark.parametrize(("model", "d"), PINHOLES.values(), ids=PINHOLES.keys())
def test_projection_is_opencvs(model: str, d: list[float]) -> None:
    camera = Camera(640, 480, K, model, np.array(d))
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, np.array(d) if d else None)
    np.testing.assert_allclose(camera.project(POINTS), expected[:, 0], atol=1e-9)


def test_equidistant_projection_is_opencvs() -> None:
    expected, _ = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, FISHEYE.coefficients)
    np.testing.assert_allclose(FISHEYE.project(POINTS), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize(("model", "d"), PINHOLES.values(), ids=PINHOLES.keys())
def test_rays_undo_the_projection(model: str, d: list[float]) -> None:
    camera = Camera(640, 480, K, model, np.array(d))
    x, y = np.meshgrid(np.linspace(-5, 645, 40), np.linspace(-5, 485, 30))
    pixels = np.stack([x, y], axis=-1)
    rays = camera.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0)
    np.testing.assert_allclose(camera.project(3.0 * rays), pixels, atol=2e-9)
    np.testing.assert_allclose(camera.rays(camera.project(POINTS)) * np.linalg.norm(POINTS, axis=1)[:, None], POINTS)


def test_equidistant_sees_behind_its_own_plane() -> None:
    rays = np.array([[np.sin(a), 0.0, np.cos(a)] for a in (0.0, 1e-9, 0.3, 1.5, np.pi / 2, 1.7)])
    np.testing.assert_allclose(FISHEYE.rays(FISHEYE.project(rays)), rays, atol=1e-12)


def test_what_has_no_image_is_nan() -> None:
    pinhole = Camera(640, 480, K)
    assert np.isnan(pinhole.project([0.1, 0.2, -1.0])).all()
    # r (1 - 0.4 r^2) never exceeds 0.61: pixels farther out see nothing.
    folded = Camera(640, 480, K, "plumb_bob", np.array([-0.4, 0.0, 0.0, 0.0]))
    assert np.isnan(folded.rays(K[:2, 2] + [0.7 * 620, 0.0])).all()
    assert np.isfinite(folded.rays(K[:2, 2] + [0.6 * 620, 0.0])).all()


@pytest.mark.parametrize(
    ("k", "model", "d", "says"),
    [
        (np.zeros(9), "plumb_bob", [0.0] * 5, "camera_info zero"),
        (np.array([620.0, 3.0, 320, 0, 620, 240, 0, 0, 1]), "plumb_bob", [], "is not"),
        (np.array([-620.0, 0, 320, 0, 620, 240, 0, 0, 1]), "plumb_bob", [], "fx, fy > 0"),
        (K, "thin_prism", [], "thin_prism"),
        (K, "equidistant", [0.1] * 5, "coefficients"),
        (K, "plumb_bob", [np.nan] * 5, "coefficients"),
    ],
)
def test_impossible_cameras_are_refused(k: np.ndarray, model: str, d: list[float], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Camera(640, 480, k, model, np.array(d))


@pytest.mark.parametrize("name", [*PINHOLES, "equidistant"])
def test_jacobians_are_those_of_differences(name: str) -> None:
    camera = FISHEYE if name == "equidistant" else Camera(640, 480, K, PINHOLES[name][0], np.array(PINHOLES[name][1]))
    points, h = np.vstack([POINTS[:50], [0.0, 0.0, 1.1]]), 1e-6
    if name == "equidistant":
        points = np.vstack([points, [0.8, -0.5, -0.1]])  # more than 90 deg from the axis
    by_point = [(camera.project(points + h * e) - camera.project(points - h * e)) / (2 * h) for e in np.eye(3)]
    pixels, jacobian = camera.project_with_jacobian(points)
    np.testing.assert_allclose(jacobian, np.stack(by_point, axis=-1), atol=1e-5)
    np.testing.assert_allclose(pixels, camera.project(points), rtol=0.0, atol=1e-9)
    given = camera.intrinsics
    by_intrinsics = [
        (camera.with_intrinsics(given + h * e).project(points) - camera.with_intrinsics(given - h * e).project(points))
        / (2 * h)
        for e in np.eye(len(given))
    ]
    np.testing.assert_allclose(camera.by_intrinsics(points), np.stack(by_intrinsics, axis=-1), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "count"),
    [
        ("fisheye", [0.01, 0.0, 0.0, 0.0], "equidistant", 4),
        ("radtan", [-0.1, 0.05, 1e-3, 0.0], "plumb_bob", 5),
        ("PLUMB_BOB", [-0.1, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "plumb_bob", 5),
        ("rational_polynomial", [-0.1, 0.05] + [0.0] * 12, "rational_polynomial", 8),
        ("none", [], "plumb_bob", 5),
    ],
)
def test_other_names_of_a_lens_and_zeros_that_are_no_coefficients(
    name: str, coefficients: list[float], model: str, count: int
) -> None:
    camera = Camera(640, 480, np.diag([500.0, 500.0, 1.0]), name, np.array(coefficients))
    assert (camera.distortion_model, len(camera.coefficients)) == (model, count)


@pytest.mark.parametrize(
    ("name", "coefficients", "message"),
    [
        ("rational_polynomial", [0.1] * 14, "rectify the pictures"),
        ("plumb_bob", [0.1] * 8, "eight are those of rational_polynomial"),
        ("thin_prism_fisheye", [0.0] * 8, "is none of plumb_bob.*rectify"),
    ],
)
def test_another_lens_is_refused_with_what_to_do(name: str, coefficients: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Camera(640, 480, np.diag([500.0, 500.0, 1.0]), name, np.array(coefficients))
