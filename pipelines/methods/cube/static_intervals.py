"""Static intervals, when the device in a cube stood still."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.methods.cube.data import Array, CubeData, computed_once, noise_densities, nominal
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.static_intervals import find_static_intervals
from alidade.pipelines.settings import Config


@computed_once
def static_intervals(data: CubeData, config: Config) -> Array:
    """Beginnings and ends, (P, 2) s, of the device's static intervals. Raises InputError when there is none."""
    densities = noise_densities(data, config)
    root_rate = float(np.median(np.diff(data.imu_t))) ** -0.5
    raw = config.section(CubeConfig).raw
    gyro, accel = nominal(data.gyro, raw.gyro), nominal(data.accel, raw.accel)
    return find_static_intervals(data.imu_t, gyro, accel, densities[0] * root_rate, densities[1] * root_rate)
