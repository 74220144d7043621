"""Pose of least squares near another, with its covariance: by pycolmap, or by ourselves where it has no wheel."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.factors.so3 import Array
from alidade.pipelines.vision.camera import Camera

# First damping, relative; most steps; the last one moves corners by less than this (norm, px).
_DAMPING, _MAX_STEPS, _SETTLED_PX = 1e-3, 50, 1e-6


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A body's pose that minimises reprojection errors.

    Attributes:
        cRb: (4,) attitude of the body in the camera.
        position: (3,) of the body's origin in the camera, m.
        covariance: (6, 6) of delta in cRb Exp(delta) and of the position, for corners with a sigma of 1 px.
        miss: (n, 2) px.
    """

    cRb: Array
    position: Array
    covariance: Array
    miss: Array

    @property
    def square(self) -> float:
        """Sum of squares of `miss`, px^2."""
        return float((self.miss**2).sum())


def refine(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """The pose with the least reprojection errors near a given one; None where there is none.

    Args:
        camera: with its distortion.
        corners: (n, 3) in the body's frame, m.
        pixels: (n, 2) where they are seen.
        cRb: (4,) attitude of the body in the camera to begin with.
        position: (3,) of its origin, m.
    """
    return (refine_by_pycolmap if _has_pycolmap() else refine_here)(camera, corners, pixels, cRb, position)


def reprojection_errors(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> Array:
    """Where corners (..., 3) of the body are projected less where they are seen, (..., 2) px."""
    return np.asarray(camera.project(position + so3.rotate(cRb, corners)) - pixels)


@cache
def _has_pycolmap() -> bool:
    return importlib.util.find_spec("pycolmap") is not None


def refine_by_pycolmap(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """As `refine`, by pycolmap (Ceres)."""
    import pycolmap

    # A pose that the corners leave open is no fault; its covariance has it.
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.gradient_tolerance = 1e-5
    # Its loss is Cauchy's. This wide (px) it is least squares; much wider, its log(1 + r^2 / scale^2) loses the digits.
    options.loss_function_scale = 100.0
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(pycolmap.Rotation3d(so3.matrix(cRb)), position),
        pixels,
        corners,
        np.ones(len(corners), dtype=bool),
        _colmap_camera(camera),
        options,
        return_covariance=True,
    )
    if found is None:
        return None
    pose = found["cam_from_world"]
    cRb, position = so3.from_matrix(pose.rotation.matrix()), np.array(pose.translation)
    miss = reprojection_errors(camera, corners, pixels, cRb, position)
    if not np.isfinite(miss).all():
        return None
    # pycolmap turns from the left, Exp(2 h) cRb, with h half an angle in c; here cRb Exp(delta): delta = 2 cRb^T h.
    T = np.eye(6)
    T[:3, :3] = 2.0 * so3.matrix(cRb).T
    return PoseFit(cRb, position, T @ found["covariance"] @ T.T, miss)


@lru_cache(maxsize=8)
def _colmap_camera(camera: Camera) -> Any:
    """The same camera for pycolmap (its place of a pixel's centre does not matter: points and K agree)."""
    import pycolmap

    k = np.concatenate([camera.focal, camera.centre, camera.coefficients])
    if camera.distortion_model == "equidistant":
        return pycolmap.Camera(model="OPENCV_FISHEYE", width=camera.width, height=camera.height, params=k)
    k = np.pad(k, (0, 12 - len(k)))
    return pycolmap.Camera(model="FULL_OPENCV", width=camera.width, height=camera.height, params=k)


def refine_here(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> PoseFit | None:
    """As `refine`, by Levenberg's and Marquardt's steps with OpenCV's derivatives of the projection."""
    damping = _DAMPING
    miss, J = _linearized(camera, corners, pixels, cRb, position)
    if not np.isfinite(J).all():
        return None
    try:
        for _ in range(_MAX_STEPS):
            H, gradient = J.T @ J, J.T @ miss
            step = -np.linalg.solve(H + np.diag(damping * np.diag(H)), gradient)
            trial = so3.multiply(cRb, so3.exp(step[:3])), position + step[3:]
            tried, by_pose = _linearized(camera, corners, pixels, *trial)
            if tried @ tried <= miss @ miss and np.isfinite(by_pose).all():
                (cRb, position), miss, J, damping = trial, tried, by_pose, 0.1 * damping
            else:
                damping *= 10.0
            if step @ H @ step < _SETTLED_PX**2:
                break
        covariance: Array = np.asarray(np.linalg.inv(J.T @ J), dtype=float)
    except np.linalg.LinAlgError:
        return None
    return PoseFit(cRb, position, covariance, miss.reshape(pixels.shape))


def _linearized(camera: Camera, corners: Array, pixels: Array, cRb: Array, position: Array) -> tuple[Array, Array]:
    """Reprojection errors (2 n,) of corners (n, 3), px, with their Jacobian (2 n, 6) by attitude and position."""
    R = so3.matrix(cRb)
    seen, by_point = camera.project_with_jacobian(position + corners @ R.T)
    by_turn = np.cross(corners[:, None, :], by_point @ R)  # d(R Exp(delta) x) = R (delta x x)
    return (seen - pixels).ravel(), np.concatenate([by_turn, by_point], axis=-1).reshape(-1, 6)
