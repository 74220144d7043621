"""Parameters of the los method: mounting angles, gyro bias, and errors of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import (
    CLOCK_SKEW,
    DEAD_BAND,
    ParameterSpec,
    check_parameters,
    encoder_errors,
    error_map,
    g_sensitivity,
    gyro_bias,
    gyro_errors,
    gyro_scale,
    parameter,
    quantities,
    scalar,
    stamped,
    time_offset,
)
from alidade.pipelines.estimation.problem import Parameter
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.los.recording import JOINTS
from alidade.pipelines.methods.noise import refuse_gyro_scale
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.settings import Config


def _angle(name: str, description: str) -> ParameterSpec:
    return scalar(name, "rad", 0.1, description, require=1e-3)


MOUNT = (
    _angle("delta_px", "Boresight in elevation: added to the elevation encoder."),
    ParameterSpec("delta_g{}", "rad", 0.1, "Gyro misalignment about {axis} of the carrier.", axes="xy", require=1e-3),
)
AZIMUTH = _angle("delta_z", "Azimuth misalignment, camera minus gyro.")
# Given both, in place of their difference.
AZIMUTH_ZEROS = (
    _angle("delta_pz", "Boresight in azimuth: added to the azimuth encoder."),
    _angle("delta_gz", "Gyro misalignment about z of the carrier."),
)
BIAS = gyro_bias(0.02, 1e-3)

# What data sheets state, one sigma: good MEMS gyros after factory calibration, a camera whose focal length was measured
# roughly, machined gimbals.
SCALE = gyro_scale("gyro", "gyro", 3e-3)
SENSITIVITY = g_sensitivity(2e-5)
ROLL = scalar("camera_roll", "rad", 1e-2, "Camera roll about the line of sight.", "camera.roll")
COLLIMATION = scalar(
    "collimation",
    "rad",
    1e-3,
    "Collimation: line of sight against the normal of the elevation axis.",
    "gimbal.collimation",
)
AXES = scalar(
    "axis_nonperpendicularity",
    "rad",
    1e-3,
    "Non-perpendicularity of elevation and azimuth axis.",
    "gimbal.nonperpendicularity",
)
TIME_OFFSET = time_offset(1e-2, data_sheet="clock.offset")
LOS_SCALE = scalar("los_scale", "", 5e-3, "Scale error of the LOS errors (focal length).", "camera.scale")
TARGET_RATE = ParameterSpec(
    "target_rate",
    "rad/s",
    1e-5,
    "Drift of the target direction about {axis}.",
    "target.rate",
    axes="xz",
    per_recording=True,
)
LOS_MAP = error_map("los_map", "xz", 1e-4, "Error of the LOS error ph{first} that depends on the gimbal angles.")
ONCE_PER_TURN, DELAY = encoder_errors(JOINTS, 2e-4, 1e-3)

GIMBAL_ERRORS = (ROLL, COLLIMATION, AXES)
# Those of alidade.factors.los.SIGHT_ERRORS, in its order.
TRACKER_ERRORS = (TIME_OFFSET, CLOCK_SKEW, LOS_SCALE, TARGET_RATE, ONCE_PER_TURN, DELAY)
NUISANCE = (*SCALE, SENSITIVITY, *GIMBAL_ERRORS, *TRACKER_ERRORS, GYRO_SLOPE)
# The angles by which gyro, gimbal axes and camera are mounted.
ANGLE_SPECS = (*MOUNT, AZIMUTH, *AZIMUTH_ZEROS, *GIMBAL_ERRORS)
ANGLES = tuple(name for each in ANGLE_SPECS for name in each.names)
PARAMETERS = (*MOUNT, AZIMUTH, *AZIMUTH_ZEROS, BIAS, *NUISANCE, DEAD_BAND, LOS_MAP)


@dataclass(frozen=True)
class LosParameters:
    """Variables that all measurements share.

    Attributes:
        angles: of the mounting.
        bias: of the gyro (3), rad/s, its first node.
        sight: alidade.factors.los.SIGHT_ERRORS; None when all are fixed.
        gyro: S of the gyro and what its drivers do, see alidade.factors.gyro; None for a perfect one.
    """

    angles: Parameter
    bias: Parameter
    sight: Parameter | None
    gyro: Parameter | None

    @classmethod
    def of(cls, config: Config, drivers: Sequence[ParameterSpec], stamp_sigma: float = 0.0) -> LosParameters:
        """Build the parameters with the priors of the config.

        Args:
            drivers: SENSITIVITY, GYRO_SLOPE and DEAD_BAND, in this order, where the gyro's IMU has their causes.
            stamp_sigma: s, how well the stamps are known.
        """
        refuse_gyro_scale("los", config)
        check_parameters(PARAMETERS, config)
        given = [each.name for each in AZIMUTH_ZEROS if each.name in config.priors]
        if len(given) == 1:
            raise InputError(f"priors: {given[0]} alone; delta_pz and delta_gz are given both, or neither for delta_z")
        angles = [q for each in (*MOUNT, *(AZIMUTH_ZEROS if given else (AZIMUTH,))) for q in quantities(each, config)]
        errors = [q for each in GIMBAL_ERRORS for q in quantities(each, config) if q.prior_sigma != 0.0]
        return cls(
            angles=Parameter(gtsam.symbol("a", 0), (*angles, *errors)),
            bias=Parameter(FIRST_BIAS, quantities(BIAS, config)),
            sight=stamped(parameter(gtsam.symbol("S", 0), TRACKER_ERRORS, config), TIME_OFFSET.name, stamp_sigma),
            gyro=gyro_errors(gtsam.symbol("G", 0), SCALE, drivers, config),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the mounting angles that are variables."""
        return tuple(q.name for q in self.angles.quantities)

    @property
    def all(self) -> tuple[Parameter, ...]:
        """All parameters in reporting order."""
        return tuple(each for each in (self.angles, self.bias, self.sight, self.gyro) if each is not None)
