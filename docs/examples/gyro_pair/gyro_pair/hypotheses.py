"""What can be wrong with the data of two gyros."""

from __future__ import annotations

from alidade.pipelines.diagnostics.fault_models import AXES, FaultModel

HYPOTHESES = FaultModel(
    streams={"a_t": ("a_gyro",), "b_t": ("b_gyro",)},
    signs={"a_gyro": ("gyro a", AXES), "b_gyro": ("gyro b", AXES)},
)
