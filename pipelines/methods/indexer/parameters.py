"""Parameters of the indexer method: mounting angles, gyro bias, and errors of gyro, encoders and axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.parameters import (
    ParameterSpec,
    check_parameters,
    encoder_errors,
    gyro_bias,
    gyro_scale,
    parameter,
    quantities,
    scalar,
    stamped,
)
from alidade.pipelines.estimation.problem import Parameter
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.indexer.recording import JOINTS
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.settings import Config

MOUNT = ParameterSpec("theta", "rad", 0.1, "IMU misalignment about {axis} of the platform.", require=5e-5)
GYRO_BIAS = gyro_bias(1e-3, 1e-5)
# Assumed only where the config gives it a prior.
TILT = scalar("axis_nonperpendicularity", "rad", 1e-2, "Non-perpendicularity of inner and outer axis.")

# What data sheets of navigation-grade sensors state, one sigma: fibre-optic or laser gyros after factory calibration,
# axes that turn with encoders of some arc seconds.
SCALE, SKEW = gyro_scale("gyro", "gyro", 1e-4, 2e-5)
ONCE_PER_TURN, DELAY = encoder_errors(JOINTS, 5e-6, 1e-3)
NUISANCE = (SCALE, SKEW, ONCE_PER_TURN, DELAY, GYRO_SLOPE)
PARAMETERS = (MOUNT, GYRO_BIAS, *NUISANCE, TILT)
THETA, BIAS, EPSILON = MOUNT.names, GYRO_BIAS.names, TILT.names
ERRORS, ENCODER = (*SCALE.names, *SKEW.names), (*ONCE_PER_TURN.names, *DELAY.names)

KEYS: dict[str, int] = {
    name: int(gtsam.symbol(c, 0))
    for name, c in zip(("theta", "errors", "temperature", "encoder", "epsilon"), "TSKNE", strict=True)
}

# The variable theta counts these, rad: a smoother linearises anew when a variable has moved by some hundredth, and
# angles that earlier turns left open by as much as their prior have to be followed to the arc second.
THETA_UNIT = 1e-3


def indexer_parameters(config: Config, stamp_sigma: float = 0.0, thermometer: bool = False) -> tuple[Parameter, ...]:
    """Parameters of the method with their priors in force, without fully fixed nuisance parameters.

    That the axes are not perpendicular is assumed only where the config gives it a prior. `stamp_sigma`, s: how well
    the stamps are known; `thermometer`: whether the IMU's temperature is measured.
    """
    check_parameters(PARAMETERS, config)
    axes = tuple(replace(q, group="assumption") for q in quantities(TILT, config, fixed=True))
    found = (
        Parameter(KEYS["theta"], quantities(MOUNT, config), theta_coordinates),
        Parameter(FIRST_BIAS, quantities(GYRO_BIAS, config)),
        parameter(KEYS["errors"], (SCALE, SKEW), config),
        parameter(KEYS["temperature"], (GYRO_SLOPE,), config) if thermometer else None,
        stamped(parameter(KEYS["encoder"], (ONCE_PER_TURN, DELAY), config), DELAY.names[0], stamp_sigma),
        Parameter(KEYS["epsilon"], axes) if any(q.prior_sigma != 0.0 for q in axes) else None,
    )
    return tuple(each for each in found if each is not None)


def theta_coordinates(values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """Coordinates of the mounting variable: its angles, rad."""
    return THETA_UNIT * np.asarray(values.atVector(key)), THETA_UNIT * np.eye(3)


def several(values: Mapping[str, float], names: Sequence[str]) -> Array:
    """Array of parameters by name; missing ones are zero."""
    return np.array([values.get(name, 0.0) for name in names])
