"""Simulator of two gyros on one body, with exact rotations.

The attitude of the body, which is frame a, is a closed-form function of time in a frame that does not turn. A sample is
Log of the exact rotation over its interval, centred on the moment it was taken, divided by the interval.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.methods import Simulator
from alidade.pipelines.simulation.motion import EulerMotion, Swing, sample_times
from alidade.pipelines.simulation.simulated import Simulated
from gyro_pair.recording import GyroPairData

Array = NDArray[np.float64]

# 2026-11-20 12:00 UTC: simulated sessions start here.
EPOCH_NS = 1_795_176_000_000_000_000
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, lt=1.0)]


class Gyro(BaseModel):
    """One of the gyros."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_hz: Positive = 200.0
    phase: Fraction = 0.0  # of the first stamp, in sample intervals
    density: Positive = 1e-4  # rad/s/sqrt(Hz)
    bias_walk: NotNegative = 1e-6  # rad/s/sqrt(s)
    turn_on_bias_deg_s: NotNegative = 0.3  # sigma per axis of the bias at the start


class GyroPairScenario(BaseModel):
    """What the simulator is asked for; every key has a default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    duration_s: Positive = 60.0
    motion: EulerMotion = EulerMotion(
        yaw=[Swing(amplitude_deg=40, frequency_hz=0.31), Swing(amplitude_deg=6, frequency_hz=1.1)],
        pitch=[Swing(amplitude_deg=30, frequency_hz=0.23), Swing(amplitude_deg=5, frequency_hz=1.3)],
        roll=[Swing(amplitude_deg=25, frequency_hz=0.41)],
    )  # of the body
    gyro_a: Gyro = Gyro()
    gyro_b: Gyro = Gyro(rate_hz=400.0, phase=0.4, density=2e-4)
    rotation_deg: tuple[float, float, float] = (60.0, -80.0, 70.0)  # rotation vector of aRb
    time_offset_s: float = 0.012  # positive: b's samples were taken later than their stamps say
    priors: dict[str, float | None] = {}  # passed on to the recording's config


def simulated(scenario: GyroPairScenario, seed: int, images: bool = False) -> Simulated:
    """Data and the true values of the parameters (rad, s, rad/s; the bias difference is its mean over the recording).

    Raises InputError when pictures are asked for: there is no camera.
    """
    if images:
        raise InputError("gyro_pair has no camera: leave out --images")
    rng = np.random.default_rng(seed)
    aRb = so3.exp(np.deg2rad(scenario.rotation_deg))
    a_t, a_gyro, a_bias = _gyro(scenario, scenario.gyro_a, so3.identity(), 0.0, rng)
    b_t, b_gyro, b_bias = _gyro(scenario, scenario.gyro_b, aRb, scenario.time_offset_s, rng)
    data = GyroPairData(
        EPOCH_NS, a_t, a_gyro, b_t, b_gyro, a_density=scenario.gyro_a.density, b_density=scenario.gyro_b.density
    )
    vectors = {
        "rotation": so3.log(aRb),
        "bias_difference": b_bias.mean(axis=0) - so3.rotate(so3.inverse(aRb), a_bias.mean(axis=0)),
    }
    truth = {f"{name}_{axis}": float(x) for name, v in vectors.items() for axis, x in zip("xyz", v, strict=True)}
    return Simulated(data, truth | {"time_offset": scenario.time_offset_s}, _config(scenario))


def _gyro(
    scenario: GyroPairScenario, gyro: Gyro, aRg: Array, offset: float, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Stamps (n,), samples (n, 3) and their biases (n, 3) of a gyro g on the body."""
    t = sample_times(scenario.duration_s, gyro.rate_hz, gyro.phase)
    edges: Array = (np.arange(len(t) + 1, dtype=float) + gyro.phase - 0.5) / gyro.rate_hz + offset
    attitude = so3.multiply(scenario.motion.attitude(edges), aRg)
    rate = so3.log(so3.multiply(so3.inverse(attitude[:-1]), attitude[1:])) * gyro.rate_hz
    steps = gyro.bias_walk / np.sqrt(gyro.rate_hz) * rng.standard_normal((len(t), 3))
    bias = np.deg2rad(gyro.turn_on_bias_deg_s) * rng.standard_normal(3) + np.cumsum(steps, axis=0)
    noise = gyro.density * np.sqrt(gyro.rate_hz) * rng.standard_normal((len(t), 3))
    return t, rate + bias + noise, bias


def _config(scenario: GyroPairScenario) -> str:
    """The recording's config, YAML; the noise is told by the messages."""
    return dump_yaml({"method": "gyro_pair", "priors": scenario.priors})


SIMULATOR = Simulator(scenario=GyroPairScenario, simulate=simulated, folder=Path(__file__).with_name("scenarios"))
