"""A calibration applied to what a cube's sensors said."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.cube.data import CubeData, nominal, recorded
from alidade.pipelines.methods.cube.parameters import CUBE, SENSITIVITY, SQUARE, TEMPERATURE
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.temperature import FIRST
from alidade.pipelines.methods.triads import triad_of
from alidade.pipelines.settings import Config


def calibrated(
    name: str,
    vectors: Array,
    config: Config,
    values: Mapping[str, float],
    force: Array | None = None,
    celsius: Array | None = None,
) -> Array:
    """K raw + b of vectors (n, 3) given in nominal units, less an accelerometer's curvature, a gyro's G f and drifts.

    Args:
        name: of the sensor.
        vectors: what it said.
        config: of the recording.
        values: parameters by name; assumptions that are not among them are 0.
        force: (n, 3) specific force in b, m/s^2, that a gyro felt; None: none.
        celsius: (n,) temperatures, degrees Celsius; None: not known.
    """
    if name == "accel":
        vectors = straightened(
            vectors, *(np.array([values.get(n, 0.0) for n in each.names]) for each in (SQUARE, CUBE))
        )
    if name == "gyro" and force is not None:
        vectors = vectors - force @ np.array([values.get(n, 0.0) for n in SENSITIVITY.names]).reshape(3, 3).T
    if name in TEMPERATURE and celsius is not None and FIRST in values:
        slope = np.array([values.get(n, 0.0) for n in TEMPERATURE[name].names])
        vectors = vectors - np.outer(celsius - values[FIRST], slope)
    raw = recorded(vectors, getattr(config.section(CubeConfig).raw, name))
    K, b = triad_of(name, values)
    return np.asarray(raw @ K.T + b)


def calibrated_rates(data: CubeData, config: Config, values: Mapping[str, float]) -> Array:
    """All of the gyro's samples calibrated, (N, 3) rad/s in b."""
    raw = config.section(CubeConfig).raw
    force = None
    celsius = None if data.temperature is None else data.temperature.above(0.0, data.imu_t)
    if "accel_k11" in values:
        force = calibrated("accel", nominal(data.accel, raw.accel), config, values, celsius=celsius)
    return calibrated("gyro", nominal(data.gyro, raw.gyro), config, values, force, celsius)


def straightened(read: Array, square: Array, cube: Array) -> Array:
    """u (n, 3) from read = u + square u^2 + cube u^3, in two steps: to (3 cube u^2)^2 of what the terms add."""
    once = read - square * read**2 - cube * read**3
    return np.asarray(read - square * once**2 - cube * once**3)
