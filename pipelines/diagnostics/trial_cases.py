"""Discrete faults and unknown shifts of a recording, each as changed data or a changed config to be solved again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.fault_models import FaultModel, ScaleFactor
from alidade.pipelines.diagnostics.trial_fit import Build, score_trial, solve_trial
from alidade.pipelines.settings import Config

# Stamps are moved by this much first, s, and numbers scaled by this much; then so many times to the bottom of a
# parabola.
_FIRST_SHIFT, _FIRST_SCALING, _SECOND_SCALING, _PARABOLAS = 0.01, 0.01, 5e-3, 4


@dataclass(frozen=True)
class TrialCase:
    """A fault, in words, with the data and config that correct the fault."""

    label: str
    data: Any
    config: Config


def trial_cases(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield all faults to test, except those that count only where no other fits."""
    yield from data_faults(model, data, config)
    yield from inverted_signs(model, data, config)
    yield from axis_orders(model, data, config)
    yield from units(model, data, config)
    yield from late_stamps(build, model, data, config)
    yield from scale_factors(build, model, data, config)


def data_faults(model: FaultModel, data: Any, config: Config, role: str = "usual") -> Iterator[TrialCase]:
    """Yield trial cases of the method's own faults of one role."""
    for fault in model.faults:
        if fault.role == role and (corrected := fault.corrected(data, config)) is not None:
            yield TrialCase(fault.label, *corrected)


def _readings(model: FaultModel, data: Any) -> Iterator[tuple[str, str, Sequence[str], Array]]:
    """Yield field, sensor, columns and readings of the present sensors with possibly wrong axes."""
    for name, (sensor, columns) in model.signs.items():
        if (values := getattr(data, name)) is not None:
            yield name, sensor, columns, values


def inverted_signs(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases for every combination of inverted axes of a sensor."""
    for name, sensor, columns, values in _readings(model, data):
        for signs in product((1.0, -1.0), repeat=len(columns)):
            wrong = [column for column, sign in zip(columns, signs, strict=True) if sign < 0.0]
            if wrong:
                axes = " and ".join(wrong)
                label = f"the sign of the {sensor}'s {axes} is wrong"
                factor = np.array(signs) if values.ndim > 1 else signs[0]
                yield TrialCase(label, replace(data, **{name: factor * values}), config)


def axis_orders(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with a sensor's axes permuted: two swapped, or a right angle about the third."""
    for name, sensor, columns, values in _readings(model, data):
        if len(columns) < 3:
            continue
        for i, j in combinations(range(3), 2):
            swapped = np.eye(3)
            swapped[[i, j]] = swapped[[j, i]]
            third = columns[3 - i - j]
            labels = {
                f"the {sensor}'s {columns[i]} and {columns[j]} are swapped": np.ones(3),
                f"the {sensor} is turned by 90 deg about its {third}": np.where(np.arange(3) == i, -1.0, 1.0),
                f"the {sensor} is turned by 90 deg the other way about its {third}": np.where(
                    np.arange(3) == j, -1.0, 1.0
                ),
            }
            for label, signs in labels.items():
                yield TrialCase(label, replace(data, **{name: values @ swapped * signs}), config)


def units(model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with rates in deg/s, or converted to rad/s twice."""
    for name, sensor, _, values in _readings(model, data):
        if "gyro" in name:
            for label, changed in {
                f"the {sensor} is in deg/s, not rad/s": np.deg2rad(values),
                f"the {sensor} was turned from deg/s to rad/s twice": np.rad2deg(values),
            }.items():
                yield TrialCase(label, replace(data, **{name: changed}), config)


def late_stamps(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield a trial case with delayed stamps shifted to the smallest residuals."""
    if model.clock is None:
        return
    stamps, source = model.clock

    def moved(shift: float) -> tuple[Any, Config]:
        return replace(data, **{stamps: getattr(data, stamps) + shift}), config

    shift = _lowest(partial(_cost, build, moved), _FIRST_SHIFT)
    if shift is not None:
        side = "early" if shift > 0.0 else "late"
        yield TrialCase(f"the stamps of the {source} are {1e3 * abs(shift):.3g} ms too {side}", *moved(shift))


def scale_factors(build: Build, model: FaultModel, data: Any, config: Config) -> Iterator[TrialCase]:
    """Yield trial cases with config numbers multiplied by the factor of smallest residuals."""
    for factor in model.scalings:
        if factor.apply(data, config, 1.0) is None:
            continue

        def changed(more: float, factor: ScaleFactor = factor) -> tuple[Any, Config]:
            found = factor.apply(data, config, 1.0 + more)
            assert found is not None
            return found

        # Not chi-square, which levels off where most measurements are rejected; near the bottom it discriminates best.
        rough = _lowest(lambda more: score_trial(build, *changed(more))[0] ** 2, _FIRST_SCALING)
        if rough:
            more = _lowest(partial(_cost, build, changed), _SECOND_SCALING, rough)
            more = rough if more is None else more
            yield TrialCase(factor.label.format(factor=1.0 + more), *changed(more))


def _cost(build: Build, changed: Callable[[float], tuple[Any, Config]], size: float) -> float:
    """Cost of the solution after a change of some size; infinite without a solution."""
    found = solve_trial(build, *changed(size), label=f"change of {size:.3g}")
    return found.cost if found else np.inf


def _lowest(cost: Callable[[float], float], step: float, start: float = 0.0) -> float | None:
    """Find the size of a change with the lowest cost, from `start` on; None if there is none.

    From the best so far a step to either side, and to the bottom of the parabola through the three.
    """
    known, best = {start: cost(start)}, start
    for _ in range(_PARABOLAS):
        sides = best - step, best + step
        known |= {size: cost(size) for size in sides if size not in known}
        left, middle, right = known[sides[0]], known[best], known[sides[1]]
        bend = left - 2.0 * middle + right
        if not np.isfinite(bend):
            return None
        if bend > 0.0:
            bottom = best + float(np.clip(0.5 * step * (left - right) / bend, -5.0 * step, 5.0 * step))
            known[bottom] = cost(bottom)
        best = min(known, key=known.__getitem__)
        if best not in sides:
            step *= 0.2
    return best
