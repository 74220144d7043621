"""What can be wrong with a method's data, in the names of its fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from alidade.pipelines.settings import Config

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Scaling:
    """A number of the config that may be off by an unknown factor.

    Attributes:
        label: the fault in words, with {factor}.
        scaled: data, config and factor -> both with the number multiplied; None where it does not occur.
    """

    label: str
    scaled: Callable[[Any, Config, float], tuple[Any, Config] | None]


@dataclass(frozen=True)
class ExactInput:
    """A number of data or config that the graph takes for exact.

    Attributes:
        name: as in result.json.
        unit: of its changes; "1": a share of itself.
        step: what it is usually off by, one sigma.
        changed: data, config and change -> both with the number larger by that; None where it does not occur.
    """

    name: str
    unit: str
    step: float
    changed: Callable[[Any, Config, float], tuple[Any, Config] | None]


@dataclass(frozen=True)
class Fault:
    """A fault of its own kind.

    Attributes:
        label: in words.
        mended: data and config -> both without it; None where it cannot be.
        last: whether what mends it would mend much else, so that it counts only where nothing else does.
    """

    label: str
    mended: Callable[[Any, Config], tuple[Any, Config] | None]
    last: bool = False


@dataclass(frozen=True)
class Hypotheses:
    """Faults to be tried by solving again, told by the names of the data's fields.

    Attributes:
        streams: stamps -> what carries them.
        signs: readings (n,) or (n, k) -> how people call them, and their columns.
        offset: whether the method has a parameter `time_offset`.
        delays: other parameters that are delays -> the fault in words, with the parameter's name in braces.
        clock: stamps that may be late, and how people call their source.
        scalings: numbers of the config that may be off by a factor.
        faults: of other kinds.
        exact: numbers that are not tried, but told what they would do.
        cut: whether a stretch of the recording is a recording.
    """

    streams: Mapping[str, Sequence[str]]
    signs: Mapping[str, tuple[str, Sequence[str]]]
    offset: bool = False
    delays: Mapping[str, str] = field(default_factory=dict)
    clock: tuple[str, str] | None = None
    scalings: Sequence[Scaling] = ()
    faults: Sequence[Fault] = ()
    exact: Sequence[ExactInput] = ()
    cut: bool = True
