"""The incremental solver looks at factors before they enter the smoother; what is not finite is named or left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.factors.bridge import BoundModel
from alidade.factors.model import Model, Residuals
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Factor, Problem, Step
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.chain import PARAMETER, Walk, state

# A chain has 60 steps.
pytestmark = pytest.mark.usefixtures("early_smoother")


def _with(problem: Problem, at: int, change: Callable[[Step], Step]) -> Problem:
    def steps(chunk: int) -> Iterator[Step]:
        for i, step in enumerate(problem.steps(chunk)):
            yield change(step) if i == at else step

    return replace(problem, steps=steps)


@dataclass(frozen=True)
class Broken(Model):
    """A residual that is not a number."""

    time: Array
    rows: int = 1
    blocks = (1, 2)

    def __call__(self, s: Array, p: Array) -> Residuals:
        shapes = ((len(s), 1, 1), (len(s), 1, p.shape[1]))
        return np.full((len(s), 1), np.nan), lambda: tuple(np.zeros(shape) for shape in shapes)


def _broken(k: int, time: float) -> BoundModel:
    return Broken(np.array([time])).on([state(k)], PARAMETER)


def test_a_measurement_that_is_not_a_number_is_left_out_and_counted() -> None:
    walk, _ = Walk.random(3)
    clean = solve_incremental(walk.problem())
    extra = _with(
        walk.problem(), 40, lambda s: replace(s, factors=[*s.factors, Factor.of("seen", _broken(40, s.time))])
    )
    estimate = solve_incremental(extra)
    np.testing.assert_allclose(estimate.values, clean.values, atol=1e-9)
    assert estimate.rejected == {"seen": 1}


def test_a_process_that_is_not_a_number_is_named() -> None:
    walk, _ = Walk.random(3)
    spoilt = _with(
        walk.problem(), 40, lambda s: replace(s, factors=[*s.factors, Factor("gyro", _broken(40, s.time).factor)])
    )
    with pytest.raises(InputError, match=r"gyro at 4\.000 s: residual or Jacobian is not a finite number"):
        solve_incremental(spoilt)


def test_a_start_that_is_not_a_number_is_named_and_not_returned() -> None:
    walk, _ = Walk.random(3)
    spoilt = _with(walk.problem(), 2, lambda s: replace(s, factors=[*s.factors, Factor.of("seen", _broken(2, s.time))]))
    with pytest.raises(InputError, match=r"seen at 0\.200 s: residual or Jacobian is not a finite number"):
        solve_incremental(replace(spoilt, steps=lambda _: spoilt.steps(1)))


def test_a_state_that_has_left_the_window_is_named() -> None:
    walk, _ = Walk.random(3, n=200)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
    loop = gtsam.BetweenFactorVector(state(5), state(150), np.zeros(1), noise)
    late = _with(walk.problem(), 150, lambda s: replace(s, factors=[*s.factors, Factor("loop", loop)]))
    with pytest.raises(InputError, match=r"loop at 15\.000 s needs the state s5.*longer --window"):
        solve_incremental(late, window=0.5)
