"""The incremental solver's window, by time, by keyframes or none: all methods end where batch does."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from alidade import simulate
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.solvers import incremental as online
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import IncrementalSolver, solve_incremental
from alidade.pipelines.solvers.window import Keyframes, parse_window

# More than twice as many keyframes as a window of ten holds.
SMALL: dict[str, dict[str, Any]] = {
    "los": {"duration_s": 5.0, "image_rate_hz": 6.0, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0},
    "head": {"duration_s": 5.0, "vision_rate_hz": 6.0, "gyro_rate_hz": 50.0},
    "indexer": {"gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0},
    "cube": {},
}


def made(method: str, **changes: Any) -> Problem:
    simulated = simulate(method, {**SMALL[method], "sensors": "ideal", **changes}, seed=1)
    return methods.method(method).problem(simulated.data, load_config(simulated.config.encode()))


@cache
def in_batch(method: str) -> tuple[Problem, Estimate]:
    problem = made(method)
    return problem, solve_batch(problem)


# Each window once.
QUICK = [("los", None), ("head", Keyframes(10))]


@pytest.mark.usefixtures("few_solutions")
@pytest.mark.parametrize(
    ("method", "window"),
    [
        pytest.param(name, window, marks=[pytest.mark.slow] * ((name, window) not in QUICK), id=f"{name}-{window}")
        for name in SMALL
        for window in (Keyframes(10), None)
    ],
)
def test_every_window_ends_where_batch_does(method: str, window: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    if method == "head":  # of 30 steps, too few for its noise levels; else all is batch
        monkeypatch.setattr(online, "MIN_STEPS", 20)
        monkeypatch.setattr(online, "levels_settled", lambda *_: True)
    problem, batch = in_batch(method)
    incremental = solve_incremental(problem, window)
    assert incremental.converged
    free = batch.sigmas > 0.0
    assert np.abs((incremental.values - batch.values)[free] / batch.sigmas[free]).max() < 0.1
    np.testing.assert_allclose(incremental.sigmas[free], batch.sigmas[free], rtol=0.05)


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        pytest.param("head", {"vision_rate_hz": 10.0}, marks=pytest.mark.slow),
        pytest.param("los", {"image_rate_hz": 50.0}, id="los, five pictures a step"),
    ],
)
def test_so_many_keyframes_are_kept(method: str, changes: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(online, "MIN_STEPS", 20)
    monkeypatch.setattr(online, "levels_settled", lambda *_: True)
    if method == "los":
        monkeypatch.setattr(online, "SOLVE_GROWTH", 1.5)
    problem = made(method, duration_s=6.0, **changes)
    run = IncrementalSolver(problem, Keyframes(7))
    held = []
    for step in problem.steps(1):
        run.add_step(step)
        if run.started:
            held.append(len([key for key in run._stamps if chr(key >> 56) == "x"]))
    assert max(held) == 8


def test_what_the_option_takes() -> None:
    assert parse_window("2.5") == 2.5
    assert not isinstance(parse_window("2"), Keyframes)
    window = parse_window("50kf")
    assert isinstance(window, Keyframes)
    assert window == 50
    assert str(window) == "50kf"
    assert parse_window("all") is None


@pytest.mark.parametrize("text", ["0", "-1", "nan", "0kf", "2.5kf", "kf", "many"])
def test_what_it_does_not_take(text: str) -> None:
    with pytest.raises(InputError, match="--window"):
        parse_window(text)
