"""A cube recording prepared for its graph: poses, reference, parameters, and first guesses of the attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.chi_square import gate
from alidade.factors.earth import earth_rate, gravity
from alidade.factors.loss import TruncatedLoss
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.cube.data import DENSITIES, CubeData, local_field, nominal
from alidade.pipelines.methods.cube.noises import noises
from alidade.pipelines.methods.cube.parameters import Parameters, cube_parameters
from alidade.pipelines.methods.cube.poses import StaticPoses, static_poses, turn
from alidade.pipelines.methods.cube.reference import Reference, cube_reference, from_vectors
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.cube.wandering import GaussMarkovDeviation
from alidade.pipelines.settings import Config

# A pause of the gyro's record in a turn longer than this, s, breaks the chain of turns.
_LONGEST_GAP = 0.1


@dataclass(frozen=True)
class Turning:
    """A turn's samples: stamps (N,), s, and gyro and accelerometer (N, 3) in nominal units.

    warmth (N,), K: temperature above the recording's first; None where nobody measures it.
    """

    t: Array
    gyro: Array
    accel: Array
    warmth: Array | None

    @property
    def whole(self) -> bool:
        """Whether there is no gap in them."""
        return bool(np.diff(self.t).max(initial=0.0) <= _LONGEST_GAP)


@dataclass(frozen=True)
class Model:
    """The recording prepared for the graph: what every step needs."""

    data: CubeData
    config: Config
    poses: StaticPoses
    reference: Reference
    parameters: Parameters
    gravity: float  # m/s^2
    earth_rate: Array  # (3,) rad/s in n, as far as the heading is known
    unknown_rate: float  # rad/s per axis, what of the earth rate that leaves out
    field: Array | None  # (3,) T in n, by the model
    density: tuple[float, ...]  # of gyro, accelerometer and magnetometer
    deviation: GaussMarkovDeviation
    gyro_bias: Array  # (3,) first guess, in nominal units
    initial: Array  # (P, 4) nRb
    loss: TruncatedLoss
    dropped: Mapping[str, int]  # reason -> measurements left out

    def samples(self, k: int) -> Turning:
        """What gyro and accelerometer said over the turn that ends in pose k."""
        rows = turn(self.data, self.poses.span[k - 1, 1], self.poses.span[k, 0])
        raw = self.config.section(CubeConfig).raw
        gyro, accel = nominal(self.data.gyro[rows], raw.gyro), nominal(self.data.accel[rows], raw.accel)
        t, warming = self.data.imu_t[rows], self.data.temperature
        return Turning(t, gyro, accel, None if warming is None else warming.above(warming.first, t))

    def warmth(self, sensor: str, k: int) -> Array | None:
        """(1,) K, mean temperature in pose k above the recording's first; None where a sensor's offset ignores it."""
        warming, celsius = self.data.temperature, self.poses.celsius
        if warming is None or celsius is None or sensor not in self.parameters.slopes:
            return None
        return np.asarray(celsius[k : k + 1] - warming.first)


def prepare(data: CubeData, config: Config) -> Model:
    """Poses, reference, parameters and first guesses of a recording; raises as the graph's `problem`."""
    if data.latitude is None:
        raise InputError(
            "the place on the earth is unknown, and with it gravity and the earth's rate: record /reference/fix, or "
            "give latitude_deg in the config"
        )
    poses, known = static_poses(data, config), noises(data, config)
    field, dropped = None, {**data.dropped, **poses.dropped}
    if poses.mag is not None and data.longitude is not None:
        field = local_field(data, config)
    # Else only the horizontal earth rate would show the heading, which no MEMS gyro feels: it is left out as noise.
    heading_known = field is not None or data.reference_t is not None
    earth = earth_rate(data.latitude)
    bias = np.median(poses.gyro, axis=0)
    reference = cube_reference(data, config, poses, field)
    return Model(
        data=data,
        config=config,
        poses=poses,
        reference=reference,
        parameters=cube_parameters(
            config,
            camera=data.camera is not None,
            reference=data.reference_t is not None,
            field=field,
            thermometer=data.temperature is not None,
        ),
        gravity=float(gravity(data.latitude, data.height)),
        earth_rate=earth * np.array([1.0, 1.0, 1.0] if heading_known else [0.0, 0.0, 1.0]),
        unknown_rate=0.0 if heading_known else float(np.hypot(*earth[:2]) * np.sqrt(0.5)),
        field=field,
        density=tuple(known[name].used if name in known else 0.0 for name in DENSITIES),
        deviation=GaussMarkovDeviation.over(poses, known["gyro_bias_walk"].used),
        gyro_bias=bias,
        initial=_attitudes(data, config, poses, reference, field, bias),
        loss=TruncatedLoss(gate(8)),
        dropped=dropped,
    )


def _attitudes(
    data: CubeData, config: Config, poses: StaticPoses, reference: Reference, field: Array | None, bias: Array
) -> Array:
    """First guess of nRb (P, 4): seen by the camera, else carried on by the gyro and levelled."""
    path = GyroPath(data.imu_t, nominal(data.gyro, config.section(CubeConfig).raw.gyro), bias)
    found: list[Array] = []
    for k, seen in enumerate(poses.tags):
        if seen is not None:
            found.append(so3.multiply(reference.nRC[k], seen.pose.cRb))
        elif not found:
            mag = None if poses.mag is None or field is None else poses.mag[k]
            found.append(from_vectors(poses.accel[k], mag, field))
        else:
            turned = path.increments(poses.span[k - 1 : k, 1], poses.span[k : k + 1, 0]).wxyz[0]
            found.append(_levelled(so3.multiply(found[-1], turned), poses.accel[k]))
    return np.array(found)


def _levelled(nRb: Array, accel: Array) -> Array:
    """nRb turned the shortest way so that the specific force points up."""
    up = so3.rotate(nRb, accel / np.linalg.norm(accel))
    axis = so3.cross(up, np.array([0.0, 0.0, 1.0]))
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, up[2]))
    return so3.multiply(so3.exp(axis * (angle / max(sine, 1e-12))), nRb)
