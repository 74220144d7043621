"""What the head method calibrates and what it assumes: names, priors and accuracies of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import gtsam

from alidade.factors.earth import EARTH_RATE
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.assumptions import (
    Assumption,
    gyro_errors,
    parameter,
    quantities,
    scale_assumptions,
    sensitivity_assumption,
    temperature_assumption,
)
from alidade.pipelines.estimation.problem import Parameter, Quantity, rotation_vector_coordinates
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.settings import Config, check_names

BIAS, HELMET, CAMERA, OFFSET = "gyro_bias", "helmet_mount", "camera_mount", "time_offset"

# The grades of real-sensor data sheets, one sigma: MEMS gyros, uncalibrated, and a platform's of 10 deg/h.
SCALE = scale_assumptions("gyro", "gyro", 1e-2)
SENSITIVITY = sensitivity_assumption("gyro", "gyro", 1e-4)
TEMPERATURE = temperature_assumption("gyro", "rad/s", 1e-4)
PLATFORM_BIAS = Assumption(tuple(f"platform_bias_{axis}" for axis in "xyz"), "rad/s", "platform_gyro", "bias", 5e-5)
PLATFORM_SCALE = scale_assumptions("platform", "platform_gyro", 1e-2)
CLOCK_SKEW = Assumption(("clock_skew",), "", "clock", "skew", 1e-4)
VISION_SCALE = Assumption(("vision_scale",), "", "camera", "scale", 3e-3)
# Half the square of 10 ms, what impulse responses of trackers and gyros differ by.
VISION_FILTER = Assumption(("vision_filter",), "s^2", "camera", "filter", 5e-5)
PICTURES = (CLOCK_SKEW, VISION_SCALE, VISION_FILTER)
ASSUMPTIONS = (
    *(*SCALE, SENSITIVITY, PLATFORM_BIAS, *PLATFORM_SCALE),
    *(CLOCK_SKEW, VISION_SCALE, TEMPERATURE, VISION_FILTER),
)


@dataclass(frozen=True)
class HeadParameters:
    """The variables that all measurements share.

    Attributes:
        bias: the helmet gyro's (3), rad/s, its first node.
        helmet, camera: vRh, cRb.
        picture: time offset alone, or with clock skew, vision scale and filter.
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
        drivers: Sequence[Assumption],
        stamp_sigma: float = 0.0,
        all_around: bool = False,
    ) -> HeadParameters:
        """With the priors in force; a camera without a moving platform is fixed by default.

        Motion capture has no scale of its angles, unless the config says something of it.

        Args:
            config: priors, data sheets, accuracies wanted.
            platform: whether there is a platform gyro.
            drivers: SENSITIVITY and TEMPERATURE, in this order, where the helmet's IMU measures their causes.
            stamp_sigma: s, how well the stamps are known.
            all_around: whether vision shows the helmet turned by half a turn: no scale of its angles but 1 is
                continuous there, so that it is fixed unless the config says something of it.
        """
        if config.noise.gyro_scale:
            figure = config.noise.gyro_scale
            raise InputError(
                f"noise.gyro_scale: head estimates the gyro's scale; write sensors: {{gyro: {{scale: {figure:g}, "
                f"skew: {figure:g}}}}} instead"
            )

        def quantity(name: str, unit: str, scale: float, require: float, fixed: bool, extra: float) -> Quantity:
            prior = config.prior(name, 0.0 if fixed else scale)
            return Quantity(name, unit, prior, scale, config.require.get(name, require), extra)

        def triple(
            name: str, unit: str, scale: float, require: float, fixed: bool = False, extra: float = 0.0
        ) -> tuple[Quantity, ...]:
            return tuple(quantity(f"{name}_{axis}", unit, scale, require, fixed, extra) for axis in "xyz")

        bias = triple(BIAS, "rad/s", 0.05, 2e-3, extra=0.0 if platform else EARTH_RATE)
        mounts = triple(HELMET, "rad", 0.35, 1e-2), triple(CAMERA, "rad", 0.35, 1e-2, fixed=not platform)
        offset = quantity(OFFSET, "s", 0.05, 5e-3, False, stamp_sigma)
        unscaled = all_around or config.vision.kind == "mocap"
        if unscaled and "scale" not in config.sensors.camera.model_fields_set:
            config = config.model_copy(update={"priors": {"vision_scale": 0.0, **config.priors}})
        assumed = chain.from_iterable(quantities(each, config) for each in ASSUMPTIONS)
        known = [q.name for q in (*bias, *mounts[0], *mounts[1], offset, *assumed)]
        check_names(config.priors, known, "priors")
        check_names(config.require, known, "require")

        clock = parameter(_key("T"), PICTURES, config)
        return cls(
            bias=Parameter(FIRST_BIAS, bias),
            helmet=Parameter(_key("H"), mounts[0], rotation_vector_coordinates),
            camera=Parameter(_key("C"), mounts[1], rotation_vector_coordinates),
            picture=Parameter(_key("T"), (offset, *(clock.quantities if clock else ()))),
            gyro=gyro_errors(_key("G"), SCALE, drivers, config),
            platform=parameter(_key("P"), (PLATFORM_BIAS, *PLATFORM_SCALE), config) if platform else None,
        )

    @property
    def clock(self) -> bool:
        """Whether clock skew, vision scale and filter are variables."""
        return len(self.picture.quantities) > 1

    @property
    def all(self) -> tuple[Parameter, ...]:
        """In reporting order."""
        found = (self.bias, self.helmet, self.camera, self.picture, self.gyro, self.platform)
        return tuple(each for each in found if each is not None)


def _key(letter: str) -> int:
    return int(gtsam.symbol(letter, 0))
