"""Whether a recording agrees with itself: either half by itself, and measurements held out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines import parallel
from alidade.pipelines.diagnostics.outcome import at_once, outcome, times_of
from alidade.pipelines.estimation.problem import Array, Problem, Quantity
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.diagnostics.fault_models import Hypotheses
    from alidade.pipelines.methods import Method
    from alidade.pipelines.solvers.linearization import Group

# One chunk of so many frames is held out of so many chunks.
_CHUNK, _HELD_OUT = 20, 5


def cut(hypotheses: Hypotheses, data: Any, start: float, stop: float) -> Any:
    """The data of [start, stop), s; times stay as they are."""
    changes: dict[str, Array] = {}
    for stamps, fields in hypotheses.streams.items():
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


@dataclass(frozen=True)
class Halves:
    """A parameter from either half of a recording: values and sigmas, SI."""

    first: float
    first_sigma: float
    second: float
    second_sigma: float

    @property
    def difference_sigmas(self) -> float:
        """Second less first, over the sigma of that difference."""
        return (self.second - self.first) / float(np.hypot(self.first_sigma, self.second_sigma))


def split_halves(method: Method, data: Any, config: Config) -> dict[str, Halves]:
    """What either half of a recording determines by itself, see `split_at`."""
    start, stop = span(method, data)
    return split_at(method, data, config, 0.5 * (start + stop))


def split_at(method: Method, data: Any, config: Config, middle: float) -> dict[str, Halves]:
    """The parameters that a recording determines both before and after a time (s); none when a part cannot be solved.

    Those that a prior holds in either part are left out: they would agree whatever was recorded. A bias that walks
    differs between the parts by its walk too.
    """
    start, stop = span(method, data)
    sides = [partial(_side, method, data, config, *part) for part in ((start, middle), (middle, stop + 1.0))]
    first, second = parallel.done(sides, "either side", at_once(method, data))
    both = {name: (first[name], second[name]) for name in first if name in second}
    return {
        name: Halves(value, sigma, other, its_sigma)
        for name, ((quantity, value, sigma), (_, other, its_sigma)) in both.items()
        if quantity.determined(max(sigma, its_sigma))
    }


# A number with its value and sigma.
_Number = tuple[Quantity, float, float]


def _side(method: Method, data: Any, config: Config, start: float, stop: float) -> dict[str, _Number]:
    """What [start, stop), s, of a recording determines by itself; nothing when it cannot be solved."""
    found = outcome(method, cut(method.hypotheses(), data, start, stop), config)
    if found is None:
        return {}
    numbers = zip(found.quantities, found.estimate.values.tolist(), found.estimate.sigmas.tolist(), strict=True)
    return {number[0].name: number for number in numbers}


def span(method: Method, data: Any) -> tuple[float, float]:
    """First and last stamp of a method's data, s; zeros where there is none."""
    times = [time for time in times_of(method, data) if len(time)]
    return float(min((t[0] for t in times), default=0.0)), float(max((t[-1] for t in times), default=0.0))


def held_out(problem: Problem) -> dict[str, float]:
    """Family -> typical size of measurements that took no part in the solution, in sigmas of their own noise.

    One chunk in five is held out. 1 is as good as the noise; a little more is the uncertainty of the prediction.
    """
    from alidade.pipelines.solvers.engines import Compiled
    from alidade.pipelines.solvers.robust import RobustConfig, solve_robust

    steps = list(problem.steps(_CHUNK))
    counts = [len(step.factors) for step in steps]
    out = np.repeat(np.arange(len(steps)) % _HELD_OUT == _HELD_OUT - 1, counts)
    compiled = Compiled.of(problem, steps=steps)
    measurements = [g for g in compiled.engine.groups if g.is_measurement]
    if all(out[g.factors].all() for g in measurements):
        return {}
    kept = compiled.engine.with_groups([_without(g, out[g.factors]) for g in compiled.engine.groups])
    solution = solve_robust(kept, compiled.initial, problem.loss, RobustConfig())
    if not solution.converged:
        return {}
    found: dict[str, list[Array]] = {}
    for group in measurements:
        residuals = group.evaluate(solution.values)[0]
        found.setdefault(group.family, []).append(residuals[out[group.factors]].ravel())
    return {family: robust_sigma(np.concatenate(each)) for family, each in found.items()}


def _without(group: Group, out: NDArray[np.bool_]) -> Group:
    """The measurements that are not held out; processes and priors stay."""
    if not group.is_measurement:
        return group
    weights = np.ones((len(out), group.model.rows)) if group.weights is None else group.weights
    return replace(group, weights=weights * ~out[:, None])
