"""What a pose of the cube says as factors: its sensors at rest, its tags, and the turn that led to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.tags import TagAttitudeFactor
from alidade.factors.triad import AccelFactor, GyroStaticFactor, MagFactor
from alidade.factors.turns import GyroRotationFactor
from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.methods.cube.model import Model
from alidade.pipelines.methods.cube.parameters import (
    CURVATURE_KEY,
    FIELD_KEY,
    LENS_KEY,
    MOUNT_KEY,
    SAID_KEY,
    SENSITIVITY_KEY,
    SLOPE_KEYS,
    TRIAD_KEYS,
    tag_key,
)
from alidade.pipelines.methods.cube.poses import SeenTags
from alidade.pipelines.methods.cube.tag_places import tag_place_key
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.cube.wandering import deviation_key

if TYPE_CHECKING:
    from alidade.pipelines.vision.camera import Camera


# Steps of derivatives by a share of the focal length and by the centre, px.
_FOCAL_STEP, _CENTRE_STEP = 1e-4, 0.1


def pose_key(k: int) -> int:
    """Variable of nRb in pose k, a Rot3."""
    return int(gtsam.symbol("x", k))


def place_key(k: int) -> int:
    """Variable of the cube's place in the camera in pose k, (3,) m."""
    return int(gtsam.symbol("p", k))


def reference_key(k: int) -> int:
    """Variable of what the reference says in pose k, nRB, a Rot3; of pose 0 where it stands still."""
    return int(gtsam.symbol("R", k))


def sensor_factors(model: Model, k: int) -> list[Factor]:
    """Accelerometer, gyro and magnetometer at rest in pose k."""
    poses, row = model.poses, slice(k, k + 1)
    time = 0.5 * poses.span[row].sum(axis=1)
    gyro_density, accel_density, mag_density = model.density
    duration = poses.duration[row]
    curved, feels = model.parameters.curvature is not None, model.parameters.sensitivity is not None
    warmths = {name: model.warmth(name, k) for name in SLOPE_KEYS}
    slopes = {name: [] if warmths[name] is None else [key] for name, key in SLOPE_KEYS.items()}
    accel_sigma = accel_density / np.sqrt(duration)
    accel = AccelFactor(time, poses.accel[row], accel_sigma, model.gravity, curved, warmths["accel"])
    gyro_sigma = np.sqrt(gyro_density**2 / duration + model.unknown_rate**2)
    gravity = model.gravity if feels else None
    gyro = GyroStaticFactor(time, poses.gyro[row], gyro_sigma, model.earth_rate, gravity, warmths["gyro"])
    terms, G = [CURVATURE_KEY] if curved else [], [SENSITIVITY_KEY] if feels else []
    of_accel = accel.on(pose_key(k), TRIAD_KEYS["accel"], *terms, *slopes["accel"])
    of_gyro = gyro.on(pose_key(k), TRIAD_KEYS["gyro"], deviation_key(k), *G, *slopes["gyro"])
    factors = [
        Factor.of("accelerometer", of_accel, 1.0 / accel.sigma),
        Factor.of("gyro at rest", of_gyro, 1.0 / gyro.sigma),
    ]
    if model.field is not None and poses.mag is not None and poses.mag_duration[k] > 0.0:
        mag = MagFactor(time, poses.mag[row], mag_density / np.sqrt(poses.mag_duration[row]))
        seen = mag.on(pose_key(k), TRIAD_KEYS["mag"], FIELD_KEY, loss=model.loss)
        factors.append(Factor.of("magnetometer", seen, 1.0 / mag.sigma))
    return factors


def tag_factor(model: Model, k: int, seen: SeenTags) -> Factor:
    """All tags seen in pose k."""
    from alidade.pipelines.vision.pose import TagBody

    body = TagBody.from_board(model.config.section(CubeConfig))
    camera = model.data.camera
    assert camera is not None
    rows = np.searchsorted(body.ids, seen.ids)
    rays = camera.rays(seen.corners)
    # How z = 1 coordinates follow pixels, by central differences over a pixel.
    ahead, behind = (camera.rays(seen.corners[..., None, :] + s * 0.5 * np.eye(2)) for s in (1.0, -1.0))
    slope = np.swapaxes(ahead[..., :2] / ahead[..., 2:] - behind[..., :2] / behind[..., 2:], -1, -2)
    covariance = slope @ seen.covariance @ np.swapaxes(slope, -1, -2)
    n = len(seen.ids)
    tags = TagAttitudeFactor(
        time=np.full(n, 0.5 * model.poses.span[k].sum()),
        measured=rays[..., :2] / rays[..., 2:],
        sqrt_information=np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2),
        corners=so3.rotate(so3.inverse(body.bRt[rows])[:, None], body.corners[rows] - body.position[rows, None]),
        bRt=body.bRt[rows],
        position=body.position[rows],
        BRC=model.reference.BRC,
        placed=bool(model.parameters.places),
        by_lens=None if model.parameters.lens is None else _by_lens(camera, seen.corners),
    )
    reference = reference_key(k if model.reference.moves else 0)
    measurement = tags.on(
        [pose_key(k)] * n,
        [place_key(k)] * n,
        [reference] * n,
        SAID_KEY,
        MOUNT_KEY,
        [tag_key(int(i)) for i in seen.ids],
        *([[tag_place_key(int(i)) for i in seen.ids]] if tags.placed else []),
        *([] if model.parameters.lens is None else [LENS_KEY]),
        loss=model.loss,
    )
    return Factor.of("tags", measurement)


def _by_lens(camera: Camera, corners: Array) -> Array:
    """Derivatives (n, 4, 2, 3) of the corners' z = 1 coordinates by the share of focal length and the centre in px."""
    columns = []
    for step, moved in (
        (_FOCAL_STEP, np.append(camera.focal, [0.0, 0.0])),
        (_CENTRE_STEP, np.array([0.0, 0.0, 1.0, 0.0])),
        (_CENTRE_STEP, np.array([0.0, 0.0, 0.0, 1.0])),
    ):
        change = step * np.append(moved, np.zeros(len(camera.coefficients)))
        ahead, behind = (camera.with_intrinsics(camera.intrinsics + sign * change).rays(corners) for sign in (1, -1))
        columns.append((ahead[..., :2] / ahead[..., 2:] - behind[..., :2] / behind[..., 2:]) / (2.0 * step))
    return np.stack(columns, axis=-1)


def turn_factor(model: Model, k: int) -> Factor:
    """What the gyro turned from pose k - 1 to pose k."""
    samples, feels = model.samples(k), model.parameters.sensitivity is not None
    t = samples.t
    duration = float(t[-1] - t[0])
    sigma = np.sqrt([model.density[0] ** 2 * duration + (model.unknown_rate * duration) ** 2])
    accel = [samples.accel] if feels else None
    slopes = model.parameters.slopes
    # What an accelerometer drifts by alone is nothing beside a gyro that does not.
    drifting = [name for name in ("gyro", *(["accel"] if feels else [])) if name in slopes and "gyro" in slopes]
    warmth = None if samples.warmth is None or not drifting else [samples.warmth]
    drifts = "accel" in drifting
    rotation = GyroRotationFactor(t[-1:], [t], [samples.gyro], model.earth_rate, sigma, accel, warmth, drifts)
    of_force = [SENSITIVITY_KEY, TRIAD_KEYS["accel"]] if feels else []
    gyro = TRIAD_KEYS["gyro"]
    slope = [SLOPE_KEYS[name] for name in drifting]
    ends = pose_key(k - 1), pose_key(k)
    measured = rotation.on(*ends, gyro, deviation_key(k - 1), deviation_key(k), *of_force, *slope)
    angle = float(np.sum(np.linalg.norm(samples.gyro[1:], axis=1) * np.diff(t)))
    return Factor.process_of("gyro turns", measured, angle / sigma)
