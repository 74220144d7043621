"""Pictures of the tag board on a helmet, as the platform's camera sees it.

Frames: c camera (optical: x right, y down, z forward), h tag board; the board's tags say how they lie in h.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from alidade.factors import so3
from alidade.pipelines.recording import series
from alidade.pipelines.settings import Board, Tag
from alidade.pipelines.simulation.rendering import Renderer, encode, expose, tag_quad
from alidade.pipelines.vision.camera import Camera

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Vector = tuple[float, float, float]

# The head's sway goes round in no common period, Hz.
_SWAY_HZ = (0.31, 0.23, 0.17)
# Off the middle of the picture, px, as principal points are.
_OFF_CENTRE = (3.4, -2.7)


def _board(*tags: tuple[float, float, float, float]) -> Board:
    """Tags of 45 mm at (x, y), m, leaning back by angles about x and y, deg.

    They face -z of the board: its axes are the camera's when it faces the camera upright, so that mounts are small.
    """
    facing = so3.exp([np.pi, 0.0, 0.0])
    out = {}
    for i, (x, y, about_x, about_y) in enumerate(tags):
        w, *v = so3.multiply(so3.exp(np.deg2rad([about_x, about_y, 0.0])), facing).tolist()
        out[i] = Tag(size=0.045, rotation=(w, v[0], v[1], v[2]), position=(x, y, 0.0))
    return Board(tags=out)


class HeadPictures(BaseModel):
    """The camera, its pictures, the tag board and where it is: a pinhole camera with plumb_bob distortion."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: Annotated[int, Field(gt=0)] = 640
    height: Annotated[int, Field(gt=0)] = 480
    focal_px: Positive = 620.0
    distortion: list[float] = [-0.22, 0.09, 8e-4, -5e-4, 0.0]  # k1 k2 p1 p2 k3
    blur_px: NotNegative = 0.7  # sigma
    grey_noise: NotNegative = 2.0  # sigma, grey levels of 255
    format: Literal["png", "jpeg"] = "jpeg"
    board: Board = _board(
        (-0.032, -0.032, 12, -12), (0.032, -0.032, 12, 12), (-0.032, 0.032, 0, 0), (0.032, 0.032, 0, 0)
    )
    position_m: Vector = (0.0, 0.0, 0.34)  # of the board's origin in the camera's frame, on average
    sway_m: Vector = (0.015, 0.01, 0.02)  # amplitude about that


def draw(
    settings: HeadPictures, t: Array, t_ns: NDArray[np.int64], cRh: Array, rng: np.random.Generator
) -> tuple[series.CameraInfo, series.ImageSeries]:
    """The camera's description and its pictures, drawn one by one as they are taken.

    Args:
        settings: camera and board.
        t: (K,) when the pictures are taken, s.
        t_ns: (K,) their stamps, Unix ns.
        cRh: (K, 4) the board's attitude at those times.
        rng: of the sensor's noise.

    Raises:
        InputError: no camera can have that distortion.
    """
    centre = np.array([settings.width - 1.0, settings.height - 1.0]) / 2.0 + _OFF_CENTRE
    K = np.array([[settings.focal_px, 0.0, centre[0]], [0.0, settings.focal_px, centre[1]], [0.0, 0.0, 1.0]])
    camera = Camera(settings.width, settings.height, K, "plumb_bob", np.array(settings.distortion))
    info = series.CameraInfo(
        t_ns=int(t_ns[0]),
        width=camera.width,
        height=camera.height,
        distortion_model=camera.distortion_model,
        d=camera.coefficients,
        k=K,
        r=np.eye(3),
        p=np.pad(K, ((0, 0), (0, 1))),
        frame_id="camera",
    )
    position = np.array(settings.position_m) + np.array(settings.sway_m) * np.sin(2.0 * np.pi * t[:, None] * _SWAY_HZ)
    files = _exposures(settings, camera, cRh, position, rng)
    return info, series.ImageSeries(t_ns, files, settings.format, "camera")


def _exposures(
    settings: HeadPictures, camera: Camera, cRh: Array, position: Array, rng: np.random.Generator
) -> Iterator[bytes]:
    """The files of the pictures."""
    renderer = Renderer(camera)
    for attitude, origin in zip(cRh, position, strict=True):
        quads = [
            tag_quad(i, tag.size, so3.multiply(attitude, tag.rotation), origin + so3.rotate(attitude, tag.position))
            for i, tag in settings.board.tags.items()
        ]
        picture = expose(renderer.radiance(quads), settings.blur_px, settings.grey_noise, rng)
        yield encode(picture, settings.format, 92)
