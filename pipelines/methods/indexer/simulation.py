"""Simulator of the `indexer` method: an IMU turned by two axes on the earth, with exact rotations.

Frames as in docs/methods/indexer.md: n level East-North-Up, base the indexer's fixed part, t its platform, m the IMU.
All angles are closed-form functions of time. A gyro sample is Log of the exact rotation against inertial space over its
interval, centred on its stamp, divided by the interval.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate
from alidade.pipelines.methods import Simulator
from alidade.pipelines.methods.indexer.parameters import NUISANCE
from alidade.pipelines.methods.indexer.recording import JOINTS, IndexerData
from alidade.pipelines.settings import SensorSheets
from alidade.pipelines.simulation.scenario import EPOCH_NS, NotNegative, Positive, ScenarioPart, Simulated
from alidade.pipelines.simulation.sensors import (
    Warming,
    by_axis,
    drift,
    measured,
    read_by,
    recording_config,
    sample_times,
    true_values,
)

ARCSEC = np.deg2rad(1.0 / 3600.0)

Vector = tuple[float, float, float]


class Position(ScenarioPart):
    """Turns about one axis, forward and back, with the other axis at a fixed angle."""

    axis: Literal["outer", "inner"]
    other_deg: float
    turns: Positive = 3.0


_SCHEDULE = [
    Position(axis="outer", other_deg=0.0),
    Position(axis="outer", other_deg=180.0),
    Position(axis="inner", other_deg=0.0),
    Position(axis="inner", other_deg=180.0),
]


class IndexerNoise(ScenarioPart):
    """Noise of the sensors, under the names the recording's config gives them; `encoder` is white, rad."""

    gyro_density: NotNegative = 5.8e-7  # rad/s/sqrt(Hz); 0.002 deg/sqrt(h)
    gyro_bias_walk: NotNegative = 0.0  # rad/s/sqrt(s)
    encoder: NotNegative = 0.0  # rad


class IndexerScenario(ScenarioPart):
    """Settings of the `indexer` simulator; every key has a default."""

    positions: list[Position] = _SCHEDULE
    cycles: Annotated[int, Field(ge=1)] = 1  # how many times the positions are gone through
    record_moves: bool = True  # False: nothing is recorded between positions
    rate_deg_s: Positive = 10.0
    acceleration_deg_s2: Positive = 20.0
    dwell_s: Positive = 5.0  # before and after every run
    latitude_deg: float = 40.0
    base_attitude: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # nRbase: w, x, y, z
    noise: IndexerNoise = IndexerNoise()
    mounting_deg: Vector = (0.5, -0.3, 0.4)  # theta_x, theta_y, theta_z
    gyro_bias_deg_h: NotNegative = 5.0  # sigma per axis
    axis_nonperpendicularity_arcsec: float = 0.0
    ripple: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0  # of the rate while turning, relative
    ripple_per_turn: Annotated[int, Field(ge=1)] = 24
    wobble_arcsec: NotNegative = 0.0  # of the axis in its bearing
    wobble_per_turn: Annotated[int, Field(ge=1)] = 2  # once a turn is no wobble but a tilt of what it carries
    encoder_harmonics_arcsec: list[NotNegative] = []  # amplitudes of the errors once, twice, ... a turn; random phases
    encoder_bits: Annotated[int, Field(ge=8, le=40)] = 32
    encoder_wrapped: bool = False  # angles in [-pi, pi)
    gyro_rate_hz: Positive = 200.0
    encoder_rate_hz: Positive = 100.0
    encoder_phase: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0  # of the first stamp, in sample intervals
    attitude_noise_arcsec: NotNegative | None = None  # of the attitude the INS puts out; null: it puts out none
    temperature: Warming | None = None  # of the IMU; null: nobody measures it
    # Data sheets that errors of the sensors are drawn from, passed on to the config; ideal: there are none; null: none
    # either, but the config does not know.
    sensors: SensorSheets | None = None
    effects: dict[str, float] = {}  # assumptions by name and their true values, whatever the data sheets
    priors: dict[str, float | None] = {}  # passed on to the recording's config


@dataclass(frozen=True)
class _Drive:
    """One uniform motion of one axis with ramps at its ends."""

    axis: int  # 0 outer, 1 inner
    start: float
    angle: float  # rad, signed
    speed: float
    acceleration: float
    is_move: bool

    @property
    def duration(self) -> float:
        return abs(self.angle) / self.speed + self.speed / self.acceleration

    def turned(self, t: Array) -> Array:
        """Angle of the motion at times t, rad, for a trapezoidal rate."""
        ramp, s = self.speed / self.acceleration, t - self.start
        even, braking = (np.maximum(s - corner, 0.0) for corner in (ramp, self.duration - ramp))
        return np.asarray(np.sign(self.angle) * 0.5 * self.acceleration * (s**2 - even**2 - braking**2))


def simulate_indexer(scenario: IndexerScenario, seed: int, _images: bool = False) -> Simulated:
    """Simulate a session in memory; the truth is in rad and rad/s, that of a walking bias its mean."""
    # What sensors with errors add is drawn apart: a seed gives the same noise whatever they do.
    rng = np.random.default_rng(seed)
    rng_of_sensors = np.random.default_rng([seed, 1])
    effects = true_values(NUISANCE, scenario, rng_of_sensors)
    drives, duration = _program(scenario)
    phases = rng.uniform(0.0, 2.0 * np.pi, size=(2, 1 + len(scenario.encoder_harmonics_arcsec)))
    gyro_t = _recorded(sample_times(duration, scenario.gyro_rate_hz), drives, scenario)
    half = 0.5 / scenario.gyro_rate_hz
    before, after = (_attitude(scenario, drives, phases, gyro_t + side) for side in (-half, half))
    turned = so3.exp(np.array([2.0 * half]) * earth_rate(np.deg2rad(scenario.latitude_deg)))
    rate = so3.log(so3.compose(so3.inverse(before), turned, after)) / (2.0 * half)
    noise = scenario.noise
    bias = np.deg2rad(scenario.gyro_bias_deg_h / 3600.0) * rng.standard_normal(3) + np.cumsum(
        noise.gyro_bias_walk / np.sqrt(scenario.gyro_rate_hz) * rng.standard_normal((len(gyro_t), 3)), axis=0
    )
    white = noise.gyro_density * np.sqrt(scenario.gyro_rate_hz) * rng.standard_normal((len(gyro_t), 3))
    encoder_t = _recorded(sample_times(duration, scenario.encoder_rate_hz, scenario.encoder_phase), drives, scenario)
    at = encoder_t + effects["encoder_delay"]
    truly = _angles(scenario, drives, phases, at)
    outer, inner = _encoders(scenario, _commanded(scenario, drives, at) + _once_per_turn(truly, effects), rng)
    attitude = None
    if scenario.attitude_noise_arcsec is not None:
        error = scenario.attitude_noise_arcsec * ARCSEC * rng.standard_normal((len(gyro_t), 3))
        attitude = so3.multiply(_attitude(scenario, drives, phases, gyro_t), so3.exp(error))
    data = IndexerData(
        EPOCH_NS,
        gyro_t,
        read_by(rate, "gyro", effects) + drift(scenario.temperature, "gyro", effects, gyro_t) + bias + white,
        encoder_t,
        outer,
        inner,
        scenario.latitude_deg,
        attitude,
        noise.gyro_density or None,
        temperature=measured(scenario.temperature, duration),
    )
    truth = by_axis(theta=np.deg2rad(scenario.mounting_deg), gyro_bias=bias.mean(axis=0))
    truth["axis_nonperpendicularity"] = float(scenario.axis_nonperpendicularity_arcsec * ARCSEC)
    return Simulated(data, {**truth, **effects}, indexer_config(scenario))


def indexer_config(scenario: IndexerScenario) -> str:
    """Config (YAML) of the recording: simulated noise, attitude of the base, the scenario's priors.

    The encoder's noise takes in all errors of the angles, RMS: white noise, harmonics, the axes' wobble, quantisation.
    """
    periodic = [*scenario.encoder_harmonics_arcsec, scenario.wobble_arcsec]
    variance = scenario.noise.encoder**2 + (2.0 * np.pi / 2**scenario.encoder_bits) ** 2 / 12.0
    variance += 0.5 * float(np.sum(np.square(periodic))) * ARCSEC**2
    noise = scenario.noise.model_dump() | {"encoder": float(np.sqrt(variance))}
    if not noise["gyro_density"]:
        del noise["gyro_density"]
    base = {"base_attitude": list(scenario.base_attitude)}
    return recording_config("indexer", scenario, noise, indexer=base)


def _program(scenario: IndexerScenario) -> tuple[list[_Drive], float]:
    """Schedule of motions in time order, and its duration, s."""
    drives: list[_Drive] = []
    at = np.zeros(2)
    now = scenario.dwell_s

    def drive(axis: int, angle: float, is_move: bool) -> None:
        nonlocal now
        acceleration = np.deg2rad(scenario.acceleration_deg_s2)
        speed = min(np.deg2rad(scenario.rate_deg_s), float(np.sqrt(abs(angle) * acceleration)))
        drives.append(_Drive(axis, now, angle, speed, acceleration, is_move))
        at[axis] += angle
        now += drives[-1].duration + scenario.dwell_s

    for position in scenario.positions * scenario.cycles:
        turning = 0 if position.axis == "outer" else 1
        target = np.deg2rad([0.0, position.other_deg] if turning == 0 else [position.other_deg, 0.0])
        for axis in (1, 0):
            if abs(target[axis] - at[axis]) > 1e-9:
                drive(axis, float(target[axis] - at[axis]), is_move=True)
        for sign in (1.0, -1.0):
            drive(turning, sign * 2.0 * np.pi * position.turns, is_move=False)
    return drives, now


def _recorded(t: Array, drives: list[_Drive], scenario: IndexerScenario) -> Array:
    """Remove the stamps within moves that the scenario does not record."""
    for move in drives:
        if move.is_move and not scenario.record_moves:
            t = t[(t < move.start) | (t > move.start + move.duration)]
    return t


def _commanded(scenario: IndexerScenario, drives: list[_Drive], t: Array) -> Array:
    """Commanded axis angles (2, N), rad, with a ripple periodic in the angle, as cogging is."""
    angles = np.zeros((2, len(t)))
    for drive in drives:
        begin, end = np.searchsorted(t, [drive.start, drive.start + drive.duration])
        k = scenario.ripple_per_turn
        for some, turned in ((slice(begin, end), drive.turned(t[begin:end])), (slice(end, None), drive.angle)):
            angles[drive.axis, some] += turned + scenario.ripple / k * np.sin(k * turned)
    return angles


def _angles(scenario: IndexerScenario, drives: list[_Drive], phases: Array, t: Array) -> Array:
    """True axis angles (2, N), rad: the drives follow the encoders with their harmonic errors."""
    commanded = _commanded(scenario, drives, t)
    angles = commanded.copy()
    for order, amplitude in enumerate(scenario.encoder_harmonics_arcsec, start=1):
        angles -= amplitude * ARCSEC * np.sin(order * commanded + phases[:, order, None])
    return angles


def _attitude(scenario: IndexerScenario, drives: list[_Drive], phases: Array, t: Array) -> Array:
    """Attitude nRm (N, 4) of the gyro."""
    ex, ey, ez = np.eye(3)
    outer, inner = _angles(scenario, drives, phases, t)[..., None]
    k, w = scenario.wobble_per_turn, scenario.wobble_arcsec * ARCSEC
    outer_axis = inner_axis = so3.identity()
    if w:
        a, b = k * outer + phases[0, 0], k * inner + phases[1, 0]
        outer_axis = so3.exp(w * (np.cos(a) * ey + np.sin(a) * ez))
        inner_axis = so3.exp(w * (np.cos(b) * ex + np.sin(b) * ey))
    tilt = so3.exp(scenario.axis_nonperpendicularity_arcsec * ARCSEC * ey)
    tRm = so3.from_angles(np.deg2rad(scenario.mounting_deg))
    baseRt = so3.compose(outer_axis, so3.exp(outer * ex), tilt, inner_axis, so3.exp(inner * ez))
    return so3.compose(np.array(scenario.base_attitude), baseRt, tRm)


def _once_per_turn(angles: Array, effects: Mapping[str, float]) -> Array:
    """Once-per-turn errors of the encoders at the axes' angles (2, N), rad."""
    sine, cosine = ([[effects[f"encoder_{joint}_{part}"]] for joint in JOINTS] for part in ("sin", "cos"))
    return np.asarray(sine * np.sin(angles) + cosine * np.cos(angles))


def _encoders(scenario: IndexerScenario, commanded: Array, rng: np.random.Generator) -> Array:
    """Encoder readings (2, M), rad."""
    read = commanded + scenario.noise.encoder * rng.standard_normal(commanded.shape)
    step = 2.0 * np.pi / 2**scenario.encoder_bits
    read = step * np.round(read / step)
    return (read + np.pi) % (2.0 * np.pi) - np.pi if scenario.encoder_wrapped else read


SIMULATOR = Simulator(scenario=IndexerScenario, simulate=simulate_indexer)
