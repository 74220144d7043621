"""LOS errors from rendered pictures of a tag and of a texture, through large rolls and offsets."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.simulation.rendering import Quad, Renderer, encode, expose, tag_quad
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.tags import UNREADABLE
from alidade.pipelines.vision.target import LOST, los_errors

FOCAL = 2000.0
CAMERA = Camera(
    640,
    480,
    np.array([[FOCAL, 0, 323.4], [0, FOCAL, 236.2], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.2, 0.1, 5e-4, 3e-4]),
)
FACING = so3.exp([np.pi, 0.0, 0.0])
LRC = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
DISTANCE = 30.0


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(CAMERA)


def _texture() -> np.ndarray:
    rng = np.random.default_rng(0)
    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(900, 1200)), (0, 0), s) for s in (3.0, 20.0))
    return np.asarray(np.clip(120 + 35 * fine / fine.std() + 25 * coarse / coarse.std(), 0, 255))


def _cameras(n: int, rng: np.random.Generator, offset_deg: float) -> np.ndarray:
    """cRw (n, 4) about a fixed centre: roll to 15 deg, offsets about x and y of c; the first is not turned."""
    roll = np.deg2rad(np.concatenate([[0.0, 15.0, -15.0], rng.uniform(-15, 15, n - 3)]))
    off = np.deg2rad(np.concatenate([np.zeros((1, 2)), rng.uniform(-offset_deg, offset_deg, (n - 1, 2))]))
    turn = so3.exp(np.column_stack([off, np.zeros(n)]))
    return so3.multiply(so3.exp(np.column_stack([np.zeros((n, 2)), -roll])), turn)


def _expected(cRw: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """phx, phz, roll by their definitions: atan2 of the direction in l, and the twist about the line of sight."""
    out = []
    for R in so3.matrix(cRw):
        lRw = LRC @ R @ LRC.T
        d0, d = LRC @ middle, lRw @ LRC @ middle
        # Parallel transport of the first direction's frame to the new one leaves the twist.
        swing0, swing = (so3.matrix(so3.exp(_between(np.array([0.0, 1.0, 0.0]), v))) for v in (d0, d))
        twist = so3.log(so3.from_matrix(swing.T @ lRw @ swing0))
        out.append([-np.arctan2(d[2], d[1]), np.arctan2(d[0], d[1]), -twist[1]])
    return np.array(out)


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return axis * (np.arcsin(sine) / sine if sine > 0 else 0.0)


def _pictures(renderer: Renderer, quad: Quad, cRw: np.ndarray, rng: np.random.Generator) -> list[tuple[int, bytes]]:
    out = []
    for k, R in enumerate(cRw):
        turned = Quad(quad.texture, quad.size, so3.multiply(R, quad.cRq), so3.rotate(R, quad.position))
        out.append((k * 50_000_000, encode(expose(renderer.radiance([turned]), 0.7, 2.0, rng), "jpeg", 92)))
    return out


def _tag() -> Quad:
    return tag_quad(3, 3.0, so3.multiply(so3.exp([0.1, -0.05, 0.02]), FACING), [0.2, -0.1, DISTANCE])


def _wall() -> Quad:
    return Quad(_texture(), (24.0, 18.0), FACING, np.array([0.0, 0.0, DISTANCE]))


@pytest.mark.parametrize("kind", ["tag", pytest.param("texture", marks=pytest.mark.slow)])
def test_los_errors_are_exact_to_a_tenth_of_a_pixel(renderer: Renderer, kind: str) -> None:
    rng = np.random.default_rng(1)
    quad, middle = (
        (_tag(), _tag().position / np.linalg.norm(_tag().position))
        if kind == "tag"
        else (_wall(), np.array([0, 0, 1.0]))
    )
    cRw = _cameras(10, rng, 2.0 if kind == "tag" else 3.0)
    found = los_errors(_pictures(renderer, quad, cRw, rng), CAMERA)
    assert not found.dropped
    error = found.error - _expected(cRw, middle)
    assert np.sqrt((error[:, :2] ** 2).mean()) * FOCAL < 0.1
    assert np.degrees(np.sqrt((error[:, 2] ** 2).mean())) < 0.02
    assert np.degrees(np.abs(found.error[:, 2]).max()) > 14.0
    nees = np.einsum("ki,kij,kj->k", error[1:], np.linalg.inv(found.covariance[1:]), error[1:])
    assert 0.5 < nees.mean() < 15.0


def test_positive_errors_and_roll_are_where_the_contract_says(renderer: Renderer) -> None:
    rng = np.random.default_rng(2)
    # Target right of the axis: phz > 0; above it: dz > 0, phx < 0. The camera turned clockwise about its axis (x to y):
    # right-handed about +y of l, so roll > 0, and the texture turns the other way.
    turns = so3.exp([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, -0.1]])
    found = los_errors(_pictures(renderer, _wall(), turns, rng), CAMERA)
    right, up, roll = found.error[1:]
    np.testing.assert_allclose(right, [0.0, 0.02, 0.0], atol=2e-4)
    np.testing.assert_allclose(up, [-0.02, 0.0, 0.0], atol=2e-4)
    np.testing.assert_allclose(roll, [0.0, 0.0, 0.1], atol=2e-4)


def test_bad_pictures_are_left_out_and_the_target_is_found_again(renderer: Renderer) -> None:
    rng = np.random.default_rng(3)
    cRw = _cameras(4, rng, 2.0)
    images = _pictures(renderer, _wall(), cRw, rng)
    grey = encode(np.full((480, 640), 100, dtype=np.uint8))
    found = los_errors([*images[:2], (5 * 10**7 + 1, b"x"), (5 * 10**7 + 2, grey), *images[2:]], CAMERA)
    assert found.dropped == {UNREADABLE: 1, LOST: 1}
    np.testing.assert_allclose(found.error, _expected(cRw, np.array([0, 0, 1.0])), atol=4e-4)


def test_nothing_to_look_at() -> None:
    grey = encode(np.full((480, 640), 100, dtype=np.uint8))
    with pytest.raises(InputError, match="no target in the first picture"):
        los_errors([(0, grey)], CAMERA)
    with pytest.raises(InputError, match="no LOS error"):
        los_errors([], CAMERA)
    with pytest.raises(InputError, match="320x240"):
        los_errors([(0, encode(np.zeros((240, 320), dtype=np.uint8)))], CAMERA)
