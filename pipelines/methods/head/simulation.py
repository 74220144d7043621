"""Simulator of the `head` method: helmet IMU, platform IMU and vision, with exact rotations.

Frames: v helmet IMU, b platform, c camera on the platform, h marker on the helmet, n level East-North-Up, and i, which
does not turn and is n at t = 0. All attitudes are closed-form functions of time. A gyro sample is Log of the exact
rotation over its interval, centred on its stamp, divided by the interval: the product of Exp(sample * interval) is the
true attitude at the end of every interval, with no integration error.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate, gravity
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import Simulator
from alidade.pipelines.methods.head.parameters import NUISANCE
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.settings import Board, SensorSheets, Tag
from alidade.pipelines.simulation.rendering import PinholeCamera, Renderer, encode, expose, tag_quad
from alidade.pipelines.simulation.scenario import EPOCH_NS, NotNegative, Positive, ScenarioPart, Simulated
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

Fraction = Annotated[float, Field(ge=0.0, lt=1.0)]
Vector = tuple[float, float, float]

# The head's sway goes round in no common period, Hz.
_SWAY_HZ = (0.31, 0.23, 0.17)


def _board(*tags: tuple[float, float, float, float]) -> Board:
    """Tags of 45 mm at (x, y), m, leaning back by angles about x and y, deg.

    They face -z of the board: its axes are the camera's when it faces the camera upright, so that mounts are small.
    """
    facing = so3.exp([np.pi, 0.0, 0.0])
    out = {}
    for i, (x, y, about_x, about_y) in enumerate(tags):
        w, *v = so3.multiply(so3.exp(np.deg2rad([about_x, about_y, 0.0])), facing).tolist()
        out[i] = Tag(size=0.045, rotation=(w, v[0], v[1], v[2]), position=(x, y, 0.0))
    return Board(tags=out)


class HeadPictures(PinholeCamera):
    """Settings of camera, pictures and tag board: a pinhole camera with plumb_bob distortion."""

    focal_px: Positive = 620.0
    distortion: list[float] = [-0.22, 0.09, 8e-4, -5e-4, 0.0]  # k1 k2 p1 p2 k3
    format: Literal["png", "jpeg"] = "jpeg"
    board: Board = _board(
        (-0.032, -0.032, 12, -12), (0.032, -0.032, 12, 12), (-0.032, 0.032, 0, 0), (0.032, 0.032, 0, 0)
    )
    position_m: Vector = (0.0, 0.0, 0.34)  # of the board's origin in the camera's frame, on average
    sway_m: Vector = (0.015, 0.01, 0.02)  # amplitude about that


class HeadNoise(ScenarioPart):
    """Noise of the sensors, under the names the recording's config gives them."""

    gyro_density: NotNegative = 1e-4  # rad/s/sqrt(Hz)
    gyro_bias_walk: NotNegative = 1e-6  # rad/s/sqrt(s)
    platform_gyro_density: NotNegative = 1e-5  # rad/s/sqrt(Hz)
    accel_density: NotNegative = 2e-3  # m/s^2/sqrt(Hz), of the helmet
    vision_attitude: NotNegative = 8.7e-3  # rad per axis of frame h
    vision_rate_noise: NotNegative = 0.0  # s: rad per axis at 1 rad/s relative to the camera


class HeadScenario(ScenarioPart):
    """Settings of the `head` simulator; every key has a default."""

    duration_s: Positive = 60.0
    head: EulerMotion = EulerMotion(
        yaw=[Swing(amplitude_deg=40, frequency_hz=0.13), Swing(amplitude_deg=10, frequency_hz=0.47)],
        pitch=[Swing(amplitude_deg=20, frequency_hz=0.19), Swing(amplitude_deg=8, frequency_hz=0.53)],
        roll=[Swing(amplitude_deg=15, frequency_hz=0.23), Swing(amplitude_deg=6, frequency_hz=0.61)],
    )  # bRv
    platform: EulerMotion | None = None  # nRb; null: at rest, and no platform topic
    latitude_deg: float | None = 40.0  # of the earth's turning; null: the earth stands still
    noise: HeadNoise = HeadNoise()
    gyro_turn_on_bias_deg_s: NotNegative = 0.3  # sigma per axis of the bias at the start
    helmet_mount_deg: Vector = (0.0, 0.0, 0.0)  # rotation vector of vRh
    camera_mount_deg: Vector = (0.0, 0.0, 0.0)  # rotation vector of cRb
    time_offset_s: float = 0.0  # positive: the picture was taken later than its stamp says
    gyro_rate_hz: Positive = 400.0
    gyro_phase: Fraction = 0.0  # of the first stamp, in sample intervals; likewise below
    platform_gyro_rate_hz: Positive = 200.0
    platform_gyro_phase: Fraction = 0.3
    vision_rate_hz: Positive = 30.0
    vision_phase: Fraction = 0.6
    truth_rate_hz: Positive = 100.0
    vision_outages_s: list[tuple[float, float]] = []  # [start, end) of each gap
    outlier_fraction: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    outlier_deg: NotNegative = 20.0  # an outlier is turned this far about a random axis
    temperature: Warming | None = None  # of the helmet's IMU; null: nobody measures it
    pictures: HeadPictures = HeadPictures()  # when pictures are asked for: they take the place of vision's attitudes
    # Data sheets that errors of the sensors are drawn from, passed on to the config; ideal: there are none; null: none
    # either, but the config does not know.
    sensors: SensorSheets | None = None
    effects: dict[str, float] = {}  # assumptions by name and their true values, whatever the data sheets
    vision_map: NotNegative = 0.0  # rad, rms about each axis: what vision's error depends on the attitude by
    priors: dict[str, float | None] = {}  # passed on to the recording's config

    @model_validator(mode="after")
    def _outages_are_ordered(self) -> Self:
        if any(end <= start for start, end in self.vision_outages_s):
            raise ValueError("vision_outages_s: each gap is [start, end] with start before end")
        return self


def simulate_head(scenario: HeadScenario, seed: int, images: bool = False) -> Simulated:
    """Simulate a session in memory, with pictures if requested; the truth of a walking bias is its mean.

    Raises:
        InputError: its pictures cannot be drawn.
    """
    # What sensors with errors add is drawn apart: a seed gives the same noise whatever they do.
    rng, rng_of_sensors = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    noise = scenario.noise
    effects = true_values(NUISANCE, scenario, rng_of_sensors)
    head_t, head_rate = _gyro(scenario, scenario.gyro_rate_hz, scenario.gyro_phase, helmet=True)
    force = _specific_force(scenario, head_t)
    bias = np.deg2rad(scenario.gyro_turn_on_bias_deg_s) * rng.standard_normal(3)
    walk = noise.gyro_bias_walk / np.sqrt(scenario.gyro_rate_hz) * rng.standard_normal((len(head_t), 3))
    bias = np.asarray(bias + np.cumsum(walk, axis=0))
    head_gyro = read_by(head_rate, "gyro", effects, force) + bias
    head_gyro += drift(scenario.temperature, "gyro", effects, head_t)
    head_gyro = head_gyro + _white(noise.gyro_density, scenario.gyro_rate_hz, len(head_t), rng)
    platform_t = platform_gyro = None
    if scenario.platform is not None:
        rate_hz = scenario.platform_gyro_rate_hz
        platform_t, platform_gyro = _gyro(scenario, rate_hz, scenario.platform_gyro_phase, helmet=False)
        platform_gyro = read_by(platform_gyro, "platform", effects)
        platform_gyro += [effects[f"platform_bias_{axis}"] for axis in "xyz"]
        platform_gyro = platform_gyro + _white(noise.platform_gyro_density, rate_hz, len(platform_t), rng)
    vision_t, vision_wxyz = _vision(scenario, effects, rng, seed)
    truth_t = sample_times(scenario.duration_s, scenario.truth_rate_hz)
    variance = noise.vision_attitude**2
    data = HeadData(
        epoch_ns=EPOCH_NS,
        head_t=head_t,
        head_gyro=head_gyro,
        platform_t=platform_t,
        platform_gyro=platform_gyro,
        vision_t=vision_t,
        vision_wxyz=vision_wxyz,
        vision_cov=np.tile(variance * np.eye(3), (len(vision_t), 1, 1)) if variance > 0.0 else None,
        truth_t=truth_t,
        truth_wxyz=scenario.head.attitude(truth_t),
        dropped={},
        gyro_density=noise.gyro_density or None,
        platform_gyro_density=(noise.platform_gyro_density or None) if scenario.platform else None,
        head_force=force + _white(noise.accel_density, scenario.gyro_rate_hz, len(head_t), rng_of_sensors),
        temperature=measured(scenario.temperature, scenario.duration_s),
    )
    pictures = simulate_pictures(scenario, seed) if images else None
    return Simulated(data, {**_truth(scenario, bias), **effects}, head_config(scenario, images), pictures)


def simulate_pictures(scenario: HeadScenario, seed: int) -> tuple[series.CameraInfo, series.ImageSeries]:
    """Render the pictures behind the attitudes of `simulate_head` with the same seed, one by one.

    Raises:
        InputError: the scenario has outliers, which are made of attitudes, or impossible distortion.
    """
    if scenario.outlier_fraction > 0.0:
        raise InputError("outlier_fraction: pictures are simulated without outliers; leave out --images")
    effects = true_values(NUISANCE, scenario, np.random.default_rng([seed, 1]))
    t, at, cRh = _sights(scenario, effects)
    settings, t_ns = scenario.pictures, nanoseconds(t, EPOCH_NS)
    position = np.array(settings.position_m) + np.array(settings.sway_m) * np.sin(2.0 * np.pi * at[:, None] * _SWAY_HZ)
    files = _exposures(settings, cRh, position, np.random.default_rng(seed))
    return settings.info(int(t_ns[0])), series.ImageSeries(t_ns, files, settings.format, frame_id="camera")


def _exposures(settings: HeadPictures, cRh: Array, position: Array, rng: np.random.Generator) -> Iterator[bytes]:
    """Yield the pictures' files."""
    renderer = Renderer(settings.camera)
    for attitude, origin in zip(cRh, position, strict=True):
        quads = [
            tag_quad(i, tag.size, so3.multiply(attitude, tag.rotation), origin + so3.rotate(attitude, tag.position))
            for i, tag in settings.board.tags.items()
        ]
        picture = expose(renderer.radiance(quads), settings.blur_px, settings.grey_noise, rng)
        yield encode(picture, settings.format, 92)


def head_config(scenario: HeadScenario, images: bool = False) -> str:
    """Config (YAML) of the recording: simulated noise, the scenario's priors and, with pictures, the tag board.

    Attitudes from pictures bring their own covariance.
    """
    noise = scenario.noise.model_dump()
    if scenario.platform is None:
        del noise["platform_gyro_density"]
    if images or not scenario.noise.vision_rate_noise:
        del noise["vision_rate_noise"]
    if not images:
        return recording_config("head", scenario, noise)
    del noise["vision_attitude"]
    return recording_config("head", scenario, noise, head={"board": scenario.pictures.board.model_dump()})


def _platform_attitude(scenario: HeadScenario, t: Array) -> Array:
    """Attitudes iRb (N, 4) of the platform."""
    if scenario.latitude_deg is None:
        iRn = so3.identity(len(t))
    else:
        iRn = so3.exp(t[:, None] * earth_rate(np.deg2rad(scenario.latitude_deg)))
    return iRn if scenario.platform is None else so3.multiply(iRn, scenario.platform.attitude(t))


def _gyro(scenario: HeadScenario, rate_hz: float, phase: float, helmet: bool) -> tuple[Array, Array]:
    """Stamps, s, and error-free mean rates, rad/s, of the helmet's gyro (in v) or the platform's (in b)."""
    t = sample_times(scenario.duration_s, rate_hz, phase)
    parts = averaged_samples(rate_hz)
    edges: Array = (np.arange(len(t) * parts + 1) / parts + (phase - 0.5)) / rate_hz
    attitude = _platform_attitude(scenario, edges)
    if helmet:
        attitude = so3.multiply(attitude, scenario.head.attitude(edges))
    return t, means(so3.local(attitude[:-1], attitude[1:]) * (parts * rate_hz), parts)


def _specific_force(scenario: HeadScenario, t: Array) -> Array:
    """Specific force of the helmet in v without noise, (N, 3) m/s^2, rotating about a point at rest."""
    nRv = scenario.head.attitude(t)
    if scenario.platform is not None:
        nRv = so3.multiply(scenario.platform.attitude(t), nRv)
    latitude = np.deg2rad(scenario.latitude_deg or 0.0)
    return so3.rotate(so3.inverse(nRv), np.array([0.0, 0.0, float(gravity(latitude))]))


def _white(density: float, rate_hz: float, n: int, rng: np.random.Generator) -> Array:
    return density * np.sqrt(rate_hz) * rng.standard_normal((n, 3))


def _sights(scenario: HeadScenario, effects: Mapping[str, float]) -> tuple[Array, Array, Array]:
    """Stamps and true times of vision, s, and attitudes cRh (K, 4) without noise."""
    t = sample_times(scenario.duration_s, scenario.vision_rate_hz, scenario.vision_phase)
    for start, end in scenario.vision_outages_s:
        t = t[(t < start) | (t >= end)]
    cRb, vRh = so3.exp(np.deg2rad([scenario.camera_mount_deg, scenario.helmet_mount_deg]))
    at = exposures(t, scenario.time_offset_s, effects["clock_skew"])
    filtered = so3.exp(effects["vision_filter"] * _acceleration(scenario, at))
    cRh = so3.compose(cRb, scenario.head.attitude(at), filtered, vRh)
    turned = so3.local(cRh[0], cRh)
    return t, at, so3.multiply(cRh[0], so3.exp((1.0 + effects["vision_scale"]) * turned))


def _rate(scenario: HeadScenario, at: Array, h: float = 1e-3) -> Array:
    """Angular rate of the helmet on its platform, (K, 3) rad/s in v, by differences over 2 h s."""
    return so3.local(scenario.head.attitude(at - h), scenario.head.attitude(at + h)) / (2.0 * h)


def _acceleration(scenario: HeadScenario, at: Array, h: float = 2e-3) -> Array:
    """Angular acceleration of the helmet on its platform, (K, 3) rad/s^2 in v, by differences over h s."""
    before, now, after = (scenario.head.attitude(at + late) for late in (-h, 0.0, h))
    ahead, behind = (so3.local(now, other) for other in (after, before))
    return np.asarray((ahead + behind) / h**2)


def _vision(
    scenario: HeadScenario, effects: Mapping[str, float], rng: np.random.Generator, seed: int
) -> tuple[Array, Array]:
    """Stamps, s, and measured attitudes cRh (K, 4)."""
    t, at, cRh = _sights(scenario, effects)
    if scenario.vision_map:
        seen = so3.matrix(cRh).reshape(-1, 9)
        cRh = so3.multiply(cRh, so3.exp(smooth_map(seen, 3, scenario.vision_map, seed)))
    n, noise = len(t), scenario.noise
    sigma = np.hypot(noise.vision_attitude, noise.vision_rate_noise * np.linalg.norm(_rate(scenario, at), axis=1))
    error = so3.exp(sigma[:, None] * rng.standard_normal((n, 3)))
    axis = rng.standard_normal((n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    is_outlier = rng.random(n) < scenario.outlier_fraction
    jump = so3.exp(axis * (np.deg2rad(scenario.outlier_deg) * is_outlier)[:, None])
    return t, so3.compose(cRh, error, jump)


def _truth(scenario: HeadScenario, bias: Array) -> dict[str, float]:
    mounts = {f"{name}_mount": np.deg2rad(getattr(scenario, f"{name}_mount_deg")) for name in ("helmet", "camera")}
    return by_axis(gyro_bias=bias.mean(axis=0), **mounts) | {"time_offset": scenario.time_offset_s}


SIMULATOR = Simulator(
    scenario=HeadScenario, simulate=simulate_head, default_with_images="head_pictures", has_camera=True
)
