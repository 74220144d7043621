"""Every error of a sensor that a method estimates is one that its simulator can make."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.estimation.parameters import ParameterSpec
from alidade.pipelines.methods.head import parameters as head
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head
from alidade.pipelines.methods.indexer import parameters as indexer
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, simulate_indexer
from alidade.pipelines.methods.los import parameters as los
from alidade.pipelines.methods.los.simulation import LosScenario, simulate_los
from alidade.pipelines.simulation.scenario import load_scenario

HEAD = load_scenario(HeadScenario, "head_mounts").model_copy(update={"duration_s": 2.0, "gyro_rate_hz": 50.0})
LOS = LosScenario(duration_s=4.0, gyro_rate_hz=50.0, gimbal_rate_hz=50.0, image_rate_hz=5.0, sensors=None)

INDEXER = IndexerScenario(gyro_rate_hz=10.0, encoder_rate_hz=10.0)


def _numbers(data: Any) -> Iterator[Any]:
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.ndarray):
            yield value


def _cases(simulate: Any, scenario: Any, specs: tuple[ParameterSpec, ...]) -> Iterator[Any]:
    for spec in specs:
        for name in spec.names if spec.figure != "temperature" else ():
            yield pytest.param(simulate, scenario, name, 10.0 * spec.prior, id=f"{type(scenario).__name__} {name}")


@pytest.mark.parametrize(
    ("simulate", "scenario", "name", "size"),
    [
        *_cases(simulate_head, HEAD, head.NUISANCE),
        *_cases(simulate_los, LOS, los.NUISANCE),
        *_cases(simulate_indexer, INDEXER, indexer.NUISANCE),
    ],
)
def test_an_error_changes_what_is_measured(simulate: Callable[..., Any], scenario: Any, name: str, size: float) -> None:
    exact, wrong = (
        simulate(scenario.model_copy(update={"sensors": None, "effects": effects}), 1).data
        for effects in ({}, {name: size})
    )
    pairs = list(zip(_numbers(exact), _numbers(wrong), strict=True))
    assert any(a.shape != b.shape or not np.array_equal(a, b, equal_nan=True) for a, b in pairs)
