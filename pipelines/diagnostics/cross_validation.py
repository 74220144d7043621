"""Cross-validation: a recording's segments solved by themselves, and the errors before and after compensation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import parallel
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.diagnostics.trial_fit import Build, max_concurrent, solve_trial
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Problem, Quantity
from alidade.pipelines.settings import Config


@dataclass(frozen=True)
class SplitHalf:
    """A parameter's estimates from the two segments of a recording: values and sigmas, SI."""

    first: float
    first_sigma: float
    second: float
    second_sigma: float

    @property
    def step(self) -> float:
        """Difference of the two estimates, second minus first."""
        return self.second - self.first

    @property
    def step_sigma(self) -> float:
        """Standard deviation of the difference between the halves."""
        return float(np.hypot(self.first_sigma, self.second_sigma))

    @property
    def z(self) -> float:
        """Difference between the halves over its sigma."""
        return self.step / self.step_sigma


# A quantity with its value and sigma.
_Number = tuple[Quantity, float, float]


def split_halves(
    build: Build, faults: FaultModel, data: Any, config: Config
) -> tuple[dict[str, SplitHalf], tuple[str, ...]]:
    """Solve both halves of a recording, see `solve_segments`; also return unsolved ones ("first", "second")."""
    parts = _solved_parts(build, faults, data, config, 0.5 * sum(faults.span(data)))
    return _in_both(*parts), tuple(name for name, part in zip(("first", "second"), parts, strict=True) if not part)


def solve_segments(
    build: Build, faults: FaultModel, data: Any, config: Config, middle: float, levels: Sequence[Level] = ()
) -> dict[str, SplitHalf]:
    """Solve the segments before and after a time, s; return the parameters that both determine.

    Parameters that a prior determines in either part are left out: they would agree whatever was recorded. A bias that
    walks differs between the parts by its walk too. Both parts have the noise levels of the whole recording in
    `levels`; those of other noises are estimated anew.
    """
    build = partial(_at_levels, build, {level.noise.name: level for level in levels})
    return _in_both(*_solved_parts(build, faults, data, config, middle))


def _solved_parts(
    build: Build, faults: FaultModel, data: Any, config: Config, middle: float
) -> list[dict[str, _Number]]:
    start, stop = faults.span(data)
    parts = [partial(_solved, build, faults, data, config, *part) for part in ((start, middle), (middle, stop + 1.0))]
    return parallel.done(parts, "either side", max_concurrent(faults.times(data)))


def _in_both(first: Mapping[str, _Number], second: Mapping[str, _Number]) -> dict[str, SplitHalf]:
    both = {name: (first[name], second[name]) for name in first if name in second}
    return {
        name: SplitHalf(value, sigma, other, other_sigma)
        for name, ((quantity, value, sigma), (_, other, other_sigma)) in both.items()
        if quantity.determined(max(sigma, other_sigma))
    }


def _at_levels(build: Build, levels: Mapping[str, Level], data: Any, config: Config) -> Problem:
    """Build the problem with the noise levels of a previous solution fixed."""
    problem = build(data, config)
    known = (levels.get(level.noise.name, level) for level in problem.noises)
    noises = tuple(
        replace(level, noise=replace(level.noise, known=0.0), least=None) if level.noise.name in levels else level
        for level in known
    )
    return replace(problem, noises=noises)


def _solved(
    build: Build, faults: FaultModel, data: Any, config: Config, start: float, stop: float
) -> dict[str, _Number]:
    """Solve the segment [start, stop), s, of a recording by itself; empty if there is no solution."""
    found = solve_trial(build, faults.segment(data, start, stop), config, f"{start:.0f} to {stop:.0f} s")
    if found is None or not found.estimate.converged:
        return {}
    numbers = zip(found.quantities, found.estimate.values.tolist(), found.estimate.sigmas.tolist(), strict=True)
    return {number[0].name: number for number in numbers}


@dataclass(frozen=True, eq=False)
class Validation:
    """Errors of one kind before and after compensation; a method may have several kinds.

    Attributes:
        name: what is compared with what.
        unit: SI, that of the errors.
        time: (n,) s from the session's start.
        before: (n, m) errors, one column an axis, with nothing compensated.
        after: (n, m) the same with the calibration applied.
        note: what a reader has to know beside it, a sentence without its full stop; may be empty.
        micro: angles are read in µrad, as in the trade of pointing, not in degrees.
    """

    name: str
    unit: str
    time: Array
    before: Array
    after: Array
    note: str = ""
    micro: bool = False


def rms(errors: Array) -> float:
    """Root mean square of the lengths of errors (n, m)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def peak(errors: Array) -> float:
    """Largest length of errors (n, m)."""
    return float(np.linalg.norm(errors, axis=1).max())
