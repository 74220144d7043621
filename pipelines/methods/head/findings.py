"""What a head session shows beside its parameters."""

from __future__ import annotations

from pipelines.graph.assumptions import fixed_without_force
from pipelines.graph.problem import Estimate, Findings
from pipelines.methods.head.parameters import SENSITIVITY
from pipelines.methods.head.recording import HeadData
from pipelines.methods.head.topics import HEAD_IMU
from pipelines.settings import Config


def findings(data: HeadData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: those that the recording gives no hold on, and why."""
    return {} if data.head_force is not None else fixed_without_force(SENSITIVITY, config, config.topic(HEAD_IMU))
