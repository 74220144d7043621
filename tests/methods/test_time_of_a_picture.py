"""When a picture was taken: graphs, trajectory, reports and the formula of calibration.yaml say the same.

The time stands in two models (`factors.attitude`, `factors.los`), in `estimation.camera_clock.Clock`, in the text of
`methods.formula.picture_time` and, for simulators, in `simulation.sensors.exposures`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.factors.attitude import VisionAttitudeFactor
from alidade.factors.los import LosDirectionFactor
from alidade.pipelines.estimation.problem import Problem, Step
from alidade.pipelines.methods import method
from alidade.pipelines.methods.formula import apply
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.report import taken
from alidade.pipelines.methods.los.simulation import LosScenario, simulate_los
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import load_scenario


def _by_formula(name: str, stamps: Array, values: Mapping[str, float]) -> Array:
    formulas = [each for each in method(name).report.formulas(list(values), Config()) if each.name == "time"]
    return apply(formulas, values, {"stamp": stamps})["time"]


def _at_random(graph: Problem, key: int, steps: Sequence[Step]) -> tuple[gtsam.Values, dict[str, float]]:
    """Values of the graph with the parameter at random, and its numbers by name with the graph's constants."""
    (parameter,) = (each for each in graph.parameters if each.key == key)
    names = [each.name for each in parameter.quantities]
    numbers = 1e-2 * np.random.default_rng(1).normal(size=len(names))
    values = gtsam.Values()
    for step in steps:
        values.insert(step.initial)
    values.update(key, numbers)
    return values, dict(graph.constants) | dict(zip(names, numbers.tolist(), strict=True))


def _models(steps: Sequence[Step], kind: type[Any]) -> list[Any]:
    bound = [factor.measurement for step in steps for factor in step.factors if factor.measurement is not None]
    models = [getattr(each.model, "model", each.model) for each in bound]
    return [each for each in models if isinstance(each, kind)]


@pytest.mark.parametrize("skew", [0.0, 0.05])
def test_of_a_head_graph(skew: float) -> None:
    """Of factors and trajectory, with and without a clock that is guessed before the graph is made."""
    settings = load_scenario(HeadScenario, "head_mounts").model_dump()
    effects = {"duration_s": 8, "gyro_rate_hz": 100, "vision_rate_hz": 20, "effects": {"clock_skew": skew}}
    data, _ = simulate_head(HeadScenario.model_validate(settings | effects), 1)
    graph = head.problem(data, Config())
    steps, key = list(graph.steps(1)), gtsam.symbol("T", 0)
    values, named = _at_random(graph, key, steps)
    models = _models(steps, VisionAttitudeFactor)
    stamps = np.concatenate([model.time for model in models])
    numbers = values.atVector(key)
    of_factors = np.concatenate([model.exposed(np.tile(numbers, (len(model.time), 1)))[0] for model in models])
    expected = _by_formula("head", stamps, named)
    np.testing.assert_allclose(of_factors, expected, atol=1e-12)
    assert graph.attitudes is not None
    of_trajectory = graph.attitudes([k for step in steps for k in step.keyframes], values).time
    np.testing.assert_allclose(of_trajectory, expected, atol=1e-12)


@pytest.mark.parametrize("skew", [pytest.param(0.0, marks=pytest.mark.slow), 2e-3])
def test_of_a_los_graph(skew: float) -> None:
    rates = {"gyro_rate_hz": 100.0, "gimbal_rate_hz": 100.0, "image_rate_hz": 5.0}
    scenario = LosScenario.model_validate({"duration_s": 60.0, **rates, "effects": {"clock_skew": skew}})
    data, _ = simulate_los(scenario, 1)
    graph = los.problem(data, Config())
    steps = list(graph.steps(1))
    (key,) = (p.key for p in graph.parameters if "time_offset" in [q.name for q in p.quantities])
    values, named = _at_random(graph, key, steps)
    models = _models(steps, LosDirectionFactor)
    shifted = np.concatenate([model.time for model in models])
    shift = np.concatenate([model.context.stamp_shift for model in models])
    assert (np.abs(shift).max() > 0.0) == (skew > 0.0)
    numbers = values.atVector(key)
    late = np.concatenate([model.context.late(np.tile(numbers, (len(model.time), 1))) for model in models])
    expected = _by_formula("los", shifted - shift, named)
    np.testing.assert_allclose(shifted + late, expected, atol=1e-12)
    np.testing.assert_allclose(taken(data, data.image_t[5:-5], named), _by_formula("los", data.image_t[5:-5], named))
