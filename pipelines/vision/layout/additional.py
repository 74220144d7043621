"""What is adjusted beside poses: photogrammetry's additional parameters, each with what is known of it beforehand.

Intrinsics of the cameras, and the time that a rolling shutter takes from one row to the next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors.so3 import Array
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout.sights import Bundle, Rows, Sights

# What a calibration of a camera is good to: focal lengths as a share, centre, distortion at the picture's corner.
_FOCAL, _CENTRE_PX, _DISTORTION_PX = 5e-3, 5.0, 1.0
# Of a shutter that may roll, s from one row to the next: what pictures do not determine has this sigma.
LINE_TIME = 3e-5


@dataclass(frozen=True, eq=False)
class Additional:
    """Prior sigmas; 0 of what stays as it is.

    Attributes:
        given: the cameras that the priors are about; their shutters are taken not to roll.
        intrinsics: (c, n) of fx, fy, cx, cy, px, and of the distortion coefficients; with cameras of fewer coefficients
            the last columns are 0.
        line_time: (c,) s.
    """

    given: tuple[Camera, ...]
    intrinsics: Array
    line_time: Array

    @property
    def sigma(self) -> Array:
        """(k,) of all, the intrinsics first."""
        return np.concatenate([self.intrinsics.ravel(), self.line_time])

    @property
    def free(self) -> NDArray[np.bool_]:
        """(k,)."""
        return np.asarray(self.sigma > 0.0)

    def parts(self, numbers: Array) -> tuple[Array, Array]:
        """Numbers (..., k) as those of the intrinsics (..., c, n) and the line times (..., c)."""
        c, n = self.intrinsics.shape
        return numbers[..., : c * n].reshape(*numbers.shape[:-1], c, n), numbers[..., c * n :]

    def off(self, bundle: Bundle) -> Array:
        """Deviation (k,) of a bundle's intrinsics and line times from their priors."""
        out = np.zeros_like(self.intrinsics)
        for row, now, given in zip(out, bundle.cameras, self.given, strict=True):
            row[: len(now.intrinsics)] = now.intrinsics - given.intrinsics
        return np.concatenate([out.ravel(), bundle.line_time])

    def moved(self, bundle: Bundle, step: Array) -> Bundle:
        """The bundle with a step (k,) added."""
        intrinsics, line_time = self.parts(step)
        cameras = tuple(
            camera.with_intrinsics(camera.intrinsics + row[: len(camera.intrinsics)]) if row.any() else camera
            for camera, row in zip(bundle.cameras, intrinsics, strict=True)
        )
        return replace(bundle, cameras=cameras, line_time=bundle.line_time + line_time)

    def rows(self, bundle: Bundle, sights: Sights, rows: Rows) -> Array:
        """Jacobian (m, 8, k) of the errors."""
        m = len(sights)
        out = np.zeros((m, 4, 2, len(self.sigma)))
        intrinsics, line_time = self.parts(out)
        by_time = (rows.by_point @ rows.velocity[..., None])[..., 0] * bundle.lines(sights)[..., None]
        for k, camera in enumerate(bundle.cameras):
            mine = bundle.camera[sights.picture] == k
            by = camera.by_intrinsics(rows.points[mine])
            intrinsics[mine, :, :, k, : by.shape[-1]] = np.nan_to_num(by) / sights.sigma[mine, None, None, None]
            line_time[mine, :, :, k] = by_time[mine]
        return out.reshape(m, 8, -1)


def nothing(bundle: Bundle) -> Additional:
    """All stays as it is."""
    cameras = bundle.cameras
    widest = max(len(camera.intrinsics) for camera in cameras)
    return Additional(cameras, np.zeros((len(cameras), widest)), np.zeros(len(cameras)))


def shutters(bundle: Bundle) -> Additional:
    """The line times, about none: 30 us, as a phone's."""
    return replace(nothing(bundle), line_time=np.full(len(bundle.cameras), LINE_TIME))


def with_intrinsics(bundle: Bundle) -> Additional:
    """Line times and cameras about what their calibration says: focal lengths to 0.5 %, the centre to 5 px.

    Each coefficient of the distortion has the sigma that moves the picture's farthest corner by a pixel.
    """
    out = shutters(bundle)
    for row, camera in zip(out.intrinsics, bundle.cameras, strict=True):
        frame = np.array([[x, y] for x in (0.0, camera.width - 1.0) for y in (0.0, camera.height - 1.0)])
        rays = camera.rays(frame)
        # Where distortion turns back before the corner, the half way there serves.
        rays = np.where(np.isfinite(rays), rays, camera.rays(0.5 * (frame + camera.centre)))
        moves = np.linalg.norm(camera.by_intrinsics(rays), axis=-2).max(axis=0)
        row[:2], row[2:4] = _FOCAL * camera.focal, _CENTRE_PX
        row[4 : len(moves)] = _DISTORTION_PX / np.maximum(moves[4:], 1e-9)
    return out
