"""Methods: what the rest of the toolkit may ask of one, and which there are.

    method("head").simulate("head_nominal", seed=1).data      # arrays
    names()                                                   # ("los", "indexer", "head", "cube", "tumble", ...)

A method is an object of a class derived from `Method`. Those of the toolkit stand in folders beside this file; other
distributions bring theirs as entry points of the group `alidade.methods`, name = the method's, value = the class.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from alidade.pipelines.errors import InputError, nearest_three

if TYPE_CHECKING:
    from pydantic import BaseModel

    from alidade.pipelines.diagnostics.checklist import ChecklistItem
    from alidade.pipelines.diagnostics.cross_validation import Validation
    from alidade.pipelines.diagnostics.fault_models import FaultModel
    from alidade.pipelines.diagnostics.use import Truth, Use
    from alidade.pipelines.display.figure import Plot
    from alidade.pipelines.display.table import Table
    from alidade.pipelines.estimation.problem import Array, Estimate, Findings, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.calibration import SavedCalibration
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config, MethodSection
    from alidade.pipelines.simulation.simulated import Simulated

GROUP = "alidade.methods"
_log = logging.getLogger("alidade")

# A motion as a simulator's settings, plain values by key.
Scenario = dict[str, Any]


class Method(ABC):
    """One method of calibration; `Any` stands for its data, a frozen dataclass of arrays that only it knows.

    Modules that take long to import, numpy and pydantic among them, are imported by the functions that need them: the
    help asks all methods for their commands, and every command asks them for the attributes below.

    Attributes:
        name: as in configs and on the command line.
        title: what people call it.
        sheets: the data sheets it uses, as under `sensors` in the config -> their figures.
        of_recording: patterns of the parameters that belong to a recording; the others are the device's.
        rotations: parameters that are rotation vectors, without their _x, _y, _z -> the rotation each is.
        meanings: pattern of parameters' names -> what they are, a sentence with {0}, {1} for the pattern's groups; what
            `alidade.pipelines.methods.meanings` says of all methods need not stand there.
        components: family of measurements -> what its residuals are, one by one, where they are not x, y and z.
        cards: of the report's results: title -> groups of numbers, each with its title, the unit (empty: the usual one)
            and the parameters; what no card has stands in a last one.
        sketch: picture of the frames, SVG, if there is one; `alidade.pipelines.reports.sketch` says what it may have.
        scenarios: folder with scenarios that come with the method, if it brings its own.
        drawn: whether its simulator draws motions, or sensors far from nominal, from the seed, so that one recording of
            a scenario determines more than another.
        yields: whether it is chosen by itself only where no other method is served: it makes do with what others read
            too.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    of_recording: ClassVar[tuple[str, ...]] = ()
    rotations: ClassVar[Mapping[str, str]] = {}
    meanings: ClassVar[Mapping[str, str]] = {}
    components: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {}
    sketch: ClassVar[Path | None] = None
    scenarios: ClassVar[Path | None] = None
    drawn: ClassVar[bool] = False
    yields: ClassVar[bool] = False

    # -- from a recording to estimates

    @property
    @abstractmethod
    def topics(self) -> tuple[Topic, ...]:
        """What it reads, the optional ones included."""

    @property
    @abstractmethod
    def needs(self) -> tuple[Need, ...]:
        """What it cannot do without."""

    @property
    def section(self) -> type[MethodSection] | None:
        """The model of its own section of the config, if it has one."""
        return None

    @property
    @abstractmethod
    def data(self) -> type:
        """The class of its data: a frozen dataclass of arrays, with epoch_ns (Unix ns) the zero of all times.

        Its annotations say what arrays hold in a row (`alidade.pipelines.recording.shapes`). They are evaluated: what
        they name is imported when the program runs, too.
        """

    @abstractmethod
    def read(self, recording: Recording, config: Config) -> Any:
        """The method's data. Raises InputError when the recording cannot be used."""

    def check(self, data: Any) -> None:  # noqa: B027
        """Raise InputError where the sensors of arrays contradict one another, as `read` does of a recording."""

    def proposed(self, recording: Recording, config: Config) -> Sequence[str]:  # noqa: ARG002
        """Keys of the config that a recording it can read suggests, each with the reason; nothing takes them."""
        return ()

    @abstractmethod
    def problem(self, data: Any, config: Config) -> Problem:
        """The graph. Raises InputError when the data are too few, or the config names no such parameter."""

    def graph(self, data: Any, config: Config) -> Problem:
        """The graph with what the config knows of parameters in place of their priors. Raises as `problem` does."""
        from alidade.pipelines.estimation.believing import believing

        return believing(self.problem(data, config), config.beliefs)

    @abstractmethod
    def published(self, data: Any, config: Config, problem: Problem) -> Estimate:
        """The published solver's estimate. Raises InputError where it cannot serve the data."""

    # -- simulation and planning

    @property
    @abstractmethod
    def scenario(self) -> type[BaseModel]:
        """The model of the simulator's settings; all of them have defaults."""

    @abstractmethod
    def simulate(self, scenario: Any, seed: int, images: bool = False) -> Simulated:
        """Data and truth of a scenario (of the model above), in memory; with `images` pictures are drawn too.

        Raises InputError when the scenario cannot be drawn.
        """

    def nominal(self, images: bool = False) -> str:  # noqa: ARG002
        """Name of the scenario that is simulated where none is named."""
        return f"{self.name}_nominal"

    def settings(self, scenario: str | None = None, images: bool = False) -> Any:
        """The simulator's settings of a scenario, by name or file (None: the nominal one).

        Raises InputError when there is no such scenario, or it does not fit the model.
        """
        from alidade.pipelines.simulation.scenario import load_scenario

        return load_scenario(self.scenario, scenario or self.nominal(images), self.scenarios)

    @abstractmethod
    def write(self, path: Path, simulated: Simulated) -> None:
        """Write data as a recording, with truth and config attached. Raises InputError when it cannot be written."""

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:  # noqa: ARG002
        """Changes of a motion that may determine more: in words, and the changed motion."""
        return iter(())

    # -- judgement

    @abstractmethod
    def hypotheses(self) -> FaultModel:
        """What can be wrong with its data, to be tried when residuals do not fit."""

    def validate(self, data: Any, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:  # noqa: ARG002
        """Errors before and after compensation with parameter values by name. Raises InputError when there are none."""
        raise InputError(f"method {self.name} has no validation")

    def checklist(self, data: Any, config: Config) -> Sequence[ChecklistItem]:  # noqa: ARG002
        """What there is by now of what the method needs, for the person recording."""
        return ()

    # -- reports

    @abstractmethod
    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:
        """How a result with these parameters is applied, in the order of evaluation.

        Assumptions that the recording does not determine are not among them.
        """

    def stated(self, config: Config) -> Mapping[str, Array]:  # noqa: ARG002
        """What formulas ask to be measured that a config states, such as rotations of a drawing: name -> value."""
        return {}

    def findings(self, data: Any, config: Config, estimate: Estimate) -> Findings:  # noqa: ARG002
        """What there is to tell beside the parameters."""
        return {}

    def figures(self, data: Any, calibration: Calibration) -> Sequence[Plot | Table]:  # noqa: ARG002
        """The method's own figures and tables for the report."""
        return ()

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        """What a result is used for, with the error that it leaves.

        Args:
            true: the estimate.
            config: in force.
            noise: name -> noise used, SI.
        """
        return ()

    @property
    def exporters(self) -> Mapping[str, Callable[[SavedCalibration], str]]:
        """Format -> what writes a calibration in it; may raise InputError."""
        return {}

    # -- the command line

    @property
    def commands(self) -> Mapping[str, Callable[..., None]]:
        """Word -> a command of its own, a function as typer takes it; may raise InputError."""
        return {}


_BUILT_IN = ("los", "indexer", "head", "cube", "tumble")


def names() -> tuple[str, ...]:
    """The toolkit's methods, then those of other distributions that can be loaded; the others are logged once."""
    return (*_BUILT_IN, *(name for name in _brought() if _is_sound(name)))


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
    """The method of that name. Raises InputError when there is none, or when its distribution is broken."""
    if name in _BUILT_IN:
        found = import_module(f"alidade.pipelines.methods.{name}").METHOD
        assert isinstance(found, Method)
        return found
    entry = _brought().get(name)
    if entry is None:
        raise InputError(f"no method {name!r}; {nearest_three(name, names())}")
    try:
        made = entry.load()()
    except Exception as error:
        raise InputError(f"method {name}, brought by {_origin(entry)}, cannot be loaded: {error}") from error
    if not isinstance(made, Method) or made.name != name:
        raise InputError(f"method {name}, brought by {_origin(entry)}: {entry.value} is no Method of that name")
    return made


def without_yielding(able: Sequence[str]) -> list[str]:
    """Of the methods that a recording serves those that do not yield; all of them where there are no others."""
    return [name for name in able if not method(name).yields] or list(able)


def simulate(name: str, scenario: str | None, seed: int, out: Path, images: bool = False) -> None:
    """Simulate a scenario, by name or file (None: the method's nominal one), and write it as a recording.

    Raises InputError when there is no such method or scenario, or the recording cannot be written.
    """
    chosen = method(name)
    chosen.write(out, chosen.simulate(chosen.settings(scenario, images), seed, images))


def scenarios() -> dict[str, dict[str, Path]]:
    """Method -> name -> file of the scenarios that are found by name; the name begins with the method's."""
    from alidade.pipelines.simulation.scenario import shipped

    return {
        name: {stem: path for stem, path in shipped(method(name).scenarios).items() if stem.startswith(f"{name}_")}
        for name in names()
    }


@cache
def _brought() -> Mapping[str, EntryPoint]:
    """Methods of other distributions, by name."""
    return {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in _BUILT_IN}


def _origin(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.value
