"""Attitudes of a tag board from rendered pictures, and what is said when there are none."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.simulation.rendering import Renderer, encode, expose, tag_quad
from alidade.pipelines.vision import board as vision
from alidade.pipelines.vision.board import board_attitudes
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import BodyPose, TagBody, estimate_pose
from alidade.pipelines.vision.tags import UNREADABLE, decode, detect, detections

CAMERA = Camera(
    640,
    480,
    np.array([[600.0, 0, 320.3], [0, 605.0, 239.1], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.25, 0.1, 1e-3, -5e-4, 0.02]),
)
# Two tags side by side, a third tilted by 30 degrees: nothing flips.
BOARD = TagBody(
    ids=np.array([0, 1, 2]),
    size=np.full(3, 0.04),
    bRt=np.concatenate([so3.identity(2), so3.exp([[0.5, 0.0, 0.0]])]),
    position=np.array([[-0.03, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, -0.055, -0.012]]),
)
FACING = so3.exp([np.pi, 0.0, 0.0])


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(CAMERA)


def _picture(
    renderer: Renderer,
    cRb: np.ndarray,
    position: np.ndarray,
    rng: np.random.Generator,
    ids: tuple[int, ...] = (0, 1, 2),
) -> np.ndarray:
    quads = [
        tag_quad(i, BOARD.size[k], so3.multiply(cRb, BOARD.bRt[k]), position + so3.rotate(cRb, BOARD.position[k]))
        for k, i in enumerate(ids)
    ]
    return expose(renderer.radiance(quads), 0.6, 2.0, rng)


def test_attitudes_come_with_their_covariance(renderer: Renderer) -> None:
    rng = np.random.default_rng(1)
    cRb = so3.multiply(so3.exp(0.25 * rng.normal(size=(15, 3))), FACING)
    images = [
        (10**9 + k * 40_000_000, encode(_picture(renderer, q, np.array([0.01, 0.02, 0.35]), rng)))
        for k, q in enumerate(cRb)
    ]
    found = board_attitudes(iter(images), CAMERA, BOARD)
    assert found.t_ns.tolist() == [t for t, _ in images]
    assert not any(found.dropped.values())
    error = so3.log(so3.multiply(so3.inverse(found.cRh), cRb))
    assert np.degrees(np.sqrt((error**2).mean())) < 0.03
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance), error)
    assert 1.0 < nees.mean() < 5.0


def test_bad_pictures_are_counted_by_reason(renderer: Renderer) -> None:
    rng = np.random.default_rng(2)
    position = np.array([0.01, 0.02, 0.35])
    tilted = so3.multiply(so3.exp([0.3, 0.2, 0.1]), FACING)
    good = encode(_picture(renderer, tilted, position, rng), "jpeg", 95)
    swapped = encode(_picture(renderer, tilted, position, rng, (1, 0, 2)))
    blank = encode(np.full((480, 640), 90, dtype=np.uint8))
    images = [(0, good), (1, b""), (2, b"\x89PNG not really"), (3, blank), (4, swapped), (5, good[:200])]
    found = board_attitudes(images, CAMERA, BOARD)
    assert found.t_ns.tolist() == [0]
    assert found.dropped == {UNREADABLE: 3, vision.UNSEEN: 1, vision.MISFIT: 1}


def test_nothing_usable_says_why(renderer: Renderer) -> None:
    rng = np.random.default_rng(3)
    other = encode(_picture(renderer, FACING, np.array([0.0, 0.0, 0.4]), rng, (7, 8, 9)))
    for images, says in (
        ([], "no pictures"),
        ([(0, b"rubbish")], "decodes"),
        ([(0, other)], r"tags seen \[7, 8, 9\], the config names \[0, 1, 2\]"),
    ):
        with pytest.raises(InputError, match=says):
            board_attitudes(images, CAMERA, BOARD)


def test_pictures_are_streamed(renderer: Renderer) -> None:
    picture = encode(_picture(renderer, FACING, np.array([0.0, 0.0, 0.4]), np.random.default_rng(4)))
    taken = 0

    def images() -> Iterator[tuple[int, bytes]]:
        nonlocal taken
        while True:
            taken += 1
            yield taken, picture

    found = detections(images(), BOARD.family, CAMERA)
    next(found)
    next(found)
    assert taken == 2


def test_cube_pictures_of_an_independent_simulator(shared_data: Path) -> None:
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    # Tags on the cube as truth.json has them (bodyRtag, x y z w).
    truth = json.loads((shared_data / "contract" / "cube_images.truth.json").read_text())
    tags = {int(i): np.roll(q, 1) for i, q in truth["_truth_frames"]["tags_xyzw"].items()}
    normals = so3.rotate(np.array([tags[i] for i in range(16, 22)]), [0.0, 0.0, 1.0])
    cube = TagBody(
        np.arange(16, 22), np.full(6, 0.12), np.array([tags[i] for i in range(16, 22)]), 0.08 * np.rint(normals)
    )
    camera, poses = None, list[BodyPose | None]()
    with (shared_data / "contract" / "cube_images.mcap").open("rb") as file:
        messages = make_reader(file).iter_messages(topics=["/camera/camera_info", "/camera/image/compressed"])
        for k, (schema, channel, message) in enumerate(messages):
            assert schema is not None
            if channel.topic == "/camera/camera_info":
                info = store.deserialize_cdr(message.data, schema.name)
                camera = Camera(info.width, info.height, info.k, info.distortion_model, info.d)
            elif k % 20 == 0:
                assert camera is not None
                image = store.deserialize_cdr(message.data, schema.name)
                picture = decode(bytes(image.data))
                assert picture is not None
                poses.append(estimate_pose(camera, cube, detect(picture, cube.family, camera)))
    rms = [pose.rms_px for pose in poses if pose is not None]
    assert len(rms) == len(poses) > 20
    assert np.median(rms) < 0.01
    assert max(rms) < 0.2
