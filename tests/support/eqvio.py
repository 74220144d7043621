"""The rotation between camera and IMU from real EuRoC data that come with gtsam.

`eqvio_processed_30s.csv` holds 30 s of EuRoC's V1_01 (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR
2016): gyro at 200 Hz, tracked features at 20 Hz in undistorted coordinates, and the published camera mount. A camera
strapped to a gyro is the los method with a gimbal that stands still, but its targets are near: a moving camera sees
them turn. So the graph holds where the camera was and how far each feature is, by its inverse depth.

Frames: v gyro (IMU), c camera (x right, y down, z ahead), w does not turn. The mount is vRc.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.chi_square import gate
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import ROT3, Model, Residuals
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.problem import (
    Estimate,
    Factor,
    Parameter,
    Problem,
    Quantity,
    Step,
    rotation_vector_coordinates,
)
from alidade.pipelines.solvers.batch import solve_batch
from benchmarks.ahrs import ahrs_factors

# rad/s/sqrt(Hz). At rest it is 1.7e-4; in flight rotors shake the gyro (third differences of its samples: 1e-3 about x,
# 5e-3 about y, 2e-3 about z), and with this chi-square fits.
GYRO_DENSITY = 1.2e-3
GYRO_SCALE = 2e-3  # of the angle turned
FEATURE_SIGMA = 1.2e-3  # of a tracked feature, 0.55 px, likewise
HALF_SPAN = 0.025  # rates at the frames are means over so much to either side, s
# Inverse depths, 1/m, of a room a few metres wide. Nothing else says how long a metre is.
INVERSE_DEPTH, INVERSE_DEPTH_SIGMA = 0.3, 0.3
GRAPH_STRIDE = 3  # of the frames in the graph
STRIDE = 10  # frames between two views of the first guess
STEP = 4  # frames from one such pair to the next
# What a camera does that has no parallax to tell: it moves at no more than a few m/s.
SPEED = 2.0
FEWEST_COMMON = 10  # features of two views
FOCAL = 458.0  # px: two-view geometry judges outliers in pixels

BIAS, MOUNT, OFFSET = (int(gtsam.symbol(c, 0)) for c in "bCT")


@dataclass(frozen=True)
class Recording:
    """What the cameras and the gyro saw.

    Attributes:
        gyro_t, gyro: (N,), (N, 3) s, rad/s.
        time: (K,) of the frames, s.
        frame, track: (n,) of each observation: which frame, which feature.
        seen: (n, 2) x / z and y / z in c.
        published: (4,) vRc.
    """

    gyro_t: Array
    gyro: Array
    time: Array
    frame: Index
    track: Index
    seen: Array
    published: Array

    def thinned(self, stride: int, start: float = 0.0) -> Recording:
        """Every so many frames of those from `start`, s, on."""
        keep = (self.time >= start) & (np.arange(len(self.time)) % stride == 0)
        rows = keep[self.frame]
        frame = (np.cumsum(keep) - 1)[self.frame[rows]]
        return Recording(
            self.gyro_t, self.gyro, self.time[keep], frame, self.track[rows], self.seen[rows], self.published
        )


def read() -> Recording:
    """The recording in gtsam's example data."""
    path = str(gtsam.findExampleDataFile("eqvio_processed_30s.csv"))  # type: ignore[no-untyped-call]
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    meta = {row["key"]: row["value"] for row in rows if row["row_type"] == "meta"}
    imu = [row for row in rows if row["row_type"] == "imu"]
    features = [row for row in rows if row["row_type"] == "vision_feature"]
    times, frame = np.unique([float(row["t_rel"]) for row in features], return_inverse=True)
    return Recording(
        gyro_t=np.array([float(row["t_rel"]) for row in imu]),
        gyro=np.array([[float(row[f"g{axis}"]) for axis in "xyz"] for row in imu]),
        time=times,
        frame=frame,
        track=np.array([int(row["landmark_id"]) for row in features]),
        seen=np.array([[float(row["u_norm"]), float(row["v_norm"])] for row in features]),
        # Named T_ci in the file, it takes camera coordinates to the IMU's.
        published=so3.normalize([float(meta[f"T_ci_q{axis}"]) for axis in "wxyz"]),
    )


@dataclass(frozen=True)
class FeatureFactor(Model):
    """Features seen again, each given by its place in the frame where it was first seen and its inverse depth there.

    Predicted: the direction cRw (wRa (x, y, 1) + rho (p_a - p)), wRc = wRv Exp(dt rate) vRc, a the first sight. Blocks:
    wRv of the first sight and of this one, vRc (rotations), camera positions p_a and p (3, in w), (x, y, rho) and dt
    (1, s; positive when the pictures were taken later than their stamps say).

    Attributes:
        time: (n,) s.
        seen: (n, 2).
        rate_a, rate: (n, 3) of the gyro at the first sight and at this one, rad/s.
        sigma: of each coordinate.
    """

    time: Array
    seen: Array
    rate_a: Array
    rate: Array
    sigma: float
    rows: int = 2
    blocks = (ROT3, ROT3, ROT3, 3, 3, 3, 1)
    stacked: ClassVar = ("time", "seen", "rate_a", "rate")

    def __call__(
        self, wRv_a: Array, wRv: Array, vRc: Array, p_a: Array, p: Array, point: Array, dt: Array
    ) -> Residuals:
        """Residual (predicted - seen) / sigma, (n, 2)."""
        ray = np.concatenate([point[:, :2], np.ones((len(point), 1))], axis=1)
        rho = point[:, 2:]
        turn_a, turn = so3.exp(self.rate_a * dt), so3.exp(self.rate * dt)
        wRa = so3.compose(wRv_a, turn_a, vRc)
        cRw = so3.inverse(so3.compose(wRv, turn, vRc))
        x, y, z = d = so3.rotate(cRw, so3.rotate(wRa, ray) + rho * (p_a - p)).T
        residual = (np.stack([x / z, y / z], axis=1) - self.seen) / self.sigma

        def jacobians() -> tuple[Array, ...]:
            zero = np.zeros_like(z)
            rows = [[1.0 / z, zero, -x / z**2], [zero, 1.0 / z, -y / z**2]]
            project = np.moveaxis(np.array(rows), 2, 0) / self.sigma
            to_c, cRa = so3.matrix(cRw), so3.matrix(so3.multiply(cRw, wRa))
            cRv = so3.matrix(so3.inverse(vRc))
            by_turn_a, by_turn = -project @ cRa @ so3.hat(ray), project @ so3.hat(d.T)
            by_place = project @ to_c * rho[..., None]
            by_depth = project @ (to_c @ (p_a - p)[..., None])
            by_point = np.concatenate([project @ cRa[:, :, :2], by_depth], axis=2)
            by_mount = by_turn_a + by_turn
            by_turn_a, by_turn = by_turn_a @ cRv, by_turn @ cRv
            by_time = by_turn_a @ self.rate_a[..., None] + by_turn @ self.rate[..., None]
            return (
                by_turn_a @ so3.matrix(so3.inverse(turn_a)),
                by_turn @ so3.matrix(so3.inverse(turn)),
                by_mount,
                by_place,
                -by_place,
                by_point,
                by_time,
            )

        return residual, jacobians


def two_view_rotations(recording: Recording) -> tuple[Index, Index, Array]:
    """Frames i and j and the rotations ciRcj between them, by pycolmap's essential matrix and its refinement."""
    import pycolmap

    camera = pycolmap.Camera(model="PINHOLE", width=752, height=480, params=[FOCAL, FOCAL, 0.0, 0.0])
    tracks = [
        dict(zip(recording.track[rows].tolist(), recording.seen[rows], strict=True))
        for rows in (recording.frame == k for k in range(len(recording.time)))
    ]
    pairs, rotations = [], []
    options = pycolmap.RANSACOptions(max_error=2.0, random_seed=0)
    for i in range(0, len(recording.time) - STRIDE, STEP):
        first, second = tracks[i], tracks[i + STRIDE]
        common = [track for track in first if track in second]
        if len(common) < FEWEST_COMMON:
            continue
        a, b = (FOCAL * np.array([view[track] for track in common]) for view in (first, second))
        found = pycolmap.estimate_essential_matrix(a, b, camera, camera, options)
        if found is None:
            continue
        pose, inliers = found["cam2_from_cam1"], found["inlier_mask"]
        refined = pycolmap.refine_relative_pose(pose, camera, a, camera, b, inliers)
        pose = pose if refined is None else refined["cam2_from_cam1"]
        pairs.append((i, i + STRIDE))
        rotations.append(so3.inverse(so3.from_matrix(pose.rotation.matrix())))
    i, j = np.array(pairs).T
    return i, j, np.array(rotations)


def hand_eye(recording: Recording) -> tuple[Array, Array]:
    """vRc (4,) and gyro bias (3,) from rates between two views: the gyro's = vRc the camera's + bias.

    Two views of few near features may be far off, so it is repeated on the half that fits best.
    """
    i, j, seen = two_view_rotations(recording)
    span = (recording.time[j] - recording.time[i])[:, None]
    path = GyroPath(recording.gyro_t, recording.gyro)
    by_camera = so3.log(seen) / span
    by_gyro = so3.log(path.increments(recording.time[i], recording.time[j]).wxyz) / span
    off = np.linalg.norm(by_camera, axis=1)
    for _ in range(10):
        good = off <= np.median(off)
        centre, gyro_centre = np.median(by_camera[good], axis=0), np.median(by_gyro[good], axis=0)
        vRc = so3.align(by_gyro[good] - gyro_centre, by_camera[good] - centre)
        off = np.linalg.norm(by_gyro - gyro_centre - so3.rotate(vRc, by_camera - centre), axis=1)
    return vRc, gyro_centre - so3.rotate(vRc, centre)


def problem(recording: Recording, start: Array, bias: Array) -> Problem:
    """The graph: attitudes and positions at the frames, features, gyro bias, mount and time offset."""
    parameters = (
        Parameter(BIAS, tuple(Quantity(f"gyro_bias_{a}", "rad/s", None, 0.1, 1e-3) for a in "xyz")),
        Parameter(
            MOUNT,
            tuple(Quantity(f"camera_mount_{a}", "rad", None, 0.5, 1e-2) for a in "xyz"),
            rotation_vector_coordinates,
        ),
        Parameter(OFFSET, (Quantity("time_offset", "s", None, 0.05, 1e-3),)),
    )
    loss = TruncatedLoss(gate(2))

    def steps(_: int) -> Iterator[Step]:
        yield _whole(recording, start, bias, loss)

    return Problem("eqvio", parameters, steps, loss)


def _state(k: int) -> int:
    return int(gtsam.symbol("x", k))


def _place(k: int) -> int:
    return int(gtsam.symbol("p", k))


def _point(track: int) -> int:
    return int(gtsam.symbol("l", track))


def _whole(recording: Recording, start: Array, bias: Array, loss: TruncatedLoss) -> Step:
    """Everything in one step: the batch solver is the only one that gets to see it."""
    time, count = recording.time, len(recording.time)
    gyro = GyroPath(recording.gyro_t, recording.gyro, bias)
    attitude = so3.multiply(so3.inverse(gyro.attitude(time[:1])), gyro.attitude(time))
    values = gtsam.Values()
    values.insert(BIAS, bias)
    values.insert(MOUNT, so3.to_gtsam(start))
    values.insert(OFFSET, np.zeros(1))
    for k in range(count):
        values.insert(_state(k), so3.to_gtsam(attitude[k]))
        values.insert(_place(k), np.zeros(3))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    held = [
        Factor("prior", gtsam.PriorFactorRot3(_state(0), so3.to_gtsam(attitude[0]), tight)),
        Factor("prior", gtsam.PriorFactorVector(_place(0), np.zeros(3), tight)),
    ]
    ends = np.clip([time - HALF_SPAN, time + HALF_SPAN], *recording.gyro_t[[0, -1]])
    rate = so3.log(gyro.increments(*ends).wxyz) / (ends[1] - ends[0])[:, None]
    features = _feature_factors(recording, rate, values, loss)
    return Step(float(time[-1]), values, [*held, *_motion_factors(time, gyro), *features])


def _motion_factors(time: Array, gyro: GyroPath) -> list[Factor]:
    """From frame to frame: the gyro's turn, and a move at no unheard-of speed."""
    count = len(time)
    increments = gyro.increments(time[:-1], time[1:])
    turned = GYRO_SCALE * np.linalg.norm(so3.log(increments.wxyz), axis=1)
    native = ahrs_factors(
        [_state(k) for k in range(count - 1)],
        [_state(k) for k in range(1, count)],
        [BIAS] * (count - 1),
        increments,
        gyro.bias_hat,
        GYRO_DENSITY**2 * increments.duration + turned**2,
    )
    moves = [
        gtsam.BetweenFactorVector(
            _place(k - 1),
            _place(k),
            np.zeros(3),
            gtsam.noiseModel.Isotropic.Sigma(3, SPEED * float(increments.duration[k - 1])),
        )
        for k in range(1, count)
    ]
    return [*(Factor("gyro", f) for f in native), *(Factor("motion", f) for f in moves)]


def _feature_factors(recording: Recording, rate: Array, values: gtsam.Values, loss: TruncatedLoss) -> Iterator[Factor]:
    """One factor a frame, of the features seen more than once; adds where they are to the values."""
    _, first, index, times_seen = np.unique(recording.track, return_index=True, return_inverse=True, return_counts=True)
    free = 1e3
    for row in first[times_seen > 1]:
        key = _point(int(recording.track[row]))
        guess = np.append(recording.seen[row], INVERSE_DEPTH)
        values.insert(key, guess)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([free, free, INVERSE_DEPTH_SIGMA]))
        yield Factor("prior", gtsam.PriorFactorVector(key, guess, sigmas))
    anchor = recording.frame[first[index]]
    for k in range(len(recording.time)):
        rows = np.flatnonzero((recording.frame == k) & (times_seen[index] > 1))
        if len(rows) == 0:
            continue
        model = FeatureFactor(
            recording.time[recording.frame[rows]],
            recording.seen[rows],
            rate[anchor[rows]],
            rate[recording.frame[rows]],
            FEATURE_SIGMA,
        )
        measurement = model.on(
            [_state(int(a)) for a in anchor[rows]],
            [_state(k)] * len(rows),
            MOUNT,
            [_place(int(a)) for a in anchor[rows]],
            [_place(k)] * len(rows),
            [_point(int(t)) for t in recording.track[rows]],
            OFFSET,
            loss=loss,
        )
        yield Factor.of("features", measurement)


def error(vRc: Array, published: Array) -> Array:
    """Rotation vector (3,), rad, from the published mount to this one, in c."""
    return so3.log(so3.multiply(so3.inverse(published), vRc))


def solve(recording: Recording) -> tuple[Array, Estimate]:
    """The first guess of vRc and the estimate."""
    start, bias = hand_eye(recording)
    return start, solve_batch(problem(recording.thinned(GRAPH_STRIDE), start, bias))
