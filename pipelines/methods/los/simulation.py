"""Simulator of the `los` method: a camera on a gyro-driven two-axis gimbal, with exact rotations.

Frames as in methods.md section 1: b carrier, m gyro on it, c camera (x right, y along the line of sight, z up), n level
East-North-Up, i which does not turn and is n at t = 0. The carrier's attitude is a closed-form function of time. A gyro
sample is Log of the exact rotation over its interval, centred on its stamp, divided by the interval. The stabilisation
loop runs at the gyro's rate: it turns every sample, noise and bias included, into the two gimbal rates that would hold
the line of sight still if the gyro and the camera were mounted straight, and the gimbal turns at these rates until the
next sample. Gimbal angles are therefore known exactly at any time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import StringIO
from math import cos, sin
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from factors import so3
from factors.earth import earth_rate
from pipelines.errors import InputError
from pipelines.methods.los.recording import LosData
from pipelines.recording import series
from pipelines.recording.checks import nanoseconds
from pipelines.simulation.motion import EulerMotion, Swing, sample_times
from pipelines.simulation.simulated import Simulated

Array = NDArray[np.float64]

# 2026-11-20 12:00 UTC: simulated sessions start here.
EPOCH_NS = 1_795_176_000_000_000_000

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Span = tuple[float, float]


class LosNoise(BaseModel):
    """Noise of the sensors, under the names the recording's config gives them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    gyro_density: NotNegative = 3e-5  # rad/s/sqrt(Hz)
    gyro_bias_walk: NotNegative = 2e-7  # rad/s/sqrt(s)
    encoder: NotNegative = 5e-6  # rad
    los_error: NotNegative = 2e-5  # rad per axis
    los_roll: NotNegative = 2e-4  # rad


class LosAngles(BaseModel):
    """Mounting angles, deg: what the method is to find."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    delta_px: float = 0.5
    delta_pz: float = 0.25
    delta_gx: float = -0.5
    delta_gy: float = 0.5
    delta_gz: float = -0.25
    camera_roll: float = 0.0
    collimation: float = 0.0
    axis_nonperpendicularity: float = 0.0


class Loss(BaseModel):
    """A target lost over [start, end), after which the camera holds on to another one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_s: float
    end_s: float
    azimuth_step_deg: float = 0.0  # how far the gimbal is turned towards the other target
    elevation_step_deg: float = 0.0


class LosCamera(BaseModel):
    """Pictures of the target: a pinhole camera with plumb_bob distortion, what it looks at, and how well."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: Annotated[int, Field(gt=0)] = 640
    height: Annotated[int, Field(gt=0)] = 480
    focal_px: Positive = 2000.0
    distortion: list[float] = [-0.2, 0.1, 5e-4, 3e-4, 0.0]
    target: Literal["tag", "texture"] = "tag"
    target_size: Positive = 0.1  # edge of the tag's black square per distance, or a quarter of the texture's width
    blur_px: NotNegative = 0.7
    grey_noise: NotNegative = 2.0


class LosScenario(BaseModel):
    """What the `los` simulator is asked for; every key has a default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
    time_offset_s: float = 0.0  # positive: the picture was taken later than its stamp says
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
    priors: dict[str, float | None] = {}  # passed on to the recording's config

    @model_validator(mode="after")
    def _spans_are_ordered(self) -> Self:
        if any(end <= start for start, end in self.gaps):
            raise ValueError("dropouts_s, losses: each gap starts before it ends")
        return self

    @property
    def gaps(self) -> list[Span]:
        """[start, end) of all stretches without pictures of the target, s."""
        return [*self.dropouts_s, *((loss.start_s, loss.end_s) for loss in self.losses)]


@dataclass(frozen=True, eq=False)
class LosMotion:
    """What happened, before anything but the gyro measured it.

    Attributes:
        edges: (N + 1,) s, ends of the gyro's intervals.
        gimbal: (N + 1, 2) azimuth and elevation there, rad; linear in between.
        gyro_t, gyro: (N,), (N, 3) the gyro's samples, noise and bias included, rad/s.
        bias: (N, 3) of the gyro, rad/s.
    """

    edges: Array
    gimbal: Array
    gyro_t: Array
    gyro: Array
    bias: Array

    def gimbal_at(self, t: Array) -> Array:
        """Azimuth and elevation (n, 2), rad."""
        return np.stack([np.interp(t, self.edges, self.gimbal[:, k]) for k in range(2)], axis=1)


def simulate_los(scenario: LosScenario, seed: int) -> tuple[LosData, dict[str, float]]:
    """A session and the true values of its parameters (rad, rad/s, s; the bias is its mean over the session)."""
    rng = np.random.default_rng(seed)
    motion = simulate_motion(scenario, rng)
    image_t, cRt = targets(scenario, motion, rng)
    noise = scenario.noise
    gimbal_t = sample_times(scenario.duration_s, scenario.gimbal_rate_hz, scenario.gimbal_phase)
    gimbal = motion.gimbal_at(gimbal_t) + noise.encoder * rng.standard_normal((len(gimbal_t), 2))
    if scenario.encoder_step > 0.0:
        gimbal = np.round(gimbal / scenario.encoder_step) * scenario.encoder_step
    exact = picture_of(cRt)
    error = exact + rng.standard_normal(exact.shape) * [noise.los_error, noise.los_error, noise.los_roll]
    outlying = rng.random(len(error)) < scenario.outlier_share
    error[outlying, :2] += scenario.outlier_size * rng.standard_normal((int(outlying.sum()), 2))
    if not scenario.measures_roll:
        error[:, 2] = np.nan
    data = LosData(
        epoch_ns=EPOCH_NS,
        gyro_t=motion.gyro_t,
        gyro=motion.gyro,
        gimbal_t=gimbal_t,
        gimbal=gimbal,
        image_t=image_t,
        error=error,
        gyro_density=noise.gyro_density or None,
    )
    return data, _truth(scenario, motion)


def simulate_motion(scenario: LosScenario, rng: np.random.Generator) -> LosMotion:
    """The carrier's sway as the gyro sees it, and what the stabilisation loop makes of that."""
    rate_hz = scenario.gyro_rate_hz
    gyro_t = sample_times(scenario.duration_s, rate_hz)
    edges = np.asarray((np.arange(len(gyro_t) + 1) - 0.5) / rate_hz)
    iRm = so3.multiply(carrier_attitude(scenario, edges), _gyro_mount(scenario))
    exact = so3.log(so3.multiply(so3.inverse(iRm[:-1]), iRm[1:])) * rate_hz
    start = scenario.gyro_turn_on_bias * rng.standard_normal(3)
    steps = scenario.noise.gyro_bias_walk / np.sqrt(rate_hz) * rng.standard_normal(exact.shape)
    bias = np.asarray(start + np.cumsum(steps, axis=0))
    gyro = exact + bias + scenario.noise.gyro_density * np.sqrt(rate_hz) * rng.standard_normal(exact.shape)
    first = np.deg2rad(scenario.azimuth_deg), np.deg2rad(scenario.elevation_deg)
    return LosMotion(edges, _stabilise(gyro, _slew(scenario, gyro_t), 1.0 / rate_hz, *first), gyro_t, gyro, bias)


def carrier_attitude(scenario: LosScenario, t: Array) -> Array:
    """iRb, shape (N, 4)."""
    nRb = scenario.carrier.attitude(t)
    if scenario.latitude_deg is None:
        return nRb
    return so3.multiply(so3.exp(t[:, None] * earth_rate(np.deg2rad(scenario.latitude_deg))), nRb)


def camera_attitude(scenario: LosScenario, gimbal: Array) -> Array:
    """bRc, shape (N, 4), at true gimbal angles (N, 2)."""
    angles = np.deg2rad(list(scenario.angles_deg.model_dump().values()))
    named = dict(zip(scenario.angles_deg.model_dump(), angles.tolist(), strict=True))
    # Each passive matrix of cRb is Exp(a e)^T, so the inverse has them the other way round and active.
    return so3.compose(
        _about(2, gimbal[:, 0] + named["delta_pz"]),
        _about(1, named["axis_nonperpendicularity"]),
        _about(0, gimbal[:, 1] + named["delta_px"]),
        _about(2, named["collimation"]),
        _about(1, named["camera_roll"]),
    )


def simulated(scenario: LosScenario, seed: int, images: bool = False) -> Simulated:
    """A session in memory, with pictures if asked for.

    Raises:
        InputError: its pictures cannot be drawn.
    """
    data, truth = simulate_los(scenario, seed)
    pictures = simulate_pictures(scenario, seed) if images else None
    return Simulated(data, truth, los_config(scenario, images), pictures)


def simulate_pictures(scenario: LosScenario, seed: int) -> tuple[series.CameraInfo, series.ImageSeries]:
    """The pictures behind the LOS errors of `simulate_los` with the same seed; drawn one by one as they are taken."""
    rng = np.random.default_rng(seed)
    stamps, cRt = targets(scenario, simulate_motion(scenario, rng), rng)
    if scenario.losses:
        raise InputError("losses: pictures are simulated of a single target; leave out --images")
    camera = scenario.camera
    centre = 0.5 * camera.width - 0.5 + 3.4, 0.5 * camera.height - 0.5 - 2.7
    K = np.array([[camera.focal_px, 0.0, centre[0]], [0.0, camera.focal_px, centre[1]], [0.0, 0.0, 1.0]])
    t_ns = nanoseconds(stamps, EPOCH_NS)
    info = series.CameraInfo(
        int(t_ns[0]),
        camera.width,
        camera.height,
        "plumb_bob",
        np.array(camera.distortion),
        K,
        np.eye(3),
        np.hstack([K, np.zeros((3, 1))]),
        "camera",
    )
    return info, series.ImageSeries(t_ns, _exposures(camera, K, cRt, rng), "jpeg", "camera")


def _exposures(settings: LosCamera, K: Array, cRt: Array, rng: np.random.Generator) -> Iterator[bytes]:
    """Pictures of a target at unit distance, as JPEG files."""
    from pipelines.simulation.rendering import Quad, Renderer, encode, expose, tag_quad
    from pipelines.vision.camera import Camera

    camera = Camera(settings.width, settings.height, K, "plumb_bob", np.array(settings.distortion))
    renderer = Renderer(camera)
    oRc = so3.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    # The target's face: x right, y up, z towards the camera.
    tRq = so3.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    texture = _texture(rng) if settings.target == "texture" else None
    for attitude in so3.multiply(oRc, cRt):
        position, oRq = so3.rotate(attitude, [0.0, 1.0, 0.0]), so3.multiply(attitude, tRq)
        if texture is None:
            quad = tag_quad(0, settings.target_size, oRq, position)
        else:
            quad = Quad(texture, (4.0 * settings.target_size, 3.0 * settings.target_size), oRq, position)
        yield encode(expose(renderer.radiance([quad]), settings.blur_px, settings.grey_noise, rng), "jpeg", 92)


def _texture(rng: np.random.Generator) -> Array:
    """Grey levels (900, 1200) with detail at two scales."""
    import cv2

    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(900, 1200)), (0, 0), s) for s in (3.0, 20.0))
    return np.asarray(np.clip(120.0 + 35.0 * fine / fine.std() + 25.0 * coarse / coarse.std(), 0.0, 255.0))


def los_config(scenario: LosScenario, images: bool = False) -> str:
    """The recording's config (YAML): the noise that was simulated and the scenario's priors.

    LOS errors from pictures bring their own covariance.
    """
    from ruamel.yaml import YAML

    noise = {name: value for name, value in scenario.noise.model_dump().items() if value > 0.0}
    if images:
        noise = {name: value for name, value in noise.items() if name not in ("los_error", "los_roll")}
    config = {"method": "los", "noise": noise, "priors": scenario.priors}
    text = StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.dump(config, text)
    return text.getvalue()


def _slew(scenario: LosScenario, t: Array) -> Array:
    """Rates (N, 2), rad/s, at which the gimbal is turned towards other targets while none is in sight."""
    out = np.zeros((len(t), 2))
    for loss in scenario.losses:
        during = (t >= loss.start_s) & (t < loss.end_s)
        step = np.deg2rad([loss.azimuth_step_deg, loss.elevation_step_deg])
        out[during] += step / (loss.end_s - loss.start_s)
    return out


def _stabilise(gyro: Array, slew: Array, dt: float, azimuth: float, elevation: float) -> Array:
    """Gimbal angles (N + 1, 2) under the commanded rates, the command taken for the angles at mid-interval."""
    out = [(azimuth, elevation)]
    for (wx, wy, wz), (slew_z, slew_x) in zip(gyro.tolist(), slew.tolist(), strict=True):
        middle, lift = azimuth, elevation
        for _ in range(2):
            rate_z, rate_x = _command(wx, wy, wz, middle, lift)
            middle, lift = azimuth + 0.5 * dt * rate_z, elevation + 0.5 * dt * rate_x
        rate_z, rate_x = _command(wx, wy, wz, middle, lift)
        azimuth, elevation = azimuth + dt * (rate_z + slew_z), elevation + dt * (rate_x + slew_x)
        out.append((azimuth, elevation))
    return np.array(out)


def _command(wx: float, wy: float, wz: float, azimuth: float, elevation: float) -> tuple[float, float]:
    """Azimuth and elevation rates of CN102288133B."""
    s, c = sin(azimuth), cos(azimuth)
    se, ce = sin(elevation), cos(elevation)
    return (-se * s * wx + se * c * wy - ce * wz) / ce, -c * wx - s * wy


def targets(scenario: LosScenario, motion: LosMotion, rng: np.random.Generator) -> tuple[Array, Array]:
    """Stamps (K,) of the pictures that show a target, and its attitudes cRt (K, 4): y towards it, z its up."""
    stamps = sample_times(scenario.duration_s, scenario.image_rate_hz, scenario.image_phase)
    seen = np.ones(len(stamps), dtype=bool)
    for start, end in scenario.gaps:
        seen &= (stamps < start) | (stamps >= end)
    stamps = stamps[seen]
    t = stamps + scenario.time_offset_s
    nRb = scenario.carrier.attitude(t)
    nRc = so3.multiply(nRb, camera_attitude(scenario, motion.gimbal_at(t)))
    target = np.searchsorted(np.sort([loss.end_s for loss in scenario.losses]), stamps, side="right")
    cRt = np.empty((len(stamps), 4))
    for k in np.unique(target):
        mine = np.flatnonzero(target == k)
        off = np.array([*(scenario.acquisition_error * rng.standard_normal(2)), 0.0])[[0, 2, 1]]
        nRt = so3.multiply(nRc[mine[0]], so3.exp(off))
        cRt[mine] = so3.multiply(so3.inverse(nRc[mine]), nRt)
    return stamps, cRt


def picture_of(cRt: Array) -> Array:
    """phx, phz and roll (K, 3), rad, of a target whose y axis points away from the camera and whose z is its up.

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
    """bRm: w_m = Ry(gy) Rx(gx) Rz(gz) w_b."""
    angles = scenario.angles_deg
    gx, gy, gz = np.deg2rad([angles.delta_gx, angles.delta_gy, angles.delta_gz])
    return so3.compose(_about(2, gz), _about(0, gx), _about(1, gy))


def _about(axis: int, angle: Array | float) -> Array:
    """Exp(angle * e_axis)."""
    return so3.exp(np.asarray(angle, dtype=float)[..., None] * np.eye(3)[axis])


def _truth(scenario: LosScenario, motion: LosMotion) -> dict[str, float]:
    truth = {name: float(np.deg2rad(value)) for name, value in scenario.angles_deg.model_dump().items()}
    truth["delta_z"] = truth["delta_pz"] - truth["delta_gz"]
    bias = motion.bias.mean(axis=0)
    if scenario.latitude_deg is not None:
        # To a target on the earth the earth rate looks like a bias.
        nRm = so3.multiply(scenario.carrier.attitude(motion.gyro_t), _gyro_mount(scenario))
        bias = bias + so3.rotate(so3.inverse(nRm), earth_rate(np.deg2rad(scenario.latitude_deg))).mean(axis=0)
    truth |= {f"gyro_bias_{axis}": float(b) for axis, b in zip("xyz", bias, strict=True)}
    return truth | {"time_offset": scenario.time_offset_s}
