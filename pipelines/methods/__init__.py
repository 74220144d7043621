"""Calibration methods: what the toolkit asks of one, and which are installed.

    method("head").problem(data, config)     # the factor graph
    names()                                  # ("los", "indexer", "head", "cube", "tumble", ...)

A method is a `Method`: nine required fields, defaults for the rest. Built-in methods are packages beside this file;
other distributions register theirs as entry points of the group `alidade.methods`, name = "module:METHOD", and commands
of their own as entry points of the group `alidade.commands`, word = "module:function".
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import require_mcap_name

if TYPE_CHECKING:
    from pydantic import BaseModel

    from alidade.factors.array import Array
    from alidade.pipelines.diagnostics.checklist import ChecklistItem
    from alidade.pipelines.diagnostics.cross_validation import Validation
    from alidade.pipelines.diagnostics.fault_models import FaultModel
    from alidade.pipelines.diagnostics.use import Truth, Use
    from alidade.pipelines.display.figure import Plot
    from alidade.pipelines.display.table import Table
    from alidade.pipelines.estimation.parameters import ParameterSpec
    from alidade.pipelines.estimation.problem import Estimate, Findings, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.noises import NoiseSpec
    from alidade.pipelines.recording import series
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config, MethodSection
    from alidade.pipelines.simulation.scenario import Simulated

GROUP, COMMANDS = "alidade.methods", "alidade.commands"
_log = logging.getLogger("alidade")

# Settings of a simulator, plain values by key.
Scenario = dict[str, Any]


def _not_offered(*_: Any) -> Any:
    raise InputError("the method does not offer this")


@dataclass(frozen=True, kw_only=True)
class Method:
    """One calibration method; `Any` stands for the class of its data.

    Attributes:
        name, title: as in the config and on the command line; as shown to people.
        data: frozen dataclass of arrays with epoch_ns, Unix ns, the zero of all times; field names are public API. Its
            annotations state the shape of a row (`alidade.pipelines.recording.shapes`) and are evaluated: the names in
            them are imported at run time.
        topics: every topic that is read, the optional ones included.
        requirements: what a recording must contain.
        read: recording, config -> data. Raises InputError when the recording cannot be used.
        check: raises InputError where the sensors of arrays contradict one another, as `read` does of a recording.
        to_topics: simulated data, pictures -> series by topic name, to be written; pictures replace what they show.
        problem: data, config -> factor graph. Raises InputError when the data do not suffice, or when the config names
            an unknown parameter.
        faults: what can be wrong with the data; tried when residuals do not fit.
        config_section: pydantic model of the method's own config section.
        noise: noises under `noise` in the config that only this method has.
        published: data, config, problem -> estimate by the published solver. Raises InputError where it does not apply.
        proposed: recording, config -> config keys that the recording suggests, each with the reason.
        parameters: unit, default prior, accuracy wanted, data sheet and description of every parameter.
        simulator, guidance, report: see these classes.
        frames: SVG of the frames for the report; `alidade.pipelines.display.drawing` states what it may contain.
        fallback: chosen automatically only for recordings that no other method can use.
    """

    name: str
    title: str
    data: type
    topics: tuple[Topic, ...]
    requirements: tuple[Need, ...]
    read: Callable[[Recording, Config], Any]
    to_topics: Callable[[Any, Any], dict[str, series.Topic]]
    problem: Callable[[Any, Config], Problem]
    parameters: tuple[ParameterSpec, ...]
    faults: FaultModel
    config_section: type[MethodSection] | None = None
    noise: tuple[NoiseSpec, ...] = ()
    published: Callable[[Any, Config, Problem], Estimate] = _not_offered
    check: Callable[[Any], None] = lambda data: None  # noqa: ARG005
    proposed: Callable[[Recording, Config], Sequence[str]] = lambda recording, config: ()  # noqa: ARG005
    simulator: Simulator | None = None
    guidance: Guidance = field(default_factory=lambda: Guidance())
    report: Report = field(default_factory=lambda: Report())
    frames: Path | None = None
    fallback: bool = False

    @property
    def data_sheets(self) -> dict[str, list[str]]:
        """Data-sheet figures that the method uses, by sensor as under `sensors` in the config."""
        found: dict[str, list[str]] = {}
        for spec in self.parameters:
            if spec.data_sheet and spec.figure not in found.setdefault(spec.sheet, []):
                found[spec.sheet].append(spec.figure)
        return found

    def is_per_recording(self, parameter: str) -> bool:
        """Whether a parameter belongs to a recording rather than to the device."""
        spec = self.spec(parameter)
        return spec is not None and spec.per_recording

    def describe(self, parameter: str) -> str:
        """Description of a parameter as a sentence; empty for an unknown one."""
        spec = self.spec(parameter)
        text = "" if spec is None else spec.describe(parameter)
        return text[:1].upper() + text[1:]

    def spec(self, parameter: str) -> ParameterSpec | None:
        """Declaration of a parameter; None for an unknown one."""
        from alidade.pipelines.estimation.parameters import spec_of

        return spec_of(self.parameters, parameter)

    def graph(self, data: Any, config: Config) -> Problem:
        """Build the factor graph with the config's prior means and covariances. Raises as `problem` does."""
        from alidade.pipelines.estimation.prior_replacement import with_priors

        return with_priors(self.problem(data, config), config.gaussian_priors)

    def simulate(self, scenario: Any, seed: int, images: bool = False) -> Simulated:
        """Simulate data and truth of a scenario in memory. Raises InputError without a simulator or if it refuses."""
        simulator = self.require_simulator()
        if images and not simulator.has_camera:
            raise InputError(f"{self.name} has no camera: leave out --images")
        return simulator.simulate(scenario, seed, images)

    def write(self, path: Path, simulated: Simulated) -> None:
        """Write simulated data as a recording with truth and config attached. Raises InputError."""
        self.write_data(path, simulated.data, simulated.truth, simulated.config, simulated.pictures)

    def write_data(
        self,
        path: Path | str,
        data: Any,
        truth: Mapping[str, float] | None = None,
        config_yaml: str | None = None,
        pictures: Any = None,
    ) -> None:
        """Write data as a recording, stamps rounded to ns; `read` restores data that begin at t = 0.

        Raises InputError when the file cannot be written.
        """
        from alidade.pipelines.recording.mcap_writer import write_session
        from alidade.pipelines.settings import ATTACHMENT, TRUTH

        attachments = {} if config_yaml is None else {ATTACHMENT: config_yaml.encode()}
        if truth is not None:
            attachments[TRUTH] = json.dumps(dict(truth), indent=1).encode()
        write_session(path, self.to_topics(data, pictures), attachments)

    def settings(self, scenario: str | None = None, images: bool = False) -> Any:
        """Simulator settings of a scenario, by name or file; None: the default scenario, or the model's defaults
        without one.

        Raises InputError when there is no such scenario, or when it does not fit the model.
        """
        from alidade.pipelines.simulation.scenario import load_scenario, shipped

        simulator, default = self.require_simulator(), self.default_scenario(images)
        of = (scenario or "").partition("_")[0]
        if of != self.name and of in _BUILT_IN and scenario in scenarios()[of]:
            raise InputError(
                f"scenario {scenario} is of method {of}; {self.name} has {', '.join(scenarios()[self.name])}"
            )
        if scenario is None and default not in shipped(simulator.folder):
            return simulator.scenario()
        return load_scenario(simulator.scenario, scenario or default, simulator.folder)

    @property
    def scenario(self) -> type[BaseModel]:
        """Class of the simulator's settings. Raises InputError without a simulator."""
        return self.require_simulator().scenario

    def default_scenario(self, images: bool = False) -> str:
        """Name of the scenario to simulate by default."""
        simulator = self.require_simulator()
        return (simulator.default_with_images if images else "") or f"{self.name}_nominal"

    def require_simulator(self) -> Simulator:
        """Return the simulator. Raises InputError when the method has none."""
        if self.simulator is None:
            raise InputError(f"method {self.name} has no simulator")
        return self.simulator


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """Declaration of how a method simulates recordings.

    Attributes:
        scenario: pydantic model of the settings; all have defaults.
        simulate: settings, seed, images wanted -> data and truth in memory. Raises InputError for settings that cannot
            be simulated.
        default_with_images: default scenario where images are wanted; empty: as without.
        folder: the method's own scenario files.
        randomised: motion or sensors depend on the seed, not only the noise: recordings of one scenario differ in what
            they determine.
        has_camera: pictures can be simulated.
    """

    scenario: type[BaseModel]
    simulate: Callable[[Any, int, bool], Simulated]
    default_with_images: str = ""
    folder: Path | None = None
    randomised: bool = False
    has_camera: bool = False


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Declaration of a method's advice: motion that helps.

    Attributes:
        checklist: data, config -> progress of each requirement of the motion, for the person recording.
        variations: settings of a planned motion -> changes that may determine more: description, changed settings.
    """

    checklist: Callable[[Any, Config], Sequence[ChecklistItem]] = lambda data, config: ()  # noqa: ARG005
    variations: Callable[[Scenario], Iterator[tuple[str, Scenario]]] = lambda scenario: iter(())  # noqa: ARG005


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Formulas whose results correct the measurements of an IMU or a magnetometer, for corrected topics.

    Attributes:
        topic: of the sensors.
        inputs: gyro, accel or field, as the messages have it -> the name that formulas have for it.
        results: gyro, accel or field -> name of the formula that corrects it.
        formulas: more of them, after the method's own.
        frame: frame of the results where it is not that of the messages.
        frame_of: topic whose corrected messages have the results' frame, if these are there.
    """

    topic: Topic
    inputs: Mapping[str, str]
    results: Mapping[str, str]
    formulas: tuple[Formula, ...] = ()
    frame: str = ""
    frame_of: Topic | None = None


@dataclass(frozen=True, kw_only=True)
class Report:
    """Declaration of a method's results other than its parameters.

    Attributes:
        formulas: names of determined parameters, config -> how a result is applied, in order of evaluation.
        fixed_rotations: config -> inputs of formulas that the config states, such as rotations of a drawing, by name.
        findings: data, config, estimate -> the method's own tables.
        figures: data, calibration -> the method's own figures and tables.
        validate: data, config, calibrated parameters by name, SI, those not there zero -> errors before and after
            compensation. Raises InputError when there are none.
        uses: estimate, config, noise used by name (SI) -> uses of a result, with the error that it leaves.
        corrections: topics whose sensors the formulas correct.
        cards: of the report's results: title -> groups of numbers, each with its title, the unit (deg, deg/s, deg/h,
            ms or µT; any other: the usual one) and the parameters; parameters of no card stand in a last one.
        residual_names: family of measurements -> names of its residuals that are not x, y, z.
    """

    formulas: Callable[[Collection[str], Config], Sequence[Formula]] = lambda parameters, config: ()  # noqa: ARG005
    fixed_rotations: Callable[[Config], Mapping[str, Array]] = lambda config: {}  # noqa: ARG005
    findings: Callable[[Any, Config, Estimate], Findings] = lambda data, config, estimate: {}  # noqa: ARG005
    figures: Callable[[Any, Calibration], Sequence[Plot | Table]] = lambda data, calibration: ()  # noqa: ARG005
    validate: Callable[[Any, Config, Mapping[str, float]], Sequence[Validation]] = _not_offered
    uses: Callable[[Truth, Config, Mapping[str, float]], Sequence[Use]] = lambda true, config, noise: ()  # noqa: ARG005
    corrections: tuple[Correction, ...] = ()
    cards: Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]] = field(default_factory=dict)
    residual_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


class _Deferred:
    """Object that is imported at its first call or attribute access."""

    def __init__(self, reference: str) -> None:
        self._reference = reference

    @cached_property
    def _target(self) -> Any:
        module, _, name = self._reference.partition(":")
        return getattr(import_module(module), name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._target(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)


# The object "package.module:name", imported when first used, in place of what it is: commands start fast.
deferred: Callable[[str], Any] = _Deferred


_BUILT_IN = ("los", "indexer", "head", "cube", "tumble")


def names() -> tuple[str, ...]:
    """Names of the built-in methods and of loadable methods from other distributions; failures are logged once."""
    return (*_BUILT_IN, *(name for name in _plugins() if _is_sound(name)))


@cache
def _is_sound(name: str) -> bool:
    try:
        method(name)
    except InputError as error:
        _log.warning("%s", error)
        return False
    return True


@cache
def method(name: str) -> Method:
    """Find a method by name. Raises InputError if there is none or its distribution is broken."""
    if name in _BUILT_IN:
        found = import_module(f"alidade.pipelines.methods.{name}").METHOD
        assert isinstance(found, Method)
        return found
    entry = _plugins().get(name)
    if entry is None:
        raise InputError(f"no method {name!r}; there are {', '.join(names())}")
    try:
        made = entry.load()
    except Exception as error:
        raise InputError(f"method {name}, brought by {_distribution(entry)}, cannot be loaded: {error}") from error
    if not isinstance(made, Method) or made.name != name:
        raise InputError(f"method {name}, brought by {_distribution(entry)}: {entry.value} is no Method of that name")
    return made


def prefer_specific(able: Sequence[str]) -> list[str]:
    """Remove the fallback methods from names, unless there are no others."""
    return [name for name in able if not method(name).fallback] or list(able)


def commands() -> dict[str, Callable[..., None]]:
    """Commands of other distributions by name, as typer functions; load failures are logged."""
    found: dict[str, Callable[..., None]] = {}
    for entry in entry_points(group=COMMANDS):
        try:
            found[entry.name] = entry.load()
        except Exception as error:
            _log.warning("command %s, brought by %s, cannot be loaded: %s", entry.name, _distribution(entry), error)
    return found


def simulate(name: str, scenario: str | None, seed: int, out: Path, images: bool = False) -> None:
    """Simulate a scenario, by name or file (None: the default one), and write it as a recording.

    Raises InputError when there is no such method or scenario, or when the recording cannot be written.
    """
    require_mcap_name(out)
    chosen = method(name)
    chosen.write(out, chosen.simulate(chosen.settings(scenario, images), seed, images))


def scenarios() -> dict[str, dict[str, Path]]:
    """Files of the named scenarios, by method and name; a name begins with the method's."""
    from alidade.pipelines.simulation.scenario import shipped

    folders = {name: simulator.folder for name in names() if (simulator := method(name).simulator) is not None}
    return {
        name: {stem: path for stem, path in shipped(folder).items() if stem.startswith(f"{name}_")}
        for name, folder in folders.items()
    }


@cache
def _plugins() -> Mapping[str, EntryPoint]:
    """Entry points of other distributions' methods, by name."""
    return {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in _BUILT_IN}


def _distribution(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.value
