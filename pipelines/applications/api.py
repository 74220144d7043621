"""Functions of `import alidade`: what the commands do, with recordings in files or with arrays in memory.

A, b, field = alidade.magcal(m)                         # MATLAB: (m - b) @ A lies on a sphere of radius field
K, bias, K_gyro, bias_gyro = alidade.imu_static(acc, gyro, t, latitude_deg=48.1)
R, delay = alidade.hand_eye(gyro, t, wxyz, t_wxyz)
"""

from __future__ import annotations

import numbers
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ValidationError

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import Settings, load_config
from alidade.pipelines.config import model as _config_model
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import AttitudeRate, EngineName
from alidade.pipelines.methods import Method
from alidade.pipelines.recording.checks import (
    SLOWEST_GYRO_S,
    SLOWEST_S,
    check_gyro,
    check_time_unit,
    clean,
    nanoseconds,
    take_rows,
    unit_quaternions,
)
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.shapes import Rows, as_dates, rows_by_name
from alidade.pipelines.recording.streams import SensorReadings, screened
from alidade.pipelines.settings import Config as _BaseConfig
from alidade.pipelines.settings import first_error, validated
from alidade.pipelines.simulation.scenario import Simulated

if TYPE_CHECKING:
    from alidade.pipelines.applications.comparison import Comparison
    from alidade.pipelines.applications.follow.guidance import View
    from alidade.pipelines.reports.calibration import SavedCalibration
    from alidade.pipelines.reports.result import Calibration

    _Model = _BaseConfig
else:
    _Model = _config_model()


class Config(_Model):
    """A config: keys of the YAML file, as a mapping or by name.

        alidade.Config({"noise": {"gyro_density": 1e-4}}, latitude_deg=48.1)

    Raises:
        InputError: the first key or value that cannot be used, in one line.
    """

    def __init__(self, keys: Mapping[str, Any] | None = None, /, **more: Any) -> None:
        try:
            super().__init__(**{**(keys or {}), **more})
        except ValidationError as error:
            raise InputError(f"config: {first_error(error, type(self))[1]}") from error

    def __repr__(self) -> str:
        return f"Config({self.model_dump(exclude_unset=True)})"

    __str__ = __repr__


# What can be opened: a recording, its files, simulated data, a method's own data or its fields by name.
Source = str | Path | list[str | Path] | Simulated | Mapping[str, Any] | Any

# No session takes longer, s; stamps in ns, and in us after ten seconds, look as if one had.
_LONGEST = 1e7
# Rate of samples without stamps, Hz.
_RATE_HZ = 50.0
# A place in arrays and in the config is the same within so many rad, deg or m: of rounding.
_SAME_PLACE = 1e-6


def open(
    source: Source,
    method: str | None = None,
    config: Settings = None,
    strict: bool = False,
    prior: str | Path | None = None,
) -> Session:
    """A recording, or arrays, ready to be calibrated.

        alidade.open("session.mcap")
        alidade.open({"head_t": t, "head_gyro": w, "vision_t": tv, "vision_wxyz": q}, method="head")

    Args:
        source: a recording, or a list of its files; what `simulate` returns; or arrays, either by name (those of the
            method's data, see `alidade.Method.data`; what is not there counts as not recorded) or as an object of that
            class. Times are s or dates (datetime64, pandas' stamps), everything else SI; lists, integers, masked arrays
            and columns of data frames become arrays of floats, and rows are sorted by their stamps.
        method: its name; by default that of the config, or the only one the recording can serve.
        config: overrides, key by key, the config that comes with the source.
        strict: refuse a recording of which anything is lost.
        prior: an earlier calibration of the device to begin from: its result.json or calibration.yaml.

    Raises:
        InputError: source, config or prior cannot be used; of arrays, which one and why.
    """
    session = _open(source, method, config, strict)
    return session if prior is None else session.beginning_from(Path(prior))


def _open(source: Source, method: str | None, config: Settings, strict: bool) -> Session:
    if isinstance(source, str | Path | list | tuple):
        return Session.read(open_recording(source, strict), method, config)
    if isinstance(source, Simulated):
        return Session.of(methods.method(method) if method else None, source, config)
    if not (isinstance(source, Mapping) or is_dataclass(source)):
        raise InputError(f"open(...) takes a recording, simulated data or arrays by name, not {type(source).__name__}")
    settings = load_config(None, config)
    name = method or settings.method
    if name is None:
        raise InputError("arrays do not say which method they are for: open(..., method=...)")
    chosen = methods.method(name)
    with _naming_arrays():
        data = _at_config_place(_checked(chosen, _data(chosen, source)), settings)
        chosen.check(data)
    return Session(chosen, data, settings)


def calibrate(
    source: Source,
    solver: str = "batch",
    *,
    method: str | None = None,
    config: Settings = None,
    window: float | None = 1.0,
    prior: str | Path | None = None,
    engine: EngineName = "auto",
    attitude_rate: AttitudeRate = "vision",
) -> Calibration:
    """Open and calibrate in one go (arguments as `open` and `Session.calibrate` have them).

    `engine` eliminates batch's linear systems: "chain" (numpy), "gtsam", or "auto", the chain where the problem is one.

    `attitude_rate` is that of the trajectory: "vision", where the method estimates it, or "gyro", carried from there to
    each sample of the gyro.

    A list of sources is several recordings of one device, calibrated together by batch; the files of one recording are
    opened first: `open([...]).calibrate()`.

    Raises:
        InputError: source or config cannot be used, or there is no such solver or window.
        IndeterminateError: states other than the parameters are not determined.
    """
    if attitude_rate not in get_args(AttitudeRate):
        raise InputError(f"no attitude rate {attitude_rate!r}; there are {', '.join(get_args(AttitudeRate))}")

    def opened(one: Source) -> Session:
        return replace(open(one, method, config, prior=prior), attitude_rate=attitude_rate)

    if isinstance(source, list | tuple):
        if solver != "batch":
            raise InputError(f"solver {solver!r}: several recordings are calibrated together by batch alone")
        if engine != "auto":
            raise InputError(f"engine {engine!r}: of several recordings each has the one that fits it; leave it out")
        from alidade.pipelines.applications.joint import calibrate_together

        return calibrate_together([partial(opened, each) for each in source])
    if engine not in get_args(EngineName):
        raise InputError(f"no engine {engine!r}; there are {', '.join(get_args(EngineName))}")
    return replace(opened(source), engine=engine).calibrate(solver, window)


def load(path: str | Path, config: Settings = None) -> SavedCalibration:
    """A calibration.yaml, to be applied: `.parameters`, `.rotations`, `.transforms`, `.apply(...)`.

    Args:
        path: of the file.
        config: that it was made with, where its formulas depend on one: a cube's conversions of counts.

    Raises:
        InputError: file or config cannot be used.
    """
    from alidade.pipelines.reports.calibration import load_calibration, with_covariance

    return with_covariance(load_calibration(Path(path), load_config(None, config)), Path(path))


def simulate(
    method: str, scenario: str | Path | Mapping[str, Any] | BaseModel | None = None, seed: int = 0, images: bool = False
) -> Simulated:
    """A recording in memory, with its truth.

        data, truth = alidade.simulate("head", {"duration_s": 20.0}, seed=1)

    Args:
        method: its name.
        scenario: a name, a YAML file, the keys of one, or the model; None is the method's nominal scenario.
        seed: of the noise, 0 or more.
        images: draw pictures in place of what is measured in them.

    Raises:
        InputError: no such method or scenario, a scenario that cannot be drawn, or a seed below zero.
    """
    _check_seed(seed)
    chosen = methods.method(method)
    return chosen.simulate(_scenario(chosen, scenario, images), seed, images)


def follow(
    path: str | Path,
    show: Callable[[View], None] | None = None,
    *,
    method: str | None = None,
    config: Settings = None,
    window: float | None = 1.0,
    patience: float = 30.0,
    prior: str | Path | None = None,
) -> Calibration:
    """Calibrate a recording while it is being made; returns when it is finished, or nothing is new for `patience` s.

    `path` is a file or a folder that is being written, `ws://host:port` of a Foxglove bridge, or `-` for standard
    input; `show` is given what is known whenever that changes; `prior` is as `open` has it.

    Raises:
        InputError: no such window or config, or the file does not appear, is no recording, or cannot be used in the
            end.
        IndeterminateError: states other than the parameters are not determined.
    """
    from alidade.pipelines.applications.follow.follower import Follower
    from alidade.pipelines.applications.follow.follower import Settings as Following
    from alidade.pipelines.applications.follow.sources import source_of

    earlier = None if prior is None else Path(prior)
    settings = Following(method, config, window, patience, check=True, prior=earlier)
    with source_of(str(path), say=lambda _: None) as source:
        return Follower(source, settings, show or (lambda _: None), lambda _: None, lambda: False).follow()


def compare(
    source: Source, *, method: str | None = None, config: Settings = None, window: float | None = 1.0
) -> Comparison:
    """Solve a recording by the published, batch and incremental solver, and its halves: `.answer`, `.calibrations`.

    Raises as `calibrate` does.
    """
    from alidade.pipelines.applications.comparison import compared

    return compared(open(source, method, config), window)


def _check_seed(seed: object) -> None:
    if not isinstance(seed, numbers.Integral) or int(seed) < 0:
        raise InputError(f"seed: {seed!r} is no whole number from zero on")


class _Result:
    """Base of the tuples that `magcal`, `imu_static` and `hand_eye` return: the calibration behind their numbers."""

    calibration: Calibration

    def _with(self, calibration: Calibration) -> Self:
        if calibration.status in ("inconsistent", "unobservable"):
            warnings.warn(f"{calibration.status}: {calibration.headline}", stacklevel=3)
        self.calibration = calibration
        return self


class MagnetometerResult(tuple[Array, Array, float], _Result):
    """Result of a compass calibration: A (3, 3), b (3,), field; details are in `.calibration`."""


class StaticResult(tuple[Array, Array, Array, Array], _Result):
    """K and bias of the accelerometer, K and bias of the gyro; the whole is in `.calibration`."""


class HandEyeResult(tuple[Array, float], _Result):
    """Result of a hand-eye calibration: R (3, 3), delay; details are in `.calibration`."""


def magcal(m: ArrayLike, t: ArrayLike | None = None, *, config: Settings = None) -> MagnetometerResult:
    """Hard and soft iron of a magnetometer from readings in all directions, method `tumble`.

    (m - b) @ A lies on a sphere: A (3, 3) symmetric with determinant 1, b (3,) hard iron and `field`, the radius, in
    the unit of m. Sigmas and verdicts are in `.calibration`.

    Args:
        m: (N, 3) readings, in any unit.
        t: (N,) s; without it 50 Hz.
        config: as `alidade.open` has it.

    Warns:
        UserWarning: the result is inconsistent or unobservable.

    Raises:
        InputError: arrays or config cannot be used.
    """
    readings = np.asarray(m, dtype=float)
    stamps = np.arange(len(readings)) / _RATE_HZ if t is None else t
    found = calibrate({"mag_t": stamps, "mag": m}, method="tumble", config=config)
    K = found.matrix("mag")
    scale = float(np.linalg.det(K) ** (-1.0 / 3.0))
    strength = found.parameters["field_strength"].value
    return MagnetometerResult((scale * K, found.bias("mag"), scale * strength))._with(found)


def imu_static(
    acc: ArrayLike, gyro: ArrayLike, t: ArrayLike, *, latitude_deg: float, config: Settings = None
) -> StaticResult:
    """Accelerometer and gyro of an IMU laid down in many attitudes, method `cube` without camera and reference.

    nominal = K (raw - bias) of either sensor, (3, 3) and (3,), SI, along the body's axes.

    Args:
        acc: (N, 3) m/s^2.
        gyro: (N, 3) rad/s.
        t: (N,) s.
        latitude_deg: of the place: gravity is 9.780 m/s^2 at the equator and 9.832 at the poles.
        config: as `alidade.open` has it.

    Warns:
        UserWarning: the result is inconsistent or unobservable.

    Raises:
        InputError: arrays or config cannot be used.
    """
    keys = {"latitude_deg": latitude_deg, **load_config(None, config).model_dump(exclude_unset=True)}
    found = calibrate({"imu_t": t, "gyro": gyro, "accel": acc}, method="cube", config=keys)
    numbers = (found.matrix("accel"), found.bias("accel"), found.matrix("gyro"), found.bias("gyro"))
    return StaticResult(numbers)._with(found)


def hand_eye(
    gyro: ArrayLike, t: ArrayLike, wxyz: ArrayLike, t_wxyz: ArrayLike, *, config: Settings = None
) -> HandEyeResult:
    """Rotation and delay between a gyro and a tracked body that are fixed to each other, method `head`.

    R (3, 3) maps coordinates in the tracked body to those of the gyro; delay, s, is positive where attitudes were taken
    later than their stamps say. Translations are not estimated.

    Args:
        gyro: (N, 3) rad/s.
        t: (N,) s.
        wxyz: (M, 4) attitudes of the body in the tracker's frame, unit quaternions w, x, y, z.
        t_wxyz: (M,) s.
        config: as `alidade.open` has it.

    Warns:
        UserWarning: the result is inconsistent or unobservable.

    Raises:
        InputError: arrays or config cannot be used.
    """
    arrays: dict[str, Any] = {"head_t": t, "head_gyro": gyro, "vision_t": t_wxyz, "vision_wxyz": wxyz}
    found = calibrate(arrays, method="head", config=config)
    R = so3.matrix(np.array(found.rotations["helmet_mount"].wxyz))
    return HandEyeResult((R, found.parameters["time_offset"].value))._with(found)


def _scenario(method: Method, given: str | Path | Mapping[str, Any] | BaseModel | None, images: bool) -> BaseModel:
    if isinstance(given, BaseModel):
        return given
    if isinstance(given, Mapping):
        return validated(method.scenario, dict(given), "scenario")
    return method.settings(None if given is None else str(given), images)


def _data(method: Method, given: Any) -> Any:
    """Make the method's data from fields by name, or an object of its class; None stands for what was not recorded."""
    kind = method.data
    if is_dataclass(given):
        if not isinstance(given, kind):
            raise InputError(f"{method.name} takes {kind.__name__}, not {type(given).__name__}")
        given = {field.name: getattr(given, field.name) for field in fields(kind)}
    hints = typing.get_type_hints(kind)
    known = {field.name: field for field in fields(kind)}
    for name in given:
        if name not in known:
            raise InputError(f"{method.name} has no {name}; it has {', '.join(known)}")
    values = {"epoch_ns": 0} | {name: value for name, value in given.items() if value is not None}
    for name, field in known.items():
        if name not in values and field.default is MISSING and field.default_factory is MISSING:
            if NoneType not in typing.get_args(hints[name]):
                raise InputError(f"{method.name} needs {name}")
            values[name] = None
    return kind(**values)


def _checked(method: Method, data: Any) -> Any:
    """Return the data with all arrays as floats, sorted by their stamps, without repeated rows.

    Raises:
        InputError: an array is none of numbers or has rows of another shape than its class says, stamps are not in s
            or cannot be sorted as those of a file are, or what they stamp is not as long as they are, or not finite.
    """
    streams = method.faults.streams
    # Stamps and what they stamp are arrays, whatever annotations say.
    rows = {name: Rows() for stamps, carried in streams.items() for name in (stamps, *carried)}
    rows |= rows_by_name(method.data)
    given = {name: value for name in rows if (value := getattr(data, name)) is not None}
    dates = {name: t_ns for name in streams if name in given and (t_ns := as_dates(given[name])) is not None}
    if dates:
        if len(dates) < len(streams.keys() & given.keys()):
            others = ", ".join(sorted(streams.keys() & given.keys() - dates.keys()))
            raise InputError(f"{', '.join(dates)} are dates, {others} are not: give all as dates, or all in s")
        start = min(int(t_ns.min(initial=np.iinfo(np.int64).max)) for t_ns in dates.values())
        given |= {name: (t_ns - start) * 1e-9 for name, t_ns in dates.items()}
        data = replace(data, epoch_ns=start)
    arrays = {name: rows[name].read(name, value) for name, value in given.items()}
    dropped: dict[str, int] = {}
    for stamps, carried in streams.items():
        t, names = arrays.get(stamps), [name for name in carried if name in arrays]
        if t is None:
            if names:
                raise InputError(f"{names[0]} needs its stamps, {stamps}")
            continue
        _check_stamps(stamps, given[stamps], t)
        for name in names:
            values = arrays[name]
            if len(values) != len(t):
                raise InputError(f"{name} has {len(values)} rows for the {len(t)} stamps of {stamps}")
            if missing := rows[name].placeholders(values):
                arrays[name] = values = values.copy()
                values[:, missing] = np.nan
                dropped[f"{name}: column {missing[0]} reads one value throughout, as if it was not measured"] = len(t)
            lost = rows[name].lost(values)
            if len(lost):
                more = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
                raise InputError(f"{name} is not finite at {t[lost[0]]:.6f} s{more}; leave out such rows")
            if rows[name].shape == (4,):
                arrays[name] = unit_quaternions(name, t, values)
        if not (np.diff(t) > 0.0).all():  # the rows are sorted, and some dropped, as those of a file are
            each = (np.nan_to_num(arrays[name]).reshape(len(t), -1) for name in names)
            kept = clean(stamps, nanoseconds(t, 0), 0, np.hstack([t[:, None] * 0.0, *each]), dropped)[1]
            arrays |= {name: arrays[name][kept] for name in (stamps, *names)}
        has_gyro = any("gyro" in name for name in names)
        t_ns = nanoseconds(arrays[stamps], 0)
        check_time_unit(stamps, t_ns, SLOWEST_GYRO_S if has_gyro else SLOWEST_S)
        sensors = [
            SensorReadings(name, arrays[name], rows[name].unit, rows[name].may_be_constant)
            for name in names
            if rows[name].unit
        ]
        sound = screened(stamps, arrays[stamps], sensors, dropped)
        arrays |= {name: take_rows(arrays[name], sound) for name in (stamps, *names)}
        for name in names:
            # Those of a method that takes counts are looked at with their conversion.
            if "gyro" in name and "raw" not in getattr(method.config_section, "model_fields", {}):
                check_gyro(name, arrays[stamps], arrays[name])
    if dropped:
        data = replace(data, dropped={**data.dropped, **dropped})
    return replace(data, **arrays)


@contextmanager
def _naming_arrays() -> Iterator[None]:
    """Context manager that makes of an InputError about a topic one about an array."""
    try:
        yield
    except InputError as error:
        raise InputError(f"arrays: {str(error).removeprefix('topic ')}") from error


def _check_stamps(name: str, given: Any, t: Array) -> None:
    if t.ndim != 1 or not np.isfinite(t).all():
        raise InputError(f"{name} has to be one row of stamps in s, each later than the one before")
    if getattr(given, "dtype", None) == np.float32 and len(t) > 1:
        held, step = float(np.spacing(np.float32(np.abs(t).max()))), float(np.ptp(t)) / (len(t) - 1)
        if held > 0.1 * step:
            raise InputError(
                f"{name} is float32, which holds {np.abs(t).max():.6g} to {held:.3g} s: give float64, or "
                "subtract the first stamp before it becomes float32"
            )
    if np.ptp(t) > _LONGEST:
        raise InputError(f"{name} spans {np.ptp(t):.3g} s; times have to be in s, not in us or ns")


def _at_config_place(data: Any, config: _BaseConfig) -> Any:
    """Return the data with the place that the config states. Raises InputError where the data state another."""
    given = {
        "latitude": None if config.latitude_deg is None else np.deg2rad(config.latitude_deg),
        "longitude": None if config.longitude_deg is None else np.deg2rad(config.longitude_deg),
        "height": config.altitude_m,
        "latitude_deg": config.latitude_deg,
    }
    known = {field.name: field.default for field in fields(data)}
    found: dict[str, float] = {}
    for name, value in given.items():
        if value is None or name not in known:
            continue
        there = getattr(data, name)
        if there is not None and there != known[name] and abs(there - value) > _SAME_PLACE:
            raise InputError(f"{name} is {there:.8g}, by the config {value:.8g}; give one of them")
        found[name] = float(value)
    return replace(data, **found)
