"""The cube method: accelerometer, gyro and magnetometer calibrated in a cube of AprilTags.

The graph's states are the attitudes nRb of the static poses. Each is seen by the camera through the corners of its tags
(with the cube's place in the camera as a by-product), by gravity, the earth's field and the earth's rate; the gyro's
whole model is integrated over the turns between them. Methods page, section 4.

What the recording holds decides what is known: without a magnetometer, or without a position for the field model, there
is no magnetometer to calibrate; without a reference the camera stands still at an unknown attitude; without a camera
the poses follow from gravity and the turns alone, and the accelerometer's own axes define the body frame: accel_k21,
accel_k31 and accel_k32 are zero unless given a prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from factors import so3
from factors.chi_square import gate
from factors.earth import earth_rate, gravity
from factors.loss import TruncatedLoss
from factors.preintegration import GyroPath
from factors.triad import (
    AccelFactor,
    GyroRotationFactor,
    GyroStaticFactor,
    MagFactor,
    TagAttitudeFactor,
    WeightedSumFactor,
    parts,
)
from pipelines.errors import InputError
from pipelines.graph.linear import linear_factor
from pipelines.graph.problem import Array, Attitudes, Factor, Problem, Step
from pipelines.methods.cube.data import CubeData, local_field, noise_densities, nominal
from pipelines.methods.cube.parameters import (
    FIELD_KEY,
    HEADING_KEY,
    MOUNT_KEY,
    TRIAD_KEYS,
    Parameters,
    cube_parameters,
    first_priors,
    tag_key,
)
from pipelines.methods.cube.poses import SeenTags, StaticPoses, static_poses, turn
from pipelines.methods.cube.reference import Reference, cube_reference, from_vectors
from pipelines.methods.cube.topics import CubeConfig
from pipelines.recording.checks import count
from pipelines.settings import DEFAULT_NOISE, Config, first_given

# Sigmas of priors as good as none, m on the cube's place in the camera and rad on an attitude that no gyro leads to:
# these only make the new variables of a step determined without its measurements.
_POSITION_PRIOR_SIGMA, _ATTITUDE_PRIOR_SIGMA = 10.0, np.pi
# A gyro bias that does not walk still does so by this much, rad/s, for the sake of the arithmetic.
_STEADY = 1e-8
# A pause of the gyro's record in a turn longer than this, s, breaks the chain of turns.
_LONGEST_GAP = 0.1


@dataclass(frozen=True)
class _GaussMarkovDeviation:
    """How the gyro's offset deviates from its mean over the session: a random walk that stays bounded.

    A first-order Gauss-Markov process: over short times the walk, over the session the deviation that a walk has from
    its own mean, whose variance is walk^2 times a sixth of the session.

    Attributes:
        sigma: (P,) of each pose's deviation, given the one before it; of the first alone.
        correlation: (P,) with the one before it; 0 for the first.
        weights: (P,) share of the session that a pose stands for.
    """

    sigma: Array
    correlation: Array
    weights: Array

    @classmethod
    def over(cls, poses: StaticPoses, walk: float) -> _GaussMarkovDeviation:
        """For a walk in rad/s/sqrt(s)."""
        start, stop = poses.span.T
        middle = 0.5 * (start + stop)
        length = float(stop[-1] - start[0])
        stationary = max(walk * float(np.sqrt(length / 6.0)), _STEADY)
        correlation = np.append(0.0, np.exp(-np.diff(middle) / (length / 3.0)))
        edges = np.concatenate([start[:1], 0.5 * (middle[1:] + middle[:-1]), stop[-1:]])
        return cls(stationary * np.sqrt(1.0 - correlation**2), correlation, np.diff(edges) / length)


@dataclass(frozen=True)
class _Model:
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
    density: tuple[float, float, float]  # of gyro, accelerometer and magnetometer
    deviation: _GaussMarkovDeviation
    scale_error: float  # sigma of a turn per angle turned
    gyro_bias: Array  # (3,) first guess, in nominal units
    initial: Array  # (P, 4) nRb
    loss: TruncatedLoss
    dropped: Mapping[str, int]  # reason -> measurements left out


def problem(data: CubeData, config: Config) -> Problem:
    """The graph of a cube recording.

    Raises:
        InputError: there is no static pose, the position is unknown, the date is outside the field model, or no tag of
            the cube is seen well though there is a camera.
    """
    model = _prepare(data, config)
    return Problem(
        method="cube",
        parameters=model.parameters.all,
        steps=partial(_steps, model),
        loss=model.loss,
        attitudes=partial(_trajectory, model),
        attitude_name="nRb",
        advice=_advice,
        dropped=model.dropped,
    )


def _prepare(data: CubeData, config: Config) -> _Model:
    if data.latitude is None:
        raise InputError(
            "the place on the earth is unknown, and with it gravity and the earth's rate: record /reference/fix, or "
            "give latitude_deg in the config"
        )
    poses = static_poses(data, config)
    field, dropped = None, {**data.dropped, **poses.dropped}
    if poses.mag is not None and data.longitude is None:
        count(dropped, "magnetometer: no position for the field model, not calibrated", 1)
    elif poses.mag is not None:
        field = local_field(data, config)
    # Else only the horizontal earth rate would show the heading, which no MEMS gyro feels: it is left out as noise.
    heading_known = field is not None or data.reference_t is not None
    earth = earth_rate(data.latitude)
    bias = np.median(poses.gyro, axis=0)
    reference = cube_reference(data, config, poses, field)
    return _Model(
        data=data,
        config=config,
        poses=poses,
        reference=reference,
        parameters=cube_parameters(
            config,
            camera=data.camera is not None,
            reference=data.reference_t is not None,
            field=field,
        ),
        gravity=float(gravity(data.latitude, data.height)),
        earth_rate=earth * np.array([1.0, 1.0, 1.0] if heading_known else [0.0, 0.0, 1.0]),
        unknown_rate=0.0 if heading_known else float(np.hypot(*earth[:2]) * np.sqrt(0.5)),
        field=field,
        density=noise_densities(data, config),
        deviation=_GaussMarkovDeviation.over(
            poses, first_given(config.noise.gyro_bias_walk, DEFAULT_NOISE.gyro_bias_walk)
        ),
        scale_error=first_given(config.noise.gyro_scale, DEFAULT_NOISE.gyro_scale),
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


def _pose_key(k: int) -> int:
    return int(gtsam.symbol("x", k))


def _place_key(k: int) -> int:
    return int(gtsam.symbol("p", k))


def _deviation_key(k: int) -> int:
    return int(gtsam.symbol("d", k))


def _reference_key(k: int) -> int:
    return int(gtsam.symbol("R", k))


def _steps(model: _Model, _: int) -> Iterator[Step]:
    """One step a static pose, with the turn before it; the calibration variables come with the first.

    No variable ages: a session has tens of poses, few enough to keep them all.
    """
    yield from (_step(model, k) for k in range(len(model.poses)))


def _step(model: _Model, k: int) -> Step:
    initial = gtsam.Values()
    factors: list[Factor] = []
    if k == 0:
        initial.insert(model.parameters.initial(model.gyro_bias))
        factors += first_priors(model.parameters)
    initial.insert(_pose_key(k), so3.to_gtsam(model.initial[k]))
    initial.insert(_deviation_key(k), np.zeros(3))
    factors += [*_deviation_factors(model, k), *_process(model, k)]
    seen = model.poses.tags[k]
    if seen is not None:
        initial.insert(_place_key(k), seen.pose.position)
        prior = gtsam.noiseModel.Isotropic.Sigma(3, _POSITION_PRIOR_SIGMA)
        factors.append(Factor("prior", gtsam.PriorFactorVector(_place_key(k), seen.pose.position, prior)))
    if model.data.camera is not None and (seen is not None if model.reference.moves else k == 0):
        initial.insert(_reference_key(k), so3.to_gtsam(model.reference.nRB[k]))
        if model.reference.covariance is not None:
            measured = so3.to_gtsam(model.reference.nRB[k])
            noise = gtsam.noiseModel.Gaussian.Covariance(model.reference.covariance[k])
            factors.append(Factor("reference", gtsam.PriorFactorRot3(_reference_key(k), measured, noise)))
    factors += _sensor_factors(model, k)
    if seen is not None:
        factors.append(_tag_factor(model, k, seen))
    return Step(
        time=float(model.poses.span[k, 1]),
        initial=initial,
        factors=factors,
        predict=partial(_predict, model, k, initial) if k > 0 and _turn_known(model, k) else None,
        keyframes=range(k, k + 1),
    )


def _trajectory(model: _Model, poses: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Attitudes nRb of the static poses, at their middles."""
    wxyz = so3.from_gtsam([values.atRot3(_pose_key(k)) for k in poses])
    return Attitudes(model.poses.span[list(poses)].mean(axis=1), wxyz)


def _turn_known(model: _Model, k: int) -> bool:
    """Whether the gyro's record of the turn that ends in pose k has no gap."""
    samples = _turn(model, k)
    return bool(np.diff(model.data.imu_t[samples]).max(initial=0.0) <= _LONGEST_GAP)


def _turn(model: _Model, k: int) -> slice:
    return turn(model.data, model.poses.span[k - 1, 1], model.poses.span[k, 0])


def _process(model: _Model, k: int) -> list[Factor]:
    """What leads to the attitude of pose k: the turn before it, or nothing."""
    if k > 0 and _turn_known(model, k):
        measurement = _rotation_model(model, k).on(
            _pose_key(k - 1), _pose_key(k), TRIAD_KEYS["gyro"], _deviation_key(k - 1), _deviation_key(k)
        )
        return [Factor("gyro turns", measurement.factor)]
    attitude = so3.to_gtsam(model.initial[k])
    prior = gtsam.noiseModel.Isotropic.Sigma(3, _ATTITUDE_PRIOR_SIGMA)
    return [Factor("prior", gtsam.PriorFactorRot3(_pose_key(k), attitude, prior))]


def _deviation_factors(model: _Model, k: int) -> list[Factor]:
    """How the offset of the gyro came to where it is in pose k; after the last, that c is its mean over the session."""
    deviation, key = model.deviation, _deviation_key(k)
    sigma = float(deviation.sigma[k])
    if k == 0:
        noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        return [Factor("bias walk", gtsam.PriorFactorVector(key, np.zeros(3), noise))]
    blocks = {key: np.eye(3), _deviation_key(k - 1): -deviation.correlation[k] * np.eye(3)}
    factors = [Factor("bias walk", linear_factor(blocks, dict.fromkeys(blocks, np.zeros(3)), sigma))]
    if k == len(model.poses) - 1:
        mean = WeightedSumFactor(model.poses.span[-1:, 1], deviation.weights, _STEADY)
        factors.append(Factor("definition", mean.on(*(_deviation_key(i) for i in range(k + 1))).factor))
    return factors


def _rotation_model(model: _Model, k: int) -> GyroRotationFactor:
    samples = _turn(model, k)
    t, raw = model.data.imu_t[samples], nominal(model.data.gyro[samples], model.config.section(CubeConfig).raw.gyro)
    duration = float(t[-1] - t[0])
    angle = np.linalg.norm(so3.log(GyroPath(t, raw, model.gyro_bias).attitude(t[-1:])[0]))
    known = model.density[0] ** 2 * duration + (model.scale_error * angle) ** 2
    variance = known + (model.unknown_rate * duration) ** 2
    return GyroRotationFactor(t[-1:], [t], [raw], model.earth_rate, np.sqrt([variance]))


def _sensor_factors(model: _Model, k: int) -> list[Factor]:
    """Accelerometer, gyro and magnetometer at rest in pose k."""
    poses, row = model.poses, slice(k, k + 1)
    time = 0.5 * poses.span[row].sum(axis=1)
    gyro_density, accel_density, mag_density = model.density
    duration = poses.duration[row]
    accel = AccelFactor(time, poses.accel[row], accel_density / np.sqrt(duration), model.gravity)
    gyro_sigma = np.sqrt(gyro_density**2 / duration + model.unknown_rate**2)
    gyro = GyroStaticFactor(time, poses.gyro[row], gyro_sigma, model.earth_rate)
    factors = [
        Factor.of("accelerometer", accel.on(_pose_key(k), TRIAD_KEYS["accel"])),
        Factor.of("gyro at rest", gyro.on(_pose_key(k), TRIAD_KEYS["gyro"], _deviation_key(k))),
    ]
    if model.field is not None and poses.mag is not None and poses.mag_duration[k] > 0.0:
        mag = MagFactor(time, poses.mag[row], mag_density / np.sqrt(poses.mag_duration[row]))
        seen = mag.on(_pose_key(k), TRIAD_KEYS["mag"], FIELD_KEY, loss=model.loss)
        factors.append(Factor.of("magnetometer", seen))
    return factors


def _tag_factor(model: _Model, k: int, seen: SeenTags) -> Factor:
    """All tags seen in pose k."""
    from pipelines.vision.pose import TagBody

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
    )
    reference = _reference_key(k if model.reference.moves else 0)
    measurement = tags.on(
        [_pose_key(k)] * n,
        [_place_key(k)] * n,
        [reference] * n,
        HEADING_KEY,
        MOUNT_KEY,
        [tag_key(int(i)) for i in seen.ids],
        loss=model.loss,
    )
    return Factor.of("tags", measurement)


def _predict(model: _Model, k: int, initial: gtsam.Values, current: gtsam.Values) -> gtsam.Values:
    """The attitude of pose k carried on by the gyro as calibrated so far; the rest as measured."""
    out = gtsam.Values(initial)
    samples = _turn(model, k)
    A, c = parts(current.atVector(TRIAD_KEYS["gyro"]))
    raw = nominal(model.data.gyro[samples], model.config.section(CubeConfig).raw.gyro)
    deviation = current.atVector(_deviation_key(k - 1))
    out.update(_deviation_key(k), model.deviation.correlation[k] * deviation)
    path = GyroPath(model.data.imu_t[samples], (raw - c - deviation) @ np.linalg.inv(A).T)
    before = so3.from_gtsam([current.atRot3(_pose_key(k - 1))])[0]
    earth = so3.exp(-model.earth_rate * (path.t[-1] - path.t[0]))
    out.update(_pose_key(k), so3.to_gtsam(so3.compose(earth, before, path.attitude(path.t[-1:])[0])))
    return out


def _advice(weights: Mapping[str, float]) -> str:
    """The motion that would make a weak direction observable."""
    strongest = [name for name, w in weights.items() if abs(w) > 0.3] or list(weights)
    if all(name.startswith("field") for name in strongest):
        return (
            "the magnetometer's scale follows the field model's strength: tighter priors on field_e, field_n, field_u"
        )
    gyro = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith("gyro_k")})
    if gyro:
        return f"turn the cube between poses about its {' and '.join(gyro)} axis, by a quarter turn or more, both ways"
    still = {name.split("_")[0] for name in strongest if name.startswith(("accel", "mag"))}
    if still:
        axes = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith(("accel_k", "mag_k"))})
        about = f", its {' and '.join(axes)} axis up, down and level" if axes else ""
        return f"{' and '.join(sorted(still))}: add static poses in other attitudes{about}"
    if any(name.startswith("gyro_b") for name in strongest):
        return "let the cube stand still longer"
    if any(name.startswith("tag_") for name in strongest):
        tags = sorted({name.split("_")[1] for name in strongest if name.startswith("tag_")})
        return f"show tag {' and '.join(tags)} to the camera together with its neighbours"
    return "heading, camera mount and field trade against each other: turn the cube through more attitudes"
