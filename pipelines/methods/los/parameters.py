"""What the los method calibrates and what it assumes: names, variables, priors and accuracies of the contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.assumptions import (
    Assumption,
    encoder_assumptions,
    gyro_errors,
    parameter,
    quantities,
    scale_assumptions,
    sensitivity_assumption,
    stamped,
    temperature_assumption,
)
from alidade.pipelines.estimation.problem import Parameter, Quantity
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.los.topics import JOINTS
from alidade.pipelines.settings import Config, check_names

_ANGLES = ("delta_px", "delta_gx", "delta_gy")
SPLIT = ("delta_pz", "delta_gz")
BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
OFFSET = "time_offset"

# What data sheets state, one sigma: good MEMS gyros after factory calibration, a camera whose focal length was measured
# roughly, machined gimbals.
SCALE = scale_assumptions("gyro", "gyro", 3e-3)
SENSITIVITY = sensitivity_assumption("gyro", "gyro", 2e-5)
TEMPERATURE = temperature_assumption("gyro", "rad/s", 1e-4)
ROLL = Assumption(("camera_roll",), "rad", "camera", "roll", 1e-2)
COLLIMATION = Assumption(("collimation",), "rad", "gimbal", "collimation", 1e-3)
AXES = Assumption(("axis_nonperpendicularity",), "rad", "gimbal", "nonperpendicularity", 1e-3)
TIME_OFFSET = Assumption((OFFSET,), "s", "clock", "offset", 1e-2)
CLOCK_SKEW = Assumption(("clock_skew",), "", "clock", "skew", 1e-4)
LOS_SCALE = Assumption(("los_scale",), "", "camera", "scale", 5e-3)
TARGET_RATE = Assumption(("target_rate_x", "target_rate_z"), "rad/s", "target", "rate", 1e-5)
ONCE_PER_TURN, DELAY = encoder_assumptions(JOINTS, 2e-4, 1e-3)

# Of the mounting, one by one; and those of alidade.factors.los.SIGHT_ERRORS, in its order.
MOUNTED, SIGHT = (ROLL, COLLIMATION, AXES), (TIME_OFFSET, CLOCK_SKEW, LOS_SCALE, TARGET_RATE, ONCE_PER_TURN, DELAY)
ASSUMPTIONS = (*SCALE, SENSITIVITY, *MOUNTED, *SIGHT, TEMPERATURE)
# The angles by which gyro, gimbal axes and camera are mounted.
ANGLES = (*_ANGLES, "delta_z", *SPLIT, *(name for each in MOUNTED for name in each.names))

_PRIOR_ANGLE, _PRIOR_BIAS, _REQUIRE = 0.1, 0.02, 1e-3


@dataclass(frozen=True)
class LosParameters:
    """The variables that all measurements share.

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
    def of(cls, config: Config, drivers: Sequence[Assumption], stamp_sigma: float = 0.0) -> LosParameters:
        """With the priors in force.

        Args:
            config: priors, data sheets, accuracies wanted.
            drivers: SENSITIVITY and TEMPERATURE, in this order, where the gyro's IMU measures their causes.
            stamp_sigma: s, how well the stamps are known.
        """
        if config.noise.gyro_scale:
            figure = config.noise.gyro_scale
            raise InputError(
                f"noise.gyro_scale: los estimates the gyro's scale; write sensors: {{gyro: {{scale: {figure:g}, "
                f"skew: {figure:g}}}}} instead"
            )
        assumed = {q.name: q for each in ASSUMPTIONS for q in quantities(each, config)}
        known = (*_ANGLES, "delta_z", *SPLIT, *BIAS, *assumed)
        check_names(config.priors, known, "priors")
        check_names(config.require, known, "require")
        given = [name for name in SPLIT if name in config.priors]
        if len(given) == 1:
            raise InputError(f"priors: {given[0]} alone; delta_pz and delta_gz are given both, or neither for delta_z")

        def calibrated(names: Sequence[str], unit: str, scale: float) -> tuple[Quantity, ...]:
            return tuple(
                Quantity(name, unit, config.prior(name, scale), scale, config.require.get(name, _REQUIRE))
                for name in names
            )

        angles = calibrated((*_ANGLES, *(SPLIT if given else ("delta_z",))), "rad", _PRIOR_ANGLE)
        mounted = tuple(assumed[name] for each in MOUNTED for name in each.names if assumed[name].prior_sigma != 0.0)
        return cls(
            angles=Parameter(_key("a"), (*angles, *mounted)),
            bias=Parameter(FIRST_BIAS, calibrated(BIAS, "rad/s", _PRIOR_BIAS)),
            sight=stamped(parameter(_key("S"), SIGHT, config), OFFSET, stamp_sigma),
            gyro=gyro_errors(_key("G"), SCALE, drivers, config),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The mounting angles that are variables."""
        return tuple(q.name for q in self.angles.quantities)

    @property
    def all(self) -> tuple[Parameter, ...]:
        """In reporting order."""
        return tuple(each for each in (self.angles, self.bias, self.sight, self.gyro) if each is not None)


def _key(letter: str) -> int:
    return int(gtsam.symbol(letter, 0))
