"""The tumble method: a magnetometer, an accelerometer, or both, turned by hand through all attitudes, and nothing else.

There is no camera and no reference. Without a gyro attitudes are unknown: what is known is that the field has one
strength, the specific force at rest another, and that the angle between them is constant. That determines each sensor's
scale, non-orthogonality and offset, and the relative rotation of two. The body's axes are those in which the
K of the accelerometer, or of a magnetometer alone, is symmetric: as near to the sensor's own as any can be. A gyro
chains the attitudes (`chained`): each sample of the field then gives three residuals instead of one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise, product

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.chi_square import gate
from alidade.factors.ellipsoid import DipFactor, StrengthFactor, entries
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import ChainLayout, Factor, Problem, Step
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.tumble.chained import FAMILIES, advice, chained
from alidade.pipelines.methods.tumble.model import Model, Moments, Sensor, prepare
from alidade.pipelines.methods.tumble.parameters import (
    DIP_KEY,
    SLOPE_KEY,
    STRENGTH_KEYS,
    TRIAD_KEYS,
    Variable,
    variables,
)
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.methods.tumble.unturned import check_turned, unturned
from alidade.pipelines.settings import Config

# What is measured within this time, s, makes one step.
_STRETCH = 0.5


def problem(data: TumbleData, config: Config) -> Problem:
    """Build the graph of a tumble recording.

    Raises:
        InputError: too few readings or attitudes, the config names no such parameter, or the date is outside the field
            model.
    """
    model = prepare(data, config)
    found = variables(model, config)
    sensors = model.sensors if model.guess is not None else tuple(map(unturned, model.sensors))
    for sensor in sensors:
        check_turned(sensor, config)
    if model.guess is not None:
        return chained(data, config, model, found)
    model = replace(model, sensors=sensors)
    noises = [Level(sensor.noise, sensor.initial_level) for sensor in model.sensors]
    if model.moments is not None:
        noises.append(Level(model.moments.noise))
    return Problem(
        method="tumble",
        parameters=tuple(variable.parameter for variable in found),
        steps=partial(_steps, model, found),
        loss=TruncatedLoss(gate(1)),
        advice=advice,
        dropped=model.dropped,
        premises=model.premises,
        noises=tuple(noises),
        elsewhere=partial(_mirrored, model),
        constants=_constants(data, model),
        layout=ChainLayout(),
    )


def _constants(data: TumbleData, model: Model) -> dict[str, float]:
    """Formula constants: first temperature and, for heading by a magnetometer alone, the model's dip, rad."""
    dip = {} if model.dip is not None or model.modelled_dip is None else {"field_dip": model.modelled_dip}
    return temperature.constants(temperature.reference(data.temperature)) | dip


def _steps(model: Model, found: tuple[Variable, ...], chunk: int) -> Iterator[Step]:
    """Yield a step for each interval of time; the first one adds the variables and their priors."""
    loss = TruncatedLoss(gate(1))
    times = [each.time for each in (*model.sensors, model.moments) if each is not None]
    start, stop = min(t[0] for t in times), max(t[-1] for t in times)
    # The same numbers whatever the chunk: a sample may be at an edge.
    edges = np.append(start + _STRETCH * np.arange(0, np.ceil((stop - start) / _STRETCH), chunk), np.inf)
    first = True
    for low, high in pairwise(edges.tolist()):
        step = Step(time=float(min(high, stop)))
        if first:
            for variable in found:
                step.initial.insert(variable.parameter.key, variable.start)
                step.factors.append(variable.prior)
        for sensor in model.sensors:
            step.factors.extend(_strengths(sensor, _rows(sensor.time, low, high), loss))
        if model.moments is not None:
            symmetric = model.sensors[0].symmetric, model.sensors[1].symmetric
            step.factors.extend(_dips(model.moments, _rows(model.moments.time, low, high), symmetric, loss))
        if first or step.factors:
            yield step
        first = False


def _mirrored(model: Model, values: gtsam.Values) -> Iterator[gtsam.Values]:
    """Yield mirrored solutions with the same lengths and dips, reflected across the axes of the symmetric K.

    Lengths and angles stay under any rotation or mirror Q of all nominal vectors, and Q K is symmetric for these alone.
    """
    numbers = {s.name: entries(s.symmetric) @ values.atVector(TRIAD_KEYS[s.name]) for s in model.sensors}
    own = next(s.name for s in model.sensors if s.symmetric)
    axes = np.linalg.eigh(numbers[own][:9].reshape(3, 3))[1]
    for signs in product((1.0, -1.0), repeat=3):
        if min(signs) > 0.0:
            continue
        Q = (axes * signs) @ axes.T
        other = gtsam.Values(values)
        for sensor in model.sensors:
            rows = np.vstack([numbers[sensor.name][:9].reshape(3, 3).T, numbers[sensor.name][9:]])
            K, b = (rows @ Q.T)[:3].T, (rows @ Q.T)[3]
            of = entries(sensor.symmetric)
            other.update(TRIAD_KEYS[sensor.name], of.T @ np.append(K, b) / of.sum(axis=0))
            if sensor.drivers is not None:
                other.update(SLOPE_KEY, (values.atVector(SLOPE_KEY).reshape(-1, 3) @ Q.T).ravel())
        yield other


def _rows(time: Array, low: float, high: float) -> slice:
    return slice(int(np.searchsorted(time, low)), int(np.searchsorted(time, high)))


def _strengths(sensor: Sensor, rows: slice, loss: TruncatedLoss) -> list[Factor]:
    """Strength factors of a sensor's readings, for a slice of rows."""
    if rows.start == rows.stop:
        return []
    drivers = None if sensor.drivers is None else sensor.drivers[rows]
    factor = StrengthFactor(
        sensor.time[rows], sensor.scaled[rows], sensor.sigma[rows], sensor.excess[rows], sensor.symmetric, drivers
    )
    keys = TRIAD_KEYS[sensor.name], STRENGTH_KEYS[sensor.name], *([] if drivers is None else [SLOPE_KEY])
    return [Factor.of(FAMILIES[sensor.name], factor.on(*keys, loss=loss))]


def _dips(moments: Moments, rows: slice, symmetric: tuple[bool, bool], loss: TruncatedLoss) -> list[Factor]:
    """Factors of the angle between field and gravity, for a slice of rows."""
    if rows.start == rows.stop:
        return []
    drivers = None if moments.drivers is None else moments.drivers[rows]
    factor = DipFactor(
        moments.time[rows], moments.accel[rows], moments.mag[rows], moments.sigma[rows], symmetric, drivers
    )
    keys = TRIAD_KEYS["accel"], TRIAD_KEYS["mag"], DIP_KEY, *([] if drivers is None else [SLOPE_KEY])
    return [Factor.of("dip", factor.on(*keys, loss=loss))]
