"""Attitude of the reference that carries the cube's camera, or of the camera itself when there is no reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.recording import REFERENCE_IMU, CubeConfig, CubeData
from alidade.pipelines.methods.cube.static_poses import StaticPoses
from alidade.pipelines.settings import Config

# Messages that scatter by more than this many times their variance are those of a reference that moved.
_MOVES = 2.0
# rad^2; no message is better.
_LEAST_VARIANCE = 1e-12
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Reference:
    """Attitude of the frame B that carries the camera; without a reference, of the stationary camera C itself.

    Attributes:
        nRB: (P, 4) at each pose, all the same when it stands still.
        covariance: (P, 3, 3) rad^2, of delta in nRB Exp(delta); None when nothing measured it.
        moves: whether it differs from pose to pose.
        BRC: (4,) camera mount as given.
    """

    nRB: Array
    covariance: Array | None
    moves: bool
    BRC: Array

    @property
    def nRC(self) -> Array:
        """Attitudes nRC (P, 4) of the camera, with the mount as stated."""
        return so3.multiply(self.nRB, self.BRC)


def cube_reference(data: CubeData, config: Config, poses: StaticPoses, field: Array | None) -> Reference:
    """Attitude of the reference at each pose.

    A reference that stands still is one attitude, the mean of all messages; one that moves has the mean of each pose.

    Raises:
        InputError: the camera's mount is not given, or the reference moves and has no message in a pose.
    """
    if data.camera is None:
        return Reference(so3.identity(len(poses)), None, False, so3.identity())
    if data.reference_t is None or data.reference_wxyz is None:
        return Reference(_camera_at_rest(poses, field), None, False, so3.identity())
    if config.section(CubeConfig).camera_rotation is None:
        raise InputError(
            "the camera's mount on the reference is not given: cube.camera_rotation, the quaternion BRC of reference "
            "body from camera (x right, y down, z forward)"
        )
    BRC = np.array(config.section(CubeConfig).camera_rotation)
    wxyz = data.reference_wxyz
    whole, scatter = _mean(wxyz)
    noise = data.reference_cov if data.reference_cov is not None else _noise(scatter)
    if _squares(scatter, noise) <= _MOVES:
        about_n = noise.mean(axis=0) / len(wxyz)
        return Reference(np.tile(whole, (len(poses), 1)), _on_the_right(whole, about_n, len(poses)), False, BRC)
    means, covariances = [], []
    for (start, stop), seen in zip(poses.span, poses.tags, strict=True):
        rows = (data.reference_t >= start) & (data.reference_t <= stop)
        if not rows.any():
            raise InputError(
                f"topic {config.topic(REFERENCE_IMU)}: no attitude of the moving reference between {start:.3f} and "
                f"{stop:.3f} s, while the cube stood still"
            )
        # When the pictures were taken: it moves on while there is none.
        at = data.reference_t[rows] if seen is None else np.clip(seen.t, data.reference_t[0], data.reference_t[-1])
        mean, _ = _mean(so3.interpolate(data.reference_t, wxyz, at))
        means.append(mean)
        covariances.append(_on_the_right(mean, noise[rows].mean(axis=0) / rows.sum(), 1)[0])
    return Reference(np.array(means), np.array(covariances), True, BRC)


def _noise(errors: Array) -> Array:
    """Covariance (N, 3, 3), rad^2, of attitude errors (N, 3) without a stated noise, from successive differences.

    Those of a motion are small: von Neumann, "Distribution of the ratio of the mean square successive difference to the
    variance", Ann. Math. Stat. 1941.
    """
    steps = np.diff(errors, axis=0)
    covariance = steps.T @ steps / (2.0 * max(len(steps), 1)) + _LEAST_VARIANCE * np.eye(3)
    return np.tile(covariance, (len(errors), 1, 1))


def _mean(wxyz: Array) -> tuple[Array, Array]:
    """Mean attitude (4,) and the samples' errors (N, 3) about the axes of n: sample = Exp(error) mean."""
    mean = wxyz[0]
    for _ in range(5):
        error = so3.log(so3.multiply(wxyz, so3.inverse(mean)))
        mean = so3.multiply(so3.exp(error.mean(axis=0)), mean)
    return mean, so3.log(so3.multiply(wxyz, so3.inverse(mean)))


def _squares(errors: Array, covariance: Array) -> float:
    """Mean square of whitened errors, 1 for the stated noise."""
    return float(np.einsum("ni,nij,nj->", errors, np.linalg.inv(covariance), errors) / errors.size)


def _on_the_right(mean: Array, about_n: Array, copies: int) -> Array:
    """Convert a covariance about the axes of n to that of delta in mean Exp(delta), (copies, 3, 3)."""
    R = so3.matrix(mean)
    return np.tile(R.T @ about_n @ R, (copies, 1, 1))


def _camera_at_rest(poses: StaticPoses, field: Array | None) -> Array:
    """Initial nRC, equal at all poses: up by the accelerometer, north by the magnetometer, if any."""
    seen = [k for k, tags in enumerate(poses.tags) if tags is not None]
    cRb = np.array([tags.pose.cRb for tags in poses.tags if tags is not None])
    up = so3.rotate(cRb, poses.accel[seen]).mean(axis=0)
    mag = None
    if field is not None and poses.mag is not None:
        mag = np.nanmean(so3.rotate(cRb, poses.mag[seen]), axis=0)
    return np.tile(from_vectors(up, mag, field), (len(poses), 1))


def from_vectors(up: Array, mag: Array | None, field: Array | None) -> Array:
    """Attitude nRa (4,) from specific force `up` at rest and field `mag` in a; without a field any heading."""
    if mag is None or field is None or not np.isfinite(mag).all():
        # Any direction across will do for north.
        mag, field = np.eye(3)[np.argmin(np.abs(up))], np.array([0.0, 1.0, 0.0])

    def axes(vertical: Array, other: Array) -> Array:
        z = vertical / np.linalg.norm(vertical)
        y = so3.cross(z, other)
        y = y / np.linalg.norm(y)
        return np.stack([so3.cross(y, z), y, z], axis=1)

    return so3.from_matrix(axes(_UP, field) @ axes(up, mag).T)
