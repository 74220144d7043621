"""A tumbled recording prepared for its graph: units, first guesses, the samples to be used and their noise.

Graph variables have no unit: raw numbers are divided by the radius of the ellipsoid that they lie on and nominal ones
by the strength of what they measure, so that K is about a rotation whatever was recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array, Index, interpolated
from alidade.factors.earth import gravity
from alidade.factors.ellipsoid import StrengthFactor, entries, excess, nominal_of
from alidade.pipelines.diagnostics.static_intervals import ACCEL_TREMOR, GYRO_TREMOR, Stream, find_static_intervals
from alidade.pipelines.display.sphere_map import described
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import ROUGHLY, Level, Noise
from alidade.pipelines.estimation.parameters import SENSOR_NAMES, ParameterSpec, parameter
from alidade.pipelines.estimation.parameters import stated as sheet
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.noise import TRUSTED, repeatability, sampled, stated, weighed
from alidade.pipelines.methods.place import FIELD, field_at, known_strength
from alidade.pipelines.methods.temperature import ACCEL_SLOPE
from alidade.pipelines.methods.triads import triad_names
from alidade.pipelines.methods.tumble.first_guess import ACCEL_OFFSET, OFFSET, first_guess, ring
from alidade.pipelines.methods.tumble.published import FEWEST
from alidade.pipelines.methods.tumble.recording import ACCEL_CURVATURE, NO_RATE, TumbleData, beside
from alidade.pipelines.methods.tumble.turning import FieldGuess, field_guess
from alidade.pipelines.recording.plausibility import (
    DEAD_BAND,
    PLAUSIBLE,
    SI,
    dead_band,
    likely_unit,
    quantum,
    without_rounding,
)
from alidade.pipelines.settings import Config

# Standard gravity, and what it is off by where the latitude is unknown, m/s^2.
_GRAVITY, _GRAVITY_SIGMA = 9.80665, 0.02
# Fewer rests do where the device is at rest for more than this share of the time: what lies between is handling, at
# several m/s^2, and no slow turn. Turns by hand without rests pause for up to a quarter of it.
_MOSTLY = 1.0 / 3.0
# Where a motion turns back it is quiet for 0.3 s (medians of 0.28 to 0.36 s in six recordings without rests); of rests
# of 0.6 s 0.5 s are found. Quiet intervals whose median is shorter, s, are no rests: readings there are off by what the
# device is accelerated with.
_PAUSE = 0.4
# Means over this time, s, show what a mean over a rest scatters by, slow tremor of a hand included.
_BLOCK = 0.25
# Strength of the earth's field where the place is unknown, T: 22e-6 to 67e-6.
_EARTH_FIELD = 4.5e-5
# Scatter of readings over their size below which a device did not turn: a degree, which is more than noise. A
# magnetometer in T with ten times the field for its offset scatters by more when it turns; counts may have any offset.
TURNED = 0.02
# The same of an accelerometer without rests and gyro in use, whose motion is noise: it was within 20 deg of upright.
_TILTED = 0.25
# Readings of a magnetometer whose lengths are off by this many times the median: 6.7 sigma of normal ones.
_OUTLYING = 10.0
# No sensor resolves a smaller share of what it measures; numbers without noise leave rounding.
_RESOLUTION = 1e-9
# A rotation from pairs of vectors is unique where the second-best solution fits this many times worse.
_CLEAR = 2.0
# Prior sigma of the noise by the hand's motion, in the logarithm.
_HARDLY = 2.0
# Largest error of the sine of the dip before a sign counts as wrong, and the least sine for that test.
_SINE = 0.35
_AT_REST = "every sample counts as one at rest, and its motion as noise"
_SWUNG = "all its samples are used, swung about a point (accel_arm); what the hand adds counts as noise"
_LEFT_HANDED = (
    "Beside the accelerometer the magnetometer's axes are left-handed: an axis of one of them has the wrong sign, or "
    "the accelerometer shows gravity down where it has to show up; K of the magnetometer mends the first."
)
_LEFT_HANDED_ACCEL = (
    "Beside gyro and magnetometer the accelerometer's axes are left-handed: one of them has the wrong sign, or two are "
    "swapped; K of the accelerometer mends it."
)
_GRAVITY_DOWN = (
    "The accelerometer shows gravity down where it has to show the force that holds it, up: all its three signs are "
    "inverted, which its K mends (about -1); the magnetometer keeps its signs."
)
_STRAIGHT = "The gyro counts as mounted straight to the magnetometer: turning about one axis does not show it."
_UPRIGHT = (
    "The accelerometer is left out: it felt gravity along much the same axis all the time, which leaves its numbers at "
    "their priors."
)
_NOT_AS_FIELD = (
    "The gyro is not used: it does not turn as the field does; are its axes and clock right, and is the field the same "
    "everywhere the device was?"
)
_NEVER_TOGETHER = "The magnetometer has no reading during a rest: nothing ties its axes to the accelerometer's."
_NEGATIVE_DIP = (
    "The field rises: right south of the magnetic equator; north of it the accelerometer shows gravity down, and all "
    "signs of K of the magnetometer rest on that. State latitude_deg and longitude_deg in the config to decide."
)


@dataclass(frozen=True, eq=False)
class Sensor:
    """Readings, noise and first guess of one triad.

    Attributes:
        name: accel or mag.
        time, raw: (n,) s and (n, 3), as recorded, of the samples or means that are used.
        sigma, excess: (n,) of these over the radius; see StrengthFactor.
        sample_scatter: sigma of a sample over the radius, as stated or else from the residuals of the first guess.
        level: of that over the one stated.
        symmetric: whether K is so by definition: the sensor defines the body's axes.
        is_si: whether it is recorded in SI; else in counts.
        radius: of the ellipsoid, in the unit recorded.
        gain: prior mean of the singular values of K without unit: what is recorded in SI is about right as it is.
        strength, spread: of what it measures, and how well that is known, one sigma.
        unit: of the strength; "1" where it is unknown and called 1.
        start: (9,) or (12,) first guess, without unit.
        turned: (3, 3) the part of that which turns: the body's axes against those of a symmetric K.
        rest_levels: of means over rests, white noise and repeatability; none: the readings are samples.
        noise: of a sample, with its family.
        drivers: (n, m) of the offset, see factors.ellipsoid.drifted, and `driven` their assumptions; None: none.
    """

    name: str
    time: Array
    raw: Array
    sigma: Array
    excess: Array
    sample_scatter: float
    level: float
    symmetric: bool
    is_si: bool
    radius: float
    gain: float
    strength: float
    spread: float
    unit: str
    start: Array
    turned: Array
    rest_levels: tuple[Level, ...]
    noise: Noise
    drivers: Array | None = None
    driven: tuple[ParameterSpec, ...] = ()

    @property
    def rested(self) -> bool:
        """Whether the readings are means over rests."""
        return bool(self.rest_levels)

    @property
    def levels(self) -> tuple[Level, ...]:
        """Noise levels to begin with: of samples at least the first guess's misfit."""
        return self.rest_levels or (Level(self.noise, max(1.0, self.level)),)

    @property
    def repeatability(self) -> float:
        """Initial error that readings of a rest have in common, over the strength, per axis."""
        return sum(level.used for level in self.rest_levels if level.noise.beside) / self.strength

    @property
    def beside(self) -> Array | None:
        """What 1 m/s^2 of repeatability adds to the whitened readings (n,); None of samples."""
        return 1.0 / (self.strength * self.sigma) if self.rested else None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the triad's parameters."""
        return triad_names(self.name, self.symmetric)

    @property
    def scaled(self) -> Array:
        """Raw readings (n, 3) divided by their radius, dimensionless."""
        return self.raw / self.radius

    @property
    def scales(self) -> Array:
        """Scale factors from the normalised variable to the reported numbers."""
        gains = len(self.start) - 3
        return np.repeat([self.strength / self.radius, self.strength], [gains, 3])

    def nominal(self, raw: Array) -> Array:
        """Nominal vectors (m, 3) of readings (m, 3) at the first guess, in the unit of the strength."""
        return self.strength * nominal_of(raw / self.radius, self.start @ entries(self.symmetric).T)

    def nonlinear_at(self, force: Array) -> Sensor:
        """Return the sensor with what nonlinearities multiply at forces (n, 3) along the body's axes, m/s^2."""
        if self.drivers is None:
            return self
        terms = dict(zip(ACCEL_CURVATURE, beside(force), strict=True))
        columns = zip(self.driven, np.split(self.drivers, len(self.driven), axis=1), strict=True)
        return replace(self, drivers=np.concatenate([terms.get(cause, each) for cause, each in columns], axis=1))

    @property
    def directions(self) -> Array:
        """Unit vectors (n, 3) of the readings at the first guess."""
        vectors = self.nominal(self.raw)
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Dip:
    """Inclination of the field, rad: first guess, and field model with sigma or None.

    A magnetometer alone has none: the level frame is defined by the field, with sigma 0.
    """

    start: float
    model: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments at which both sensors are used together.

    Attributes:
        time, accel, mag: (n,) s, (n, 3) and (n, 3), without unit.
        sigma: (n,) of the cosine between them.
        noise: of the cosine.
        drivers: (n, m), of the accelerometer, as of a sensor.
    """

    time: Array
    accel: Array
    mag: Array
    sigma: Array
    noise: Noise
    drivers: Array | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """A recording prepared for the graph.

    Attributes:
        sensors: accelerometer first.
        dip: None where a sensor is alone.
        moments: what the sensors measured together, where no gyro ties them.
        guess: of the magnetometer in the axes of the gyro that chains the attitudes; None: these are eliminated.
        declination: of the field, rad east, where the place is known.
        premises: sentences about assumptions that a user should know.
        dropped: what was left out.
        modelled_dip: of the field, rad, where the place is known.
    """

    sensors: tuple[Sensor, ...]
    dip: Dip | None
    moments: Moments | None
    guess: FieldGuess | None
    declination: float
    premises: tuple[str, ...]
    dropped: Mapping[str, int]
    modelled_dip: float | None = None


def prepare(data: TumbleData, config: Config) -> Model:
    """Prepare a recording. Raises InputError with too few samples or rests, or a date outside the field model."""
    premises: list[str] = []
    field = None
    if data.mag is not None and data.latitude is not None and data.longitude is not None:
        field = field_at(data.latitude, data.longitude, data.height, data.epoch_ns, config.date)
    sensors: list[Sensor] = []
    rests = None
    if data.accel is not None:
        rests = static_rests(data, config)
        if data.mag is not None and _is_upright(data, rests):
            data = replace(data, accel_t=None, accel=None)
            premises.append(_UPRIGHT)
    if data.mag is not None and data.mag_t is not None:
        sensors.append(_magnetometer(data, config, field, alone=data.accel is None))
        if sensors[-1].unit == "1":
            premises.append(
                "No position: the field's strength is unknown, and K and b are in units of it; for T state "
                "latitude_deg and longitude_deg, or field.strength, in the config."
            )
    gyro, more = _gyro(data, sensors)
    if data.accel is not None:
        sensors.insert(0, _accelerometer(data, config, rests, swung=rests is None and gyro is not None))
    premises += [note for sensor in sensors if not sensor.is_si and (note := _maybe_a_unit(sensor))]
    premises += more
    if gyro is None and more and len(sensors) > 1 and _is_upright(replace(data, gyro=None), rests):
        data, sensors = replace(data, accel_t=None, accel=None), [_magnetometer(data, config, field, alone=True)]
        premises.append(_UPRIGHT)
    if sensors[-1].name == "mag" and (gyro is None or gyro.assumed):
        premises += _about_one_axis(sensors[-1])
    if sensors[0].name == "accel" and not sensors[0].rested:
        done = _AT_REST if gyro is None else _SWUNG
        premises.append(f"The accelerometer has fewer than {FEWEST} rests: {done}.")
    dip = moments = None
    modelled = None
    if field is not None:
        size = float(np.linalg.norm(field))
        modelled = float(np.arcsin(-field[2] / size)), sheet(config, FIELD) / size  # dip and its sigma, rad
    if gyro is not None:
        sensors, dip, gyro, more = _chained(sensors, gyro, modelled)
        premises += more
    elif len(sensors) > 1:
        sensors, dip, moments, more = _together(data, config, sensors[0], sensors[1], rests, modelled)
        premises += more
    if modelled is None and len(sensors) > 1 and dip is not None and np.sin(dip.start) < -_SINE:
        premises.append(_NEGATIVE_DIP)
    declination = 0.0 if field is None else float(np.arctan2(field[0], field[1]))
    return Model(
        tuple(sensors),
        dip,
        moments,
        gyro,
        declination,
        tuple(premises),
        data.dropped,
        None if modelled is None else modelled[0],
    )


def _maybe_a_unit(sensor: Sensor) -> str:
    """Note on readings treated as counts whose magnitude suggests a unit; empty for others."""
    size = float(np.median(np.linalg.norm(sensor.raw, axis=1)))
    unit, kind = likely_unit(sensor.name, size), {"accel": "accel", "mag": "field"}[sensor.name]
    if not unit or "counts" in unit:
        return ""
    return (
        f"{SENSOR_NAMES[sensor.name].capitalize()}: a norm of {size:.3g} is none in {SI[sensor.name]}, so it is read "
        f"as counts; if it is in {unit}, state `units: {{{kind}: {unit}}}` beside its `columns`, or convert it."
    )


def _is_upright(data: TumbleData, rests: Array | None) -> bool:
    """Whether an accelerometer's readings cover so few attitudes that K stays at its prior."""
    assert data.accel is not None
    assert data.accel_t is not None
    raw = _means(data.accel_t, data.accel, rests)[1]
    least = _TILTED if rests is None and data.gyro is None else TURNED
    return _is_si("accel", raw) and relative_scatter(raw) < least


def relative_scatter(raw: Array) -> float:
    """Scatter of readings (n, 3) about their mean, all axes together, over their median length."""
    return float(np.sqrt(raw.var(axis=0).sum()) / np.median(np.linalg.norm(raw, axis=1)))


def _about_one_axis(mag: Sensor) -> list[str]:
    """Note on a magnetometer rotated about one axis: transverse hard iron with sigma, and ellipse ratio."""
    found = ring(mag.raw)
    if found is None:
        return []
    unit, factor = ("µT", 1e6) if mag.is_si else ("counts", 1.0)
    across = sorted(np.argsort(np.abs(found.axis))[:2])
    centre = " and ".join(f"{'xyz'[i]} {factor * found.centre[i]:.4g}" for i in across)
    return [
        f"The magnetometer was turned about one axis only, {described(found.axis)}. Across it the hard iron is "
        f"{centre} ± {factor * found.sigma:.1g} {unit}, with what soft iron makes of the field along the axis, and the "
        f"longest axis of the ellipse of readings is {found.ratio:.3f} times the shortest, which is what headings "
        "about that axis need; what is along it, and by how much it leans, is hardly known."
    ]


def _gyro(data: TumbleData, sensors: list[Sensor]) -> tuple[FieldGuess | None, list[str]]:
    """Magnetometer guess in the gyro's axes, with notes: assumptions, or why the gyro is not used."""
    if any(reason.endswith(NO_RATE) for reason in data.dropped):
        return None, ["The gyro is not used: it reads more than rad/s can be; is it in deg/s, or in counts?"]
    if data.gyro is None or data.gyro_t is None or data.mag is None:
        return None, []
    mag = sensors[-1]
    off = np.abs(np.linalg.norm(mag.nominal(mag.raw), axis=1) / mag.strength - 1.0)
    some = off <= _OUTLYING * max(float(np.median(off)), _RESOLUTION)
    found = field_guess(data, mag.time[some], mag.raw[some])
    if found is None:
        return None, [_NOT_AS_FIELD]
    notes = {
        _STRAIGHT: found.assumed and ring(sensors[-1].raw) is not None,
        DEAD_BAND: dead_band(data.gyro_t, data.gyro)[0] > 0.0,
    }
    return found, [note for note, holds in notes.items() if holds]


def _chained(
    sensors: list[Sensor], gyro: FieldGuess, model: tuple[float, float] | None
) -> tuple[list[Sensor], Dip, FieldGuess, list[str]]:
    """Sensors, dip and first guess in the gyro's axes, with notes."""
    *beside, mag = sensors
    beside = [replace(each, symmetric=False, start=each.start @ entries(True).T) for each in map(_of_hand, beside)]
    sine, premises, found = 0.0, [], _of_guess(mag, gyro)
    if beside:
        accel = beside[0]
        rows = np.clip(np.searchsorted(mag.time, accel.time), 0, len(mag.time) - 1)
        rotation, sine, _ = _mounting(accel.directions, found.directions[rows])
        if model is not None and _contradicts(sine, model[0]):
            sine = -sine
            if not _is_mounted_straight(found.turned):
                gyro = replace(gyro, K=-gyro.K, b=-gyro.b)  # in the opposite field
                found = _of_guess(mag, gyro)
                premises.append(_LEFT_HANDED)
            elif _is_mounted_straight(rotation):
                accel = _inverted(accel)
                premises.append(_GRAVITY_DOWN)
            else:
                rotation = -rotation
                premises.append(_LEFT_HANDED_ACCEL)
        beside = [accel if _is_mounted_straight(rotation) else _turned(accel, rotation.T)]
    else:
        model = 0.0, 0.0
    dip = Dip(float(np.arcsin(np.clip(sine, -0.99, 0.99))), model)
    return [*beside, found], dip, gyro, premises


def _of_guess(mag: Sensor, guess: FieldGuess) -> Sensor:
    """Start a magnetometer at a first guess, with its radius set so that normalised K has determinant 1."""
    radius = float(np.abs(np.linalg.det(guess.K))) ** (-1.0 / 3.0)
    scale = mag.radius / radius
    start = np.append(radius * guess.K, guess.b)
    return replace(
        mag,
        radius=radius,
        gain=mag.gain / scale if mag.is_si else 1.0,
        sigma=scale * mag.sigma,
        sample_scatter=scale * mag.sample_scatter,
        symmetric=False,
        start=start,
        turned=guess.mount,
    )


def _of_hand(accel: Sensor) -> Sensor:
    """Give an accelerometer without rests the noise of hand motion, to be estimated from residuals."""
    if accel.rested or accel.noise.known == 0.0:
        return accel
    return replace(accel, noise=replace(accel.noise, name="accel_motion", source="default", known=_HARDLY))


def _contradicts(sine: float, dip: float) -> bool:
    """Whether the sine of a dip has the wrong sign."""
    return bool(abs(np.sin(dip)) > _SINE and sine * np.sin(dip) < 0.0)


def _is_mounted_straight(rotation: Array) -> bool:
    """Whether a rotation (3, 3) aligns axes of the same name.

    Of a contradicted dip the accelerometer with all signs inverted is then the one cause, one axis that is not another.
    """
    return bool((nearest_axes(rotation) == np.eye(3)).all())


def _inverted(accel: Sensor) -> Sensor:
    """Invert the sign of all of an accelerometer's readings."""
    found = replace(accel, start=-accel.start, turned=-accel.turned)
    return found.nonlinear_at(found.nominal(found.raw))


def _turned(sensor: Sensor, rotation: Array) -> Sensor:
    """Rotate a sensor with a symmetric initial K by an orthogonal matrix."""
    numbers = sensor.start @ entries(sensor.symmetric).T
    K = rotation @ numbers[:9].reshape(3, 3)
    start = np.concatenate([K.ravel(), rotation @ numbers[9:]])
    found = replace(sensor, symmetric=False, start=start, turned=rotation)
    return found.nonlinear_at(found.nominal(found.raw))


def static_rests(data: TumbleData, config: Config) -> Array | None:
    """Start and end (P, 2), s, of intervals with all sensors at rest; None if motion is more informative."""
    assert data.accel is not None
    assert data.accel_t is not None
    t = data.accel_t
    root_rate = float(np.median(np.diff(t))) ** -0.5
    size = float(np.median(np.linalg.norm(data.accel - data.accel.mean(axis=0), axis=1))) / _GRAVITY
    unit = 1.0 if _is_si("accel", data.accel) else max(size, np.finfo(float).tiny)
    accel = Stream(data.accel / unit, stated("accel_density", config).stated * root_rate, ACCEL_TREMOR)
    gyro, others = None, []
    if data.gyro is not None and data.gyro_t is not None:
        density = sampled(stated("gyro_density", config, data.gyro_density), data.gyro_t, data.gyro).used
        gyro = Stream(interpolated(t, data.gyro_t, data.gyro), density * root_rate, GYRO_TREMOR)
    if data.mag is not None and data.mag_t is not None:
        mag = interpolated(t, data.mag_t, data.mag)
        others.append(Stream(mag / mag.std(), 1e-3, 0.0))
    try:
        found = find_static_intervals(t, accel, gyro, *others)
    except InputError:
        return None
    few = len(found) < FEWEST and (data.gyro is not None or np.diff(found).sum() <= _MOSTLY * (t[-1] - t[0]))
    if few or np.median(np.diff(found)) < _PAUSE:
        return None
    if data.gyro is not None:
        return found
    turned = [_slow_scatter(data.accel[first:last]) for first, last in np.searchsorted(t, found)]
    return found if np.median(turned) < TURNED else None


def _slow_scatter(raw: Array) -> float:
    """Scatter of readings (n, 3) over gravity beyond that of white noise: slow rotations at what looks like a rest."""
    slow = (raw.var(axis=0, ddof=1) - 0.5 * np.square(np.diff(raw, axis=0)).mean(axis=0)).sum()
    return float(np.sqrt(max(slow, 0.0)) / np.median(np.linalg.norm(raw, axis=1)))


def _accelerometer(data: TumbleData, config: Config, rests: Array | None, swung: bool) -> Sensor:
    assert data.accel is not None
    assert data.accel_t is not None
    known = data.latitude is not None
    strength = float(gravity(data.latitude, data.height)) if data.latitude is not None else _GRAVITY
    of = strength, 0.0 if known else _GRAVITY_SIGMA, "m/s^2"
    found = _sensor("accel", (data.accel_t, data.accel, data.accel_density), rests, config, of, swung)
    causes = dict(zip(ACCEL_CURVATURE, beside(found.nominal(found.raw)), strict=True))
    if rests is None and not swung:
        # The errors of a hand in motion are coloured by attitudes as cubic terms are, and far larger.
        del causes[ACCEL_CURVATURE[1]]
    if data.temperature is not None:
        temperature = data.temperature.above(data.temperature.first, data.accel_t)
        causes[ACCEL_SLOPE] = np.repeat(_means(data.accel_t, temperature[:, None], rests)[1], 3, axis=1)
    driven = tuple(each for each in causes if parameter(0, (each,), config) is not None)
    if not driven:
        return found
    return replace(found, drivers=np.concatenate([causes[each] for each in driven], axis=1), driven=driven)


def _magnetometer(data: TumbleData, config: Config, field: Array | None, alone: bool) -> Sensor:
    assert data.mag is not None
    assert data.mag_t is not None
    strength = known_strength(config, field)
    known = (1.0, 0.0, "1") if strength is None else (*strength, "T")
    found = _sensor("mag", (data.mag_t, data.mag, data.mag_density), None, config, known)
    return found if alone else replace(found, symmetric=False, start=found.start @ entries(True).T)


def _sensor(
    name: str,
    stream: tuple[Array, Array, float | None],
    rests: Array | None,
    config: Config,
    known: tuple[float, float, str],
    swung: bool = False,
) -> Sensor:
    """Build a triad with symmetric K.

    Args:
        name: accel or mag.
        stream: stamps of all samples, raw numbers, and the density that their messages state.
        rests: over which means are used; None: all samples are.
        known: strength, its sigma, and its unit.
        swung: whether it moves beside a gyro. In SI its K and b begin as nominal then: the ellipsoid nearest to
            readings with several m/s^2 of motion may have its centre thousands of m/s^2 away.
    """
    time, raw, number = _means(*stream[:2], rests)
    if rests is None and len(raw) < FEWEST:
        raise InputError(f"{name}: {len(raw)} readings, at least {FEWEST} in different attitudes are needed")
    is_si = _is_si(name, raw)
    usual = (_EARTH_FIELD if known[2] == "1" else known[0]) if is_si else None
    if swung and usual is not None:
        S, centre = np.eye(3) / usual, np.zeros(3)
    else:
        S, centre = first_guess(raw, usual, ACCEL_OFFSET if is_si and name == "accel" else OFFSET)
    radius = float(np.linalg.det(S)) ** (-1.0 / 3.0)
    start = np.concatenate([(radius * S)[np.triu_indices(3)], -S @ centre])
    numbers, root_number = start @ entries(True).T, np.sqrt(number)
    apart = StrengthFactor(time, raw / radius, np.ones(len(raw)), np.zeros(len(raw)), symmetric=True)
    distances = apart(np.tile(start, (len(raw), 1)), np.ones((len(raw), 1)))[0][:, 0]
    interval = float(np.median(np.diff(stream[0])))
    at_rest, spread = (0.0, 0.0) if rests is None else _scatter_at_rest(*stream[:2], rests, centre)
    seen = max(radius * robust_sigma(distances * root_number), _RESOLUTION * radius, at_rest * interval**-0.5)
    noise = _noise(name, config, stream[2], is_si, seen * interval**0.5, at_rest)
    if noise.stated > 0.0:
        noise = replace(noise, least=_RESOLUTION * radius * interval**0.5 / noise.stated)
    stated_sigma = noise.stated * interval**-0.5
    level = seen / stated_sigma if noise.source == "default" and noise.estimated else 1.0
    sample_scatter = level * stated_sigma / radius
    rest_levels: tuple[Level, ...] = ()
    if rests is not None:
        white = Level(replace(noise, families=()))
        if noise.estimated and at_rest:
            found = at_rest / noise.stated
            white = weighed(replace(white, found=found, sigma=spread * found))
        # Nine numbers are fitted to the readings, and take their share of what they miss.
        misfit = robust_sigma(distances) * (len(raw) / max(len(raw) - len(start), 1)) ** 0.5
        least = quantisation(*stream[:2], rests) / radius
        rest_levels = white, _repeatability(config, noise.families, known[0] * misfit, known[0] * least)
    return Sensor(
        name=name,
        time=time,
        raw=raw,
        sigma=stated_sigma / radius / root_number,
        excess=excess(raw / radius, sample_scatter / root_number, numbers),
        sample_scatter=sample_scatter,
        level=level,
        symmetric=True,
        is_si=is_si,
        radius=radius,
        gain=1.0 if usual is None else radius / usual,
        strength=known[0],
        spread=known[1],
        unit=known[2],
        start=start,
        turned=np.eye(3),
        rest_levels=rest_levels,
        noise=noise,
    )


def _scatter_at_rest(t: Array, raw: Array, rests: Array, centre: Array) -> tuple[float, float]:
    """Noise density, per sqrt(Hz), of vector lengths within rests, and its relative sigma; 0 where undetermined.

    Few rests determine the ellipsoid with hardly a residual, whose size says nothing of their noise.
    """
    interval = float(np.median(np.diff(t)))
    size = max(1, round(_BLOCK / interval))
    variances, redundancy = [], 0
    for first, last in np.searchsorted(t, rests):
        values = raw[first : last - (last - first) % size] - centre
        if len(values) > size:
            along = values @ (values.mean(axis=0) / np.linalg.norm(values.mean(axis=0)))
            means = along.reshape(-1, size).mean(axis=1)
            variances.append([along.var(ddof=1), size * means.var(ddof=1)])
            redundancy += len(means) - 1
    if not variances:
        return 0.0, 0.0
    # Samples say best how large white noise is, means how much more a slow one leaves.
    density = float(np.sqrt(np.mean(variances, axis=0).max() * interval))
    return density, max((2.0 * redundancy) ** -0.5, TRUSTED)


def _repeatability(config: Config, families: Sequence[str], misfit: float, least: float) -> Level:
    """Initial level of an accelerometer's repeatability over rests, at least `least` where no config states it, m/s^2.

    It begins at the misfit of the first guess: rests that repeat badly are no outliers.
    """
    level = repeatability("accel", config, *families)
    if level.noise.source != "default" or not level.noise.estimated:
        return level
    noise = replace(level.noise, least=least / level.noise.stated)
    return replace(level, noise=noise, scale=max(1.0, misfit / noise.stated, noise.least))


def quantisation(t: Array, raw: Array, rests: Array) -> float:
    """RMS error that readings in steps have in common over a rest, per axis, in their unit; 0 where noise dithers them.

    In steps q, with noise sigma, the mean square error is f = q^2 / (2 pi^2) sum exp(-(2 pi k sigma / q)^2) / k^2 over
    k = 1, 2, ..., and the variance shown q^2 / 12 + sigma^2 - f (Widrow, Kollar, "Quantization Noise", 2008).
    """
    spans = [slice(*span) for span in np.searchsorted(t, rests) + [0, 1]]
    shown = np.mean([raw[span].var(axis=0) for span in spans], axis=0)
    k, sigma = np.arange(1.0, 100.0), np.linspace(0.0, 1.0, 101)
    common = (np.exp(-((2.0 * np.pi * sigma[:, None] * k) ** 2)) / k**2).sum(axis=1) / (2.0 * np.pi**2)
    variance = np.maximum.accumulate(1.0 / 12.0 + sigma**2 - common)
    steps = [quantum(column) for column in without_rounding(raw).T]
    found = [q**2 * float(np.interp(own / q**2, variance, common)) for q, own in zip(steps, shown, strict=True) if q]
    return float(np.sqrt(sum(found) / len(steps)))


def _noise(name: str, config: Config, message: float | None, is_si: bool, seen: float, at_rest: float) -> Noise:
    """Noise as stated, in the recorded unit; if unstated, that at rest or, for counts, the first guess's scatter."""
    family = SENSOR_NAMES[name]
    if is_si:
        noise = stated(f"{name}_density", config, message, (family,))
        return replace(noise, stated=at_rest) if at_rest and noise.source == "default" and noise.estimated else noise
    figure = (at_rest or seen) if message is None else message
    return Noise(f"{name}_counts", figure, "default" if message is None else "message", ROUGHLY, (family,))


def _is_si(name: str, raw: Array) -> bool:
    """Whether the norms of readings with their offset are plausible in SI; others are counts."""
    low, high = PLAUSIBLE[name]
    return low <= float(np.median(np.linalg.norm(raw, axis=1))) <= high


def _means(t: Array, values: Array, rests: Array | None) -> tuple[Array, Array, Array]:
    """Times, means over the rests and sample counts, without empty rests; without rests, all samples."""
    if rests is None:
        return t, values, np.ones(len(t))
    first, last = np.searchsorted(t, rests[:, 0]), np.searchsorted(t, rests[:, 1], side="right")
    some = last > first
    means = [values[a:b].mean(axis=0) for a, b in zip(first[some], last[some], strict=True)]
    return rests[some].mean(axis=1), np.array(means).reshape(-1, values.shape[1]), (last - first)[some].astype(float)


def _together(
    data: TumbleData,
    config: Config,
    accel: Sensor,
    mag: Sensor,
    rests: Array | None,
    model: tuple[float, float] | None,
) -> tuple[list[Sensor], Dip, Moments | None, list[str]]:
    """Combine accelerometer and magnetometer: both in one frame, with the angles between their vectors."""
    assert data.mag_t is not None
    assert data.mag is not None
    rows, time, readings, number = _beside(data.mag_t, data.mag, accel.time, rests)
    if not len(rows):
        return [accel, mag], Dip(0.0, model), None, [_NEVER_TOGETHER]
    up = accel.directions[rows]
    vectors = nominal_of(readings / mag.radius, mag.start)
    seen = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rotation, sine, clear = _mounting(up, seen)
    premises = []
    if clear and model is not None and _contradicts(sine, model[0]):
        sine = -sine
        if _is_mounted_straight(rotation):
            accel = _inverted(accel)
            premises.append(_GRAVITY_DOWN)
        else:
            rotation = -rotation
            premises.append(_LEFT_HANDED)
    turned = _turned(mag, rotation)
    interval = float(np.median(np.diff(mag.time)))
    own = mag.noise.stated * interval**-0.5 / mag.radius / np.sqrt(number)
    cosine2 = max(1.0 - sine**2, 1e-2)
    sigma = np.sqrt(cosine2 * (accel.sigma[rows] ** 2 + accel.repeatability**2 + own**2))
    noise = Noise("dip", float(np.median(sigma)), "default", 0.0 if config.noise_known == 0.0 else ROUGHLY, ("dip",))
    drivers = None if accel.drivers is None else accel.drivers[rows]
    moments = Moments(time, accel.scaled[rows], readings / mag.radius, sigma, noise, drivers)
    dip = Dip(float(np.arcsin(np.clip(sine, -0.99, 0.99))), model)
    return [accel, turned], dip, moments, premises


def _beside(t: Array, values: Array, at: Array, rests: Array | None) -> tuple[Index, Array, Array, Array]:
    """Accelerometer rows with simultaneous magnetometer data; times, readings and sample counts of the latter."""
    if rests is not None:
        first, last = np.searchsorted(t, rests[:, 0]), np.searchsorted(t, rests[:, 1], side="right")
        rows = np.flatnonzero(last > first)
        time, readings, number = _means(t, values, rests)
        return rows, time, readings, number
    step = 1.5 * float(np.median(np.diff(t)))
    after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    rows = np.flatnonzero((at >= t[0]) & (at <= t[-1]) & (t[after] - t[after - 1] <= step))
    readings = interpolated(at[rows], t, values)
    return rows, at[rows], readings, np.ones(len(rows))


def _mounting(up: Array, field: Array) -> tuple[Array, float, bool]:
    """Solve up . R field = -s for a rotation R (3, 3) and s, from unit vectors (n, 3); also whether R is unique.

    Linear in the nine entries of R and in s, with one solution up to a factor, whose sign is R's determinant.
    """
    straight = np.eye(3), -float(np.mean((up * field).sum(axis=1))), False
    if len(up) < FEWEST:
        return straight
    design = np.column_stack([np.einsum("ni,nj->nij", up, field).reshape(-1, 9), np.ones(len(up))])
    _, sizes, axes = np.linalg.svd(design, full_matrices=False)
    M, s = axes[-1, :9].reshape(3, 3), float(axes[-1, 9])
    sign = 1.0 if np.linalg.det(M) > 0.0 else -1.0
    size = float(np.linalg.norm(M)) / np.sqrt(3.0)
    u, _, vt = np.linalg.svd(sign * M)
    if sizes[-2] <= _CLEAR * sizes[-1] or size < 1e-6:
        return straight
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, sign * s / size, True


def nearest_axes(rotation: Array) -> Array:
    """Signed permutation of axes nearest to an orthogonal matrix: the nominal mounting of a sensor."""
    mounted = np.zeros((3, 3))
    left = np.abs(rotation).copy()
    for _ in range(3):
        i, j = np.unravel_index(int(np.argmax(left)), (3, 3))
        mounted[i, j] = np.sign(rotation[i, j])
        left[i], left[:, j] = -1.0, -1.0
    return mounted
