"""What a los session shows beside its parameters."""

from __future__ import annotations

from alidade.pipelines.estimation.assumptions import fixed_without_force
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.methods.los.parameters import SENSITIVITY
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.recording.topics import IMU
from alidade.pipelines.settings import Config


def findings(data: LosData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: those that the recording gives no hold on, and why."""
    return {} if data.force is not None else fixed_without_force(SENSITIVITY, config, config.topic(IMU))
