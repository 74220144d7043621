"""Assumptions: systematic effects of real sensors as parameters of the graph, with priors as data sheets state them.

What a recording determines of such an effect is estimated; what it does not determine enlarges the sigmas of what it
trades with. A method lists its `Assumption`s and makes variables of them with `parameter`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.pipelines.estimation.problem import Array, Findings, Parameter, Quantity
from alidade.pipelines.settings import Config

# What is left free has a prior so many times the one in force.
_FREE = 10.0
# A sigma of more than this part of its prior's says nothing, one of less than that determines it.
_UNTOLD = 0.98

# What the names of numbers of one kind differ by.
_NUMBERS = re.compile(r"(_[xyzenu]{1,2})?(_sin|_cos)?$")


@dataclass(frozen=True)
class Assumption:
    """Numbers that one figure of a data sheet is about.

    Attributes:
        names: of the parameters, which are 0 for a perfect sensor.
        unit: SI.
        sheet: the sensor, as under `sensors` in the config.
        figure: of that sensor, likewise.
        sigma: the figure of a sensor of the usual grade, one sigma.
    """

    names: tuple[str, ...]
    unit: str
    sheet: str
    figure: str
    sigma: float


def scale_assumptions(
    sensor: str, sheet: str, sigma: float, skew_sigma: float | None = None
) -> tuple[Assumption, Assumption]:
    """The six numbers of a gyro's S, in the order of factors.gyro: measured = (I + S) w; skew as scale if not given."""
    skew_sigma = sigma if skew_sigma is None else skew_sigma
    return (
        Assumption(tuple(f"{sensor}_scale_{axis}" for axis in "xyz"), "", sheet, "scale", sigma),
        Assumption(tuple(f"{sensor}_skew_{axes}" for axes in ("xy", "xz", "yz")), "", sheet, "skew", skew_sigma),
    )


def sensitivity_assumption(sensor: str, sheet: str, sigma: float) -> Assumption:
    """The nine numbers of a gyro's G, by rows: measured = w + G f."""
    names = tuple(f"{sensor}_g_{row}{column}" for row in "xyz" for column in "xyz")
    return Assumption(names, "rad/s/(m/s^2)", sheet, "g_sensitivity", sigma)


def temperature_assumption(sensor: str, unit: str, sigma: float) -> Assumption:
    """The three slopes of a sensor's bias over its temperature, `unit`/K."""
    names = tuple(f"{sensor}_temperature_{axis}" for axis in "xyz")
    return Assumption(names, f"{unit}/K", sensor, "temperature", sigma)


def encoder_assumptions(joints: Sequence[str], once_per_turn: float, delay: float) -> tuple[Assumption, Assumption]:
    """Sine and cosine of each encoder's error once a turn, rad, and the delay of their readings, s; one sigma."""
    names = tuple(f"encoder_{joint}_{part}" for joint in joints for part in ("sin", "cos"))
    return (
        Assumption(names, "rad", "encoder", "once_per_turn", once_per_turn),
        Assumption(("encoder_delay",), "s", "encoder", "delay", delay),
    )


def kind(name: str) -> str:
    """What a parameter is about: its name without axes, and without sine and cosine."""
    return _NUMBERS.sub("", name)


def quantities(assumption: Assumption, config: Config) -> tuple[Quantity, ...]:
    """With the priors in force: the config's `priors`, else its `sensors`, else the usual grade's."""
    sheet = stated(config, assumption)
    usual = sheet or assumption.sigma

    def quantity(name: str) -> Quantity:
        prior = config.prior(name, sheet)
        if prior is None:
            prior = _FREE * usual
        figure = f"{assumption.sheet}.{assumption.figure}"
        require = config.require.get(name, math.inf)
        return Quantity(name, assumption.unit, prior, usual, require, group="assumption", sheet=figure)

    return tuple(map(quantity, assumption.names))


def parameter(key: int, assumptions: Sequence[Assumption], config: Config) -> Parameter | None:
    """One variable of several assumptions; None if all are fixed, so that the graph can do without."""
    all_of_them = tuple(q for assumption in assumptions for q in quantities(assumption, config))
    return Parameter(key, all_of_them) if any(q.prior_sigma for q in all_of_them) else None


def gyro_errors(
    key: int, scale: Sequence[Assumption], drivers: Sequence[Assumption], config: Config
) -> Parameter | None:
    """One variable of a gyro's errors, see factors.gyro: S and, in this order, what of its drivers is not all fixed."""
    return parameter(key, (*scale, *(each for each in drivers if parameter(key, (each,), config))), config)


def acting(errors: Parameter | None, drivers: Mapping[Assumption, Array | None]) -> Array | None:
    """Those of a gyro's drivers that its errors act on, side by side, (N, d): of (N, 3) and (N,); None: none."""
    names = {q.name for q in errors.quantities} if errors else set()
    found = [driver for each, driver in drivers.items() if driver is not None and each.names[0] in names]
    alone = len(found) == 1 and found[0].ndim == 2
    return found[0] if alone else np.column_stack(found) if found else None


def stamped(parameter: Parameter | None, name: str, sigma: float) -> Parameter | None:
    """The variable with the sigma of stamps, s, where log times stand in for them, in one of its numbers: a delay.

    How late log times are nobody knows: that is part of what the delay may be, and of what it may be off.
    """

    def known(q: Quantity) -> Quantity:
        if q.name != name or not q.prior_sigma:
            return q
        return replace(q, prior_sigma=math.hypot(q.prior_sigma, sigma), extra_sigma=sigma)

    return parameter and replace(parameter, quantities=tuple(map(known, parameter.quantities)))


def fixed_without_force(assumption: Assumption, config: Config, topic: str) -> Findings:
    """The row of `fixed_assumptions` of a g-sensitivity that an Imu without acceleration gives no hold on."""
    if parameter(0, (assumption,), config) is None:
        return {}
    names = f"{assumption.names[0]} to {assumption.names[-1]}"
    return {"fixed_assumptions": [{"parameters": names, "value": 0.0, "why": f"{topic} has no acceleration"}]}


def pull(quantity: Quantity, value: float, sigma: float, inflation: float = 1.0) -> float | None:
    """How far the recording takes an assumption from its prior, in sigmas of what it could; None if it says nothing.

    With s = sigma / inflation, p the prior's sigma and V = sigma^2 - (s^2 / p)^2 what comes from elsewhere than from
    the prior, the estimate's change from the prior has the variance (p - s^2 / p)^2 + V; for white noise p^2 - s^2.

    Args:
        quantity: the assumption.
        value, sigma: its estimate.
        inflation: by what sigma is larger because noise is coloured.
    """
    prior, white = quantity.prior_sigma or 0.0, sigma / inflation
    if white > _UNTOLD * prior or prior == 0.0:
        return None
    elsewhere = sigma**2 - (white**2 / prior) ** 2
    return (value - quantity.prior_mean) / math.sqrt((prior - white**2 / prior) ** 2 + elsewhere)


def stated(config: Config, assumption: Assumption) -> float:
    """The figure in force, one sigma: the config's `sensors`, else the usual grade's."""
    sheet = getattr(config.sensors, assumption.sheet)
    if assumption.figure not in sheet.model_fields_set:
        return assumption.sigma
    figure: float | None = getattr(sheet, assumption.figure)
    return _FREE * assumption.sigma if figure is None else figure
