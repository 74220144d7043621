"""A problem's steps put together and compiled for one of the two engines that eliminate its linear systems.

"chain" (`chain.py`, numpy) serves problems whose variables are a chain of small states with shared unknowns, which all
methods' are; "gtsam" (`gtsam_engine.py`) any graph. "auto" takes the chain where the problem declares one and its
factors fit it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import gtsam

from alidade.pipelines.estimation.problem import EngineName, Factor, Problem, Step
from alidade.pipelines.solvers.layout import Layout, NotAChainError, Values
from alidade.pipelines.solvers.linearization import Linearization

# More measurements than any recording has: one step takes all.
ALL = 1 << 40


@dataclass(frozen=True, eq=False)
class Compiled:
    """A problem, or its first steps, ready to be solved.

    Attributes:
        problem: of which it is.
        engine: of its factors, with the noise stated.
        initial: values of all variables.
        current_keys: parameter key -> variable that holds its value in the end, where another one does.
        keyframes: of all steps.
    """

    problem: Problem
    engine: Linearization
    initial: Values
    current_keys: dict[int, int]
    keyframes: list[int]

    @classmethod
    def of(cls, problem: Problem, engine: EngineName = "auto", steps: Iterable[Step] | None = None) -> Self:
        """Compile a problem, or some of its steps.

        Raises:
            NotAChainError: "chain" is asked for, and the problem is none.
        """
        factors, initial, current, keyframes = list[Factor](), gtsam.Values(), dict[int, int](), list[int]()
        for step in problem.steps(ALL) if steps is None else steps:
            factors += step.factors
            initial.insert(step.initial)
            current |= step.current_keys
            keyframes += step.keyframes
        made, values = _engine(problem, engine, factors, initial, current)
        return cls(problem, made, values, current, keyframes)

    @property
    def layout(self) -> Layout:
        """Layout of the variables."""
        return self.engine.layout

    @property
    def keys(self) -> list[int]:
        """Keys of the variables that hold the parameters' final values."""
        return [self.current_keys.get(p.key, p.key) for p in self.problem.parameters]


def _engine(
    problem: Problem, name: EngineName, factors: list[Factor], initial: gtsam.Values, current: dict[int, int]
) -> tuple[Linearization, Values]:
    shared = [current.get(p.key, p.key) for p in problem.parameters]
    try:
        if problem.layout is None:
            raise NotAChainError(f"{problem.method}: the problem does not say how its variables are a chain")
        layout, values = Layout.of(problem.layout, initial)
        for key in shared:
            layout.root_columns(key)
        if name != "gtsam":
            return Linearization.of(factors, layout), values
    except NotAChainError:
        if name == "chain":
            raise
        layout, values = Layout.of(None, initial, shared)
    return Linearization.of(factors, layout, chain=False), values
