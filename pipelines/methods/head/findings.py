"""What a head session shows beside its parameters."""

from __future__ import annotations

from alidade.pipelines.estimation.assumptions import fixed_without_force
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.methods.head.parameters import SENSITIVITY
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.topics import HEAD_IMU
from alidade.pipelines.settings import Config


def findings(data: HeadData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: those that the recording gives no hold on, and why."""
    return {} if data.head_force is not None else fixed_without_force(SENSITIVITY, config, config.topic(HEAD_IMU))
