"""What of the cameras is adjusted with the tags, and how well their calibration is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.vision.camera import Camera
from pipelines.vision.layout.sights import Array

# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0


@dataclass(frozen=True, eq=False)
class Cameras:
    """What of the cameras is adjusted: (c, n) prior sigmas of fx, fy, cx, cy, px, and of the distortion coefficients.

    Attributes:
        given: the cameras that the priors are about.
        sigma: (c, n); 0 where nothing is adjusted; with cameras of fewer coefficients the last columns are 0.
    """

    given: tuple[Camera, ...]
    sigma: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """(c * n,)."""
        return np.asarray(self.sigma.ravel() > 0.0)

    def off(self, cameras: tuple[Camera, ...]) -> Array:
        """(c * n,) how far cameras are from those given."""
        out = np.zeros_like(self.sigma)
        for row, now, given in zip(out, cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        return out.ravel()

    def moved(self, cameras: tuple[Camera, ...], step: Array) -> tuple[Camera, ...]:
        """Cameras with a step (c * n,) added."""
        steps = step.reshape(self.sigma.shape)
        return tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row.any() else camera
            for camera, row in zip(cameras, steps, strict=True)
        )


def fixed_cameras(cameras: tuple[Camera, ...]) -> Cameras:
    """Cameras as given."""
    return Cameras(cameras, np.zeros((len(cameras), max(len(c.intrinsics) for c in cameras))))


def free_cameras(cameras: tuple[Camera, ...]) -> Cameras:
    """Cameras about what their calibration says: focal lengths to 0.5 %, the centre to 5 px, a pixel of distortion.

    Each coefficient of the distortion has the sigma that moves the picture's farthest corner by a pixel.
    """
    out = fixed_cameras(cameras).sigma
    for row, camera in zip(out, cameras, strict=True):
        frame = np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
        rays = camera.rays(frame)
        # Where distortion turns back before the corner, the half way there serves.
        rays = np.where(np.isfinite(rays), rays, camera.rays(0.5 * (frame + camera.centre)))
        moves = np.linalg.norm(camera.by_intrinsics(rays), axis=-2).max(axis=0)
        row[:2], row[2:4] = _FOCAL * camera.focal, _CENTRE_PX
        row[4 : len(moves)] = _DISTORTION_PX / np.maximum(moves[4:], 1e-9)
    return Cameras(cameras, out)
