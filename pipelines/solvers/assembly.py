"""Steps put together to one graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam

from alidade.pipelines.estimation.problem import Factor, Problem, Step

# Frames in one vectorised factor: past this the Jacobians' zeros cost more than the Python calls they save.
CHUNK = 20


class StepBoundary(NamedTuple):
    """The end of a step: its time, the number of factors until then, and the variables that hold the parameters."""

    time: float
    factors: int
    current_keys: Mapping[int, int]


@dataclass
class Assembly:
    """The graph of some steps.

    Attributes:
        factors: in the order of the steps.
        initial: values of all variables.
        current_keys: parameter key -> variable that holds its value after the last step, where another one does.
        timestamps: variable -> time of last use, s, of those that age.
        keyframes: of all steps.
        boundaries: the steps' ends.
    """

    factors: list[Factor] = field(default_factory=list)
    initial: gtsam.Values = field(default_factory=gtsam.Values)
    current_keys: dict[int, int] = field(default_factory=dict)
    timestamps: dict[int, float] = field(default_factory=dict)
    keyframes: list[int] = field(default_factory=list)
    boundaries: list[StepBoundary] = field(default_factory=list)

    @classmethod
    def of(cls, steps: Iterable[Step]) -> Assembly:
        """All of the steps."""
        out = cls()
        for step in steps:
            out.factors.extend(step.factors)
            out.initial.insert(step.initial)
            out.current_keys.update(step.current_keys)
            out.timestamps.update(step.timestamps)
            out.keyframes.extend(step.keyframes)
            out.boundaries.append(StepBoundary(step.time, len(out.factors), dict(out.current_keys)))
        return out

    def shared(self, problem: Problem) -> list[int]:
        """The variables that hold the problem's parameters."""
        return [self.current_keys.get(p.key, p.key) for p in problem.parameters]
