"""Parameters of the head method: mounts, gyro bias, time offset, and errors of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam

from alidade.factors.attitude import PICTURE_ERRORS
from alidade.factors.earth import EARTH_RATE
from alidade.pipelines.estimation.parameters import (
    CLOCK_SKEW,
    DEAD_BAND,
    ParameterSpec,
    check_parameters,
    error_map,
    g_sensitivity,
    gyro_bias,
    gyro_errors,
    gyro_scale,
    parameter,
    quantities,
    scalar,
    time_offset,
)
from alidade.pipelines.estimation.problem import Parameter, rotation_vector_coordinates
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.noise import refuse_gyro_scale
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.settings import Config

HELMET = ParameterSpec(
    "helmet_mount",
    "rad",
    0.35,
    "Rotation markers to helmet IMU (vRh), {axis} of the rotation vector.",
    require=1e-2,
    rotation="vRh",
)
CAMERA = ParameterSpec(
    "camera_mount",
    "rad",
    0.35,
    "Rotation platform to camera (cRb), {axis} of the rotation vector.",
    require=1e-2,
    rotation="cRb",
)
BIAS, OFFSET = gyro_bias(0.05, 2e-3), time_offset(0.05, 5e-3)

# The grades of real-sensor data sheets, one sigma: MEMS gyros, uncalibrated, and a platform's of 10 deg/h.
SCALE = gyro_scale("gyro", "gyro", 1e-2)
SENSITIVITY = g_sensitivity(1e-4)
PLATFORM_BIAS = ParameterSpec(
    "platform_bias", "rad/s", 5e-5, "Platform gyro bias about {axis}.", "platform_gyro.bias", per_recording=True
)
PLATFORM_SCALE = gyro_scale("platform", "platform_gyro", 1e-2, of="Platform gyro")
VISION_SCALE = scalar("vision_scale", "", 3e-3, "Scale error of the angles measured by vision.", "camera.scale")
# Half the square of 10 ms, what impulse responses of trackers and gyros differ by. Of a gyro that is low-passed more
# the model lacks higher derivatives: at 10 Hz (-.9e-4 s^2) a mount of BROAD is .2 deg off, at 5 Hz (-2.8e-4) 1.2 deg.
VISION_FILTER = scalar(
    "vision_filter",
    "s^2",
    5e-5,
    "Low-pass of vision: half the second moment of its impulse response, less the gyro's.",
    "camera.filter",
    valid_below=5e-5,
)
# A tenth of a degree: distortion, tag sizes and hidden markers.
VISION_MAP = error_map("vision_map", "xyz", 1.75e-3, "Error of vision about {first} that depends on the attitude.")
# In the order in which simulators draw their values: a new one is the last, or every seed has other ones.
NUISANCE = (
    *(*SCALE, SENSITIVITY, PLATFORM_BIAS, *PLATFORM_SCALE),
    *(CLOCK_SKEW, VISION_SCALE, GYRO_SLOPE, VISION_FILTER),
)
PARAMETERS = (BIAS, HELMET, CAMERA, OFFSET, *NUISANCE, DEAD_BAND, VISION_MAP)
# Those of the pictures, behind the time offset, in the order of the factor's columns.
PICTURE_SPECS = tuple(next(spec for spec in NUISANCE if spec.name == name) for name in PICTURE_ERRORS[1:])


@dataclass(frozen=True)
class HeadParameters:
    """Variables that all measurements share.

    Attributes:
        bias: the helmet gyro's (3), rad/s, its first node.
        helmet, camera: vRh, cRb.
        picture: the time offset alone, or all of PICTURE_ERRORS.
        gyro: S of the helmet's gyro and what its drivers do, see alidade.factors.gyro; None for a perfect one.
        platform: bias and S of the platform's gyro (9); None for a perfect one, or none.
    """

    bias: Parameter
    helmet: Parameter
    camera: Parameter
    picture: Parameter
    gyro: Parameter | None
    platform: Parameter | None

    @classmethod
    def of(
        cls,
        config: Config,
        platform: bool,
        drivers: Sequence[ParameterSpec],
        stamp_sigma: float = 0.0,
        all_around: bool = False,
    ) -> HeadParameters:
        """Build the parameters with the priors of the config; without a moving platform the camera is fixed by default.

        Motion capture has no scale of its angles, unless the config says something of it.

        Args:
            platform: whether there is a platform gyro.
            drivers: SENSITIVITY, GYRO_SLOPE and DEAD_BAND, in this order, where the helmet's IMU has their causes.
            stamp_sigma: s, how well the stamps are known.
            all_around: whether vision shows the helmet turned by half a turn: no scale of its angles but 1 is
                continuous there, so that it is fixed unless the config says something of it.
        """
        refuse_gyro_scale("head", config)
        unscaled = all_around or config.vision.kind == "mocap"
        if unscaled and "scale" not in config.sensors.camera.model_fields_set:
            config = config.model_copy(update={"priors": {"vision_scale": 0.0, **config.priors}})
        check_parameters(PARAMETERS, config)
        mounts = quantities(HELMET, config), quantities(CAMERA, config, fixed=not platform)
        clock = parameter(gtsam.symbol("T", 0), PICTURE_SPECS, config)
        return cls(
            bias=Parameter(FIRST_BIAS, quantities(BIAS, config, extra_sigma=0.0 if platform else EARTH_RATE)),
            helmet=Parameter(gtsam.symbol("H", 0), mounts[0], rotation_vector_coordinates),
            camera=Parameter(gtsam.symbol("C", 0), mounts[1], rotation_vector_coordinates),
            picture=Parameter(
                gtsam.symbol("T", 0),
                (*quantities(OFFSET, config, extra_sigma=stamp_sigma), *(clock.quantities if clock else ())),
            ),
            gyro=gyro_errors(gtsam.symbol("G", 0), SCALE, drivers, config),
            platform=parameter(gtsam.symbol("P", 0), (PLATFORM_BIAS, *PLATFORM_SCALE), config) if platform else None,
        )

    @property
    def has_picture_errors(self) -> bool:
        """Whether the pictures have error parameters other than the time offset."""
        return len(self.picture.quantities) > 1

    @property
    def all(self) -> tuple[Parameter, ...]:
        """All parameters in reporting order."""
        found = (self.bias, self.helmet, self.camera, self.picture, self.gyro, self.platform)
        return tuple(each for each in found if each is not None)
