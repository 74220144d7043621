"""The parameters of the indexer method: their names, variables and priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from pipelines.graph.problem import Array, Parameter, Quantity
from pipelines.graph.walking_bias import FIRST as FIRST_BIAS
from pipelines.settings import Config, check_names

THETA = ("theta_x", "theta_y", "theta_z")
BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
SCALE = ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")
EPSILON = ("axis_nonperpendicularity",)
NAMES = (*THETA, *BIAS, *SCALE, *EPSILON)

KEYS: dict[str, int] = {
    name: int(gtsam.symbol(c, 0)) for name, c in zip(("theta", "scale", "epsilon"), "TSE", strict=True)
}

# The variable theta counts these, rad: a smoother linearises anew when a variable has moved by some hundredth, and
# angles that earlier turns left open by as much as their prior have to be followed to the arc second.
THETA_UNIT = 1e-3


def indexer_parameters(config: Config) -> tuple[Parameter, ...]:
    """The method's parameters with their priors; options only where the config gives them a prior other than 0."""
    check_names(config.priors, NAMES, "priors")
    check_names(config.require, NAMES, "require")

    def several(names: Sequence[str], unit: str, scale: float, require: float, default: float) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(name, unit, config.priors.get(name, default), scale, config.require.get(name, require))
            for name in names
        )

    parameters = [
        Parameter(KEYS["theta"], several(THETA, "rad", 0.1, 5e-5, 0.1), theta_coordinates),
        Parameter(FIRST_BIAS, several(BIAS, "rad/s", 1e-3, 1e-5, 1e-3)),
    ]
    if any(config.priors.get(name, 0.0) != 0.0 for name in SCALE):
        parameters.append(Parameter(KEYS["scale"], several(SCALE, "1", 0.01, 1e-3, 0.0)))
    if config.priors.get(EPSILON[0], 0.0) != 0.0:
        parameters.append(Parameter(KEYS["epsilon"], several(EPSILON, "rad", 1e-2, 5e-5, 0.0)))
    return tuple(parameters)


def theta_coordinates(values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """The angles in rad."""
    return THETA_UNIT * np.asarray(values.atVector(key)), THETA_UNIT * np.eye(3)


def several(values: Mapping[str, float], names: Sequence[str]) -> Array:
    """Parameters by name as an array; those that are not given are zero."""
    return np.array([values.get(name, 0.0) for name in names])
