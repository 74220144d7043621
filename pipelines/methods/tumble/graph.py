"""The tumble method: a magnetometer, an accelerometer, or both, turned by hand through all attitudes, and nothing else.

There is no camera, no reference and no gyro, so that attitudes are unknown: what is known is that the field has one
strength, the specific force at rest another, and that the angle between them stays. That tells of each sensor scale,
non-orthogonality and offset, and of two how they are turned against each other. The body's axes are those in which the
K of the accelerometer, or of a magnetometer alone, is symmetric: as near to the sensor's own as any can be.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import pairwise

import numpy as np

from factors.chi_square import gate
from factors.ellipsoid import DipFactor, StrengthFactor
from factors.loss import TruncatedLoss
from pipelines.graph.motion import Motion
from pipelines.graph.noise import Level
from pipelines.graph.problem import Array, Factor, Problem, Step
from pipelines.judgement.pictures import swaying
from pipelines.methods.tumble.model import Dip, Model, Sensor, prepare
from pipelines.methods.tumble.parameters import DIP_KEY, STRENGTH_KEYS, TRIAD_KEYS, Variable, variables
from pipelines.methods.tumble.recording import TumbleData
from pipelines.settings import Config

# What is measured within this time, s, makes one step.
_STRETCH = 0.5
_FAMILIES = {"accel": "accelerometer", "mag": "magnetometer"}


def problem(data: TumbleData, config: Config) -> Problem:
    """The graph.

    Raises:
        InputError: too few readings, the config names no such parameter, or the date is outside the field model.
    """
    model = prepare(data, config)
    found = variables(model, config)
    noises = [Level(sensor.noise) for sensor in model.sensors]
    if model.dip is not None:
        noises.append(Level(model.dip.noise))
    return Problem(
        method="tumble",
        parameters=tuple(variable.parameter for variable in found),
        steps=partial(_steps, model, found),
        loss=TruncatedLoss(gate(1)),
        advice=_advice,
        dropped=model.dropped,
        premises=model.premises,
        noises=tuple(noises),
    )


def _steps(model: Model, found: tuple[Variable, ...], chunk: int) -> Iterator[Step]:
    """A step for each stretch of time; the first brings the variables and their priors too."""
    loss = TruncatedLoss(gate(1))
    times = [each.time for each in (*model.sensors, model.dip) if each is not None]
    start, stop = min(t[0] for t in times), max(t[-1] for t in times)
    edges = np.append(np.arange(start, stop, chunk * _STRETCH), np.inf)
    first = True
    for low, high in pairwise(edges.tolist()):
        step = Step(time=float(min(high, stop)))
        if first:
            for variable in found:
                step.initial.insert(variable.parameter.key, variable.start)
                step.factors.append(variable.prior)
        for sensor in model.sensors:
            step.factors.extend(_strengths(sensor, _rows(sensor.time, low, high), loss))
        if model.dip is not None:
            symmetric = model.sensors[0].symmetric, model.sensors[1].symmetric
            step.factors.extend(_dips(model.dip, _rows(model.dip.time, low, high), symmetric, loss))
        if first or step.factors:
            yield step
        first = False


def _rows(time: Array, low: float, high: float) -> slice:
    return slice(int(np.searchsorted(time, low)), int(np.searchsorted(time, high)))


def _strengths(sensor: Sensor, rows: slice, loss: TruncatedLoss) -> list[Factor]:
    """What a sensor says in a stretch of time."""
    if rows.start == rows.stop:
        return []
    factor = StrengthFactor(
        sensor.time[rows], sensor.scaled[rows], sensor.sigma[rows], sensor.excess[rows], sensor.symmetric
    )
    keys = TRIAD_KEYS[sensor.name], STRENGTH_KEYS[sensor.name]
    return [Factor.of(_FAMILIES[sensor.name], factor.on(*keys, loss=loss))]


def _dips(dip: Dip, rows: slice, symmetric: tuple[bool, bool], loss: TruncatedLoss) -> list[Factor]:
    """The angles between field and gravity in a stretch of time."""
    if rows.start == rows.stop:
        return []
    factor = DipFactor(dip.time[rows], dip.accel[rows], dip.mag[rows], dip.sigma[rows], symmetric)
    return [Factor.of("dip", factor.on(TRIAD_KEYS["accel"], TRIAD_KEYS["mag"], DIP_KEY, loss=loss))]


def _advice(weights: Mapping[str, float]) -> Motion:
    """The motion that would make a weak direction observable."""
    strong = [name for name, weight in weights.items() if abs(weight) > 0.3] or list(weights)
    if any(name.startswith("accel") for name in strong):
        return Motion("rest the device for a second or two in each of twenty and more attitudes, every side up")
    return Motion(
        "turn the device through more attitudes, each end of each axis up, down, north and south, away from iron",
        swaying("xyz", "device"),
    )
