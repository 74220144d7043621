"""Short problems of all methods, of simulated recordings, each made once."""

from __future__ import annotations

from functools import cache
from typing import Any

from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.cube.simulation import CubeScenario
from alidade.pipelines.methods.head.simulation import HeadScenario
from alidade.pipelines.methods.indexer.simulation import IndexerScenario
from alidade.pipelines.methods.los.simulation import LosScenario
from alidade.pipelines.methods.tumble.simulation import TumbleScenario
from tests.support.short_problems import COARSE, HEAD, LOS

_WALK = {"gyro_density": 1e-5, "gyro_bias_walk": 1e-6}
SCENARIOS: dict[str, Any] = {
    "los": LOS,
    "los with a bias that walks": LosScenario.model_validate({**LOS.model_dump(), "noise": _WALK}),
    "head": HEAD,
    "head with a bias that walks": HeadScenario.model_validate({**HEAD.model_dump(), "noise": _WALK}),
    "cube": CubeScenario(poses=8),
    "cube without camera": CubeScenario(poses=8, camera=None, reference=None),
    "cube, reference at rest": CubeScenario(poses=8, reference=None),
    "indexer": IndexerScenario.model_validate({**COARSE, "noise": _WALK}),
    "tumble": TumbleScenario(attitudes=12),
    "tumble at rest": TumbleScenario.model_validate({"attitudes": 14, "rest_s": 1.5, "accelerometer": {}}),
    "tumble with gyro": TumbleScenario.model_validate({"attitudes": 10, "accelerometer": {}, "gyro": {}}),
}


@cache
def problem(name: str) -> Problem:
    """The problem of a scenario."""
    method = methods.method(name.split()[0].rstrip(","))
    found = method.simulate(SCENARIOS[name], 3)
    return method.problem(found.data, load_config(found.config.encode()))
