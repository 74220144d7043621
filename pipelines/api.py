"""What `import alidade` gives: the functions behind the commands, with files or with arrays in memory."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ValidationError

from pipelines import methods
from pipelines.config import load_config
from pipelines.config import model as _config_model
from pipelines.errors import InputError
from pipelines.methods import Method
from pipelines.recording.opening import Where
from pipelines.recording.reading import open_recording
from pipelines.session import Arrays, Session
from pipelines.settings import Config as _BaseConfig
from pipelines.simulation.simulated import Simulated

if TYPE_CHECKING:
    from pipelines.follow.guidance import View
    from pipelines.planning import Plan
    from pipelines.reports.calibration import SavedCalibration
    from pipelines.reports.result import Calibration

    Config = _BaseConfig
else:
    Config = _config_model()

# What can be opened: a recording, its files, simulated data, a method's own data or its fields by name.
Source = str | Path | list[str | Path] | Simulated | Mapping[str, Any] | Any
# Settings that override the recording's own: an alidade.Config or a YAML file.
Settings = _BaseConfig | str | Path | None


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
            class. Times are s, everything else SI.
        method: its name; by default that of the config, or the only one the recording can serve.
        config: overrides, key by key, the config that comes with the source.
        strict: refuse a recording of which anything is lost.
        prior: an earlier calibration of the device to begin from: its result.json or calibration.yaml.

    Raises:
        InputError: source, config or prior cannot be used.
    """
    session = _open(source, method, config, strict)
    return session if prior is None else session.beginning_from(Path(prior))


def _open(source: Source, method: str | None, config: Settings, strict: bool) -> Session:
    override = Path(config) if isinstance(config, str) else config
    if isinstance(source, str | Path | list | tuple):
        return Session.read(open_recording(_files(source), strict), method, override)
    if isinstance(source, Simulated):
        text = load_config(source.config.encode(), override)
        chosen = methods.method(method or text.method or "")
        return Session(chosen, source.data, text, Arrays(chosen, source.data, source.truth))
    settings = load_config(None, override)
    name = method or settings.method
    if name is None:
        raise InputError("arrays do not say which method they are for: open(..., method=...)")
    chosen = methods.method(name)
    data = source if is_dataclass(source) else _data(chosen, source)
    _check(chosen, data)
    return Session(chosen, data, settings, Arrays(chosen, data))


def _files(source: str | Path | Sequence[Any]) -> Where:
    """A recording's path, or the paths of its files. Raises InputError when a list has anything else."""
    if isinstance(source, str | Path):
        return source
    if not all(isinstance(file, str | Path) for file in source):
        raise InputError("open([...]) takes the files of one recording; calibrate([...]) takes several recordings")
    return [Path(file) for file in source]


def calibrate(
    source: Source,
    solver: str = "batch",
    *,
    method: str | None = None,
    config: Settings = None,
    window: float | None = 1.0,
    prior: str | Path | None = None,
) -> Calibration:
    """Open and calibrate in one go (arguments as `open` and `Session.calibrate` have them).

    A list of sources is several recordings of one device, calibrated together by batch; the files of one recording are
    opened first: `open([...]).calibrate()`.

    Raises:
        InputError: source or config cannot be used, or there is no such solver.
        IndeterminateError: states other than the parameters are not determined.
    """
    if isinstance(source, list | tuple):
        if solver != "batch":
            raise InputError(f"solver {solver!r}: several recordings are calibrated together by batch alone")
        from pipelines.together import calibrate_together

        return calibrate_together([partial(open, each, method, config, prior=prior) for each in source])
    return open(source, method, config, prior=prior).calibrate(solver, window)


def load(path: str | Path, config: Settings = None) -> SavedCalibration:
    """A calibration.yaml, to be applied: `.parameters`, `.rotations`, `.transforms`, `.apply(...)`.

    Args:
        path: of the file.
        config: that it was made with, where its formulas depend on one: a cube's conversions of counts.

    Raises:
        InputError: file or config cannot be used.
    """
    from pipelines.reports.calibration import load_calibration

    return load_calibration(Path(path), load_config(None, Path(config) if isinstance(config, str) else config))


def simulate(
    method: str, scenario: str | Path | Mapping[str, Any] | BaseModel | None = None, seed: int = 0, images: bool = False
) -> Simulated:
    """A recording in memory, with its truth.

        data, truth = alidade.simulate("head", {"duration_s": 20.0}, seed=1)

    Args:
        method: its name.
        scenario: a name, a YAML file, the keys of one, or the model; None is the method's nominal scenario.
        seed: of the noise.
        images: draw pictures in place of what is measured in them.

    Raises:
        InputError: no such method or scenario, or a scenario that cannot be drawn.
    """
    chosen = methods.method(method)
    return chosen.simulate(_scenario(chosen, scenario, images), seed, images)


def plan(
    method: str,
    scenario: str | Path | None = None,
    *,
    config: str | Path | None = None,
    require: Mapping[str, float] | None = None,
) -> Plan:
    """How well a planned motion would determine each parameter, and a better one: `.now.sigmas`, `.steps`, `.best`.

    Raises:
        InputError: no such method, scenario or parameter.
    """
    from pipelines.planning import make_plan

    named = None if scenario is None else str(scenario)
    return make_plan(method, named, None if config is None else Path(config), require)


def follow(
    path: str | Path,
    show: Callable[[View], None] | None = None,
    *,
    method: str | None = None,
    config: str | Path | None = None,
    window: float | None = 1.0,
    patience: float = 30.0,
    prior: str | Path | None = None,
) -> Calibration:
    """Calibrate a recording while it is being made; returns when it is finished, or nothing is new for `patience` s.

    `path` is a file or a folder that is being written, `ws://host:port` of a Foxglove bridge, or `-` for standard
    input; `show` is given what is known whenever that changes; `prior` is as `open` has it.

    Raises:
        InputError: the file does not appear, is no recording, or cannot be used in the end.
        IndeterminateError: states other than the parameters are not determined.
    """
    from pipelines.follow.follower import Follower
    from pipelines.follow.follower import Settings as Following
    from pipelines.follow.sources import source_of

    earlier = None if prior is None else Path(prior)
    settings = Following(method, None if config is None else Path(config), window, patience, prior=earlier)
    with source_of(str(path), say=lambda _: None) as source:
        return Follower(source, settings, show or (lambda _: None), lambda _: None, lambda: False).follow()


def _scenario(method: Method, given: str | Path | Mapping[str, Any] | BaseModel | None, images: bool) -> BaseModel:
    from pipelines.simulation.scenario import explain

    if isinstance(given, BaseModel):
        return given
    if isinstance(given, Mapping):
        try:
            return method.scenario.model_validate(dict(given))
        except ValidationError as error:
            raise InputError(f"scenario: {explain(error.errors()[0], method.scenario)}") from error
    return method.settings(None if given is None else str(given), images)


def _data(method: Method, given: Mapping[str, Any]) -> Any:
    """The method's data from its fields by name."""
    kind = method.data
    hints = typing.get_type_hints(kind)
    known = {field.name: field for field in fields(kind)}
    for name in given:
        if name not in known:
            raise InputError(f"arrays: {method.name} has no {name}; it has {', '.join(known)}")
    values: dict[str, Any] = {"epoch_ns": 0}
    for name, field in known.items():
        if name in given:
            value = given[name]
            values[name] = np.asarray(value) if isinstance(value, list | tuple | np.ndarray) else value
        elif field.default is MISSING and field.default_factory is MISSING and name not in values:
            if NoneType not in typing.get_args(hints[name]):
                raise InputError(f"arrays: {method.name} needs {name}")
            values[name] = None
    return kind(**values)


def _check(method: Method, data: Any) -> None:
    """Raise InputError unless stamps increase and everything that they stamp is as long as they are."""
    if not isinstance(data, method.data):
        raise InputError(f"arrays: {method.name} takes {method.data.__name__}, not {type(data).__name__}")
    for stamps, carried in method.hypotheses().streams.items():
        t = getattr(data, stamps)
        if t is None:
            continue
        if t.ndim != 1 or not np.isfinite(t).all() or not (np.diff(t) > 0.0).all():
            raise InputError(f"arrays: {stamps} has to be one row of stamps in s, each later than the one before")
        for name in carried:
            values = getattr(data, name)
            if values is not None and len(values) != len(t):
                raise InputError(f"arrays: {name} has {len(values)} rows for the {len(t)} stamps of {stamps}")
