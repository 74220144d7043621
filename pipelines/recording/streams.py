"""Sensors as methods need them: times in s from the session's start, sorted and finite, faulty samples removed.

    reader = StreamReader(recording, {"/imu": (), "/mag": ()})    # decodes all of them in one pass
    imu = reader.gyro("/imu")                                     # imu.t (N,) s, imu.series.gyro (N, 3) rad/s
    density = reader.density("/imu", "gyro", imu)                 # rad/s/sqrt(Hz)
    reader.dropped                                                # reason -> samples

A topic that is missing, empty or beyond repair is an InputError, see checks.py and faults.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import checks, plausibility
from alidade.pipelines.recording.checks import LEAST_ACCEL, LEAST_GYRO, LEAST_MAG, SLOWEST_GYRO_S, SLOWEST_S
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.series import ImuSeries, JointSeries, MagneticSeries, Series

AnySeries = TypeVar("AnySeries", bound=Series | JointSeries)

# Quantities whose faults are looked for, and their unit.
_UNITS = {"gyro": "rad/s", "accel": "m/s^2", "field": "T"}
# Kind of sensor -> covariance of its samples, and the noise density below which no sensor is.
_NAMES = {"gyro": "gyro", "accel": "accelerometer"}
_NOISE = {
    "gyro": ("gyro_cov", LEAST_GYRO),
    "accel": ("accel_cov", LEAST_ACCEL),
    "mag": ("field_cov", LEAST_MAG),
}
# Temperatures that sensors work at, degrees Celsius, and what kelvin are for most of them.
_COLDEST, _WARMEST, _ZERO_CELSIUS = -100.0, 200.0, 273.15
# Longest gap between temperatures, s: they change slowly, a straight line serves over this time.
MAX_TEMPERATURE_GAP_S = 30.0


@final
@dataclass(frozen=True, eq=False)
class Samples(Generic[AnySeries]):
    """Usable samples of a series, N of them, at times t (N,), s from the session's start, strictly increasing."""

    t: Array
    series: AnySeries

    def rows(self, rows: NDArray[np.intp]) -> Samples[AnySeries]:
        """Return the samples in the selected rows."""
        return Samples(checks.take_rows(self.t, rows), _rows(self.series, rows))


@dataclass(frozen=True, eq=False)
class Temperature:
    """Temperatures (P,), degrees Celsius, at times t (P,), s, increasing, P >= 1."""

    t: Array
    celsius: Array

    @property
    def first(self) -> float:
        """First temperature, degrees Celsius, at which biases are stated."""
        return float(self.celsius[0])

    def above(self, reference: float, at: ArrayLike) -> Array:
        """Return temperatures above a reference, K, at times (n,), s, interpolated linearly between messages."""
        return np.asarray(np.interp(np.asarray(at, dtype=float), self.t, self.celsius) - reference)


class SensorReadings(NamedTuple):
    """Readings (N, k) of one sensor: its name in messages, its unit, and whether all axes may read one value."""

    name: str
    values: Array
    unit: str
    may_be_constant: bool = False


def screened(stream: str, t: Array, sensors: Sequence[SensorReadings], dropped: dict[str, int]) -> NDArray[np.intp]:
    """Return the rows of a stream at times t (N,), s, that are measured once and have no fault; count the others.

    A driver may repeat a reading until there is a new one; it is used once, and is none at the end of the range.

    Raises:
        InputError: a sensor is dead, or loses more than a fifth of its samples (`faults.drop_faults`).
    """
    if not sensors:
        return np.arange(len(t))
    # Recordings of hours: a copy is made where it has to be.
    readings = sensors[0].values if len(sensors) == 1 else np.hstack([sensor.values for sensor in sensors])
    once = plausibility.measured_once(stream, readings, dropped)
    del readings
    time, sound = checks.take_rows(t, once), np.arange(len(once))
    for name, values, unit, may_be_constant in sensors:
        kept = drop_faults(name, time, checks.take_rows(values, once), dropped, unit, may_be_constant)
        sound = np.intersect1d(sound, kept, assume_unique=True)
    return once[sound]


class StreamReader:
    """Reads the sensors of a recording and counts the samples that cannot be used.

    Args:
        topics: names of topics that are decoded in one pass, each with the joints that are needed; those that are not
            there are ignored.

    Attributes:
        dropped: reason -> samples that are not used, or used with a reservation, of the topics read by now.
    """

    def __init__(self, recording: Recording, topics: Mapping[str, Sequence[str]]) -> None:
        self.recording, self.epoch_ns = recording, recording.epoch_ns
        self.dropped: dict[str, int] = {}
        recording.read_together(topics)

    def count(self, topic: str, reason: str, number: int) -> None:
        """Add a number of samples of a topic to the entry of a reason in `dropped`."""
        checks.count(self.dropped, f"{topic}: {reason}", number)

    def clean(
        self, topic: str, t_ns: NDArray[np.int64], values: Array, least: int = 2
    ) -> tuple[Array, NDArray[np.int64]]:
        """Times (n,), s from the recording's epoch, and row numbers of the usable samples; see checks.clean."""
        return checks.clean(topic, t_ns, self.epoch_ns, values, self.dropped, least)

    def samples(
        self, topic: str, found: AnySeries, *quantities: str, least: int = 2, may_be_constant: bool = False
    ) -> Samples[AnySeries]:
        """Return the samples of a series whose `quantities` (names of attributes) are finite and without faults.

        Args:
            quantities: (N, k) each; those of inertial sensors and magnetometers are screened.
            least: samples needed.
            may_be_constant: whether all axes may read the same throughout.
        """
        self.count(topic, "stamped by log time (kept)", found.stamped_by_log)
        for name in () if may_be_constant else quantities:
            _check_recorded(topic, found, name)
        values = np.concatenate([getattr(found, name).reshape(len(found), -1) for name in quantities], axis=1)
        slowest_s = SLOWEST_GYRO_S if "gyro" in quantities else SLOWEST_S
        t, rows = checks.clean(topic, found.t_ns, self.epoch_ns, values, self.dropped, least, slowest_s)
        del values
        samples = Samples(t, _rows(found, rows))
        sensors = [
            SensorReadings(topic, getattr(samples.series, name), _UNITS[name], may_be_constant)
            for name in quantities
            if name in _UNITS
        ]
        return samples.rows(screened(topic, t, sensors, self.dropped))

    def gyro(self, topic: str, least: int = 2, may_be_constant: bool = False) -> Samples[ImuSeries]:
        """Read the samples of an Imu topic with usable rates, rad/s; a reading that the driver repeats is used once.

        `may_be_constant`: a parked platform may read zero throughout, by a simulator or a driver that cuts off noise.
        """
        imu = self.recording.imu(topic)
        samples = self.samples(topic, imu, "gyro", least=least, may_be_constant=may_be_constant)
        checks.check_gyro(topic, samples.t, samples.series.gyro)
        return samples

    def force(self, topic: str, imu: Samples[ImuSeries]) -> Array | None:
        """Return the specific force (N, 3), m/s^2, of samples from `gyro`; None where the topic has no accelerometer.

        It has none when it is a placeholder, when a number is missing, or when it is not in m/s^2, gravity in it.
        """
        force = imu.series.accel
        if not (np.isfinite(force).all() and plausibility.is_there("accel", force, imu.series.accel_cov)):
            return None
        if problem := plausibility.implausible("accel", force):
            self.count(topic, f"{problem}: not used", len(force))
            return None
        return force

    def magnetic_field(self, topic: str) -> Samples[MagneticSeries]:
        """Read the samples of a MagneticField topic, T; a reading that the driver repeats is used once."""
        return self.samples(topic, self.recording.magnetic(topic), "field")

    def density(self, topic: str, kind: str, samples: Samples[AnySeries]) -> float | None:
        """Noise density, per sqrt(Hz), that the covariances of samples state; None if they state none.

        The N >= 2 samples are of a `kind`: gyro, accel or mag.
        """
        attribute, least = _NOISE[kind]
        return plausibility.density(topic, kind, samples.t, getattr(samples.series, attribute), least, self.dropped)

    def attitude(self, topic: str, least_variance: float, least: int = 2) -> tuple[Array, Array, Array]:
        """Times (N,) s, unit quaternions (N, 4) and covariances (N, 3, 3), rad^2, of a topic of poses or attitudes.

        Rotations that a tracker lost are left out, and one that is published again counts once. An implausible
        covariance is zero, also where it is below `least_variance`, rad^2.
        """
        poses = self.recording.poses(topic)
        self.count(topic, "stamped by log time (kept)", poses.stamped_by_log)
        given = checks.tracked(topic, poses.wxyz, self.dropped)
        t, rows = self.clean(topic, poses.t_ns, given, least)
        own = plausibility.measured_once(topic, given[rows], self.dropped)
        t, rows = t[own], rows[own]
        wxyz = checks.unit_quaternions(topic, t, given[rows])
        cov = poses.cov[rows][:, 3:, 3:]
        return t, wxyz, plausibility.plausible_covariance(topic, "attitude", cov, least_variance, self.dropped)

    def temperature(self, topic: str, sensor_t: Array) -> Temperature:
        """Read the temperature of a sensor that has samples at sensor_t (N,), s from the session's start.

        Raises InputError also when a temperature is none of a sensor in degrees Celsius, and when there is none for
        MAX_TEMPERATURE_GAP_S while the sensor has samples.
        """
        samples = self.samples(topic, self.recording.temperature(topic), "celsius", least=1)
        t, celsius = samples.t, samples.series.celsius
        bad = np.flatnonzero((celsius < _COLDEST) | (celsius > _WARMEST))
        if len(bad):
            value = celsius[bad[0]]
            kelvin = _COLDEST < value - _ZERO_CELSIUS < _WARMEST
            more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
            raise InputError(
                f"topic {topic}: {value:.6g} at {t[bad[0]]:.6f} s{more}{'; is it in kelvin?' if kelvin else ''} "
                f"The temperature of a sensor in degrees Celsius is needed, {_COLDEST:g} to {_WARMEST:g}"
            )
        span = sensor_t[[0, -1]]
        known = np.concatenate([span[:1], np.clip(t, *span), span[1:]])
        widest = int(np.argmax(np.diff(known)))
        if known[widest + 1] - known[widest] > MAX_TEMPERATURE_GAP_S:
            raise InputError(
                f"topic {topic}: no temperature from {known[widest]:.1f} to {known[widest + 1]:.1f} s; there has to be "
                f"one at least every {MAX_TEMPERATURE_GAP_S:g} s while the sensor measures"
            )
        return Temperature(t, celsius)


def imu_series(
    epoch_ns: int,
    t: Array,
    gyro: Array,
    accel: Array | None = None,
    density: float | None = None,
    accel_density: float | None = None,
    frame_id: str = "imu",
) -> ImuSeries:
    """Make an IMU series for writing, from samples at times t (N,), s, and noise densities, SI per sqrt(Hz)."""
    t_ns, force = checks.nanoseconds(t, epoch_ns), np.zeros(3) if accel is None else accel
    gyro_cov, accel_cov = white_covariance(t, density), white_covariance(t, accel_density)
    return ImuSeries(t_ns, gyro, force, gyro_cov=gyro_cov, accel_cov=accel_cov, frame_id=frame_id)


def white_covariance(t: Array, density: float | None) -> Array:
    """Covariance (3, 3) of samples at times t (N,), s, with white noise of a density; zeros where it is unknown."""
    return (0.0 if density is None else density**2 / float(np.median(np.diff(t)))) * np.eye(3)


def _check_recorded(topic: str, found: AnySeries, name: str) -> None:
    """Raise InputError for an IMU without a sensor: it states a covariance of -1 and has no plausible readings."""
    if not isinstance(found, ImuSeries) or name not in _NAMES:
        return
    values, cov = getattr(found, name), getattr(found, f"{name}_cov")
    if (cov[:, 0, 0] == -1.0).all() and not plausibility.is_there(name, values, cov):
        raise InputError(
            f"topic {topic} has no {_NAMES[name]}, which is needed here: record it, or name its topic or columns"
        )


def _rows(found: AnySeries, rows: NDArray[np.intp]) -> AnySeries:
    """Return a series with the selected rows alone."""
    names = ("t_ns", *(found.COLUMNS if isinstance(found, Series) else ("position",)))
    kept: dict[str, Any] = {name: checks.take_rows(getattr(found, name), rows) for name in names}
    return dataclasses.replace(found, **kept)
