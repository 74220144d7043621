"""Fault models of a method's data, by the names of its fields; `hypothesis_tests` tests them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.settings import Config


@dataclass(frozen=True)
class ScaleFactor:
    """A number of the config with a possibly wrong scale.

    Attributes:
        label: the fault in words, with {factor}.
        apply: data, config and factor -> both with the number multiplied; None where it does not occur.
    """

    label: str
    apply: Callable[[Any, Config, float], tuple[Any, Config] | None]


@dataclass(frozen=True)
class ExactInput:
    """A number of data or config without uncertainty in the graph.

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
class DataFault:
    """A data fault specific to one method.

    Attributes:
        label: in words.
        corrected: data and config -> both without it; None where it cannot be.
        role: `fallback`: its correction would fit much else, so that it is tested only where nothing else fits;
            `stated`: it undoes what the config states, and counts wherever that leads nearer to the priors.
    """

    label: str
    corrected: Callable[[Any, Config], tuple[Any, Config] | None]
    role: Literal["usual", "fallback", "stated"] = "usual"


@dataclass(frozen=True)
class FaultModel:
    """Faults to test by solving again, in terms of the data's fields.

    Attributes:
        streams: stamps -> what carries them.
        signs: readings (n,) or (n, k) -> how people call them, and their columns.
        clock: stamps that may be late, and how people call their source.
        scalings: numbers of the config that may be off by a factor.
        faults: of other kinds.
        exact: fixed inputs, whose effect is reported and not tested.
        cut: whether a segment of the recording determines what the whole does, if less well.
    """

    streams: Mapping[str, Sequence[str]]
    signs: Mapping[str, tuple[str, Sequence[str]]]
    clock: tuple[str, str] | None = None
    scalings: Sequence[ScaleFactor] = ()
    faults: Sequence[DataFault] = ()
    exact: Sequence[ExactInput] = ()
    cut: bool = True

    def times(self, data: Any) -> list[Array]:
        """Stamps (n,), s, of all streams in the data."""
        return [time for name in self.streams if (time := getattr(data, name)) is not None]

    def span(self, data: Any) -> tuple[float, float]:
        """First and last stamp, s; zeros where there are no stamps."""
        times = [time for time in self.times(data) if len(time)]
        return float(min((t[0] for t in times), default=0.0)), float(max((t[-1] for t in times), default=0.0))

    def segment(self, data: Any, start: float, stop: float) -> Any:
        """Select the data in [start, stop), s, with unchanged times."""
        changes: dict[str, Array] = {}
        for stamps, fields in self.streams.items():
            time = getattr(data, stamps)
            if time is None:
                continue
            # Times increase: the samples are a view of those that there are.
            inside = slice(*np.searchsorted(time, [start, stop]).tolist())
            for name in (stamps, *fields):
                values = getattr(data, name)
                if values is not None:
                    changes[name] = values[inside]
        return replace(data, **changes)
