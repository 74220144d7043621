"""Layouts of tags from their corners in pictures, which are drawn by OpenCV's projection, not the estimator's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.config import configured
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.tags import cube_layout
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout import Layout, Shots, estimate_layout
from alidade.pipelines.vision.layout.bundle import (
    Additional,
    Bundle,
    Sights,
    free_columns,
    linearized,
    moved,
    shared_rows,
)
from alidade.pipelines.vision.layout.placing import mirrored
from alidade.pipelines.vision.pose import TagBody, estimate_pose
from alidade.pipelines.vision.tags import Detections
from datasets import tagslam_block

K = np.array([[1150.0, 0, 641.3], [0, 1155.0, 477.8], [0, 0, 1]])
CAMERA = Camera(1280, 960, K, "plumb_bob", np.array([-0.25, 0.1, 1e-3, -5e-4, 0.02]))
SQUARE = 0.5 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
SIGMA = 0.3


@dataclass(frozen=True)
class Scene:
    """Tags about a ball, and pictures of it."""

    body: TagBody
    pictures: list[Detections]
    sides: np.ndarray

    def given(self) -> TagBody:
        """Ids, sizes and the first tag's pose."""
        n = len(self.body.ids)
        return replace(
            self.body,
            bRt=np.concatenate([self.body.bRt[:1], so3.identity(n - 1)]),
            position=np.concatenate([self.body.position[:1], np.zeros((n - 1, 3))]),
        )

    def errors(self, layout: Layout) -> np.ndarray:
        """(6 (n - 1),) of the tags after the first."""
        rows = np.searchsorted(self.body.ids, layout.body.ids)
        turned = so3.log(so3.multiply(so3.inverse(self.body.bRt[rows]), layout.body.bRt))
        return np.concatenate([turned, layout.body.position - self.body.position[rows]], axis=1)[1:].ravel()


def scene(
    tags: int,
    pictures: int,
    seed: int,
    camera: Camera = CAMERA,
    distance: tuple[float, float] = (0.7, 1.35),
    take: int = 0,
    bend: float = 0.0,
) -> Scene:
    """A body that the seed gives, and pictures and noise of one of several takes of it.

    Corners are off a square by `bend` of the tag's size, one sigma each way, but for what turns or moves the tag.
    """
    rng = np.random.default_rng(seed)
    body, R = _body(tags, rng)
    bends = np.zeros((tags, 4, 3))
    if bend:
        rigid = np.concatenate([np.cross(np.eye(3)[:, None], SQUARE), np.broadcast_to(np.eye(3)[:, None], (3, 4, 3))])
        axes = np.linalg.qr(rigid.reshape(6, 12).T)[0]
        off = bend * np.random.default_rng([seed, 99]).normal(size=(tags, 12))
        bends = (off - off @ axes @ axes.T).reshape(tags, 4, 3)
    rng = np.random.default_rng([seed, take]) if take else rng
    found: list[Detections] = []
    sides: list[float] = []
    while len(found) < pictures:
        seen = _picture(body, R, bends, camera, distance, rng)
        if seen:
            ids, corners = np.array(list(seen)), np.array(list(seen.values()))
            sides += np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1).tolist()
            found.append(detections(ids, corners + SIGMA * rng.normal(size=corners.shape)))
    return Scene(body, found, np.array(sides))


def _body(tags: int, rng: np.random.Generator) -> tuple[TagBody, np.ndarray]:
    """Tags about a ball, and their attitudes as matrices."""
    k = np.arange(tags) + 0.5
    up, turn = 1 - 2 * k / tags, np.pi * (1 + 5**0.5) * k
    out = np.stack([np.sqrt(1 - up**2) * np.cos(turn), np.sqrt(1 - up**2) * np.sin(turn), up], axis=1)
    R = []
    for direction in out:
        z = direction + 0.15 * rng.normal(size=3)
        z /= np.linalg.norm(z)
        x = np.cross(rng.normal(size=3), z)
        x /= np.linalg.norm(x)
        R.append(np.stack([x, np.cross(z, x), z], axis=1))
    return TagBody(np.arange(tags), rng.uniform(0.02, 0.037, tags), so3.from_matrix(np.array(R)), 0.1 * out), np.array(
        R
    )


def detections(ids: np.ndarray, corners: np.ndarray) -> Detections:
    return Detections(ids, corners, np.tile(SIGMA**2 * np.eye(2), (len(ids), 4, 1, 1)))


def _picture(
    body: TagBody,
    R: np.ndarray,
    bends: np.ndarray,
    camera: Camera,
    distance: tuple[float, float],
    rng: np.random.Generator,
) -> dict[int, np.ndarray]:
    vector = rng.normal(size=3)
    vector *= rng.uniform(0, np.pi) / np.linalg.norm(vector)
    at = np.append(rng.uniform([-0.12, -0.09], [0.12, 0.09]), 1) * rng.uniform(*distance)
    turn, _ = cv2.Rodrigues(vector)
    seen = {}
    for i in range(len(R)):
        centre = turn @ body.position[i] + at
        if -(turn @ R[i][:, 2]) @ centre / np.linalg.norm(centre) < 0.35:
            continue
        points = (R[i] @ (body.size[i] * (SQUARE + bends[i])).T).T + body.position[i]
        pixels = cv2.projectPoints(points, vector, at, camera.K, camera.coefficients)[0][:, 0]
        if ((pixels > 5) & (pixels < [1275, 955])).all():
            seen[i] = pixels
    return seen


@cache
def found(tags: int, pictures: int, seed: int, bend: float = 0.0) -> tuple[Scene, Layout]:
    """A scene and the layout of its pictures."""
    drawn = scene(tags, pictures, seed, bend=bend)
    return drawn, estimate_layout([Shots(CAMERA, drawn.pictures)], drawn.given())


def nees(tags: int, pictures: int, seeds: range, bend: float = 0.0) -> float:
    """Mean over sessions of the squared error of a layout in its own sigmas, per number."""
    squares = []
    for seed in seeds:
        drawn, layout = found(tags, pictures, seed, bend)
        assert len(layout.body.ids) == tags
        assert 10.0 < drawn.sides.min() < 20.0 < 40.0 < drawn.sides.max() < 75.0
        error = drawn.errors(layout)
        squares.append(float(error @ np.linalg.solve(layout.covariance, error)) / len(error))
    return float(np.mean(squares))


def test_sigmas_of_a_small_layout_hold() -> None:
    # Mean of 2 * 42 squares: 1 +- 0.15.
    assert 0.7 < nees(8, 40, range(2)) < 1.3


@pytest.mark.slow
def test_sigmas_of_bent_tags_hold() -> None:
    assert 0.75 < nees(8, 40, range(3), bend=2e-3) < 1.3


@pytest.mark.slow
@pytest.mark.parametrize(("tags", "pictures"), [(18, 80), (30, 80)])
def test_sigmas_of_large_layouts_hold(tags: int, pictures: int) -> None:
    spread = 1.96 * (2 / (20 * 6 * (tags - 1))) ** 0.5
    assert abs(nees(tags, pictures, range(20)) - 1.0) < spread


@pytest.mark.slow
@pytest.mark.parametrize(("tags", "pictures"), [(18, 80), (30, 80)])
def test_sigmas_of_large_layouts_of_bent_tags_hold(tags: int, pictures: int) -> None:
    """Never too small; up to a tenth too large, since bends count as noise of the corners too."""
    spread = 1.96 * (2 / (20 * 6 * (tags - 1))) ** 0.5
    assert 0.81 < nees(tags, pictures, range(20), bend=2e-3) < 1.0 + spread


def test_how_far_tags_are_bent_is_told() -> None:
    for bend, least, most in ((0.0, 0.0, 2e-3), (8e-3, 6e-3, 1e-2)):
        _, layout = found(8, 40, 1, bend)
        assert least <= layout.bend < most


def _waved(tags: int, pictures: int, seed: int, line_time: float, rate_hz: float = 25.0) -> tuple[Scene, np.ndarray]:
    """A body waved before the camera: each corner is where it is when its row is exposed; stamps, s, too."""
    rng = np.random.default_rng(seed)
    body, R = _body(tags, rng)
    f, phase = rng.uniform(0.3, 0.8, 6), rng.uniform(0.0, 6.0, 6)
    spread = np.array([2.0, 2.0, 2.0, 0.08, 0.06, 0.1])
    corners = np.einsum("nij,nkj->nki", R, body.size[:, None, None] * SQUARE) + body.position[:, None]

    def pose(t: float) -> tuple[np.ndarray, np.ndarray]:
        wave = spread * np.sin(2.0 * np.pi * f * t + phase)
        return wave[:3], wave[3:] + [0.0, 0.0, 0.8]

    time = np.arange(pictures) / rate_hz
    found = []
    for t in time:
        vector, at = pose(t)
        turn = cv2.Rodrigues(vector)[0]
        centre = body.position @ turn.T + at
        facing = -np.einsum("ni,ni->n", R[:, :, 2] @ turn.T, centre) / np.linalg.norm(centre, axis=1)
        ids = np.flatnonzero(facing > 0.35)
        seen = np.full((len(ids), 4, 2), 0.5 * (CAMERA.height - 1))
        for _ in range(5):
            for i, k in np.ndindex(len(ids), 4):
                there = pose(t + line_time * (seen[i, k, 1] - 0.5 * (CAMERA.height - 1)))
                point = corners[ids[i], k][None]
                seen[i, k] = cv2.projectPoints(point, *there, CAMERA.K, CAMERA.coefficients)[0][0, 0]
        inside = ((seen > 5) & (seen < [1275, 955])).all(axis=(1, 2))
        found.append(detections(ids[inside], seen[inside] + SIGMA * rng.normal(size=(int(inside.sum()), 4, 2))))
    return Scene(body, found, np.zeros(0)), time


@pytest.mark.parametrize("line_time", [pytest.param(0.0, marks=pytest.mark.slow), 2e-5])
def test_a_shutter_that_rolls_is_told(line_time: float) -> None:
    drawn, time = _waved(7, 75, 0, line_time)
    layout = estimate_layout([Shots(CAMERA, drawn.pictures, time.tolist())], drawn.given())
    assert layout.line_time_sigma[0] < 1e-6
    assert abs(layout.line_time[0] - line_time) < 3.5 * layout.line_time_sigma[0]
    assert layout.rms_px < 1.1 * SIGMA
    error = drawn.errors(layout)
    assert float(error @ np.linalg.solve(layout.covariance, error)) / len(error) < 1.8


def test_pictures_of_unknown_time_or_far_apart_tell_nothing_of_the_shutter() -> None:
    drawn, untimed = found(8, 40, 0)
    timed = estimate_layout([Shots(CAMERA, drawn.pictures, np.arange(40.0).tolist())], drawn.given())
    for layout in (untimed, timed):
        assert layout.line_time[0] == 0.0
        assert layout.line_time_sigma[0] == pytest.approx(3e-5)


def test_tags_whose_own_pose_no_picture_tells_are_placed() -> None:
    far = Camera(1280, 960, np.array([[4600.0, 0, 641.3], [0, 4620.0, 477.8], [0, 0, 1]]))
    drawn = scene(8, 60, 3, far, (3.0, 4.0))
    one = replace(drawn.body, bRt=so3.identity(8), position=np.zeros((8, 3)))
    alone = [
        estimate_pose(far, TagBody(one.ids[i : i + 1], one.size[i : i + 1], one.bRt[:1], one.position[:1]), seen)
        for seen in drawn.pictures[:20]
        for i in seen.ids.tolist()
    ]
    assert sum(pose is not None and pose.decided for pose in alone) < 0.1 * len(alone)
    layout = estimate_layout([Shots(far, drawn.pictures)], drawn.given())
    assert len(layout.body.ids) == 8
    assert np.abs(drawn.errors(layout).reshape(-1, 6)[:, :3]).max() < np.deg2rad(1.0)


def test_false_detections_are_left_out() -> None:
    drawn, rng = scene(14, 36, 1), np.random.default_rng(1)
    many = [k for k, seen in enumerate(drawn.pictures) if len(seen) > 3][::3]
    for k in many:
        seen = drawn.pictures[k]
        ids = seen.ids.copy()
        ids[rng.integers(len(ids))] = next(i for i in rng.permutation(14) if i not in ids)
        drawn.pictures[k] = detections(ids, seen.corners)
    layout = estimate_layout([Shots(CAMERA, drawn.pictures)], drawn.given())
    assert sum(seen.rejected for seen in layout.seen.values()) == len(many) > 8
    error = drawn.errors(layout)
    assert float(error @ np.linalg.solve(layout.covariance, error)) / len(error) < 2.0


def test_a_tag_that_was_moved_is_not_placed() -> None:
    drawn = scene(8, 60, 2)
    rng = np.random.default_rng(2)
    for k, seen in enumerate(drawn.pictures):
        corners = seen.corners.copy()
        corners[seen.ids == 5] += rng.uniform(-60, 60, 2)
        drawn.pictures[k] = detections(seen.ids, corners)
    layout = estimate_layout([Shots(CAMERA, drawn.pictures)], drawn.given())
    assert list(layout.unplaced) == [5]
    assert "disagrees" in layout.unplaced[5] or "flip" in layout.unplaced[5]


@pytest.mark.slow
def test_a_tag_seen_once_from_afar_is_not_placed() -> None:
    far = Camera(1280, 960, np.array([[4600.0, 0, 641.3], [0, 4620.0, 477.8], [0, 0, 1]]))
    drawn = scene(8, 60, 3, far, (3.0, 4.0))
    once = next(k for k, seen in enumerate(drawn.pictures) if len(seen) == 2 and 5 in seen.ids)
    for k, seen in enumerate(drawn.pictures):
        keep = (seen.ids != 5) | (k == once)
        drawn.pictures[k] = detections(seen.ids[keep], seen.corners[keep])
    layout = estimate_layout([Shots(far, drawn.pictures)], drawn.given())
    assert list(layout.unplaced) == [5]
    assert "flip" in layout.unplaced[5]


@pytest.mark.slow
def test_tags_that_a_wrong_tag_alone_ties_to_the_others_are_not_placed() -> None:
    """Tags 0 to 3 and 4 to 7, never in one picture but for tag 8, which lies about loose."""
    drawn, rng = scene(9, 120, 6), np.random.default_rng(0)
    pictures = []
    for k, seen in enumerate(drawn.pictures):
        keep = (seen.ids < 4 if k % 2 else (seen.ids > 3) & (seen.ids < 8)) | (seen.ids == 8)
        corners = seen.corners + (seen.ids == 8)[:, None, None] * rng.uniform(-60, 60, 2)
        pictures.append(detections(seen.ids[keep], corners[keep]))
    layout = estimate_layout([Shots(CAMERA, [seen for seen in pictures if len(seen)])], drawn.given())
    assert set(layout.unplaced) >= {4, 5, 6, 7, 8}
    assert layout.body.ids[0] == 0


@pytest.mark.slow
def test_pictures_without_perspective_do_not_tell_inside_from_outside() -> None:
    far = Camera(1280, 960, np.array([[115000.0, 0, 640.0], [0, 115000.0, 480.0], [0, 0, 1]]))
    drawn = scene(5, 30, 0, far, (95.0, 100.0))
    with pytest.raises(InputError, match=r"mirror image|planar flip"):
        estimate_layout([Shots(far, drawn.pictures)], drawn.given())


def test_mirror_image_of_the_mirror_image_is_the_body() -> None:
    body = scene(6, 1, 0).body
    twice = mirrored(mirrored(body, 2), 2)
    np.testing.assert_allclose(so3.matrix(twice.bRt), so3.matrix(body.bRt), atol=1e-12)
    np.testing.assert_allclose(twice.position, body.position, atol=1e-12)
    assert np.linalg.norm(mirrored(body, 2).position - body.position, axis=1).max() > 0.05


def test_a_camera_that_is_off_is_found() -> None:
    drawn = scene(8, 45, 4, distance=(0.35, 0.7))
    wrong = CAMERA.with_intrinsics(CAMERA.intrinsics + [5.0, 5.0, 4.0, -4.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    shots = [Shots(wrong, drawn.pictures)]
    layout = estimate_layout(shots, drawn.given(), refine_camera=True)
    assert layout.camera_sigma is not None
    off = (layout.cameras[0].intrinsics - CAMERA.intrinsics) / layout.camera_sigma[0]
    assert np.abs(off[:4]).max() < 3.5
    assert (layout.camera_sigma[0, :4] < [5.0, 5.0, 4.9, 4.9]).all()  # the priors' are 5.75 and 5 px
    error = drawn.errors(layout)
    assert float(error @ np.linalg.solve(layout.covariance, error)) / len(error) < 1.6


def test_pictures_that_err_alike_tell_less_of_a_camera_than_its_prior() -> None:
    """Corners that err by the same for fifteen pictures in a row: centres are drawn from their prior."""
    squares = []
    for seed in range(1):
        drawn, rng = scene(6, 45, 20 + seed, distance=(0.35, 0.7)), np.random.default_rng(seed)
        off = rng.normal(scale=5.0, size=2)
        for start in range(0, 45, 15):
            alike = rng.normal(scale=1.0, size=(6, 4, 2))
            for k in range(start, start + 15):
                seen = drawn.pictures[k]
                drawn.pictures[k] = detections(seen.ids, seen.corners + alike[seen.ids])
        wrong = CAMERA.with_intrinsics(CAMERA.intrinsics + np.array([0.0, 0.0, *off, 0.0, 0.0, 0.0, 0.0, 0.0]))
        layout = estimate_layout([Shots(wrong, drawn.pictures)], drawn.given(), refine_camera=True)
        assert layout.camera_sigma is not None
        assert layout.with_camera is not None
        assert layout.camera_sigma[0, 2:4].max() < 5.0
        focal = np.hypot(*(0.5 * layout.camera_sigma[0, :2] / layout.cameras[0].focal))
        assert 0.9 * focal < layout.with_camera[-3, -3] ** 0.5 < 1.42 * focal
        np.testing.assert_allclose(np.diag(layout.with_camera)[-2:] ** 0.5, layout.camera_sigma[0, 2:4])
        np.testing.assert_array_equal(layout.with_camera[:-3, :-3], layout.covariance)
        squares.append(((layout.cameras[0].centre - CAMERA.centre) / layout.camera_sigma[0, 2:4]) ** 2)
    assert np.mean(squares) < 3.0


@pytest.mark.slow
def test_recordings_of_two_cameras_are_one_layout() -> None:
    other = Camera(1280, 960, np.array([[900.0, 0, 600.0], [0, 900.0, 500.0], [0, 0, 1]]))
    first, second = scene(6, 20, 5), scene(6, 20, 5, other, take=1)
    shots = [Shots(CAMERA, first.pictures), Shots(other, second.pictures)]
    both, alone = estimate_layout(shots, first.given()), estimate_layout(shots[:1], first.given())
    assert len(both.cameras) == 2
    assert both.with_camera is None
    assert np.trace(both.covariance) < 0.8 * np.trace(alone.covariance)
    error = first.errors(both)
    assert float(error @ np.linalg.solve(both.covariance, error)) / len(error) < 2.0


@pytest.mark.parametrize("refined", [False, True])
def test_jacobians_are_those_of_differences(refined: bool) -> None:
    drawn = scene(4, 3, 0)
    rows = [(f, i, c) for f, seen in enumerate(drawn.pictures) for i, c in zip(seen.ids, seen.corners, strict=True)]
    frame, tag = (np.array([row[k] for row in rows]) for k in (0, 1))
    sights = Sights(frame, tag, np.array([row[2] for row in rows]), np.full(len(rows), SIGMA))
    rng = np.random.default_rng(0)
    cRb = so3.normalize(np.array([1.0, 0.1, -0.2, 0.1]) + 0.1 * rng.normal(size=(3, 4)))
    bundle = Bundle.of((CAMERA,), np.zeros(3, dtype=np.intp), drawn.body, cRb, np.tile([0.02, 0.01, 0.8], (3, 1)))
    bundle = replace(bundle, motion=rng.normal(size=(3, 6)), line_time=np.array([2e-5]))
    additional = Additional.of(bundle, refined, refined)
    found = linearized(bundle, sights)
    shared = shared_rows(bundle, sights, found, additional)
    h = 1e-6

    def change(step: np.ndarray, pictures: np.ndarray) -> np.ndarray:
        ahead, behind = (linearized(moved(bundle, s * step, s * pictures, additional), sights).miss for s in (h, -h))
        return (ahead - behind) / (2 * h)

    still = np.zeros((3, 6))
    for column in np.flatnonzero(free_columns(bundle, -1, additional)).tolist():
        step = np.zeros(shared.shape[2])
        step[column] = 1.0
        np.testing.assert_allclose(change(step, still), shared[..., column], rtol=1e-5, atol=1e-3)
    for column in range(6):
        pictures = np.tile(np.eye(6)[column], (3, 1))
        np.testing.assert_allclose(
            change(np.zeros(shared.shape[2]), pictures), found.by_picture[..., column], rtol=1e-5, atol=1e-3
        )


def test_a_corner_beside_the_camera_has_no_slope() -> None:
    """How far its distortion throws it had no digits left for what is made of it: matrices of 1e37 were singular."""
    body = TagBody(np.array([0]), np.array([0.1]), so3.identity(1), np.zeros((1, 3)))
    sights = Sights(np.arange(2), np.zeros(2, dtype=np.intp), np.zeros((2, 4, 2)), np.full(2, SIGMA))
    there = np.array([[0.05, 0.02, 1e-4], [0.05, 0.02, 0.5]])
    found = linearized(Bundle.of((CAMERA,), np.zeros(2, dtype=np.intp), body, so3.identity(2), there), sights)
    assert not found.by_picture[0].any()
    assert not found.by_tag[0].any()
    assert (found.miss[0] == 1e4).all()
    assert np.abs(found.by_picture[1]).max() > 1e2


def apart(a: Layout, b: Layout) -> np.ndarray:
    """(n, 6) difference of the tags of two layouts, in its sigmas."""
    ids = sorted(set(a.body.ids[1:].tolist()) & set(b.body.ids[1:].tolist()))
    i, j = np.searchsorted(a.body.ids, ids), np.searchsorted(b.body.ids, ids)
    turned = so3.log(so3.multiply(so3.inverse(a.body.bRt[i]), b.body.bRt[j]))
    difference = np.concatenate([turned, b.body.position[j] - a.body.position[i]], axis=1)
    sigma = [np.sqrt(np.diag(each.covariance)).reshape(-1, 6)[k - 1] for each, k in ((a, i), (b, j))]
    return np.asarray(difference / np.hypot(*sigma))


@pytest.mark.slow
def test_a_real_cube_of_18_tags(shared_data) -> None:  # type: ignore[no-untyped-def]
    whole = open_recording(shared_data / "tagslam_cube18" / "cam1.mcap")
    recording, config = configured(whole, shared_data / "tagslam_cube18" / "ids.yaml")
    layout = cube_layout([(recording, config)])
    assert len(layout.body.ids) == 18
    assert not layout.unplaced
    assert layout.rms_px < 0.35
    # Its shutter does not roll.
    assert abs(layout.line_time[0]) < 3.0 * layout.line_time_sigma[0]
    from alidade.pipelines.methods.cube.recording import CubeConfig
    from alidade.pipelines.methods.cube.tags import _shots

    shots, given = _shots(recording, config), TagBody.from_board(config.section(CubeConfig))
    assert shots.time is not None
    middle = len(shots.pictures) // 2
    for parts in ((slice(0, None, 2), slice(1, None, 2)), (slice(0, middle), slice(middle, None))):
        halves = [Shots(shots.camera, shots.pictures[part], shots.time[part]) for part in parts]
        found = [estimate_layout([half], given) for half in halves]
        assert np.abs(apart(*found)).max() < 3.0


@pytest.mark.slow
def test_a_real_block_of_ten_tags(shared_data) -> None:  # type: ignore[no-untyped-def]
    block = tagslam_block.read_block(shared_data / "tagslam_block")
    layout, comparison = tagslam_block.compare(block)
    assert len(layout.body.ids) == 10
    assert layout.rms_px < 0.35
    assert comparison.held_out_px < 0.35
    assert comparison.position_mm < 0.3
    assert comparison.rotation_deg < 0.1
    middle = len(block.pictures) // 2
    parts = (block.pictures[::2], block.pictures[1::2]), (block.pictures[:middle], block.pictures[middle:])
    for halves in parts:
        found = [estimate_layout([Shots(block.camera, half)], block.published) for half in halves]
        assert np.abs(apart(*found)).max() < 3.0
