"""What a head session shows beside its parameters."""

from __future__ import annotations

from pipelines.graph.assumptions import parameter
from pipelines.graph.problem import Estimate, Findings
from pipelines.methods.head.parameters import SENSITIVITY
from pipelines.methods.head.recording import HeadData
from pipelines.methods.head.topics import HEAD_IMU
from pipelines.settings import Config


def findings(data: HeadData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: those that the recording gives no hold on, and why."""
    if data.head_force is not None or parameter(0, [SENSITIVITY], config) is None:
        return {}
    names = f"{SENSITIVITY.names[0]} to {SENSITIVITY.names[-1]}"
    why = f"{config.topic(HEAD_IMU)} has no acceleration"
    return {"fixed_assumptions": [{"parameters": names, "value": 0.0, "why": why}]}
