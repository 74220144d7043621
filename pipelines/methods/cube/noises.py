"""What noise the cube's graph reckons with."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.methods.cube.data import CubeData, computed_once, nominal, stated_density
from alidade.pipelines.methods.cube.poses import static_poses
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.noise import repeatability, sampled, stated, typical, walked
from alidade.pipelines.settings import Config


@computed_once
def noises(data: CubeData, config: Config) -> dict[str, Level]:
    """What is in force, by name, in nominal SI. Raises InputError when there is no static pose."""
    raw, poses = config.section(CubeConfig).raw, static_poses(data, config)
    gyro = stated_density("gyro_density", data, config, "gyro turns", "gyro at rest")
    accel = stated_density("accel_density", data, config)
    causes = poses.accel if poses.celsius is None else np.column_stack([poses.accel, poses.celsius])
    found = [
        sampled(gyro, data.imu_t, nominal(data.gyro, raw.gyro)),
        sampled(accel, data.imu_t, nominal(data.accel, raw.accel)),
        walked(stated("gyro_bias_walk", config), poses.span.mean(axis=1), poses.gyro, causes),
        repeatability("gyro", config, "gyro at rest"),
        repeatability("turn", config, "gyro turns"),
        repeatability("accel", config, "accelerometer"),
    ]
    if data.mag is not None and data.mag_t is not None:
        mag = stated_density("mag_density", data, config)
        found += [sampled(mag, data.mag_t, nominal(data.mag, raw.mag)), repeatability("mag", config, "magnetometer")]
    if data.camera is not None:
        seen = None if data.sightings is None else data.sightings.covariance
        corners = typical(None if seen is None else seen.reshape(-1, 2, 2), 0, 1)
        found.append(Level(stated("corner_px", config, corners, ("tags",))))
    return {level.noise.name: level for level in found}
