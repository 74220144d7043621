"""The temperature of sensors whose biases follow it, as methods have it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.parameters import ParameterSpec, parameter, temperature_slope
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.recording.streams import StreamReader, Temperature
from alidade.pipelines.recording.topics import TEMPERATURE, wanted
from alidade.pipelines.settings import Config

# Slopes of consumer sensors' biases, one sigma.
GYRO_SLOPE = temperature_slope("gyro", "rad/s", 1e-4)
ACCEL_SLOPE = temperature_slope("accel", "m/s^2", 1e-2)
# What formulas call the temperature at which a bias is the bias, degrees Celsius.
FIRST = "first_temperature"


def read(reader: StreamReader, config: Config, slopes: Sequence[ParameterSpec], sensor_t: Array) -> Temperature | None:
    """Read a sensor's temperature at sensor_t (N,), s; None without the topic or if all slopes are fixed.

    Raises InputError as StreamReader.temperature does.
    """
    if not wanted(reader.recording, config, TEMPERATURE) or parameter(0, slopes, config) is None:
        return None
    return reader.temperature(config.topic(TEMPERATURE), sensor_t)


def reference(temperature: Temperature | None) -> float | None:
    """Reference temperature of a bias, degrees Celsius: the first one recorded."""
    return None if temperature is None else temperature.first


def above(temperature: Temperature | None, reference: float | None, at: Array) -> Array | None:
    """Temperature (n,) above the reference, K, at times (n,), s; None if not recorded."""
    return None if temperature is None or reference is None else temperature.above(reference, at)


def longest_gap(temperature: Temperature | None) -> float:
    """Longest gap between temperature messages, s, over which the temperature is interpolated."""
    return 0.0 if temperature is None else float(np.diff(temperature.t).max(initial=0.0))


def constants(reference: float | None) -> dict[str, float]:
    """Constants of formulas that have slopes over temperature."""
    return {} if reference is None else {FIRST: reference}


def topics(temperature: Temperature | None, epoch_ns: int) -> dict[str, series.Topic]:
    """Temperature topic to write; empty without a temperature."""
    if temperature is None:
        return {}
    t_ns = nanoseconds(temperature.t, epoch_ns)
    return {TEMPERATURE.name: series.TemperatureSeries(t_ns, temperature.celsius, frame_id="imu")}
