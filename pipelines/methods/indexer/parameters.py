"""What the indexer method calibrates and what it assumes: names, variables, priors and accuracies of the contract."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import chain

import gtsam
import numpy as np

from alidade.pipelines.estimation.assumptions import (
    encoder_assumptions,
    parameter,
    quantities,
    scale_assumptions,
    stamped,
    temperature_assumption,
)
from alidade.pipelines.estimation.problem import Array, Parameter, Quantity
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.indexer.topics import JOINTS
from alidade.pipelines.settings import Config, check_names

THETA = ("theta_x", "theta_y", "theta_z")
BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
EPSILON = ("axis_nonperpendicularity",)

# What data sheets of navigation-grade sensors state, one sigma: fibre-optic or laser gyros after factory calibration,
# axes that turn with encoders of some arc seconds.
SCALE, SKEW = scale_assumptions("gyro", "gyro", 1e-4, 2e-5)
ONCE_PER_TURN, DELAY = encoder_assumptions(JOINTS, 5e-6, 1e-3)
TEMPERATURE = temperature_assumption("gyro", "rad/s", 1e-4)
ASSUMPTIONS = (SCALE, SKEW, ONCE_PER_TURN, DELAY, TEMPERATURE)
ERRORS, ENCODER = (*SCALE.names, *SKEW.names), (*ONCE_PER_TURN.names, *DELAY.names)

KEYS: dict[str, int] = {
    name: int(gtsam.symbol(c, 0))
    for name, c in zip(("theta", "errors", "temperature", "encoder", "epsilon"), "TSKNE", strict=True)
}

# The variable theta counts these, rad: a smoother linearises anew when a variable has moved by some hundredth, and
# angles that earlier turns left open by as much as their prior have to be followed to the arc second.
THETA_UNIT = 1e-3


def indexer_parameters(config: Config, stamp_sigma: float = 0.0, thermometer: bool = False) -> tuple[Parameter, ...]:
    """The method's parameters with their priors in force; of the assumptions those that are not all fixed.

    That the axes are not perpendicular is assumed only where the config gives it a prior. `stamp_sigma`, s: how well
    the stamps are known; `thermometer`: whether the IMU's temperature is measured.
    """
    assumed = chain.from_iterable(quantities(each, config) for each in ASSUMPTIONS)
    known = [*THETA, *BIAS, *(q.name for q in assumed), *EPSILON]
    check_names(config.priors, known, "priors")
    check_names(config.require, known, "require")

    def calibrated(names: Sequence[str], unit: str, scale: float, require: float) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(name, unit, config.prior(name, scale), scale, config.require.get(name, require)) for name in names
        )

    axes = tuple(
        Quantity(name, "rad", config.prior(name, 0.0), 1e-2, config.require.get(name, math.inf), group="assumption")
        for name in EPSILON
    )
    found = (
        Parameter(KEYS["theta"], calibrated(THETA, "rad", 0.1, 5e-5), theta_coordinates),
        Parameter(FIRST_BIAS, calibrated(BIAS, "rad/s", 1e-3, 1e-5)),
        parameter(KEYS["errors"], (SCALE, SKEW), config),
        parameter(KEYS["temperature"], (TEMPERATURE,), config) if thermometer else None,
        stamped(parameter(KEYS["encoder"], (ONCE_PER_TURN, DELAY), config), DELAY.names[0], stamp_sigma),
        Parameter(KEYS["epsilon"], axes) if any(q.prior_sigma != 0.0 for q in axes) else None,
    )
    return tuple(each for each in found if each is not None)


def theta_coordinates(values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """The angles in rad."""
    return THETA_UNIT * np.asarray(values.atVector(key)), THETA_UNIT * np.eye(3)


def several(values: Mapping[str, float], names: Sequence[str]) -> Array:
    """Parameters by name as an array; those that are not given are zero."""
    return np.array([values.get(name, 0.0) for name in names])
