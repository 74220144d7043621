"""The parameters of the los method: their names, variables and priors."""

from __future__ import annotations

import gtsam

from pipelines.errors import InputError
from pipelines.graph.problem import Parameter, Quantity
from pipelines.graph.walking_bias import FIRST as FIRST_BIAS
from pipelines.settings import Config, check_names

_ANGLES = ("delta_px", "delta_gx", "delta_gy")
SPLIT = ("delta_pz", "delta_gz")
_OPTIONS = ("camera_roll", "collimation", "axis_nonperpendicularity")
BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
OFFSET = "time_offset"
# Everything but gyro bias and time offset: the angles by which gyro, gimbal axes and camera are mounted.
ANGLES = (*_ANGLES, "delta_z", *SPLIT, *_OPTIONS)
NAMES = (*ANGLES, *BIAS, OFFSET)

ANGLES_KEY, OFFSET_KEY = int(gtsam.symbol("a", 0)), int(gtsam.symbol("T", 0))
_PRIOR_ANGLE, _PRIOR_BIAS, _PRIOR_OFFSET = 0.1, 0.02, 0.05


def los_parameters(config: Config) -> tuple[Parameter, ...]:
    """The method's parameters with their priors; options only where the config gives them a prior other than 0."""
    check_names(config.priors, NAMES, "priors")
    check_names(config.require, NAMES, "require")
    given = [name for name in SPLIT if name in config.priors]
    if len(given) == 1:
        raise InputError(f"priors: {given[0]} alone; delta_pz and delta_gz are given both, or neither for delta_z")

    def quantity(name: str, unit: str, scale: float) -> Quantity:
        return Quantity(name, unit, config.priors.get(name, scale), scale, config.require.get(name, 1e-3))

    names = (*_ANGLES, *(SPLIT if given else ("delta_z",)), *(n for n in _OPTIONS if config.priors.get(n, 0.0) != 0.0))
    parameters = [
        Parameter(ANGLES_KEY, tuple(quantity(name, "rad", _PRIOR_ANGLE) for name in names)),
        Parameter(FIRST_BIAS, tuple(quantity(name, "rad/s", _PRIOR_BIAS) for name in BIAS)),
    ]
    if config.priors.get(OFFSET, 0.0) != 0.0:
        parameters.append(Parameter(OFFSET_KEY, (quantity(OFFSET, "s", _PRIOR_OFFSET),)))
    return tuple(parameters)
