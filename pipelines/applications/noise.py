"""Noise of the gyros, accelerometers and magnetometers of a recording, from its static intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alidade.factors.array import Array, Index, Stamps, interpolated
from alidade.pipelines import deadline, methods, progress
from alidade.pipelines.applications.table_discovery import with_columns
from alidade.pipelines.config import Settings, load_config
from alidade.pipelines.diagnostics.noise_spectrum import AxisNoise, axis_noise
from alidade.pipelines.diagnostics.static_intervals import stretches_at_rest
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.checks import clean
from alidade.pipelines.recording.plausibility import SI, implausible, is_there
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.streams import SensorReadings, screened
from alidade.pipelines.settings import Config

# Pieces shorter than this many samples are left out.
_SHORTEST = 16
# No gyro at rest has more white noise, rad/s/sqrt(Hz): cheap consumer parts have .05 deg/s/sqrt(Hz), 9e-4.
_MOST_GYRO_DENSITY = 3e-3
# Readings that differ by less are one value, SI: no sensor's noise is as small, and its square is lost in rounding.
_LEAST_SPREAD = 1e-15
# A step longer than this many intervals may be a loss; it is one if so many stamps on either side agree.
_STEP, _AROUND = 1.5, 8
# So many samples lost in a row are filled in, if no more than this part of all is; otherwise a piece ends.
_HOLE, _MOST_FILLED = 5, 0.02


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Allan deviation and noise coefficients of one sensor.

    Attributes:
        topic: where it is in the recording.
        kind: gyro, accel or mag.
        unit: of its samples, SI.
        rate_hz: of its samples.
        rests: (P, 2) s from the recording's start, the static intervals that were used.
        samples: how many; filled: how many of them stand for lost ones.
        axes: x, y, z -> its noise; an axis that never changes is left out.
    """

    topic: str
    kind: str
    unit: str
    rate_hz: float
    rests: Array
    samples: int
    filled: int
    axes: dict[str, AxisNoise]

    @property
    def length_s(self) -> float:
        """Time at rest, s, all intervals together."""
        return self.samples / self.rate_hz


@dataclass(frozen=True, eq=False, repr=False)
class NoiseStudy:
    """Noise of all sensors of a recording; `notes` are sentences about lost and unusable data."""

    recording: str
    duration_s: float
    sensors: tuple[SensorNoise, ...]
    notes: tuple[str, ...]

    @property
    def config(self) -> dict[str, dict[str, float]]:
        """Section `noise` of a config with the densities found."""
        from alidade.pipelines.reports.noise_report import section

        return {"noise": section(self)[0]}

    def __repr__(self) -> str:
        return f"<NoiseStudy of {self.recording}: {', '.join(f'{s.topic} {s.kind}' for s in self.sensors)}>"


def noise(
    recording: str | Path, *, config: Settings = None, strict: bool = False, auto_columns: bool = False
) -> NoiseStudy:
    """Allan deviation of the sensors of a recording at rest: `.sensors`, and `.config`, what a Config takes of it.

    Args:
        recording: with gyros, accelerometers or magnetometers.
        config: the columns of tables, topics made of others, and those with rates alone.
        strict: refuse a recording of which anything is lost.
        auto_columns: take what `alidade info` concludes of the columns of tables, where the config describes none.

    Raises:
        InputError: recording or config cannot be used, there is no such sensor, or nothing in it is at rest.
    """
    settings, path = load_config(None, config), Path(recording)
    opened = open_recording(path, strict).with_config(settings.topics.values(), settings.columns)
    if auto_columns:
        opened, _ = with_columns(opened, settings)
    rates = _rates_alone(settings)
    names = [
        name
        for name, topic in opened.topics.items()
        if (topic.type in (*messages.IMUS, messages.MAGNETIC_FIELD) or name in rates)
        and topic.is_readable
        and topic.count
    ]
    if not names:
        kinds = f"{', '.join(messages.IMUS)} or {messages.MAGNETIC_FIELD}"
        raise InputError(
            f"{path}: no messages of an inertial sensor or magnetometer ({kinds}); {opened.there()}; a topic of "
            "rates alone is named in the config, `topics: {head_imu: TOPIC}`"
        )
    found: list[SensorNoise] = []
    troubles: list[str] = []
    notes: list[str] = []
    with deadline.usual(opened.duration_s):
        some = deadline.until_passed(names, "the noise of {} and of what follows it".format, 1)
        for name in progress.track(some, "noise", len(names)):
            try:
                found += _topic_noise(opened, name, notes)
            except InputError as error:
                troubles.append(str(error))
        notes += filter(None, [deadline.stopped()])
    if not found:
        raise InputError(
            "; ".join([*troubles, *notes]) or f"{path}: {', '.join(names)}: no sensor, all values are zero or NaN"
        )
    notes = [*opened.notes, *troubles, *notes]
    return NoiseStudy(path.name, opened.duration_s, tuple(found), tuple(notes))


def _rates_alone(settings: Config) -> set[str]:
    """Return the names of topics in the config for which a gyro's rates alone suffice."""
    known = [topic for name in methods.names() for topic in methods.method(name).topics]
    takes = {topic.key for topic in known if set(messages.RATES) <= set(topic.types)}
    return {source.name for key, source in settings.topics.items() if key in takes}


def _topic_noise(recording: Recording, name: str, notes: list[str]) -> Iterator[SensorNoise]:
    """Yield the noise of each sensor of a topic, none of a topic without sensors. Raises InputError."""
    t_ns, sensors = _sensors(recording, name)
    if not sensors:
        return
    dropped: dict[str, int] = {}
    together = np.hstack(list(sensors.values()))
    t, keep = clean(name, t_ns, recording.epoch_ns, together, dropped, least=3)
    samples = {kind: values[keep] for kind, values in sensors.items()}
    _check_units(name, t, samples)
    rests = stretches_at_rest(t, list(samples.values()), samples.get("gyro"))
    if not len(rests):
        raise InputError(
            f"topic {name}: nowhere at rest for two seconds in {t[-1] - t[0]:.3g} s; record it lying still, "
            "ten minutes for the densities, hours for the rest"
        )
    for kind, values in samples.items():
        part = f"{name} {kind}"
        # At rest a coarse sensor may read one value, which is noted below.
        sound = screened(part, t, [SensorReadings(part, values, SI[kind], may_be_constant=True)], dropped)
        pieces, interval, filled = _pieces(t[sound], values[sound], rests)
        if not pieces:
            raise InputError(f"topic {part}: too many samples are missing in the {len(rests)} static intervals")
        axes = {}
        for axis, letter in enumerate("xyz"):
            columns = [piece[:, axis] for piece in pieces]
            if any(np.ptp(column) > _LEAST_SPREAD for column in columns):
                axes[letter] = axis_noise(columns, interval)
            else:
                notes.append(f"{part}: axis {letter} reads the same value whenever it is at rest")
        count = sum(len(piece) for piece in pieces)
        if axes:
            yield SensorNoise(name, kind, SI[kind], 1.0 / interval, rests, count, filled, axes)
    notes += [f"{reason}: {number}" for reason, number in dropped.items()]


def _check_units(name: str, t: Array, samples: Mapping[str, Array]) -> None:
    """Raise InputError for sensors that are not in SI, all of them named."""
    wrong = [said for kind, values in samples.items() if (said := implausible(kind, values))]
    if "gyro" in samples:
        # Where it is quietest: of differences of white noise a tenth is below this share of a sample's sigma.
        steps = np.quantile(np.abs(np.diff(samples["gyro"], axis=0)), 0.1, axis=0) / (0.1257 * 2.0**0.5)
        density = float(np.median(steps)) * float(np.median(np.diff(t))) ** 0.5
        if density > _MOST_GYRO_DENSITY:
            wrong.append(
                f"rates scatter by {density:.2g} rad/s/sqrt(Hz), more than any gyro's at rest "
                f"({_MOST_GYRO_DENSITY:g}): record it lying still; if it did, is it in deg/s?"
            )
    if wrong:
        raise InputError(
            f"topic {name}: {'; '.join(wrong)} The message has to be in rad/s and m/s^2, T; of a table "
            "`units:` says what its columns are in"
        )


def _sensors(recording: Recording, name: str) -> tuple[Stamps, dict[str, Array]]:
    """Return the stamps of a topic, ns, and the samples (N, 3) of each sensor by kind."""
    if recording.topics[name].type == messages.MAGNETIC_FIELD:
        field = recording.magnetic(name)
        sensors, t_ns = {"mag": field.field}, field.t_ns
    else:
        imu = recording.imu(name)
        sensors, t_ns = {"gyro": imu.gyro, "accel": imu.accel}, imu.t_ns
        covariances = {"gyro": imu.gyro_cov, "accel": imu.accel_cov}
        sensors = {kind: values for kind, values in sensors.items() if is_there(kind, values, covariances[kind])}
    # A field of the message that nobody filled in is no sensor.
    return t_ns, {kind: values for kind, values in sensors.items() if np.any(np.nan_to_num(values))}


def _pieces(t: Array, values: Array, rests: Array) -> tuple[list[Array], float, int]:
    """Return evenly sampled pieces (n, 3) of static intervals, sampling interval, s, and number of filled samples."""
    pieces, lengths, intervals, filled = [], [], [], 0
    for start, end in rests:
        inside = slice(*np.searchsorted(t, [start, end + 1e-9]))
        if len(t[inside]) < _SHORTEST:
            continue
        parts, interval, holes = even_pieces(t[inside], values[inside])
        pieces += [part for part in parts if len(part) >= _SHORTEST]
        lengths.append(len(t[inside]))
        intervals.append(interval)
        filled += holes
    return pieces, float(np.average(intervals, weights=lengths)) if pieces else 0.0, filled


def even_pieces(t: Array, values: Array) -> tuple[list[Array], float, int]:
    """Return pieces (n, k) of evenly spaced samples, their interval, s, and the number of samples filled in.

    Jittering stamps count as evenly spaced; the stamps beside a hole distinguish lost samples from late stamps. Short
    holes are filled by straight lines, long ones split the record.

    Args:
        t: (N,) s, increasing.
        values: (N, k).
    """
    interval = float(np.median(np.diff(t)))
    lost = _lost(t, interval)
    interval = float((t[-1] - t[0]) / (len(t) - 1 + lost.sum()))
    fill = (lost > 0) & (lost <= _HOLE)
    if lost[fill].sum() > _MOST_FILLED * len(t):
        fill[:] = False
    ends = np.flatnonzero((lost > 0) & ~fill) + 1
    pieces = []
    for rows in np.split(np.arange(len(t)), ends):
        if len(rows) < 2:
            continue
        place = np.append(0, np.cumsum(1 + np.where(fill, lost, 0)[rows[:-1]]))
        part = values[rows]
        if place[-1] >= len(rows):
            grid = np.arange(place[-1] + 1)
            part = interpolated(grid, place, part)
        pieces.append(part)
    return pieces, interval, int(lost[fill].sum())


def _lost(t: Array, interval: float) -> Index:
    """Return the number of samples lost between each sample and the next, (N-1,)."""
    out = np.zeros(len(t) - 1, dtype=np.intp)
    late = t - interval * np.arange(len(t))
    for i in np.flatnonzero(np.diff(t) > _STEP * interval):
        before, after = late[max(0, i + 1 - _AROUND) : i + 1], late[i + 1 : i + 1 + _AROUND]
        out[i] = max(0, round(float(np.median(after) - np.median(before)) / interval))
    return out
