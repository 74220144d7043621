"""The camera of a recording, from its CameraInfo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import CAMERA_INFO
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.recording.series import CameraInfo
    from alidade.pipelines.vision.camera import Camera

Array = NDArray[np.float64]


def camera_of(recording: Recording, config: Config) -> Camera:
    """The camera. Raises InputError when its topic is missing or says what no camera can be."""
    from alidade.pipelines.vision.camera import Camera

    info = recording.camera_info(config.topic(CAMERA_INFO))
    camera = Camera(info.width, info.height, info.k, info.distortion_model, info.d, _rectified(info))
    if info.distortion_model not in ("", camera.distortion_model):
        recording.remark(f"camera_info: distortion model {info.distortion_model} is read as {camera.distortion_model}")
    if len(info.d) > len(camera.coefficients):
        recording.remark(
            f"camera_info: {len(info.d)} coefficients, of which the last {len(info.d) - len(camera.coefficients)} are "
            "zero and none of the model's"
        )
    return camera


def _rectified(info: CameraInfo) -> Array | None:
    """The left three columns of P; None where it is not filled in."""
    P = info.p[:, :3]
    plain = np.isfinite(P).all() and P[0, 0] > 0.0 and P[1, 1] > 0.0 and P[0, 1] == 0.0
    return P if plain else None
