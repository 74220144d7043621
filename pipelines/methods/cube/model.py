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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.chi_square import gate
from alidade.factors.earth import earth_rate, gravity
from alidade.factors.loss import TruncatedLoss
from alidade.factors.preintegration import GyroPath
from alidade.factors.triad import AccelFactor, GyroStaticFactor, MagFactor, TagAttitudeFactor
from alidade.factors.turns import GyroRotationFactor, Samples, Turns
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.prior_replacement import with_priors
from alidade.pipelines.estimation.priors import linear_factor, rotation_about, vector_about
from alidade.pipelines.estimation.problem import Attitudes, ChainLayout, Factor, Problem, Step
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.guidance import advice
from alidade.pipelines.methods.cube.parameters import (
    CURVATURE_KEY,
    DEAD_BAND_KEY,
    FIELD_KEY,
    LENS_KEY,
    MOUNT_KEY,
    SAID_KEY,
    SENSITIVITY_KEY,
    SLOPE_KEYS,
    TRIAD_KEYS,
    Parameters,
    cube_parameters,
    first_priors,
    tag_key,
    tag_place_key,
)
from alidade.pipelines.methods.cube.recording import (
    DENSITIES,
    CubeConfig,
    CubeData,
    computed_once,
    local_field,
    nominal,
    stated_density,
)
from alidade.pipelines.methods.cube.static_poses import (
    Reference,
    SeenTags,
    StaticPoses,
    cube_reference,
    from_vectors,
    static_poses,
)
from alidade.pipelines.methods.cube.tags import layout_prior
from alidade.pipelines.methods.noise import repeatability, sampled, stated, typical, walked
from alidade.pipelines.recording.plausibility import DEAD_BAND, dead_band
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.vision.camera import Camera


_NO_FIELD = (
    "The magnetometer is not calibrated, for the field is not known where nobody says where it was: give latitude_deg "
    "and longitude_deg in the config, or record /reference/fix."
)
# Sigmas of priors as good as none, m on the cube's place in the camera and rad on an attitude that no gyro leads to:
# these only make the new variables of a step determined without its measurements.
_POSITION_PRIOR_SIGMA, _ATTITUDE_PRIOR_SIGMA = 10.0, np.pi


def _key_of_pose(letter: str) -> Callable[[int], int]:
    return lambda k: int(gtsam.symbol(letter, k))


# Variables of pose k: attitude nRb (Rot3); the cube's position in the camera frame, (3,) m; reference attitude nRB
# (Rot3), that of pose 0 for a stationary reference; the gyro offset's deviation from its mean, (3,), nominal units; the
# sum of deviations up to this pose, weighted by duration.
pose_key, place_key, reference_key, deviation_key, sum_key = map(_key_of_pose, "xpRde")


def problem(data: CubeData, config: Config) -> Problem:
    """Build the graph of a cube recording.

    Raises:
        InputError: there is no static pose, the position is unknown, the date is outside the field model, or no tag of
            the cube is seen well though there is a camera.
    """
    model = prepare(data, config)
    premises = {_NO_FIELD: model.poses.mag is not None and model.field is None, DEAD_BAND: model.dead_band > 0.0}
    graph = Problem(
        method="cube",
        parameters=model.parameters.all,
        steps=partial(_steps, model),
        loss=model.loss,
        attitudes=partial(_trajectory, model),
        advice=advice,
        dropped=model.dropped,
        premises=tuple(premise for premise, holds in premises.items() if holds),
        noises=tuple(noises(data, config).values()),
        constants=temperature.constants(temperature.reference(data.temperature)),
        layout=ChainLayout(states="xdepR" if model.reference.moves else "xdep"),
    )
    if data.camera is None:
        return graph
    known = with_priors(graph, [layout_prior(config)])
    return known if config.section(CubeConfig).covariance is not None else _by_sheets(known, graph)


def _by_sheets(known: Problem, plain: Problem) -> Problem:
    """Restore the data-sheet names of the quantities after their priors were joined."""
    sheets = {q.name: q.sheet for q in plain.quantities}
    parameters = tuple(
        replace(p, quantities=tuple(replace(q, sheet=sheets[q.name]) for q in p.quantities)) for p in known.parameters
    )
    return replace(known, parameters=parameters, premises=plain.premises)


def _steps(model: Model, _: int) -> Iterator[Step]:
    """Yield a step for each static pose, with the preceding turn; the first one adds the calibration variables.

    No variable ages: a session has tens of poses, few enough to keep them all.
    """
    yield from (_step(model, k) for k in range(len(model.poses)))


def _step(model: Model, k: int) -> Step:
    initial = gtsam.Values()
    factors: list[Factor] = []
    if k == 0:
        initial.insert(model.parameters.initial(model.gyro_bias))
        factors += first_priors(model.parameters)
    initial.insert(pose_key(k), so3.to_gtsam(model.initial[k]))
    initial.insert(deviation_key(k), np.zeros(3))
    initial.insert(sum_key(k), np.zeros(3))
    factors += [*model.deviation.factors(k), *_process(model, k)]
    seen = model.poses.tags[k]
    if seen is not None:
        initial.insert(place_key(k), seen.pose.position)
        factors.append(vector_about(place_key(k), seen.pose.position, _POSITION_PRIOR_SIGMA))
    if model.data.camera is not None and (seen is not None if model.reference.moves else k == 0):
        initial.insert(reference_key(k), so3.to_gtsam(model.reference.nRB[k]))
        if model.reference.covariance is not None:
            R = np.linalg.cholesky(np.linalg.inv(model.reference.covariance[k])).T
            factors.append(rotation_about(reference_key(k), model.reference.nRB[k], R, "reference"))
    factors += sensor_factors(model, k)
    if seen is not None:
        factors.append(tag_factor(model, k, seen))
    return Step(
        time=float(model.poses.span[k, 1]),
        initial=initial,
        factors=factors,
        predict=partial(_predict, model, k, initial) if k > 0 and model.samples(k).whole else None,
        keyframes=range(k, k + 1),
    )


def _trajectory(model: Model, poses: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Attitudes nRb (P, 4) of the static poses, at their mid-times."""
    wxyz = so3.from_gtsam([values.atRot3(pose_key(k)) for k in poses])
    return Attitudes(model.poses.span[list(poses)].mean(axis=1), wxyz)


def _process(model: Model, k: int) -> list[Factor]:
    """Factors on pose k's attitude from the preceding turn, or a wide prior without a complete turn."""
    if k > 0 and model.samples(k).whole:
        return [turn_factor(model, k)]
    return [rotation_about(pose_key(k), model.initial[k], np.eye(3) / _ATTITUDE_PRIOR_SIGMA)]


def _predict(model: Model, k: int, initial: gtsam.Values, current: gtsam.Values) -> gtsam.Values:
    """Initial values of pose k: attitude propagated by the gyro as calibrated so far, the rest as measured."""
    out = gtsam.Values(initial)
    samples, deviation = model.samples(k), current.atVector(deviation_key(k - 1))
    own = current.atVector(TRIAD_KEYS["gyro"]) + np.append(np.zeros(9), deviation)
    gyro, accel = samples.gyro, samples.accel
    if model.parameters.dead_band is not None:
        gyro = gyro + samples.beyond * current.atVector(DEAD_BAND_KEY)
    if samples.temperature_rise is not None:
        slopes = model.parameters.slopes
        drifts = {name: np.outer(samples.temperature_rise, current.atVector(SLOPE_KEYS[name])) for name in slopes}
        gyro, accel = gyro - drifts.get("gyro", 0.0), accel - drifts.get("accel", 0.0)
    of_force = []
    if model.parameters.sensitivity is not None:
        of_force = [current.atVector(SENSITIVITY_KEY)[None], current.atVector(TRIAD_KEYS["accel"])[None], accel]
    (turned,) = Turns.of(Samples.of([samples.t]), gyro, own[None], *of_force).rotation
    out.update(deviation_key(k), model.deviation.correlation[k] * deviation)
    before = so3.from_gtsam([current.atRot3(pose_key(k - 1))])[0]
    earth = so3.exp(-model.earth_rate * (samples.t[-1] - samples.t[0]))
    out.update(pose_key(k), so3.to_gtsam(so3.compose(earth, before, turned)))
    return out


# A pause of the gyro's record in a turn longer than this, s, breaks the chain of turns.
_LONGEST_GAP = 0.1


@dataclass(frozen=True)
class Turning:
    """Samples of one turn: stamps (N,), s, and gyro and accelerometer (N, 3) in nominal units.

    beyond (N, 3): side of the gyro's dead band, 0 within or without one. temperature_rise (N,), K: temperature above
    the recording's first; None where nobody measures it.
    """

    t: Array
    gyro: Array
    accel: Array
    beyond: Array
    temperature_rise: Array | None

    @property
    def whole(self) -> bool:
        """Whether the samples have no gap."""
        return bool(np.diff(self.t).max(initial=0.0) <= _LONGEST_GAP)


@dataclass(frozen=True)
class Model:
    """A recording prepared for the graph."""

    data: CubeData
    config: Config
    poses: StaticPoses
    reference: Reference
    parameters: Parameters
    gravity: float  # m/s^2
    earth_rate: Array  # (3,) rad/s in n, as far as the heading is known
    unknown_rate: float  # rad/s per axis, what of the earth rate that leaves out
    dead_band: float  # rad/s, half width of the gyro's, 0 without one
    beyond: Array  # (N, 3) the side of it that a sample is on, 0 within or without one
    field: Array | None  # (3,) T in n, by the model
    density: tuple[float, ...]  # of gyro, accelerometer and magnetometer
    deviation: GaussMarkovDeviation
    gyro_bias: Array  # (3,) first guess, in nominal units
    initial: Array  # (P, 4) nRb
    loss: TruncatedLoss
    dropped: Mapping[str, int]  # reason -> measurements left out

    def samples(self, k: int) -> Turning:
        """Readings of gyro and accelerometer over the turn that ends in pose k."""
        t, start, stop = self.data.imu_t, self.poses.span[k - 1, 1], self.poses.span[k, 0]
        rows = slice(np.searchsorted(t, start), np.searchsorted(t, stop, side="right"))
        raw = self.config.section(CubeConfig).raw
        gyro, accel = nominal(self.data.gyro[rows], raw.gyro), nominal(self.data.accel[rows], raw.accel)
        t, warming = t[rows], self.data.temperature
        return Turning(t, gyro, accel, self.beyond[rows], None if warming is None else warming.above(warming.first, t))

    def temperature_rise(self, sensor: str, k: int) -> Array | None:
        """Mean temperature (1,), K, in pose k above the first one; None if the sensor's slope is no parameter."""
        warming, celsius = self.data.temperature, self.poses.celsius
        if warming is None or celsius is None or sensor not in self.parameters.slopes:
            return None
        return np.asarray(celsius[k : k + 1] - warming.first)


def prepare(data: CubeData, config: Config) -> Model:
    """Find poses, reference, parameters and initial values of a recording; raises as the graph's `problem`."""
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
    half_width, beyond = dead_band(data.imu_t, nominal(data.gyro, config.section(CubeConfig).raw.gyro))
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
            dead_band=bool(beyond.any()),
        ),
        gravity=float(gravity(data.latitude, data.height)),
        earth_rate=earth * np.array([1.0, 1.0, 1.0] if heading_known else [0.0, 0.0, 1.0]),
        unknown_rate=0.0 if heading_known else float(np.hypot(*earth[:2]) * np.sqrt(0.5)),
        dead_band=half_width,
        beyond=beyond,
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
    """Initial attitudes nRb (P, 4): from the camera, else propagated by the gyro and levelled."""
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
            nRb = so3.multiply(found[-1], turned)
            up = so3.rotate(nRb, poses.accel[k] / np.linalg.norm(poses.accel[k]))
            found.append(so3.multiply(so3.shortest(up, [0.0, 0.0, 1.0]), nRb))
    return np.array(found)


@computed_once
def noises(data: CubeData, config: Config) -> dict[str, Level]:
    """Noises in use, by name, in nominal SI. Raises InputError when there is no static pose."""
    raw, poses = config.section(CubeConfig).raw, static_poses(data, config)
    gyro = stated_density("gyro_density", data, config, "gyro turns", "gyro at rest")
    accel = stated_density("accel_density", data, config)
    causes = poses.accel if poses.celsius is None else np.column_stack([poses.accel, poses.celsius])
    found = [
        sampled(gyro, data.imu_t, nominal(data.gyro, raw.gyro)),
        sampled(accel, data.imu_t, nominal(data.accel, raw.accel)),
        walked(stated("gyro_bias_walk", config), poses.span.mean(axis=1), poses.gyro, causes),
        repeatability("gyro", config, "gyro at rest"),
        repeatability("turn", config, "gyro turns"),
        repeatability("accel", config, "accelerometer"),
    ]
    if data.mag is not None and data.mag_t is not None:
        mag = stated_density("mag_density", data, config)
        found += [sampled(mag, data.mag_t, nominal(data.mag, raw.mag)), repeatability("mag", config, "magnetometer")]
    if data.camera is not None:
        seen = None if data.sightings is None else data.sightings.covariance
        corners = typical(None if seen is None else seen.reshape(-1, 2, 2), 0, 1)
        found.append(Level(stated("corner_px", config, corners, ("tags",))))
    return {level.noise.name: level for level in found}


# Steps of derivatives by a share of the focal length and by the centre, px.
_FOCAL_STEP, _CENTRE_STEP = 1e-4, 0.1


def sensor_factors(model: Model, k: int) -> list[Factor]:
    """Factors of accelerometer, gyro and magnetometer at rest in pose k."""
    poses, row = model.poses, slice(k, k + 1)
    time = 0.5 * poses.span[row].sum(axis=1)
    gyro_density, accel_density, mag_density = model.density
    duration = poses.duration[row]
    curved, feels = model.parameters.curvature is not None, model.parameters.sensitivity is not None
    temperature_rises = {name: model.temperature_rise(name, k) for name in SLOPE_KEYS}
    slopes = {name: [] if temperature_rises[name] is None else [key] for name, key in SLOPE_KEYS.items()}
    accel_sigma = accel_density / np.sqrt(duration)
    accel = AccelFactor(time, poses.accel[row], accel_sigma, model.gravity, curved, temperature_rises["accel"])
    # Beside white noise: the earth rate left out, and an offset in the dead band, uniform and the same in all poses.
    offset = np.hypot(model.unknown_rate, model.dead_band * np.sqrt(len(poses) / 3.0))
    gyro_sigma = np.sqrt(gyro_density**2 / duration + offset**2)
    gravity = model.gravity if feels else None
    gyro = GyroStaticFactor(time, poses.gyro[row], gyro_sigma, model.earth_rate, gravity, temperature_rises["gyro"])
    terms, G = [CURVATURE_KEY] if curved else [], [SENSITIVITY_KEY] if feels else []
    of_accel = accel.on(pose_key(k), TRIAD_KEYS["accel"], *terms, *slopes["accel"])
    of_gyro = gyro.on(pose_key(k), TRIAD_KEYS["gyro"], deviation_key(k), *G, *slopes["gyro"])
    factors = [
        Factor.of("accelerometer", of_accel, poses.unrest[row, 1] / accel.sigma),
        Factor.of("gyro at rest", of_gyro, poses.unrest[row, 0] / gyro.sigma),
    ]
    if model.field is not None and poses.mag is not None and poses.mag_duration[k] > 0.0:
        mag = MagFactor(time, poses.mag[row], mag_density / np.sqrt(poses.mag_duration[row]))
        seen = mag.on(pose_key(k), TRIAD_KEYS["mag"], FIELD_KEY, loss=model.loss)
        factors.append(Factor.of("magnetometer", seen, 1.0 / mag.sigma))
    return factors


def tag_factor(model: Model, k: int, seen: SeenTags) -> Factor:
    """Factor of all tags seen in pose k."""
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
        [tag_place_key(int(i)) for i in seen.ids],
        *([] if model.parameters.lens is None else [LENS_KEY]),
        loss=model.loss,
    )
    return Factor.of("tags", measurement)


def _by_lens(camera: Camera, corners: Array) -> Array:
    """Derivatives (n, 4, 2, 3) of the corners' z = 1 coordinates by focal-length share and principal point, px."""
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
    """Factor of the gyro's rotation from pose k - 1 to pose k."""
    samples, feels = model.samples(k), model.parameters.sensitivity is not None
    t = samples.t
    duration = float(t[-1] - t[0])
    # Beside white noise: the earth rate left out, and rates within the gyro's dead band, uniform in it.
    within = (samples.beyond == 0.0).mean(axis=0).max()
    rate_error = np.hypot(model.unknown_rate, model.dead_band * within / np.sqrt(3.0))
    sigma = np.sqrt([model.density[0] ** 2 * duration + (rate_error * duration) ** 2])
    accel = [samples.accel] if feels else None
    slopes = model.parameters.slopes
    # What an accelerometer drifts by alone is nothing beside a gyro that does not.
    drifting = [name for name in ("gyro", *(["accel"] if feels else [])) if name in slopes and "gyro" in slopes]
    temperature_rise = None if samples.temperature_rise is None or not drifting else [samples.temperature_rise]
    drifts, banded = "accel" in drifting, model.parameters.dead_band is not None
    beyond = [samples.beyond] if banded else None
    rotation = GyroRotationFactor(
        t[-1:], [t], [samples.gyro], model.earth_rate, sigma, accel, temperature_rise, drifts, beyond
    )
    of_force = [SENSITIVITY_KEY, TRIAD_KEYS["accel"]] if feels else []
    gyro = TRIAD_KEYS["gyro"]
    slope = [*(SLOPE_KEYS[name] for name in drifting), *([DEAD_BAND_KEY] if banded else [])]
    ends = pose_key(k - 1), pose_key(k)
    measured = rotation.on(*ends, gyro, deviation_key(k - 1), deviation_key(k), *of_force, *slope)
    angle = float(np.sum(np.linalg.norm(samples.gyro[1:], axis=1) * np.diff(t)))
    return Factor.process_of("gyro turns", measured, angle / sigma)


# A gyro bias that does not walk still does so by this much, rad/s, for the sake of the arithmetic.
_STEADY = 1e-8


@dataclass(frozen=True)
class GaussMarkovDeviation:
    """Deviation of the gyro's offset from its mean over the session: a random walk that stays bounded.

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
    def over(cls, poses: StaticPoses, walk: float) -> GaussMarkovDeviation:
        """Build the deviation of an offset with a random walk in rad/s/sqrt(s) over static poses."""
        start, stop = poses.span.T
        middle = 0.5 * (start + stop)
        length = float(stop[-1] - start[0])
        stationary = max(walk * float(np.sqrt(length / 6.0)), _STEADY)
        correlation = np.append(0.0, np.exp(-np.diff(middle) / (length / 3.0)))
        edges = np.concatenate([start[:1], 0.5 * (middle[1:] + middle[:-1]), stop[-1:]])
        return cls(stationary * np.sqrt(1.0 - correlation**2), correlation, np.diff(edges) / length)

    def factors(self, k: int) -> list[Factor]:
        """Build the factors of the offset's walk to pose k and its running mean; for the last pose also a zero mean.

        The mean of the session is zero to `_STEADY`, in variance half by the steps of the sum and half by its end.
        """
        key, share, count = deviation_key(k), self.weights[k], len(self.weights)
        first, none = k == 0, np.zeros(3)
        before = {} if first else {deviation_key(k - 1): -self.correlation[k] * np.eye(3)}
        blocks = {key: np.eye(3), **before}
        walk = linear_factor(blocks, float(self.sigma[k]))
        summed = {} if first else {sum_key(k - 1): -np.eye(3)}
        blocks = {sum_key(k): np.eye(3), key: -share * np.eye(3), **summed}
        step = linear_factor(blocks, _STEADY / float(np.sqrt(2.0 * count)))
        found = [Factor.process_of("bias walk", walk), Factor.process_of("definition", step)]
        if k == count - 1:
            found.append(vector_about(sum_key(k), none, _STEADY / float(np.sqrt(2.0)), "definition"))
        return found
