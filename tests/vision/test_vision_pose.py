"""Poses of tag bodies: calibrated covariance, planar flips, wrong tags."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import BodyPose, TagBody, estimate_pose, refine_by_pycolmap, refine_here
from alidade.pipelines.vision.tags import Detections

K = np.array([[1150.0, 0, 641.3], [0, 1155.0, 477.8], [0, 0, 1]])
PINHOLE = Camera(1280, 960, K, "plumb_bob", np.array([-0.25, 0.1, 1e-3, -5e-4, 0.02]))
FISHEYE = Camera(1280, 960, K, "equidistant", np.array([0.05, -0.01, 0.0, 0.0]))
FACING = so3.exp([np.pi, 0.0, 0.0])
H = np.sqrt(0.5)
# The cube of the geometry in the contract: faces +z, +x, +y, -x, -y, -z.
CUBE = TagBody(
    ids=np.arange(16, 22),
    size=np.full(6, 0.12),
    bRt=np.array(
        [[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [0, 0, H, H], [0.5, 0.5, -0.5, -0.5], [H, H, 0, 0], [0, 0, 1, 0]]
    ),
    position=0.08 * np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]),
)
SINGLE = TagBody(np.array([5]), np.array([0.12]), so3.identity(1), np.zeros((1, 3)))
BOARD = TagBody(
    np.arange(4), np.full(4, 0.04), so3.identity(4), 0.03 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
)


def _random_pose(rng: np.random.Generator, body: TagBody, distance: float) -> tuple[np.ndarray, np.ndarray]:
    cRb = so3.normalize(rng.normal(size=4)) if body is CUBE else so3.multiply(so3.exp(0.3 * rng.normal(size=3)), FACING)
    return cRb, distance * np.append(rng.uniform([-0.2, -0.15], [0.2, 0.15]), 1.0)


def _seen(
    camera: Camera, body: TagBody, cRb: np.ndarray, position: np.ndarray, sigma: float, rng: np.random.Generator
) -> Detections:
    """Detections of the faces turned to the camera, with noise on the corners."""
    out = so3.rotate(so3.multiply(cRb, body.bRt), [0.0, 0.0, 1.0])
    centre = position + so3.rotate(cRb, body.position)
    seen = (out * centre).sum(axis=1) < -0.25 * np.linalg.norm(centre, axis=1)
    pixels = camera.project(position + so3.rotate(cRb, body.corners[seen]))
    covariance = np.broadcast_to(sigma**2 * np.eye(2), (*pixels.shape, 2))
    return Detections(body.ids[seen], pixels + sigma * rng.normal(size=pixels.shape), covariance)


def _error(pose: BodyPose, cRb: np.ndarray, position: np.ndarray) -> np.ndarray:
    return np.concatenate([so3.log(so3.multiply(so3.inverse(pose.cRb), cRb)), position - pose.position])


@pytest.mark.parametrize(
    ("camera", "body", "distance", "sigma"),
    [
        pytest.param(PINHOLE, SINGLE, 0.5, 0.1, id="single tag"),
        pytest.param(PINHOLE, CUBE, 0.7, 0.2, id="cube", marks=pytest.mark.slow),
        pytest.param(FISHEYE, CUBE, 0.7, 0.1, id="cube, fisheye"),
        pytest.param(PINHOLE, BOARD, 0.5, 0.1, id="board", marks=pytest.mark.slow),
    ],
)
def test_covariance_is_calibrated_and_flips_are_told(
    camera: Camera, body: TagBody, distance: float, sigma: float
) -> None:
    rng = np.random.default_rng(7)
    nees, squares, trials, ambiguous = [], [], 200, 0
    for _ in range(trials):
        cRb, position = _random_pose(rng, body, distance)
        pose = estimate_pose(camera, body, _seen(camera, body, cRb, position, sigma, rng), sigma)
        assert pose is not None
        if pose.ambiguous:
            ambiguous += 1
            continue
        error = _error(pose, cRb, position)
        nees.append(error @ np.linalg.solve(pose.covariance, error))
        squares.append(8 * len(pose.ids) * pose.rms_px**2 / (8 * len(pose.ids) - 6) / sigma**2)
    # No decided pose is a flip (its NEES would be in the thousands), and few stay undecided.
    assert ambiguous < 0.1 * trials
    assert np.max(nees) < 40.0
    # 99 % interval of the mean of n chi-squares of 6 degrees of freedom.
    assert abs(np.mean(nees) - 6.0) < 2.58 * np.sqrt(12.0 / len(nees))
    assert 0.9 < np.mean(squares) < 1.1


def test_exact_corners_give_the_exact_pose() -> None:
    rng = np.random.default_rng(8)
    for camera in (PINHOLE, FISHEYE):
        for body in (SINGLE, BOARD, CUBE):
            cRb, position = _random_pose(rng, body, 0.6)
            pose = estimate_pose(camera, body, _seen(camera, body, cRb, position, 0.0, rng), 0.1)
            assert pose is not None
            np.testing.assert_allclose(_error(pose, cRb, position), 0.0, atol=1e-7)
            assert pose.rms_px < 1e-5


def test_ambiguous_poses_are_said_to_be_so_and_settled_by_an_expected_attitude() -> None:
    rng = np.random.default_rng(9)
    cRb = so3.multiply(so3.exp([0.25, 0.0, 0.0]), FACING)
    position = np.array([0.0, 0.0, 6.0])
    undecided = wrong = 0
    for _ in range(50):
        seen = _seen(PINHOLE, SINGLE, cRb, position, 0.3, rng)
        alone = estimate_pose(PINHOLE, SINGLE, seen, 0.3)
        assert alone is not None
        undecided += alone.ambiguous
        helped = estimate_pose(PINHOLE, SINGLE, seen, 0.3, expected=so3.multiply(cRb, so3.exp([0.02, -0.01, 0.03])))
        assert helped is not None
        wrong += int(not helped.ambiguous and np.linalg.norm(_error(helped, cRb, position)[:3]) > 0.25)
        unhelped = estimate_pose(PINHOLE, SINGLE, seen, 0.3, expected=so3.multiply(so3.exp([0.0, 0.9, 0.0]), FACING))
        assert unhelped is not None
        assert unhelped.ambiguous == alone.ambiguous
    assert undecided > 40
    assert wrong == 0


def test_a_tag_in_the_wrong_place_is_named() -> None:
    rng = np.random.default_rng(10)
    cRb = so3.multiply(so3.exp([0.4, 0.3, 0.2]), FACING)
    position = np.array([0.02, 0.01, 0.5])
    seen = _seen(PINHOLE, BOARD, cRb, position, 0.1, rng)
    seen.corners[2] += [15.0, -9.0]
    pose = estimate_pose(PINHOLE, BOARD, seen, 0.1)
    assert pose is not None
    assert pose.rejected == (2,)
    assert pose.ids.tolist() == [0, 1, 3]
    assert np.linalg.norm(_error(pose, cRb, position)) < 0.02
    # With two tags nothing tells which one is wrong, but the misfit shows.
    two = Detections(seen.ids[1:3], seen.corners[1:3], seen.covariance[1:3])
    pose = estimate_pose(PINHOLE, BOARD, two, 0.1)
    assert pose is not None
    assert pose.rms_px > 1.0


def test_without_sigma_the_misfit_counts() -> None:
    rng = np.random.default_rng(11)
    cRb, position = so3.multiply(so3.exp([0.4, 0.3, 0.2]), FACING), np.array([0.02, 0.01, 0.5])
    true = _seen(PINHOLE, BOARD, cRb, position, 0.2, rng)
    own = estimate_pose(PINHOLE, BOARD, true, None)
    given = estimate_pose(PINHOLE, BOARD, true, 0.2)
    assert own is not None
    assert given is not None
    assert own.covariance[0, 0] >= given.covariance[0, 0]
    optimistic = estimate_pose(PINHOLE, BOARD, Detections(true.ids, true.corners, 1e-4 * true.covariance), None)
    assert optimistic is not None
    np.testing.assert_allclose(optimistic.covariance[0, 0] / given.covariance[0, 0], 1.0, atol=0.6)


def test_nothing_of_the_body_seen() -> None:
    corners = np.array([[[100.0, 200], [150, 200], [150, 150], [100, 150]]])
    other = Detections(np.array([99]), corners, np.zeros((1, 4, 2, 2)))
    assert estimate_pose(PINHOLE, SINGLE, other, 0.1) is None
    twice = Detections(np.array([5, 5]), np.concatenate([corners, corners + 300]), np.zeros((2, 4, 2, 2)))
    assert estimate_pose(PINHOLE, SINGLE, twice, 0.1) is None


def test_bodies_from_the_config() -> None:
    tag = SimpleNamespace(size=0.12, rotation=(0.5, 0.5, 0.5, 0.5), position=(0.08, 0.0, 0.0))
    body = TagBody.from_board(SimpleNamespace(tag_family="36h11", tags={17: tag}))  # type: ignore[arg-type]
    # The face +x of the cube; its x is the body's y, its y the body's z.
    expected = [[0.08, -0.06, -0.06], [0.08, 0.06, -0.06], [0.08, 0.06, 0.06], [0.08, -0.06, 0.06]]
    np.testing.assert_allclose(body.corners[0], expected, atol=1e-15)
    with pytest.raises(InputError, match="no tags"):
        TagBody.from_board(SimpleNamespace(tag_family="36h11", tags={}))  # type: ignore[arg-type]


RATIONAL = Camera(1280, 960, K, "rational_polynomial", np.array([-0.2, 0.1, 1e-3, -5e-4, 0.02, 0.02, 0.01, 1e-3]))


@pytest.mark.parametrize("camera", [PINHOLE, RATIONAL, FISHEYE], ids=lambda camera: camera.distortion_model)
@pytest.mark.parametrize("body", [BOARD, CUBE], ids=["board", "cube"])
def test_poses_and_covariances_without_pycolmap_are_those_by_it(camera: Camera, body: TagBody) -> None:
    """Both begin 3 deg and 1 cm off; pycolmap's convergence is the coarser one."""
    pytest.importorskip("pycolmap")
    rng, compared = np.random.default_rng(3), 0
    for _ in range(10):
        cRb, position = _random_pose(rng, body, 0.7)
        seen = _seen(camera, body, cRb, position, 0.1, rng)
        if len(seen.ids) < 2:
            continue
        corners, pixels = body.corners[np.isin(body.ids, seen.ids)].reshape(-1, 3), seen.corners.reshape(-1, 2)
        start = so3.multiply(cRb, so3.exp([0.03, -0.04, 0.02])), position + 0.01
        here, there = (refine(camera, corners, pixels, *start) for refine in (refine_here, refine_by_pycolmap))
        assert here is not None
        assert there is not None
        scale = np.sqrt(np.diag(here.covariance))
        moved = np.concatenate(
            [so3.log(so3.multiply(so3.inverse(here.cRb), there.cRb)), there.position - here.position]
        )
        assert (np.abs(moved) < 5e-3 * scale).all()  # of what a pixel of noise makes
        by_scale = np.outer(scale, scale)
        np.testing.assert_allclose(there.covariance / by_scale, here.covariance / by_scale, atol=5e-3)
        assert here.square < there.square + 1e-6
        compared += 1
    assert compared >= 5


def test_a_tag_as_far_off_as_its_drawing_allows_is_used() -> None:
    """Places are good to 0.3 mm, corners to a hundredth of that."""
    cRb, position = so3.multiply(so3.exp([0.4, 0.3, 0.2]), FACING), np.array([0.02, 0.01, 0.5])
    for off, rejected in ((3e-4, ()), (3e-3, ()), (1e-2, (2,))):
        place = BOARD.position.copy()
        place[2] += [off, 0.0, 0.0]
        seen = _seen(PINHOLE, replace(BOARD, position=place), cRb, position, 0.002, np.random.default_rng(10))
        exact, drawn = (estimate_pose(PINHOLE, body, seen) for body in (BOARD, replace(BOARD, accuracy=3e-4)))
        assert exact is not None
        assert exact.rejected == (2,)
        assert drawn is not None
        assert drawn.rejected == rejected
