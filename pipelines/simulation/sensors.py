"""Motion and sensors of simulators: angles over time, true values of sensors' errors, what such a gyro reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.estimation.parameters import ParameterSpec, quantities
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.recording.streams import Temperature
from alidade.pipelines.settings import Config, Sensors
from alidade.pipelines.simulation.scenario import Positive, ScenarioPart

# Least internal sample rate, Hz, of a gyro however slowly it reports: over h = 25 ms the rotation vector per second
# differs from the mean rate by h^2 |w x w'| / 12, 1e-4 rad/s at 2 rad^2/s^3, and a stabilisation loop whose rates step
# that slowly has kinks between encoder readings.
INTERNAL_RATE_HZ = 200.0


class Swing(ScenarioPart):
    """One part of an angle: an oscillation and a turn at constant rate, between `start_s` and `end_s`.

    angle = amplitude * sin(2 pi * frequency * s + phase) + rate * s, with s = clip(t, start, end) - start in seconds:
    constant outside the interval, continuous everywhere.
    """

    amplitude_deg: float = 0.0
    frequency_hz: float = 0.0
    phase_deg: float = 0.0
    rate_deg_s: float = 0.0
    start_s: float = 0.0
    end_s: float = float("inf")


class EulerMotion(ScenarioPart):
    """Yaw, pitch and roll over time, each the sum of its swings; no swings = zero."""

    yaw: list[Swing] = Field(default_factory=list)
    pitch: list[Swing] = Field(default_factory=list)
    roll: list[Swing] = Field(default_factory=list)

    def attitude(self, t: Array) -> Array:
        """aRb at the times t (s), shape (N, 4), b turned from a by yaw about z, then pitch about y, then roll about x.

        In the passive matrices of the publications bRa = Rx(roll) Ry(pitch) Rz(yaw).
        """
        return so3.from_angles(np.stack([angle(each, t) for each in (self.roll, self.pitch, self.yaw)], axis=1))


def angle(swings: Sequence[Swing], t: Array) -> Array:
    """Sum of the swings at the times t (s), rad, shape of t."""
    total = np.zeros_like(t)
    for swing in swings:
        s = np.clip(t, swing.start_s, swing.end_s) - swing.start_s
        phase = 2.0 * np.pi * swing.frequency_hz * s + np.deg2rad(swing.phase_deg)
        total += np.deg2rad(swing.amplitude_deg) * np.sin(phase) + np.deg2rad(swing.rate_deg_s) * s
    return total


def sample_times(duration_s: float, rate_hz: float, phase: float = 0.0) -> Array:
    """Stamps (k + phase) / rate in [0, duration), s, on whole nanoseconds as message stamps are."""
    t = (np.arange(np.ceil(duration_s * rate_hz)) + phase) / rate_hz
    return np.asarray(np.round(t[t < duration_s] * 1e9) / 1e9)


def averaged_samples(rate_hz: float) -> int:
    """Number of internal samples, at `INTERNAL_RATE_HZ` or more, that a gyro averages into a reading at `rate_hz`."""
    return int(np.ceil(INTERNAL_RATE_HZ / rate_hz))


def means(samples: Array, count: int) -> Array:
    """Average samples (N, ...) in groups of `count` consecutive ones, (n, ...); an incomplete last group is dropped."""
    whole = len(samples) // count * count
    return np.asarray(samples[:whole].reshape(-1, count, *samples.shape[1:]).mean(axis=1))


def exposures(stamps: Array, offset: float, skew: float) -> Array:
    """When pictures with these stamps (K,), s, were taken, s: an offset later, less a skew, s/s, since the first one.

    The one formula of simulators; `estimation.camera_clock.Clock` is that of the graphs, which they do not know.
    """
    return np.asarray(stamps + offset - skew * (stamps - stamps[0]))


class Warming(ScenarioPart):
    """Warm-up of a sensor: its temperature moves from one value to another, slower and slower."""

    start_c: Annotated[float, Field(ge=-100.0, le=200.0)] = 20.0
    rise_k: Annotated[float, Field(ge=-100.0, le=100.0)] = 10.0  # after a long time
    time_constant_s: Positive = 40.0
    rate_hz: Annotated[float, Field(ge=0.1)] = 2.0  # of the messages

    def at(self, t: Array) -> Array:
        """Temperatures (n,) at times (n,), s, degrees Celsius."""
        return np.asarray(self.start_c - self.rise_k * np.expm1(-t / self.time_constant_s))


def true_values(specs: Sequence[ParameterSpec], scenario: Any, rng: np.random.Generator) -> dict[str, float]:
    """A value for each parameter: as given, else drawn from the prior that data sheets make, else 0 for perfect ones.

    Args:
        specs: of errors of sensors; without a temperature those that follow from one are left out.
        scenario: has `effects`, values by name, `sensors`, their data sheets or None, and `temperature`.
        rng: draws them.

    Raises:
        InputError: `effects` has an unknown name.
    """
    config = Config(sensors=scenario.sensors or Sensors())
    known = [spec for spec in specs if scenario.temperature is not None or spec.figure != "temperature"]
    sigmas = {q.name: q.prior_sigma or 0.0 for spec in known for q in quantities(spec, config)}
    drawn = {name: float(sigma * rng.standard_normal()) if scenario.sensors else 0.0 for name, sigma in sigmas.items()}
    for name in scenario.effects:
        if name not in drawn:
            raise InputError(f"unknown key effects.{name}{nearest(name, list(drawn))}")
    return {**drawn, **scenario.effects}


def smooth_map(of: Array, axes: int, rms: float, seed: int) -> Array:
    """Errors (n, axes) that are a smooth function of numbers (n, d) of order 1; mean 0 and this rms about each axis.

    A sum of waves of random directions, a turn or so long, drawn apart from all else.
    """
    rng = np.random.default_rng([seed, 4])
    waves = rng.standard_normal((of.shape[1], 8)) * 1.5
    error = np.sin(of @ waves + rng.uniform(0.0, 2.0 * np.pi, 8)) @ rng.standard_normal((8, axes))
    error -= error.mean(axis=0)
    return np.asarray(rms * error / error.std(axis=0))


def by_axis(**vectors: ArrayLike) -> dict[str, float]:
    """Components of vectors as parameters: name_x, name_y, name_z."""
    return {
        f"{name}_{axis}": float(x)
        for name, vector in vectors.items()
        for axis, x in zip("xyz", np.asarray(vector), strict=True)
    }


def strength_measured(field: Array, sigma: float | None, seed: int) -> dict[str, object]:
    """The config's key of the strength of a field (3,), T, measured with this sigma; none where nobody did.

    Drawn apart: a seed gives the same noise whatever is measured.
    """
    if sigma is None:
        return {}
    value = float(np.linalg.norm(field) + sigma * np.random.default_rng([seed, 3]).standard_normal())
    return {"field": {"strength": {"value": value, "sigma": sigma}}}


def recording_config(method: str, scenario: Any, noise: Mapping[str, float], **more: object) -> str:
    """The config of a simulated recording (YAML): the noise, priors and data sheets of the scenario, other keys."""
    config = {"method": method, "noise": dict(noise), "priors": scenario.priors, **more}
    if getattr(scenario, "sensors", None) is not None:
        config["sensors"] = scenario.model_dump()["sensors"]
    return dump_yaml(config)


def read_by(rate: Array, sensor: str, values: Mapping[str, float], force: Array | None = None) -> Array:
    """Reading (n, 3), rad/s, of a gyro of known errors, without bias and noise: (I + S) w + G f."""
    x, y, z = (values[f"{sensor}_scale_{axis}"] for axis in "xyz")
    xy, xz, yz = (values[f"{sensor}_skew_{axes}"] for axes in ("xy", "xz", "yz"))
    read = rate + rate @ np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])
    if force is not None:
        read = read + force @ np.array([[values[f"{sensor}_g_{row}{column}"] for row in "xyz"] for column in "xyz"])
    return np.asarray(read)


def measured(warming: Warming | None, duration: float) -> Temperature | None:
    """Sample the temperature of a sensor from 0 to `duration`, s, as its topic states it; None without such a topic."""
    if warming is None:
        return None
    t = np.arange(np.floor(duration * warming.rate_hz) + 1.0) / warming.rate_hz
    return Temperature(t, warming.at(t))


def drift(warming: Warming | None, sensor: str, values: Mapping[str, float], t: Array) -> Array:
    """What a sensor reads too much at times t (n,), s, (n, 3): its slopes times what it is warmer than at first."""
    if warming is None:
        return np.zeros((len(t), 3))
    slope = np.array([values[f"{sensor}_temperature_{axis}"] for axis in "xyz"])
    return np.asarray(np.outer(warming.at(t) - warming.start_c, slope))
