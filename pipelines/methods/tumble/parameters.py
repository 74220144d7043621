"""Parameters of the tumble method: names, units, priors and required accuracy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.ellipsoid import entries
from alidade.pipelines.estimation.parameters import check_parameters, quantities
from alidade.pipelines.estimation.priors import prior_sigmas, vector_about
from alidade.pipelines.estimation.problem import Factor, Parameter, Quantity
from alidade.pipelines.methods.triads import MAG_SHAPE, with_factor
from alidade.pipelines.methods.tumble import PARAMETERS
from alidade.pipelines.methods.tumble.first_guess import ACCEL_OFFSET, GAIN, OFFSET
from alidade.pipelines.methods.tumble.model import Model, Sensor, nearest_axes
from alidade.pipelines.methods.tumble.turning import EARTH
from alidade.pipelines.settings import Config

TRIAD_KEYS = {"accel": int(gtsam.symbol("A", 0)), "mag": int(gtsam.symbol("M", 0))}
STRENGTH_KEYS = {"accel": int(gtsam.symbol("g", 0)), "mag": int(gtsam.symbol("f", 0))}
DIP_KEY, SLOPE_KEY = (int(gtsam.symbol(letter, 0)) for letter in "iJ")
STRENGTHS = {"accel": "gravity", "mag": "field_strength"}
_DIP = "field_dip"

# Prior of a dip without a model, rad.
_ANY_DIP = 1.0
# A strength that is known, over itself, where it is set free.
_ANY_STRENGTH = 1e-2
# Accuracies wanted: of gains and of b over the strength; of the dip, rad.
_REQUIRE_GAIN, _REQUIRE_BIAS, _REQUIRE_DIP = 5e-3, {"accel": 2e-3, "mag": 1e-2}, 2e-2


@dataclass(frozen=True)
class Variable:
    """Graph variable with its parameter, initial value, and dimensionless prior mean and sigma."""

    parameter: Parameter
    start: Array
    mean: Array
    sigma: Array

    @property
    def prior(self) -> Factor:
        """Prior factor of the variable."""
        return vector_about(self.parameter.key, self.mean, self.sigma)


def variables(model: Model, config: Config) -> tuple[Variable, ...]:
    """Variables of triads, strengths, dip and offset drivers in reporting order; gyro ones in `turning.parameters`.

    Raises InputError when the config names no such parameter.
    """
    check_parameters(PARAMETERS, config, EARTH, [MAG_SHAPE])
    found = [_triad(sensor, config) for sensor in model.sensors]
    found += [_strength(sensor, config) for sensor in model.sensors]
    if model.dip is not None:
        mean, sigma = model.dip.model or (0.0, _ANY_DIP)
        wanted = config.require.get(_DIP, _REQUIRE_DIP)
        known = config.prior(_DIP, sigma)
        quantity = Quantity(_DIP, "rad", known, sigma or _ANY_DIP, wanted, prior_mean=mean, nuisance=True)
        found.append(_variable(DIP_KEY, (quantity,), np.ones(1), np.array([model.dip.start])))
    for sensor in model.sensors:
        if sensor.driven:
            numbers = tuple(q for each in sensor.driven for q in quantities(each, config))
            scales = np.full(len(numbers), sensor.strength)
            found.append(_variable(SLOPE_KEY, numbers, scales, np.zeros(len(numbers))))
    return tuple(found)


def _triad(sensor: Sensor, config: Config) -> Variable:
    gains = len(sensor.start) - 3
    spread = ACCEL_OFFSET if sensor.name == "accel" and sensor.is_si else OFFSET
    mounted = np.concatenate([nearest_axes(sensor.turned).ravel(), np.zeros(3)])
    spread_of = entries(sensor.symmetric)
    mean = sensor.gain * (spread_of.T @ mounted) / spread_of.sum(axis=0)
    sigma = np.repeat([GAIN * sensor.gain, spread], [gains, 3])
    # An offset of many times the strength, as of counts, goes with the gain.
    wide = max(1.0, float(np.linalg.norm(sensor.start[-3:])))
    accuracy = _REQUIRE_GAIN * (1.0 if sensor.unit == "1" else sensor.gain)
    require = np.repeat([accuracy, _REQUIRE_BIAS[sensor.name] * wide], [gains, 3])
    listed = []
    raw = {"accel": "m/s^2", "mag": "T"}[sensor.name] if sensor.is_si else "count"
    units = ["1" if sensor.unit == raw else f"{sensor.unit}/{raw}"] * gains + [sensor.unit] * 3
    for i, (name, unit) in enumerate(zip(sensor.names, units, strict=True)):
        scale = float(sensor.scales[i])
        prior = config.prior(name, scale * float(sigma[i]))
        wanted = config.require.get(name, scale * float(require[i]))
        listed.append(Quantity(name, unit, prior, scale * float(sigma[i]), wanted, prior_mean=scale * float(mean[i])))
    if sensor.name == "mag":
        listed = list(with_factor("mag", listed, config, _REQUIRE_GAIN))
    return _variable(TRIAD_KEYS[sensor.name], tuple(listed), sensor.scales, sensor.start)


def _strength(sensor: Sensor, config: Config) -> Variable:
    """Variable of the measured vector's strength, which no motion separates from the sensor's scale."""
    name, usual = STRENGTHS[sensor.name], sensor.spread or _ANY_STRENGTH * sensor.strength
    quantity = Quantity(
        name,
        sensor.unit,
        config.prior(name, sensor.spread),
        usual,
        config.require.get(name, math.inf),
        prior_mean=sensor.strength,
        group="assumption",
    )
    found = with_factor("mag", (quantity,), config, _REQUIRE_GAIN) if sensor.name == "mag" else (quantity,)
    return _variable(STRENGTH_KEYS[sensor.name], found, np.array([sensor.strength]), np.ones(1))


def _variable(key: int, quantities: tuple[Quantity, ...], scales: Array, start: Array) -> Variable:
    parameter = Parameter(key, quantities, partial(_scaled, scales))
    mean = np.array([q.prior_mean for q in quantities]) / scales
    return Variable(parameter, start, mean, prior_sigmas(parameter) / scales)


def _scaled(scales: Array, values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """Reported numbers of a dimensionless variable, and their Jacobian."""
    return scales * np.asarray(values.atVector(key), dtype=float), np.diag(scales)
