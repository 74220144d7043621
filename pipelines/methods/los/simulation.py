"""Simulator of the `los` method: a camera on a gyro-driven two-axis gimbal, with exact rotations.

Frames as in docs/methods/los.md: b carrier, m gyro on it, c camera (x right, y along the line of sight, z up), n level
East-North-Up, i which does not turn and is n at t = 0. The carrier's attitude is a closed-form function of time. A gyro
sample is Log of the exact rotation over its interval, centred on its stamp, divided by the interval. The stabilisation
loop runs at the gyro's rate or, below `INTERNAL_RATE_HZ`, at its least multiple from there on, and what is recorded is
the mean of so many samples of the loop: it turns every sample, noise and bias included, into the two gimbal rates that
would hold the line of sight still if the gyro and the camera were mounted straight, and the gimbal turns at these rates
until the next sample. Gimbal angles are therefore known exactly at any time. Sensors may have errors: the loop holds on
to what its gyro reads, errors included.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import cos, sin
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from alidade.factors import so3
from alidade.factors.array import Array, Mask, interpolated
from alidade.factors.earth import earth_rate, gravity
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import Simulator
from alidade.pipelines.methods.los.parameters import NUISANCE
from alidade.pipelines.methods.los.recording import JOINTS, LosData
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.settings import SensorSheets
from alidade.pipelines.simulation.rendering import PinholeCamera, Quad, Renderer, encode, expose, tag_quad
from alidade.pipelines.simulation.scenario import EPOCH_NS, NotNegative, Positive, ScenarioPart, Share, Simulated
from alidade.pipelines.simulation.sensors import (
    EulerMotion,
    Swing,
    Warming,
    averaged_samples,
    by_axis,
    drift,
    exposures,
    means,
    measured,
    read_by,
    recording_config,
    sample_times,
    smooth_map,
    true_values,
)

# Gyro samples that are simulated at once.
_BLOCK = 100_000

Span = tuple[float, float]


class LosNoise(ScenarioPart):
    """Noise of the sensors, under the names the recording's config gives them."""

    gyro_density: NotNegative = 3e-5  # rad/s/sqrt(Hz)
    gyro_bias_walk: NotNegative = 2e-7  # rad/s/sqrt(s)
    accel_density: NotNegative = 1e-3  # m/s^2/sqrt(Hz)
    encoder: NotNegative = 5e-6  # rad
    los_error: NotNegative = 2e-5  # rad per axis
    los_roll: NotNegative = 2e-4  # rad


class LosAngles(ScenarioPart):
    """Mounting angles to be found by the method, deg."""

    delta_px: float = 0.5
    delta_pz: float = 0.25
    delta_gx: float = -0.5
    delta_gy: float = 0.5
    delta_gz: float = -0.25


class Loss(ScenarioPart):
    """Loss of the target over [start, end), s, after which the camera tracks another target."""

    start_s: float
    end_s: float
    azimuth_step_deg: float = 0.0  # how far the gimbal is turned towards the other target
    elevation_step_deg: float = 0.0


class LosCamera(PinholeCamera):
    """Settings of pictures of the target: pinhole camera with plumb_bob distortion, scene, image quality."""

    focal_px: Positive = 2000.0
    distortion: list[float] = [-0.2, 0.1, 5e-4, 3e-4, 0.0]
    target: Literal["tag", "texture"] = "tag"
    target_size: Positive = 0.1  # edge of the tag's black square per distance, or a quarter of the texture's width


class LosScenario(ScenarioPart):
    """Settings of the `los` simulator; every key has a default."""

    duration_s: Positive = 60.0
    carrier: EulerMotion = EulerMotion(
        pitch=[Swing(amplitude_deg=5, frequency_hz=0.17)],
        roll=[Swing(amplitude_deg=6, frequency_hz=0.21)],
        yaw=[Swing(amplitude_deg=6, frequency_hz=0.13)],
    )  # nRb: roll about x (right), pitch about y (ahead), yaw about z (up)
    azimuth_deg: float = 20.0  # where the gimbal points at the start
    elevation_deg: Annotated[float, Field(gt=-80.0, lt=80.0)] = 20.0
    angles_deg: LosAngles = LosAngles()
    noise: LosNoise = LosNoise()
    gyro_turn_on_bias: NotNegative = 1e-4  # rad/s, sigma per axis of the bias at the start
    encoder_step: NotNegative = 0.0  # rad, quantisation
    latitude_deg: float | None = None  # of a target on the turning earth; null: nothing turns
    measures_roll: bool = False
    gyro_rate_hz: Positive = 500.0
    gimbal_rate_hz: Positive = 200.0
    gimbal_phase: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0  # of the first stamp, in sample intervals
    image_rate_hz: Positive = 50.0
    image_phase: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.3
    acquisition_error: NotNegative = 1e-3  # rad, sigma per axis: how far off its axis the camera finds a target
    dropouts_s: list[Span] = []  # [start, end): pictures without the target
    losses: list[Loss] = []
    camera: LosCamera = LosCamera()
    outlier_share: Share = 0.0
    outlier_size: NotNegative = 5e-3  # rad, sigma per axis
    temperature: Warming | None = None  # of the IMU; null: nobody measures it
    # Data sheets that errors of the sensors are drawn from, passed on to the config; ideal: there are none; null: none
    # either, but the config does not know.
    sensors: SensorSheets | None = None
    effects: dict[str, float] = {}  # assumptions by name and their true values, whatever the data sheets
    los_map: NotNegative = 0.0  # rad, rms of each axis: what LOS errors depend on the gimbal angles by
    priors: dict[str, float | None] = {}  # passed on to the recording's config

    @model_validator(mode="after")
    def _spans_are_ordered(self) -> Self:
        if any(end <= start for start, end in self.gaps):
            raise ValueError("dropouts_s, losses: each gap starts before it ends")
        return self

    @property
    def gaps(self) -> list[Span]:
        """Intervals [start, end), s, without pictures of the target."""
        return [*self.dropouts_s, *((loss.start_s, loss.end_s) for loss in self.losses)]


@dataclass(frozen=True, eq=False)
class LosMotion:
    """True motion of a simulated los session, without sensor errors.

    Attributes:
        edges: (N + 1,) s, ends of the gyro's intervals.
        gimbal: (N + 1, 2) azimuth and elevation there, rad; linear in between.
        gyro_t, gyro: (N,), (N, 3) the gyro's samples, noise and bias included, rad/s.
        bias: (N, 3) of the gyro, rad/s.
        force: (N, 3) specific force at the gyro's samples, in m, m/s^2.
        effects: errors of the sensors by name.
    """

    edges: Array
    gimbal: Array
    gyro_t: Array
    gyro: Array
    bias: Array
    force: Array
    effects: Mapping[str, float]

    def gimbal_at(self, t: Array) -> Array:
        """Azimuth and elevation (n, 2), rad, at times (n,), s."""
        return interpolated(t, self.edges, self.gimbal)

    def covers(self, t: Array) -> Mask:
        """Mask of the times (n,) within the simulated motion."""
        return np.asarray((t >= self.edges[0]) & (t <= self.edges[-1]))


def simulate_los(scenario: LosScenario, seed: int, images: bool = False) -> Simulated:
    """Simulate a session in memory, with pictures if requested; the truth of a walking bias is its mean.

    Raises:
        InputError: its pictures cannot be drawn.
    """
    rng_of_sensors = np.random.default_rng([seed, 1])
    motion, rng = _drawn(scenario, seed, rng_of_sensors)
    averaged = averaged_samples(scenario.gyro_rate_hz)
    gyro_t, gyro, force = (means(each, averaged) for each in (motion.gyro_t, motion.gyro, motion.force))
    image_t, cRt = targets(scenario, motion, rng)
    noise = scenario.noise
    gimbal_t, gimbal = _encoders(scenario, motion, rng)
    exact = picture_of(cRt)
    exact[:, :2] *= 1.0 + motion.effects["los_scale"]
    if scenario.los_map:
        angles = motion.gimbal_at(image_t)
        exact[:, :2] += smooth_map(np.hstack([np.sin(angles), np.cos(angles)]), 2, scenario.los_map, seed)
    error = exact + rng.standard_normal(exact.shape) * [noise.los_error, noise.los_error, noise.los_roll]
    outlying = rng.random(len(error)) < scenario.outlier_share
    error[outlying, :2] += scenario.outlier_size * rng.standard_normal((int(outlying.sum()), 2))
    if not scenario.measures_roll:
        error[:, 2] = np.nan
    _shake(force, noise.accel_density * np.sqrt(scenario.gyro_rate_hz), rng_of_sensors)
    data = LosData(
        epoch_ns=EPOCH_NS,
        gyro_t=gyro_t,
        gyro=gyro,
        gimbal_t=gimbal_t,
        gimbal=gimbal,
        image_t=image_t,
        error=error,
        gyro_density=noise.gyro_density or None,
        force=force,
        temperature=measured(scenario.temperature, scenario.duration_s),
    )
    pictures = simulate_pictures(scenario, seed) if images else None
    return Simulated(data, _truth(scenario, motion), los_config(scenario, images), pictures)


def _drawn(
    scenario: LosScenario, seed: int, rng_of_sensors: np.random.Generator
) -> tuple[LosMotion, np.random.Generator]:
    """Simulate carrier and gimbal at the stabilisation loop's rate; also return the generator for the sensors' noise.

    What sensors with errors add is drawn apart: a seed gives the same noise whatever they do.
    """
    rng, rate_hz = np.random.default_rng(seed), averaged_samples(scenario.gyro_rate_hz) * scenario.gyro_rate_hz
    effects = true_values(NUISANCE, scenario, rng_of_sensors)
    return simulate_motion(scenario.model_copy(update={"gyro_rate_hz": rate_hz}), effects, rng), rng


def simulate_motion(scenario: LosScenario, effects: Mapping[str, float], rng: np.random.Generator) -> LosMotion:
    """Simulate the carrier's sway, the gyro samples, and the gimbal motion of the stabilisation loop.

    Errors of the sensors by name are all NUISANCE.
    """
    rate_hz = scenario.gyro_rate_hz
    gyro_t = sample_times(scenario.duration_s, rate_hz)
    edges = np.asarray((np.arange(len(gyro_t) + 1) - 0.5) / rate_hz)
    start = scenario.gyro_turn_on_bias * rng.standard_normal(3)
    bias = rng.standard_normal((len(gyro_t), 3))
    bias *= scenario.noise.gyro_bias_walk / np.sqrt(rate_hz)
    np.cumsum(bias, axis=0, out=bias)
    bias += start
    gyro, force = np.empty_like(bias), np.empty_like(bias)
    # The carrier turns about a point at rest.
    up = np.array([0.0, 0.0, float(gravity(np.deg2rad(scenario.latitude_deg or 0.0)))])
    for some in _blocks(len(gyro_t)):
        iRm = so3.multiply(carrier_attitude(scenario, edges[some.start : some.stop + 1]), _gyro_mount(scenario))
        exact = so3.local(iRm[:-1], iRm[1:]) * rate_hz
        force[some] = _in_gyro(scenario, gyro_t[some], up)
        read = read_by(exact, "gyro", effects, force[some])
        gyro[some] = read + bias[some] + drift(scenario.temperature, "gyro", effects, gyro_t[some])
    _shake(gyro, scenario.noise.gyro_density * np.sqrt(rate_hz), rng)
    gimbal = _stabilise(scenario, gyro_t, gyro)
    return LosMotion(edges, gimbal, gyro_t, gyro, bias, force, effects)


def _blocks(count: int) -> Iterator[slice]:
    """Yield slices of samples in blocks of bounded size, to bound memory."""
    return (slice(begin, min(begin + _BLOCK, count)) for begin in range(0, count, _BLOCK))


def _in_gyro(scenario: LosScenario, t: Array, vector: Array) -> Array:
    """Rotate a vector (3,) from n to m at times t (N,), s: (N, 3)."""
    nRm = so3.multiply(scenario.carrier.attitude(t), _gyro_mount(scenario))
    return so3.rotate(so3.inverse(nRm), vector)


def _shake(readings: Array, sigma: float, rng: np.random.Generator) -> None:
    """Add white noise to readings (N, 3)."""
    for some in _blocks(len(readings)):
        readings[some] += sigma * rng.standard_normal(readings[some].shape)


def _encoders(scenario: LosScenario, motion: LosMotion, rng: np.random.Generator) -> tuple[Array, Array]:
    """Stamps, s, and readings (n, 2), rad, of the encoders within the recording."""
    t = sample_times(scenario.duration_s, scenario.gimbal_rate_hz, scenario.gimbal_phase)
    at = t + motion.effects["encoder_delay"]
    t, at = t[motion.covers(at)], at[motion.covers(at)]
    angle = motion.gimbal_at(at)
    s, c = (np.array([motion.effects[f"encoder_{joint}_{part}"] for joint in JOINTS]) for part in ("sin", "cos"))
    read = angle + s * np.sin(angle) + c * np.cos(angle) + scenario.noise.encoder * rng.standard_normal((len(t), 2))
    if scenario.encoder_step > 0.0:
        read = np.round(read / scenario.encoder_step) * scenario.encoder_step
    return t, np.asarray(read)


def carrier_attitude(scenario: LosScenario, t: Array) -> Array:
    """Attitudes iRb (N, 4) of the carrier."""
    nRb = scenario.carrier.attitude(t)
    if scenario.latitude_deg is None:
        return nRb
    return so3.multiply(so3.exp(t[:, None] * earth_rate(np.deg2rad(scenario.latitude_deg))), nRb)


def camera_attitude(scenario: LosScenario, gimbal: Array, effects: Mapping[str, float]) -> Array:
    """Camera attitude bRc (N, 4) at true gimbal angles (N, 2), rad, with errors of gimbal and camera, rad."""
    px, pz = np.deg2rad([scenario.angles_deg.delta_px, scenario.angles_deg.delta_pz])
    # Each passive matrix of cRb is Exp(a e)^T, so the inverse has them the other way round and active.
    return so3.compose(
        _about(2, gimbal[:, 0] + pz),
        _about(1, effects["axis_nonperpendicularity"]),
        _about(0, gimbal[:, 1] + px),
        _about(2, effects["collimation"]),
        _about(1, effects["camera_roll"]),
    )


def simulate_pictures(scenario: LosScenario, seed: int) -> tuple[series.CameraInfo, series.ImageSeries]:
    """Render the pictures of `simulate_los` with the same seed, one by one."""
    motion, rng = _drawn(scenario, seed, np.random.default_rng([seed, 1]))
    stamps, cRt = targets(scenario, motion, rng)
    if scenario.losses:
        raise InputError("losses: pictures are simulated of a single target; leave out --images")
    t_ns = nanoseconds(stamps, EPOCH_NS)
    files = _exposures(scenario.camera, 1.0 + motion.effects["los_scale"], cRt, rng)
    return scenario.camera.info(int(t_ns[0])), series.ImageSeries(t_ns, files, frame_id="camera")


def _exposures(settings: LosCamera, magnified: float, cRt: Array, rng: np.random.Generator) -> Iterator[bytes]:
    """Pictures of a target at unit distance, as JPEG files, by a lens that magnifies by more than CameraInfo knows."""
    camera = settings.camera
    renderer = Renderer(replace(camera, K=camera.K * np.array([magnified, magnified, 1.0])))
    oRc = so3.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    tRq = oRc  # the target's face: x right, y up, z towards the camera
    texture = _texture(rng) if settings.target == "texture" else None
    for attitude in so3.multiply(oRc, cRt):
        position, oRq = so3.rotate(attitude, [0.0, 1.0, 0.0]), so3.multiply(attitude, tRq)
        if texture is None:
            quad = tag_quad(0, settings.target_size, oRq, position)
        else:
            quad = Quad(texture, (4.0 * settings.target_size, 3.0 * settings.target_size), oRq, position)
        yield encode(expose(renderer.radiance([quad]), settings.blur_px, settings.grey_noise, rng), "jpeg", 92)


def _texture(rng: np.random.Generator) -> Array:
    """Random grey levels (900, 1200) with detail at two scales."""
    import cv2

    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(900, 1200)), (0, 0), s) for s in (3.0, 20.0))
    return np.asarray(np.clip(120.0 + 35.0 * fine / fine.std() + 25.0 * coarse / coarse.std(), 0.0, 255.0))


def los_config(scenario: LosScenario, images: bool = False) -> str:
    """Config (YAML) of the recording: the simulated noise and the scenario's priors.

    LOS errors from pictures bring their own covariance.
    """
    noise = {name: value for name, value in scenario.noise.model_dump().items() if value > 0.0}
    if images:
        noise = {name: value for name, value in noise.items() if name not in ("los_error", "los_roll")}
    return recording_config("los", scenario, noise)


def _slew(scenario: LosScenario, t: Array) -> Array:
    """Gimbal rates (N, 2), rad/s, towards the next target while none is in sight."""
    out = np.zeros((len(t), 2))
    for loss in scenario.losses:
        during = (t >= loss.start_s) & (t < loss.end_s)
        step = np.deg2rad([loss.azimuth_step_deg, loss.elevation_step_deg])
        out[during] += step / (loss.end_s - loss.start_s)
    return out


def _stabilise(scenario: LosScenario, t: Array, gyro: Array) -> Array:
    """Gimbal angles (N + 1, 2), rad, under the commanded rates, computed for the angles at mid-interval."""
    dt = 1.0 / scenario.gyro_rate_hz
    angles = np.empty((len(t) + 1, 2))
    angles[0] = np.deg2rad([scenario.azimuth_deg, scenario.elevation_deg])
    azimuth, elevation = angles[0].tolist()
    for some in _blocks(len(t)):
        out = []
        for (wx, wy, wz), (slew_z, slew_x) in zip(gyro[some].tolist(), _slew(scenario, t[some]).tolist(), strict=True):
            middle, lift = azimuth, elevation
            for _ in range(2):
                rate_z, rate_x = _command(wx, wy, wz, middle, lift)
                middle, lift = azimuth + 0.5 * dt * rate_z, elevation + 0.5 * dt * rate_x
            rate_z, rate_x = _command(wx, wy, wz, middle, lift)
            azimuth, elevation = azimuth + dt * (rate_z + slew_z), elevation + dt * (rate_x + slew_x)
            out.append((azimuth, elevation))
        angles[some.start + 1 : some.stop + 1] = out
    return angles


def _command(wx: float, wy: float, wz: float, azimuth: float, elevation: float) -> tuple[float, float]:
    """Azimuth and elevation rate commands, rad/s, by CN102288133B."""
    s, c = sin(azimuth), cos(azimuth)
    se, ce = sin(elevation), cos(elevation)
    return (-se * s * wx + se * c * wy - ce * wz) / ce, -c * wx - s * wy


def targets(scenario: LosScenario, motion: LosMotion, rng: np.random.Generator) -> tuple[Array, Array]:
    """Stamps (K,), s, of pictures that show a target, and target attitudes cRt (K, 4): y towards it, z up."""
    stamps = sample_times(scenario.duration_s, scenario.image_rate_hz, scenario.image_phase)
    for start, end in scenario.gaps:
        stamps = stamps[(stamps < start) | (stamps >= end)]
    effects = motion.effects
    t = exposures(stamps, effects["time_offset"], effects["clock_skew"])
    # What would be taken beyond the recording's ends is left out.
    stamps, t = stamps[motion.covers(t)], t[motion.covers(t)]
    nRb = scenario.carrier.attitude(t)
    nRc = so3.multiply(nRb, camera_attitude(scenario, motion.gimbal_at(t), effects))
    turning = np.array([effects["target_rate_x"], 0.0, effects["target_rate_z"]])
    target = np.searchsorted(np.sort([loss.end_s for loss in scenario.losses]), stamps, side="right")
    cRt = np.empty((len(stamps), 4))
    for k in np.unique(target):
        mine = np.flatnonzero(target == k)
        off = np.array([*(scenario.acquisition_error * rng.standard_normal(2)), 0.0])[[0, 2, 1]]
        nRt = so3.multiply(nRc[mine[0]], so3.exp(off))
        moved = so3.exp((t[mine] - t[mine[0]])[:, None] * turning)
        cRt[mine] = so3.compose(so3.inverse(nRc[mine]), nRt, moved)
    return stamps, cRt


def picture_of(cRt: Array) -> Array:
    """LOS errors and roll phx, phz, roll (K, 3), rad, of a target at cRt with y away from the camera and z up.

    The roll is minus the turn of the similarity that best fits the pinhole picture of a small patch of the target.
    """
    R = so3.matrix(cRt)
    ahead = R[:, :, 1]
    x, z = ahead[:, 0] / ahead[:, 1], ahead[:, 2] / ahead[:, 1]
    # Steps in the picture for steps along the target's own x and z.
    right = R[:, [0, 2], 0] - np.stack([x, z], axis=1) * R[:, 1, [0]]
    up = R[:, [0, 2], 2] - np.stack([x, z], axis=1) * R[:, 1, [2]]
    roll = np.arctan2(right[:, 1] - up[:, 0], right[:, 0] + up[:, 1])
    return np.stack([-np.arctan2(ahead[:, 2], ahead[:, 1]), np.arctan2(ahead[:, 0], ahead[:, 1]), roll], axis=1)


def _gyro_mount(scenario: LosScenario) -> Array:
    """Gyro mounting bRm (4,), with w_m = Ry(gy) Rx(gx) Rz(gz) w_b."""
    angles = scenario.angles_deg
    gx, gy, gz = np.deg2rad([angles.delta_gx, angles.delta_gy, angles.delta_gz])
    return so3.compose(_about(2, gz), _about(0, gx), _about(1, gy))


def _about(axis: int, angle: Array | float) -> Array:
    """Rotation Exp(angle * e_axis), (..., 4)."""
    return so3.exp(np.asarray(angle, dtype=float)[..., None] * np.eye(3)[axis])


def _earth(scenario: LosScenario, t: Array) -> Array:
    """Mean earth rate (3,) in m, rad/s."""
    rate, total = earth_rate(np.deg2rad(scenario.latitude_deg or 0.0)), np.zeros(3)
    for some in _blocks(len(t)):
        total += _in_gyro(scenario, t[some], rate).sum(axis=0)
    return total / len(t)


def _truth(scenario: LosScenario, motion: LosMotion) -> dict[str, float]:
    truth = {name: float(np.deg2rad(value)) for name, value in scenario.angles_deg.model_dump().items()}
    truth["delta_z"] = truth["delta_pz"] - truth["delta_gz"]
    bias = motion.bias.mean(axis=0)
    if scenario.latitude_deg is not None:
        # To a target on the earth the earth rate looks like a bias.
        bias = bias + _earth(scenario, motion.gyro_t)
    return {**truth, **by_axis(gyro_bias=bias), **motion.effects}


SIMULATOR = Simulator(scenario=LosScenario, simulate=simulate_los, default_with_images="los_images", has_camera=True)
