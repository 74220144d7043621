"""What a cube calibration is worth: sensors at rest against gravity and field, gyro turns against the camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.factors import so3
from alidade.factors.earth import gravity
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.compensation import calibrated, calibrated_rates
from alidade.pipelines.methods.cube.data import CubeData, local_field, nominal
from alidade.pipelines.methods.cube.poses import StaticPoses, static_poses, turn
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.settings import Config


def validate(data: CubeData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Errors without and with a calibration, at the static poses and over the turns between them.

    Without calibration the sensors are nominal: as recorded, or converted as the config's `raw` says.

    Args:
        data: the session.
        config: of the session.
        values: calibrated parameters by name, those of calibration.yaml.

    Raises:
        InputError: there is no static pose, or the place on the earth is unknown.
    """
    if data.latitude is None:
        raise InputError("the place on the earth is unknown: record /reference/fix, or give latitude_deg in the config")
    poses = static_poses(data, config)
    time = poses.span.mean(axis=1)
    strength = {"accel": float(gravity(data.latitude, data.height))}
    means = {"accel": poses.accel}
    if poses.mag is not None and data.longitude is not None:
        strength["mag"], means["mag"] = float(np.linalg.norm(local_field(data, config))), poses.mag
    found = []
    for name, unit, what in (("accel", "m/s^2", "specific force"), ("mag", "T", "magnetic field")):
        if name in means and f"{name}_k11" in values:
            good = np.isfinite(means[name]).all(axis=1)
            errors = [
                np.linalg.norm(vectors[good], axis=1)[:, None] - strength[name]
                for vectors in (means[name], calibrated(name, means[name], config, values, celsius=poses.celsius))
            ]
            found.append(Validation(f"{what} at rest, its strength", unit, time[good], *errors))
    if "gyro_k11" in values and sum(tags is not None for tags in poses.tags) > 1:
        found.append(_turns(data, config, poses, values))
    return found


def _turns(data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]) -> Validation:
    """Rotations by the gyro against those between poses that the camera sees one after the other.

    The camera is taken to stand still; the earth's own turning, 0.1 mrad in two seconds, is not taken off.
    """
    rates = nominal(data.gyro, config.section(CubeConfig).raw.gyro), calibrated_rates(data, config, values)
    time, errors = [], []
    for k in range(1, len(poses)):
        before, after = poses.tags[k - 1], poses.tags[k]
        if before is None or after is None:
            continue
        samples = turn(data, poses.span[k - 1, 1], poses.span[k, 0])
        seen = so3.multiply(so3.inverse(before.pose.cRb), after.pose.cRb)
        pair = []
        for rate in rates:
            path = GyroPath(data.imu_t[samples], rate[samples])
            pair.append(so3.log(so3.multiply(so3.inverse(seen), path.attitude(path.t[-1:])[0])))
        time.append(poses.span[k, 0])
        errors.append(pair)
    both = np.array(errors).reshape(-1, 2, 3)
    return Validation("turns by the gyro, against the camera", "rad", np.array(time), both[:, 0], both[:, 1])
