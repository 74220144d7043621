"""The tumble method: a magnetometer, an accelerometer, or both, turned by hand through all attitudes, and nothing else.

There is no camera and no reference. Without a gyro attitudes are unknown: what is known is that the field has one
strength, the specific force at rest another, and that the angle between them is constant. That determines each sensor's
scale, non-orthogonality and offset, and the relative rotation of two. The body's axes are those in which the
K of the accelerometer, or of a magnetometer alone, is symmetric: as near to the sensor's own as any can be. A gyro
chains the attitudes (`_chained`): each sample of the field then gives three residuals instead of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, interpolated
from alidade.factors.chi_square import gate
from alidade.factors.ellipsoid import DipFactor, StrengthFactor, entries, excess, sagitta
from alidade.factors.loss import TruncatedLoss
from alidade.factors.turned import FieldFactor, UpFactor
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.gyro_chain import LAYOUT
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import SENSOR_NAMES
from alidade.pipelines.estimation.priors import prior_of, rotation_about
from alidade.pipelines.estimation.problem import Attitudes, ChainLayout, Factor, Problem, Step
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.place import STRENGTH_ADVICE
from alidade.pipelines.methods.tumble.first_guess import CLOUD
from alidade.pipelines.methods.tumble.model import TURNED, Model, Moments, Sensor, prepare, relative_scatter
from alidade.pipelines.methods.tumble.parameters import (
    DIP_KEY,
    SLOPE_KEY,
    STRENGTH_KEYS,
    TRIAD_KEYS,
    Variable,
    variables,
)
from alidade.pipelines.methods.tumble.published import FEWEST
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.methods.tumble.turning import (
    DELAY_KEY,
    FILTER_KEY,
    FieldGuess,
    Rows,
    Seen,
    Turning,
    specific_force,
    turning,
)
from alidade.pipelines.recording.topics import IMU, MAG
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
        _check_turned(sensor, config)
    if model.guess is not None:
        return _chained(data, config, model, found)
    model = replace(model, sensors=sensors)
    noises = [level for sensor in model.sensors for level in sensor.levels]
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
        offsets=tuple(tuple(f"{sensor.name}_b{axis}" for axis in "123") for sensor in model.sensors),
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
    beside = None if sensor.beside is None else sensor.beside[rows]
    return [Factor.of(SENSOR_NAMES[sensor.name], factor.on(*keys, loss=loss), beside)]


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


# -- with a gyro: attitudes at keyframes, at which field and gravity are what they are

# Prior sigma of the first attitude, rad: as good as none. A magnetometer alone leaves its rotation about the field,
# which is y then, undetermined: it is fixed to this, and the earth's rate is in the axes that follow.
_ANY_ATTITUDE, _FIXED = np.pi, 1e-3


@dataclass(frozen=True, eq=False)
class _Graph:
    """Common inputs of all steps: sensors by name, chain, shared variables, robust loss."""

    sensors: Mapping[str, Sensor]
    turning: Turning
    shared: tuple[Variable, ...]
    loss: TruncatedLoss


def _chained(data: TumbleData, config: Config, model: Model, shared: tuple[Variable, ...]) -> Problem:
    """Build the graph of a recording with a gyro, whose mounting the model's first guess gives."""
    assert model.guess is not None
    assert model.dip is not None
    sensors = {sensor.name: sensor for sensor in model.sensors}
    seen = {"mag": _seen(sensors["mag"], data.mag)}
    force = None
    if (accel := sensors.get("accel")) is not None and data.accel_t is not None:
        seen["accel"] = _seen(accel, data.accel)
        force = specific_force(data, seen["accel"], model.guess)
        if not accel.rested:
            sensors["accel"] = accel.nonlinear_at(interpolated(accel.time, data.accel_t, force))
    turned = turning(data, config, model.guess, seen, force, model.declination, model.dip.start)
    graph = _Graph(sensors, turned, shared, TruncatedLoss(gate(3)))
    return Problem(
        method="tumble",
        parameters=(*(each.parameter for each in shared), *turned.parameters),
        steps=partial(_keyframe_steps, graph),
        loss=graph.loss,
        attitudes=partial(_trajectory, graph),
        advice=advice,
        dropped=model.dropped,
        premises=model.premises,
        noises=(*(level for sensor in model.sensors for level in _levels(sensor, model.guess)), *turned.levels),
        constants=temperature.constants(temperature.reference(data.temperature)),
        layout=LAYOUT,
    )


def _levels(sensor: Sensor, guess: FieldGuess) -> tuple[Level, ...]:
    """Initial noise levels of a sensor; without stated noise, a magnetometer's is that of the gyro's first guess."""
    if sensor.name != "mag":
        return sensor.levels
    if sensor.noise.source != "default" or sensor.noise.known == 0.0:
        return (Level(sensor.noise),)
    return (Level(sensor.noise, max(1.0, guess.sigma / float(np.median(sensor.sigma)))),)


def _seen(sensor: Sensor, whole: Array | None) -> Seen:
    assert whole is not None
    return Seen(sensor.time, sensor.directions, sensor.nominal(whole), sensor.strength, not sensor.rested)


def _keyframe_steps(graph: _Graph, chunk: int) -> Iterator[Step]:
    """Yield the first keyframe with all shared variables and their priors, then `chunk` keyframes at a time."""
    count = len(graph.turning.chain.time)
    yield _step(graph, range(1))
    for begin in range(1, count, chunk):
        yield _step(graph, range(begin, min(begin + chunk, count)))


def _step(graph: _Graph, keyframes: range) -> Step:
    chain = graph.turning.chain
    step = Step(
        time=float(chain.time[keyframes[-1]]),
        predict=partial(chain.predict, keyframes, lambda k, _: chain.initial[k]),
        keyframes=chain.numbers(keyframes),
    )
    if keyframes.start == 0:
        _begin(graph, step)
    chain.add(step, keyframes)
    step.factors.extend([*_field(graph, keyframes), *_up(graph, keyframes)])
    return step


def _begin(graph: _Graph, step: Step) -> None:
    for variable in graph.shared:
        step.initial.insert(variable.parameter.key, variable.start)
        step.factors.append(variable.prior)
    turned = graph.turning
    step.factors.append(prior_of(turned.parameters[0]))
    for parameter in turned.parameters[1:]:
        step.initial.insert(parameter.key, np.zeros(len(parameter.quantities)))
        step.factors.append(prior_of(parameter))
    chain = turned.chain
    about_field = _ANY_ATTITUDE if "accel" in graph.sensors else _FIXED
    sigmas = np.array([_ANY_ATTITUDE, about_field, _ANY_ATTITUDE])
    R = so3.matrix(chain.initial[0]) / sigmas[:, None]
    step.factors.append(rotation_about(chain.state(0), chain.initial[0], R))


def _field(graph: _Graph, keyframes: range) -> list[Factor]:
    turned, chain = graph.turning, graph.turning.chain
    seen, sensor = turned.mag.of(keyframes), graph.sensors["mag"]
    if not len(seen.row):
        return []
    factor = FieldFactor(*_measured(turned, sensor, seen), chain.gyro, turned.errors, turned.earth)
    own = FILTER_KEY, TRIAD_KEYS["mag"], STRENGTH_KEYS["mag"], DIP_KEY, DELAY_KEY
    keys = *own, *chain.error_keys, *_earth_key(turned)
    states = [chain.state(int(k)) for k in seen.keyframe]
    return [Factor.of(SENSOR_NAMES["mag"], factor.on(states, chain.bias_keys(seen.keyframe), *keys, loss=graph.loss))]


def _up(graph: _Graph, keyframes: range) -> list[Factor]:
    turned, chain = graph.turning, graph.turning.chain
    seen = turned.accel.of(keyframes)
    if not len(seen.row):
        return []
    sensor = graph.sensors["accel"]
    measured = _measured(turned, sensor, seen)
    drivers = None if sensor.drivers is None else sensor.drivers[seen.row]
    unit = None if turned.arm is None else sensor.strength
    factor = UpFactor(*measured, chain.gyro, turned.errors, turned.earth, unit, drivers)
    arm = [] if turned.arm is None else [turned.arm.key]
    slope = [] if drivers is None else [SLOPE_KEY]
    keys = FILTER_KEY, TRIAD_KEYS["accel"], STRENGTH_KEYS["accel"], *chain.error_keys, *arm, *slope, *_earth_key(turned)
    states = [chain.state(int(k)) for k in seen.keyframe]
    beside = None if sensor.beside is None else sensor.beside[seen.row]
    bound = factor.on(states, chain.bias_keys(seen.keyframe), *keys, loss=graph.loss)
    return [Factor.of(SENSOR_NAMES["accel"], bound, beside)]


def _earth_key(turned: Turning) -> list[int]:
    return [] if turned.earth_rate is None else [turned.earth_rate.key]


def _measured(turned: Turning, sensor: Sensor, seen: Rows) -> tuple[Array, Array, Array, Array, Array]:
    """Stamps, s, keyframe times, s, normalised readings and sigmas, and s since the first keyframe."""
    time = sensor.time[seen.row]
    anchor = turned.chain.time[seen.keyframe]
    return time, anchor, sensor.scaled[seen.row], sensor.sigma[seen.row], turned.elapsed(time)


def _trajectory(graph: _Graph, keyframes: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Attitudes nRb (wxyz) of the turned device at keyframes; n is level, with y along the horizontal field."""
    turned, chain, rows = graph.turning, graph.turning.chain, list(keyframes)
    aRb = so3.from_gtsam([values.atRot3(chain.state(k)) for k in rows])
    time = chain.time[rows]
    earth = turned.earth
    if turned.earth_rate is not None:
        earth = values.atVector(turned.earth_rate.key)
    assert earth is not None
    return Attitudes(time, so3.multiply(so3.exp(-turned.elapsed(time)[:, None] * earth), aRb))


def advice(weights: Mapping[str, float]) -> Motion:
    """Motion that would make a weak direction observable."""
    if "mag_scale" in weights:
        return STRENGTH_ADVICE
    strong = [name for name, weight in weights.items() if abs(weight) > 0.3] or list(weights)
    if any(name.startswith("accel") for name in strong):
        return Motion("rest the device for a second or two in each of twenty and more attitudes, every side up")
    return Motion(
        "turn the device through more attitudes, each end of each axis up, down, north and south, away from iron",
        swaying("xyz", "device"),
    )


# -- means over readings between which the device hardly rotated, one attitude each

# A mean may lie inside the ellipsoid, which is allowed for, by this many times its own sigma ...
_OFF = 1.0
# ... and those of its parts no farther apart, as a square in such units, than outliers do.
_NEAR = 6.0
_TOPICS = {"accel": IMU, "mag": MAG}


def unturned(sensor: Sensor) -> Sensor:
    """Replace a sensor's readings by means of neighbours, `excess` corrected for their depth in the ellipsoid.

    Single samples of a rest scatter like those of a slightly rotating device, and the ellipsoid's normal there follows
    the direction of least scatter: an estimate from single samples fits their noise. Rests are means already. Without a
    stated noise the sensor stays as it is: the scatter may be motion.
    """
    if sensor.rested or sensor.noise.source == "default":
        return sensor
    raw, sample_scatter = sensor.scaled, sensor.sample_scatter
    first = _beginnings(raw, sample_scatter)
    number = np.diff(np.append(first, len(raw)))

    def mean(values: Array) -> Array:
        return np.asarray((np.add.reduceat(values, first).T / number).T)

    means = mean(raw)
    apart = raw - np.repeat(means, number, axis=0)
    scatter = mean(apart[:, :, None] * apart[:, None, :])
    scatter -= (sample_scatter**2 * (1.0 - 1.0 / number))[:, None, None] * np.eye(3)
    numbers = sensor.start @ entries(sensor.symmetric).T
    return replace(
        sensor,
        time=mean(sensor.time),
        raw=sensor.radius * means,
        sigma=sensor.sigma[first] / np.sqrt(number),
        excess=excess(means, sample_scatter / np.sqrt(number), numbers) - sagitta(means, scatter, numbers),
        drivers=None if sensor.drivers is None else mean(sensor.drivers),
    )


def _check_turned(sensor: Sensor, config: Config) -> None:
    """Raise InputError if readings, or their means by `unturned`, cover too few attitudes for a parameter."""
    few = not sensor.rested and len(sensor.raw) < FEWEST
    # Counts may have any offset: those of a device that rests are a cloud of noise, and so is their ellipsoid.
    still = relative_scatter(sensor.raw) < TURNED and (sensor.is_si or sensor.sample_scatter > CLOUD)
    if few or still:
        raise InputError(
            f"topic {config.topic(_TOPICS[sensor.name])}: the device did not turn, or hardly, beyond the noise of its "
            f"readings; turn it slowly through all attitudes, {FEWEST} at the very least, and record again"
        )


def _beginnings(raw: Array, sigma: float) -> Index:
    """Index of the first sample of each mean; neighbours are merged while their scatter allows.

    Of points of a sphere of radius 1, with a scatter V, the mean lies V / 2 inside.
    """
    first, number = np.arange(len(raw)), np.ones(len(raw))
    means, scatter = raw.copy(), np.zeros(len(raw))
    begin, idle = 0, 0
    while idle < 2:
        a = np.arange(begin, len(first) - 1, 2)
        together = number[a] + number[a + 1]
        share = number[a + 1] / together
        apart = ((means[a + 1] - means[a]) ** 2).sum(axis=1)
        squares = scatter[a] + scatter[a + 1] + number[a] * share * apart
        turned = squares / together - 3.0 * sigma**2 * (1.0 - 1.0 / together)
        fewest = np.minimum(number[a], number[a + 1])
        one = (0.5 * turned < _OFF * sigma / np.sqrt(together)) & (apart < _NEAR * sigma / np.sqrt(fewest))
        into, gone = a[one], a[one] + 1
        means[into] += share[one, None] * (means[gone] - means[into])
        scatter[into], number[into] = squares[one], together[one]
        first = np.delete(first, gone)
        number, means, scatter = (np.delete(each, gone, axis=0) for each in (number, means, scatter))
        begin, idle = 1 - begin, 0 if len(gone) else idle + 1
    return first
