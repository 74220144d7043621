"""The published calibration of a sensor cube: one linear least-squares regression a triad, nominal on raw.

Patent on joint calibration of an inertial measurement unit and a geomagnetic sensor with an AprilTag hexahedron: in
every static pose the chain of reference, camera and tags gives the attitude, this the nominal specific force, earth
rate and field in the body, and nominal = K raw + b is solved by least squares. The local-level frame is
North-East-Down, and the earth rate is written (0, 0, 7.292115e-5 rad/s) in it, whatever the latitude. At rest a
gyro feels nothing but that, so that K of a gyro with noise comes out near 0. Mounts are taken as exact.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.earth import EARTH_RATE, gravity
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes, Estimate, Problem, Residuals
from alidade.pipelines.methods.cube.recording import CubeConfig, CubeData, local_field, recorded
from alidade.pipelines.methods.cube.static_poses import StaticPoses, static_poses
from alidade.pipelines.methods.triads import triad_names
from alidade.pipelines.settings import Config

# Twelve unknowns, three equations a pose.
_FEWEST_POSES = 4
# Published practice: 18 poses, each face three times.
_POSES_A_FACE = 3
# Coordinates in North-East-Down of a vector in East-North-Up, and back.
_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, eq=False)
class TriadRegression:
    """Result of the regression nominal = K raw + b by least squares.

    Attributes:
        K: (3, 3).
        b: (3,) in the unit of nominal.
        residual_covariance: (3, 3) of nominal - K raw - b.
        covariance: (12, 12) of rows of K, then b, if the residuals were independent of the raw numbers.
    """

    K: Array
    b: Array
    residual_covariance: Array
    covariance: Array


def regression(raw: Array, nominal: Array) -> TriadRegression:
    """Fit nominal = K raw + b to nominal (P, 3) and raw (P, 3) vectors by least squares.

    Raises:
        InputError: fewer than four poses, or all of them in a plane.
    """
    if len(raw) < _FEWEST_POSES:
        raise InputError(f"the published regression needs at least {_FEWEST_POSES} static poses, there are {len(raw)}")
    # Raw numbers about their mean and in units of their spread keep the digits of counts with large offsets.
    centre, spread = raw.mean(axis=0), raw.std(axis=0)
    design = np.hstack([(raw - centre) / spread, np.ones((len(raw), 1))])
    if np.linalg.cond(design) > 1e8:
        raise InputError("the published regression cannot separate the axes: all static poses are alike")
    solution = np.linalg.lstsq(design, nominal, rcond=None)[0]
    residuals = nominal - design @ solution
    freedom = max(len(raw) - 4, 1)
    residual_covariance = residuals.T @ residuals / freedom
    # From the scaled design to columns of K and b: b = b' - K centre.
    back = np.block([[np.diag(1.0 / spread), np.zeros((3, 1))], [-(centre / spread)[None], np.ones((1, 1))]])
    cofactor = back @ np.linalg.inv(design.T @ design) @ back.T
    solution = back @ solution
    covariance = np.zeros((12, 12))
    places = [[3 * i, 3 * i + 1, 3 * i + 2, 9 + i] for i in range(3)]
    for i, rows in enumerate(places):
        for j, columns in enumerate(places):
            covariance[np.ix_(rows, columns)] = residual_covariance[i, j] * cofactor
    return TriadRegression(solution[:3].T, solution[3], residual_covariance, covariance)


def nominal_vectors(data: CubeData, config: Config, nRb: Array) -> dict[str, Array]:
    """Nominal specific force, earth rate and field (if its place is known) in the body at the attitudes nRb (P, 4).

    Computed in North-East-Down, as published.

    Raises:
        InputError: the place on the earth or the date do not do for the models.
    """
    if data.latitude is None:
        raise InputError("the place on the earth is unknown: record /reference/fix, or give latitude_deg in the config")
    body_from_ned = so3.matrix(so3.inverse(nRb)) @ _NED_FROM_ENU.T
    vectors = {
        "accel": np.array([0.0, 0.0, -float(gravity(data.latitude, data.height))]),
        "gyro": np.array([0.0, 0.0, EARTH_RATE]),
    }
    if data.longitude is not None and data.mag is not None:
        vectors["mag"] = _NED_FROM_ENU @ local_field(data, config)
    return {name: body_from_ned @ vector for name, vector in vectors.items()}


def published_estimate(data: CubeData, config: Config, problem: Problem) -> Estimate:
    """Run the regressions as a solver of the problem: K and b of each triad, for raw numbers as recorded.

    Raises:
        InputError: there is no camera or no reference, or too few poses.
    """
    poses = static_poses(data, config)
    k, nRb = attitudes(data, config, poses)
    nominal = nominal_vectors(data, config, nRb)
    raw = {"accel": poses.accel, "gyro": poses.gyro, "mag": poses.mag}
    names: list[str] = []
    values, residuals = [], {}
    covariance = np.zeros((12 * len(nominal), 12 * len(nominal)))
    for i, (name, vectors) in enumerate(nominal.items()):
        means = raw[name]
        assert means is not None
        good = np.isfinite(means[k]).all(axis=1)
        recorded_means = recorded(means[k][good], getattr(config.section(CubeConfig).raw, name))
        found = regression(recorded_means, vectors[good])
        names += triad_names(name)
        values += [*found.K.ravel(), *found.b]
        covariance[12 * i : 12 * i + 12, 12 * i : 12 * i + 12] = found.covariance
        misses = vectors[good] - recorded_means @ found.K.T - found.b
        sigma = np.sqrt(np.diag(found.residual_covariance))
        used = np.ones(len(misses), dtype=bool)
        residuals[name] = Residuals(poses.span[k][good].mean(axis=1), misses / np.where(sigma > 0.0, sigma, 1.0), used)
    known = [i for i, name in enumerate(names) if name in {q.name for q in problem.quantities}]
    return Estimate(
        solver="published",
        names=tuple(names[i] for i in known),
        values=np.array(values)[known],
        covariance=covariance[np.ix_(known, known)],
        converged=True,
        message=_coverage(nRb),
        residuals=residuals,
        attitudes=Attitudes(poses.span[k].mean(axis=1), nRb),
    )


def attitudes(data: CubeData, config: Config, poses: StaticPoses) -> tuple[Index, Array]:
    """Indices of the poses with visible cube, and nRb = nRB BRC cRb there, with all mounts as stated.

    Raises:
        InputError: there is no camera or no reference.
    """
    if data.camera is None or data.reference_t is None or data.reference_wxyz is None:
        raise InputError(
            "the published solver needs a camera and a reference; without them take `calibrate --solver batch` or "
            "incremental"
        )
    BRC = config.section(CubeConfig).camera_rotation
    if BRC is None:
        raise InputError("the camera's mount on the reference is not given: cube.camera_rotation")
    seen, found = [], []
    for k, tags in enumerate(poses.tags):
        at = (data.reference_t >= poses.span[k, 0]) & (data.reference_t <= poses.span[k, 1])
        if tags is None or not at.any():
            continue
        samples = data.reference_wxyz[at]
        # Quaternions of one attitude with one sign: their mean is the mean attitude, as near as they are together.
        nRB = so3.normalize((samples * np.sign(samples @ samples[0])[:, None]).mean(axis=0))
        seen.append(k)
        found.append(so3.compose(nRB, BRC, tags.pose.cRb))
    return np.array(seen, dtype=np.intp), np.array(found).reshape(-1, 4)


def _coverage(nRb: Array) -> str:
    """Sentence on how often each face was up, compared with the published practice."""
    up = so3.rotate(so3.inverse(nRb), np.array([0.0, 0.0, 1.0]))
    axis = np.argmax(np.abs(up), axis=1)
    sign = np.take_along_axis(up, axis[:, None], axis=1)[:, 0] > 0.0
    faces = Counter(f"{'+' if s else '-'}{'xyz'[a]}" for a, s in zip(axis, sign, strict=True))
    few = [f"{face} ({faces[face]})" for face in ("+x", "-x", "+y", "-y", "+z", "-z") if faces[face] < _POSES_A_FACE]
    advice = f"; fewer than {_POSES_A_FACE} with this side up: {', '.join(few)}: add poses" if few else ""
    return f"{len(nRb)} static poses{advice}"
