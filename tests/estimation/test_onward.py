"""Graphs of the end of a recording that grows: the steps are those of the graph of the whole."""

from __future__ import annotations

import dataclasses
from typing import Any

import gtsam
import numpy as np
import pytest

from alidade.pipelines.estimation.problem import Problem, Step
from alidade.pipelines.methods import method
from alidade.pipelines.recording.streams import Temperature
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.sensors import Warming

# Between two temperatures, s: until the next one is there it is not known what it is.
WARMED = 0.5


def _between(name: str, data: Any, start: float, stop: float) -> Any:
    """What was measured in between."""
    cut: dict[str, Any] = {}
    for stamps, carried in method(name).faults.streams.items():
        t = getattr(data, stamps)
        inside = (t >= start) & (t < stop)
        cut |= {field: getattr(data, field)[inside] for field in (stamps, *carried) if getattr(data, field) is not None}
    if getattr(data, "temperature", None) is not None:
        inside = (data.temperature.t >= start) & (data.temperature.t < stop)
        messages = (each[inside] for each in (data.temperature.t, data.temperature.celsius))
        cut["temperature"] = Temperature(*messages)
    return dataclasses.replace(data, **cut)


def _assert_same(step: Step, wanted: Step) -> None:
    assert (step.time, step.keyframes, step.timestamps, step.current_keys) == (
        wanted.time,
        wanted.keyframes,
        wanted.timestamps,
        wanted.current_keys,
    )
    assert [f.family for f in step.factors] == [f.family for f in wanted.factors]
    assert [list(f.factor.keys()) for f in step.factors] == [list(f.factor.keys()) for f in wanted.factors]


def _jacobian(factor: Any, values: Any) -> Any:
    """Augmented, without the columns of los' errors of camera and target.

    These are for LOS errors that are foreseen: smoothed over all there is.
    """
    dims = [3 if chr(gtsam.Symbol(key).chr()) in "xCH" else len(values.atVector(key)) for key in factor.keys()]
    own = np.repeat([chr(gtsam.Symbol(key).chr()) != "S" for key in factor.keys()], dims)
    return factor.linearize(values).augmentedJacobian()[:, [*np.flatnonzero(own), -1]]


def _values(problem: Problem) -> Any:
    values: Any = None
    for step in problem.steps(1):
        if values is None:
            values = step.initial
        else:
            values.insert(step.initial)
    return values


@pytest.mark.parametrize(
    ("name", "rates"),
    [
        ("los", {"image_rate_hz": 4.0, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0, "temperature": Warming()}),
        pytest.param(
            "head",
            {"gyro_rate_hz": 50.0, "platform_gyro_rate_hz": 50.0, "vision_rate_hz": 5.0, "temperature": Warming()},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_steps_of_the_end_are_those_of_the_whole(name: str, rates: dict[str, Any]) -> None:
    chosen = method(name)
    settings = chosen.settings().model_copy(update={"duration_s": 40.0, **rates})
    data = chosen.simulate(settings, 3).data
    config = Config()
    start = chosen.problem(data, config)
    assert start.continuation is not None
    whole = start.continuation(data, -np.inf)
    assert whole is not None
    assert whole.continuation is not None
    assert whole.steps_after is not None
    values, wanted = _values(whole), {step.time: step for step in whole.steps(1)}
    times = list(wanted)
    # Where the next stretch of the bias begins.
    problem, base = whole, next(t for t in times if t >= times[0] + 10.0)
    taken = 0
    for stop in (22.0, 31.0, 40.1):
        assert problem.continuation is not None
        grown = problem.continuation(_between(name, data, base - 2.0, stop), base)
        assert grown is not None
        assert grown.steps_after is not None
        if start.keyframes is not None:
            assert grown.keyframes is not None
            assert grown.keyframes.clock.begun == pytest.approx(start.keyframes.clock.begun), "not that of the tail"
        steps = list(grown.steps_after(base))
        # The last one may still grow.
        for step in steps if stop > 40.0 else [s for s in steps[:-1] if s.time < stop - WARMED]:
            _assert_same(step, wanted[step.time])
            for mine, its in zip(step.factors, wanted[step.time].factors, strict=True):
                ours, theirs = (_jacobian(f.factor, values) for f in (mine, its))
                np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())
            taken += 1
        problem, base = grown, steps[-5].time
    assert taken > 0.7 * len(times)
    assert problem.continuation is not None
    assert problem.continuation(data, base + 1e-4) is None, "there is no keyframe"
