"""What a los session shows beside its parameters."""

from __future__ import annotations

from pipelines.graph.assumptions import fixed_without_force
from pipelines.graph.problem import Estimate, Findings
from pipelines.methods.los.parameters import SENSITIVITY
from pipelines.methods.los.recording import LosData
from pipelines.recording.topics import IMU
from pipelines.settings import Config


def findings(data: LosData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: those that the recording gives no hold on, and why."""
    return {} if data.force is not None else fixed_without_force(SENSITIVITY, config, config.topic(IMU))
