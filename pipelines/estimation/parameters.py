"""Parameters: what is declared of them, and variables of the graph with the priors in force.

    BIAS = ParameterSpec("gyro_bias", "rad/s", 0.05, "Gyro bias about {axis}.", require=2e-3)
    quantities(BIAS, config)        # gyro_bias_x, gyro_bias_y, gyro_bias_z

A spec with a data sheet is a nuisance parameter: an error of real sensors that is 0 in a perfect one. What a recording
determines of it is estimated; what it does not determine enlarges the sigmas of the parameters that it is correlated
with.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.estimation.priors import prior_of
from alidade.pipelines.estimation.problem import (
    ChainLayout,
    Estimate,
    Factor,
    Findings,
    Parameter,
    Problem,
    Quantity,
    Step,
    rotation_vector_coordinates,
    vector_coordinates,
)
from alidade.pipelines.settings import Config, check_names

# The prior of a nuisance parameter that the config sets to null is so many times the usual one.
_FREE = 10.0
# A sigma of more than this part of its prior's says nothing, one of less than that determines it.
_UNINFORMED = 0.98

# What the names of numbers of one kind differ by.
_NUMBERS = re.compile(r"(_p?[xyzenu]{1,2})?(_sin|_cos)?$")

_WORDS = {**dict(zip("123", "xyz", strict=True)), "e": "east", "n": "north", "u": "up", "sin": "sine", "cos": "cosine"}


SENSOR_NAMES = {"accel": "accelerometer", "gyro": "gyro", "mag": "magnetometer"}


@dataclass(frozen=True)
class ParameterSpec:
    """Declaration of a group of parameters that differ by their axis.

    Attributes:
        name: what their names begin with, before _AXIS; or with {} where the axis stands.
        unit: SI.
        prior: default prior sigma; of a nuisance parameter that of a sensor of the usual grade.
        description: a sentence for people; {axis} is the ending of the name, {first} and {last} its two halves.
        data_sheet: sensor and figure under `sensors` in the config, as "gyro.scale"; empty: no nuisance parameter.
        axes: endings of the names; none: there is one parameter, `name`. A * stands for any number.
        require: accuracy wanted, one sigma.
        per_recording: it belongs to a recording; other parameters belong to the device.
        rotation: the rotation whose rotation vector it is, as "vRh"; empty: it is none.
        valid_below: as Quantity has it.
    """

    name: str
    unit: str
    prior: float
    description: str
    data_sheet: str = ""
    axes: Sequence[str] = "xyz"
    require: float = math.inf
    per_recording: bool = False
    rotation: str = ""
    valid_below: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, with * in place of any number."""
        stem = self.name if "{}" in self.name else f"{self.name}_{{}}"
        return tuple(map(stem.format, self.axes)) or (self.name,)

    @property
    def sheet(self) -> str:
        """Key of the sensor under `sensors` in the config."""
        return self.data_sheet.partition(".")[0]

    @property
    def figure(self) -> str:
        """Key of the sensor's data-sheet figure."""
        return self.data_sheet.partition(".")[2]

    def describe(self, name: str) -> str:
        """Description of one of the parameters, as a sentence."""
        axis = name.removeprefix(self.name.partition("{}")[0]).removeprefix("_") if self.axes else ""
        parts = axis.split("_") if "_" in axis else list(axis)
        words = [_WORDS.get(part, part) for part in parts] or [""]
        first = " ".join(words[:-1] or words)
        return self.description.format(axis="".join(words), first=first, last=words[-1])


# One parameter.
scalar = partial(ParameterSpec, axes="")


def spec_of(specs: Iterable[ParameterSpec], name: str) -> ParameterSpec | None:
    """Find the declaration of a parameter; None where there is none."""
    return next((spec for spec in specs if any(fnmatchcase(name, each) for each in spec.names)), None)


def check_parameters(
    specs: Iterable[ParameterSpec], config: Config, more: Sequence[str] = (), derived: Sequence[str] = ()
) -> None:
    """Raise InputError if the config has a prior or a requirement of an unknown parameter.

    `more` are names of parameters that stand for a * of the specs, `derived` what else may be required.
    """
    known = [*(name for spec in specs for name in spec.names if "*" not in name), *more]
    check_names(config.priors, known, "priors")
    check_names(config.require, [*known, *derived], "require")


def gyro_scale(
    sensor: str, sheet: str, sigma: float, skew_sigma: float | None = None, of: str = "Gyro"
) -> tuple[ParameterSpec, ParameterSpec]:
    """Declare a gyro's S, in the order of factors.gyro: measured = (I + S) w; default skew sigma that of scale."""
    skew_sigma = sigma if skew_sigma is None else skew_sigma
    return (
        ParameterSpec(f"{sensor}_scale", "", sigma, f"{of} scale-factor error, {{axis}}.", f"{sheet}.scale"),
        ParameterSpec(
            f"{sensor}_skew",
            "",
            skew_sigma,
            f"{of} non-orthogonality {{axis}} (half the angle error).",
            f"{sheet}.skew",
            axes=("xy", "xz", "yz"),
        ),
    )


def g_sensitivity(sigma: float) -> ParameterSpec:
    """Declare the nine numbers of a gyro's g-sensitivity G, by rows: measured = w + G f."""
    return ParameterSpec(
        "gyro_g",
        "rad/s/(m/s^2)",
        sigma,
        "Gyro g-sensitivity: reading about {first} due to specific force along {last}.",
        "gyro.g_sensitivity",
        axes=tuple(f"{row}{column}" for row in "xyz" for column in "xyz"),
    )


def temperature_slope(sensor: str, unit: str, sigma: float) -> ParameterSpec:
    """Declare the three temperature slopes of a sensor's bias, `unit`/K."""
    return ParameterSpec(
        f"{sensor}_temperature",
        f"{unit}/K",
        sigma,
        f"Temperature slope of the {SENSOR_NAMES[sensor]} bias, {{axis}}.",
        f"{sensor}.temperature",
    )


# Half a degree a second, what devices clear of the noise at rest.
DEAD_BAND = scalar(
    "gyro_dead_band", "rad/s", 1e-2, "Dead band that the gyro subtracts from its rates.", "gyro.dead_band"
)
CLOCK_SKEW = scalar("clock_skew", "", 1e-4, "Clock skew, camera against gyro.", "clock.skew", per_recording=True)


def gyro_bias(prior: float, require: float) -> ParameterSpec:
    """Declare the bias of a gyro, rad/s."""
    return ParameterSpec("gyro_bias", "rad/s", prior, "Gyro bias about {axis}.", require=require, per_recording=True)


def time_offset(prior: float, require: float = math.inf, data_sheet: str = "") -> ParameterSpec:
    """Declare the time offset of pictures, s."""
    text = "Camera time offset (exposure minus stamp, on the gyro's clock)."
    return scalar("time_offset", "s", prior, text, data_sheet, require=require, per_recording=True)


def accel_curvature(square: float, cube: float) -> tuple[ParameterSpec, ParameterSpec]:
    """Declare the three square and three cube terms of an accelerometer, of these prior sigmas.

    It reads u + square u^2 + cube u^3, axis by axis. Of cube u is A f + c; in tumble K has the line that is in the
    cubic term.
    """
    return (
        ParameterSpec(
            "accel_square", "s^2/m", square, "Accelerometer quadratic nonlinearity, {axis}.", "accel.square", axes="123"
        ),
        ParameterSpec(
            "accel_cube", "s^4/m^2", cube, "Accelerometer cubic nonlinearity, {axis}.", "accel.cube", axes="123"
        ),
    )


def error_map(name: str, axes: str, sigma: float, description: str) -> ParameterSpec:
    """Declare the coefficients of an error map of measurements: one for each axis and harmonic, rad."""
    return ParameterSpec(
        name, "rad", sigma, description, "camera.map", axes=[f"{axis}_*" for axis in axes], per_recording=True
    )


def encoder_errors(joints: Sequence[str], once_per_turn: float, delay: float) -> tuple[ParameterSpec, ParameterSpec]:
    """Declare encoder errors: once-per-turn sine and cosine of each joint, rad, and time delay, s, one sigma."""
    return (
        ParameterSpec(
            "encoder",
            "rad",
            once_per_turn,
            "Encoder error once per turn, {first} axis, {last} term.",
            "encoder.once_per_turn",
            axes=tuple(f"{joint}_{part}" for joint in joints for part in ("sin", "cos")),
        ),
        scalar("encoder_delay", "s", delay, "Encoder time delay (true time minus stamp).", "encoder.delay"),
    )


def kind(name: str) -> str:
    """Kind of a parameter: its name without axes, sine and cosine."""
    return _NUMBERS.sub("", name)


def quantities(
    spec: ParameterSpec, config: Config, fixed: bool = False, extra_sigma: float = 0.0
) -> tuple[Quantity, ...]:
    """Quantities with the priors in force: the config's `priors`, else its `sensors`, else the default.

    Args:
        spec: of the parameters.
        config: priors, data sheets, accuracies wanted.
        fixed: whether the default prior of a parameter without data sheet is 0.
        extra_sigma: as Quantity has it.
    """
    sheet = stated(config, spec)

    def quantity(name: str) -> Quantity:
        require = config.require.get(name, spec.require)
        prior = config.prior(name, 0.0 if fixed else sheet)
        if not spec.data_sheet:
            return Quantity(name, spec.unit, prior, spec.prior, require, extra_sigma)
        usual = sheet or spec.prior
        prior = _FREE * usual if prior is None else prior
        figure = "" if name in config.priors else spec.data_sheet
        found = Quantity(name, spec.unit, prior, usual, require, group="assumption", sheet=figure)
        return replace(found, valid_below=spec.valid_below)

    return tuple(map(quantity, spec.names))


def parameter(key: int, specs: Sequence[ParameterSpec], config: Config) -> Parameter | None:
    """Build the graph variable of several specs; None if all their parameters are fixed."""
    all_of_them = tuple(q for spec in specs for q in quantities(spec, config))
    return Parameter(key, all_of_them) if any(q.prior_sigma for q in all_of_them) else None


def gyro_errors(
    key: int, scale: Sequence[ParameterSpec], drivers: Sequence[ParameterSpec], config: Config
) -> Parameter | None:
    """Build the variable of a gyro's errors, see factors.gyro: S, then every driver that is not entirely fixed."""
    return parameter(key, (*scale, *(each for each in drivers if parameter(key, (each,), config))), config)


def acting(errors: Parameter | None, drivers: Mapping[ParameterSpec, Array | None]) -> Array | None:
    """Columns (N, d) of the drivers that a gyro's errors depend on; None if there are none."""
    names = {q.name for q in errors.quantities} if errors else set()
    found = [driver for each, driver in drivers.items() if driver is not None and each.names[0] in names]
    alone = len(found) == 1 and found[0].ndim == 2
    return found[0] if alone else np.column_stack(found) if found else None


def stamped(parameter: Parameter | None, name: str, sigma: float) -> Parameter | None:
    """Add the sigma of replaced stamps, s, to the prior and the final sigma of a delay parameter.

    The lateness of log times is unknown: it widens the prior of the delay and its final sigma.
    """

    def known(q: Quantity) -> Quantity:
        if q.name != name or not q.prior_sigma:
            return q
        return replace(q, prior_sigma=math.hypot(q.prior_sigma, sigma), extra_sigma=sigma)

    return parameter and replace(parameter, quantities=tuple(map(known, parameter.quantities)))


def fixed_without_force(spec: ParameterSpec, config: Config, topic: str) -> Findings:
    """`fixed_assumptions` row for a g-sensitivity if the Imu stream has no acceleration to determine it."""
    if parameter(0, (spec,), config) is None:
        return {}
    names = f"{spec.names[0]} to {spec.names[-1]}"
    return {"fixed_assumptions": [{"parameters": names, "value": 0.0, "why": f"{topic} has no acceleration"}]}


def prior_z_score(quantity: Quantity, value: float, sigma: float, inflation: float = 1.0) -> float | None:
    """Shift of a nuisance parameter from its prior, in sigmas of that shift; None if not determined.

    With s = sigma / inflation, p the prior's sigma and V = sigma^2 - (s^2 / p)^2 what comes from elsewhere than from
    the prior, the estimate's change from the prior has the variance (p - s^2 / p)^2 + V; for white noise p^2 - s^2. The
    first p is less where the model is valid less far.

    Args:
        quantity: the assumption.
        value, sigma: its estimate.
        inflation: by what sigma is larger because noise is coloured, or errors are slow.
    """
    prior, white = quantity.prior_sigma or 0.0, sigma / inflation
    if white > _UNINFORMED * prior or prior == 0.0:
        return None
    elsewhere = sigma**2 - (white**2 / prior) ** 2
    may_differ = quantity.prior_at(value) * (1.0 - (white / prior) ** 2)
    return (value - quantity.prior_mean) / math.sqrt(may_differ**2 + elsewhere)


def prior_z_scores(estimate: Estimate, quantities: Sequence[Quantity]) -> list[float | None]:
    """Shift of each number of an estimate from its prior, see `prior_z_score`; quantities in the estimate's order.

    Of an estimate that prior conflicts have widened it is that before.
    """
    if estimate.prior_z is not None:
        return list(estimate.prior_z)
    numbers = (each.tolist() for each in (estimate.values, estimate.sigmas, estimate.widenings))
    return [prior_z_score(*each) for each in zip(quantities, *numbers, strict=True)]


def stated(config: Config, spec: ParameterSpec) -> float:
    """Prior sigma in force: the config's `sensors` figure, else that of the usual grade."""
    sheet = getattr(config.sensors, spec.sheet, None)
    if sheet is None or spec.figure not in sheet.model_fields_set:
        return spec.prior
    figure: float | None = getattr(sheet, spec.figure)
    return _FREE * spec.prior if figure is None else figure


def parameter_problem(
    method: str,
    specs: Sequence[ParameterSpec],
    config: Any,
    initial: Mapping[str, ArrayLike],
    family: str,
    model: Any,
    **fields: Any,
) -> Problem:
    """Build a graph without states: one measurement model over shared parameters, a variable and prior for each spec.

        parameter_problem("mine", PARAMETERS, config, initial, "increment", model, dropped=data.dropped)

    Args:
        method: its name.
        specs: of the parameters, in the order of the model's blocks; one with a rotation is a Rot3.
        config: priors, data sheets, accuracies wanted.
        initial: name of a spec -> first guess: a quaternion w, x, y, z, a vector or a number.
        family: of the measurements.
        model: alidade.factors.model.Model of all measurements in time order; `model.time` (n,), s.
        fields: of the Problem.

    Raises:
        InputError: the config names an unknown parameter.
    """
    check_parameters(specs, config)
    parameters = tuple(
        Parameter(
            int(gtsam.symbol("P", i)),
            quantities(spec, config),
            rotation_vector_coordinates if spec.rotation else vector_coordinates,
        )
        for i, spec in enumerate(specs)
    )
    values = gtsam.Values()
    for parameter, spec in zip(parameters, specs, strict=True):
        guess = np.atleast_1d(np.asarray(initial[spec.name], dtype=float))
        values.insert(parameter.key, so3.to_gtsam(guess) if spec.rotation else guess)
    time: Array = model.time

    def steps(chunk: int, after: float = -np.inf) -> Iterator[Step]:
        for begin in range(int(np.searchsorted(time, after, side="right")), len(time), chunk):
            rows = slice(begin, min(begin + chunk, len(time)))
            step = Step(time=float(time[rows.stop - 1]), keyframes=range(rows.start, rows.stop))
            if begin == 0:
                step.initial.insert(values)
                step.factors.extend(map(prior_of, parameters))
            some = replace(model, **{name: getattr(model, name)[rows] for name in model.stacked})
            step.factors.append(Factor.of(family, some.on(*(each.key for each in parameters))))
            yield step

    return Problem(method, parameters, steps, steps_after=lambda after: steps(1, after), layout=ChainLayout(), **fields)
