"""Simulator of the `tumble` method: a device turned by hand from one random attitude to the next.

Frames: n level East-North-Up, b the device. The attitude is a closed-form function of time: from one attitude to the
next about a fixed axis, slow at both ends. A reading is the exact vector at the moment of its stamp.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate, gravity, magnetic_field
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import Simulator
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.simulation.scenario import EPOCH_NS, YEAR, NotNegative, Positive, ScenarioPart, Simulated
from alidade.pipelines.simulation.sensors import (
    Warming,
    by_axis,
    drift,
    measured,
    recording_config,
    sample_times,
    strength_measured,
)


class TumbledMagnetometer(ScenarioPart):
    """Settings of the simulated magnetometer, with hard and soft iron."""

    rate_hz: Positive = 50.0
    density: Positive = 5e-8  # T/sqrt(Hz)
    soft_iron: NotNegative = 0.05  # sigma of each entry of K - 1
    hard_iron: NotNegative = 3e-5  # T, sigma of each component of b


class TumbledAccelerometer(ScenarioPart):
    """Settings of the simulated accelerometer."""

    rate_hz: Positive = 100.0
    density: Positive = 1.5e-3  # m/s^2/sqrt(Hz)
    gain: NotNegative = 0.02  # sigma of each entry of K - 1
    bias: NotNegative = 0.3  # m/s^2
    mounting_deg: NotNegative = 3.0  # sigma of the magnetometer's rotation against it, each component
    temperature: NotNegative = 1e-2  # m/s^2/K, sigma of each slope of b, where there is a temperature
    square: NotNegative = 3e-5  # s^2/m, sigma of what is felt squared that each axis reads beside it
    cube: NotNegative = 2e-5  # s^4/m^2, sigma of its cube, less what K has of it
    arm: NotNegative = 0.1  # m, from the centre that the device is turned about


class TumbledGyro(ScenarioPart):
    """Settings of the simulated gyro, sampled with the accelerometer if there is one."""

    rate_hz: Positive = 100.0
    density: Positive = 1e-4  # rad/s/sqrt(Hz)
    bias: NotNegative = 1e-2  # rad/s, sigma of each component
    scale: NotNegative = 1e-2  # sigma of each number of S
    g_sensitivity: NotNegative = 2e-4  # rad/s per m/s^2, sigma of each number of G, beside an accelerometer
    temperature: NotNegative = 1e-4  # rad/s/K, sigma of each slope of the bias, where there is a temperature
    mounting_deg: NotNegative = 0.5  # sigma of the next sensor's rotation against it, each component
    mag_delay: NotNegative = 1e-2  # s, sigma


class TumbleScenario(ScenarioPart):
    """Settings of the `tumble` simulator; every key has a default, `null` leaves a sensor out."""

    attitudes: Annotated[int, Field(ge=2)] = 30  # random ones, gone through one after the other
    turn_rad_s: Positive = 1.5  # mean rate from one to the next
    rest_s: NotNegative = 0.0  # in each
    tilt_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0  # the attitudes are within this of level, any heading
    magnetometer: TumbledMagnetometer | None = TumbledMagnetometer()
    accelerometer: TumbledAccelerometer | None = None
    gyro: TumbledGyro | None = None
    temperature: Warming | None = None  # of accelerometer and gyro; null: nobody measures it
    latitude_deg: float | None = 40.0  # null: nobody knows where it was
    longitude_deg: float = 116.3
    field_error: NotNegative = 5e-7  # T, sigma of the strength about its model
    field_measured: Positive | None = 1e-7  # T, sigma of the strength that was measured there; null: nobody did
    priors: dict[str, float | None] = {}  # passed on to the recording's config


def tumble_config(scenario: TumbleScenario, **more: object) -> str:
    """Config (YAML) of the recording: simulated noise, the scenario's priors, other keys."""
    noise = {}
    if scenario.magnetometer is not None:
        noise["mag_density"] = scenario.magnetometer.density
    if scenario.accelerometer is not None:
        # Simulated sensors repeat as well as white noise lets them.
        noise |= {"accel_density": scenario.accelerometer.density, "accel_repeatability": 0.0}
    if scenario.gyro is not None:
        noise |= {"gyro_density": scenario.gyro.density, "gyro_bias_walk": 0.0}
    return recording_config("tumble", scenario, noise, date="2026-11-20", **more)


# Half the step of the differences that an acceleration is made of, s.
_STEP = 1e-3
# Field, T in n, and latitude, rad, of a place that the recording does not name.
_FIELD, _LATITUDE = np.array([0.0, 2.2e-5, -4.2e-5]), np.deg2rad(45.0)


def simulated(scenario: TumbleScenario, seed: int, _images: bool = False) -> Simulated:
    """Simulate data; return them with the true parameters. Raises InputError without a sensor."""
    if scenario.magnetometer is None and scenario.accelerometer is None:
        raise InputError("tumble: magnetometer or accelerometer is needed, or both")
    rng = np.random.default_rng(seed)
    motion = _Motion(scenario, rng)
    truth: dict[str, float] = {}
    place = None if scenario.latitude_deg is None else np.deg2rad([scenario.latitude_deg, scenario.longitude_deg])
    model = _FIELD if place is None else magnetic_field(float(place[0]), float(place[1]), 0.0, YEAR)
    strength = float(np.linalg.norm(model))
    field = model * (1.0 + (0.0 if place is None else scenario.field_error / strength) * rng.standard_normal())
    found: dict[str, object] = {}
    if place is not None:
        found |= {"latitude": float(place[0]), "longitude": float(place[1])}
    mounting, delay = so3.identity(), 0.0
    # Drawn apart: a seed gives the same noise whatever temperatures do.
    slopes = _slopes(scenario, np.random.default_rng([seed, 1]))
    truth |= slopes
    g = 9.80665 if place is None else float(gravity(float(place[0]), 0.0))
    earth = earth_rate(_LATITUDE if place is None else float(place[0]))
    if (gyro := scenario.gyro) is not None:
        t, raw, own = _gyro(motion, gyro, scenario.accelerometer, earth, g, rng)
        raw = raw + drift(scenario.temperature, "gyro", slopes, t)
        found |= {"gyro_t": t, "gyro": raw, "gyro_density": gyro.density}
        delay = gyro.mag_delay * float(rng.standard_normal())
        truth |= own | {"mag_delay": delay}
        mounting = so3.exp(np.deg2rad(gyro.mounting_deg) * rng.standard_normal(3))
    if (accel := scenario.accelerometer) is not None:
        K, b = _drawn(rng, accel.gain, accel.bias)
        K, b = so3.matrix(mounting) @ K, so3.rotate(mounting, b)
        t, raw = _accelerometer(motion, accel, g, K, b, rng)
        curvature = np.random.default_rng([seed, 2])
        square, cube = accel.square * curvature.standard_normal(3), accel.cube * curvature.standard_normal(3)
        truth |= {f"accel_square_{i + 1}": float(each) for i, each in enumerate(square)}
        truth |= {f"accel_cube_{i + 1}": float(each) for i, each in enumerate(cube)}
        f = raw @ K.T + b
        added = (
            square * f**2
            + cube * f * (f**2 - 31.0 / 35.0 * 9.80665**2)
            + drift(scenario.temperature, "accel", slopes, t)
        )
        raw = raw + added @ np.linalg.inv(K).T
        found |= {"accel_t": t, "accel": raw, "accel_density": accel.density}
        truth |= _truth("accel", K, b, symmetric=gyro is None) | {"gravity": g}
        truth |= {"accel_arm_x": accel.arm, "accel_arm_y": 0.0, "accel_arm_z": 0.0}
        mounting = so3.exp(np.deg2rad(accel.mounting_deg) * rng.standard_normal(3))
    if (mag := scenario.magnetometer) is not None:
        K, b = _drawn(rng, mag.soft_iron, mag.hard_iron)
        t, raw = _magnetometer(motion, mag, field, so3.matrix(mounting) @ K, so3.rotate(mounting, b), delay, rng)
        found |= {"mag_t": t, "mag": raw, "mag_density": mag.density}
        unit = 1.0 if place is not None else float(np.linalg.norm(field))
        K, b = so3.matrix(mounting) @ K / unit, so3.rotate(mounting, b) / unit
        truth |= _truth("mag", K, b, symmetric=accel is None and gyro is None)
        truth |= {"field_strength": float(np.linalg.norm(field)) / unit}
        if accel is not None or gyro is not None:
            estimated = gyro is not None and (place is None or accel is None)
            truth |= _level_frame(field, earth if estimated else None, accel is None)
    found |= {"temperature": measured(scenario.temperature, motion.duration)}
    is_measured = place is not None and scenario.magnetometer is not None
    known = strength_measured(field, scenario.field_measured, seed) if is_measured else {}
    return Simulated(TumbleData(EPOCH_NS, **found), truth, tumble_config(scenario, **known))  # type: ignore[arg-type]


def _level_frame(field: Array, earth: Array | None, alone: bool) -> dict[str, float]:
    """True dip, rad, and estimated earth rate, rad/s; for a magnetometer alone, y is along the field."""
    unit = field / np.linalg.norm(field)
    if alone and earth is not None:
        return {"field_dip": 0.0, "earth_rate_y": float(earth @ unit)}
    rates = {} if earth is None else {f"earth_rate_{a}": float(w) for a, w in zip("xyz", earth, strict=True)}
    return {"field_dip": float(np.arcsin(-unit[2]))} | rates


def _slopes(scenario: TumbleScenario, rng: np.random.Generator) -> dict[str, float]:
    """Draw temperature slopes of the offsets of gyro and accelerometer, if temperature is simulated."""
    sensors = {"gyro": scenario.gyro, "accel": scenario.accelerometer}
    there = {name: sensor for name, sensor in sensors.items() if sensor is not None and scenario.temperature}
    return {
        f"{name}_temperature_{axis}": sensor.temperature * float(rng.standard_normal())
        for name, sensor in there.items()
        for axis in "xyz"
    }


class _Motion:
    """Attitudes nRb over time."""

    def __init__(self, scenario: TumbleScenario, rng: np.random.Generator) -> None:
        heading = rng.uniform(-np.pi, np.pi, scenario.attitudes)
        # Evenly over the part of the sphere that may be up, any heading.
        cosine = rng.uniform(np.cos(np.deg2rad(scenario.tilt_deg)), 1.0, scenario.attitudes)
        around = rng.uniform(-np.pi, np.pi, scenario.attitudes)
        lean = np.arccos(cosine)[:, None] * np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=1)
        about_up = heading[:, None] * np.array([0.0, 0.0, 1.0])
        self.nRb = so3.multiply(so3.exp(about_up), so3.exp(lean))
        self.turns = so3.local(self.nRb[:-1], self.nRb[1:])
        lasting = np.linalg.norm(self.turns, axis=1) / scenario.turn_rad_s
        self.starts = scenario.rest_s + np.cumsum(np.append(0.0, lasting[:-1] + scenario.rest_s))
        self.lasting = np.maximum(lasting, 1e-3)
        self.duration = float(self.starts[-1] + self.lasting[-1] + scenario.rest_s)

    def attitude(self, t: Array) -> Array:
        """Attitudes nRb (n, 4) at times t (n,), s."""
        k = np.clip(np.searchsorted(self.starts, t, side="right") - 1, 0, len(self.starts) - 1)
        s = np.clip((t - self.starts[k]) / self.lasting[k], 0.0, 1.0)
        # Velocity and acceleration are zero at both ends.
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return so3.multiply(self.nRb[k], so3.exp(share[:, None] * self.turns[k]))


def _drawn(rng: np.random.Generator, gain: float, bias: float) -> tuple[Array, Array]:
    """Draw a symmetric K (3, 3) near the identity, and b (3,)."""
    K = gain * rng.standard_normal((3, 3))
    K = np.triu(K) + np.triu(K, 1).T
    return np.eye(3) + K, bias * rng.standard_normal(3)


def _magnetometer(
    motion: _Motion,
    sensor: TumbledMagnetometer,
    field: Array,
    K: Array,
    b: Array,
    delay: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    t = sample_times(motion.duration, sensor.rate_hz)
    seen = so3.rotate(so3.inverse(motion.attitude(t + delay)), field)
    return t, _read(seen, K, b, sensor.density, sensor.rate_hz, rng)


def _gyro(
    motion: _Motion,
    sensor: TumbledGyro,
    beside: TumbledAccelerometer | None,
    earth: Array,
    g: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, dict[str, float]]:
    """Stamps, readings (I + S) w + G f + bias, and true S, G and bias."""
    rate_hz = sensor.rate_hz if beside is None else beside.rate_hz
    t = sample_times(motion.duration, rate_hz, 0.3)
    before, now, after = (motion.attitude(t + step) for step in (-_STEP, 0.0, _STEP))
    rate = so3.local(before, after) / (2.0 * _STEP) + so3.rotate(so3.inverse(now), earth)
    S, bias = sensor.scale * rng.standard_normal(6), sensor.bias * rng.standard_normal(3)
    G = (0.0 if beside is None else sensor.g_sensitivity) * rng.standard_normal((3, 3))
    gain = np.eye(3) + np.array([[S[0], S[3], S[4]], [S[3], S[1], S[5]], [S[4], S[5], S[2]]])
    exact = rate @ gain.T + bias
    if beside is not None:
        exact = exact + _force(motion, beside, g, t) @ G.T
    names = (*(f"gyro_scale_{a}" for a in "xyz"), *(f"gyro_skew_{a}" for a in ("xy", "xz", "yz")))
    truth = dict(zip(names, S.tolist(), strict=True))
    truth |= by_axis(gyro_bias=bias)
    truth["gyro_filter"] = rate_hz**-2 / 24.0  # a point's beside that of a mean over an interval
    if beside is not None:
        truth |= {f"gyro_g_{a}{c}": float(G[i, j]) for i, a in enumerate("xyz") for j, c in enumerate("xyz")}
    return t, exact + sensor.density * np.sqrt(rate_hz) * rng.standard_normal(exact.shape), truth


def _accelerometer(
    motion: _Motion, sensor: TumbledAccelerometer, g: float, K: Array, b: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    t = sample_times(motion.duration, sensor.rate_hz, 0.3)
    return t, _read(_force(motion, sensor, g, t), K, b, sensor.density, sensor.rate_hz, rng)


def _force(motion: _Motion, sensor: TumbledAccelerometer, g: float, t: Array) -> Array:
    """Specific force (n, 3), m/s^2, in b at the accelerometer."""
    arm = np.array([sensor.arm, 0.0, 0.0])
    before, now, after = (so3.rotate(motion.attitude(t + step), arm) for step in (-_STEP, 0.0, _STEP))
    force = (before - 2.0 * now + after) / _STEP**2 + np.array([0.0, 0.0, g])
    return so3.rotate(so3.inverse(motion.attitude(t)), force)


def _read(nominal: Array, K: Array, b: Array, density: float, rate_hz: float, rng: np.random.Generator) -> Array:
    """Readings (n, 3) with white noise of a sensor with nominal = K raw + b."""
    exact = (nominal - b) @ np.linalg.inv(K).T
    return np.asarray(exact + density * np.sqrt(rate_hz) * rng.standard_normal(nominal.shape))


def _truth(name: str, K: Array, b: Array, symmetric: bool) -> dict[str, float]:
    gains = {f"{name}_k{i + 1}{j + 1}": float(K[i, j]) for i in range(3) for j in range(3) if i <= j or not symmetric}
    return gains | {f"{name}_b{i + 1}": float(b[i]) for i in range(3)}


SIMULATOR = Simulator(scenario=TumbleScenario, simulate=simulated, randomised=True)
