"""What can be wrong with the data of the los method."""

from __future__ import annotations

from alidade.pipelines.diagnostics.fault_models import AXES, FaultModel

HYPOTHESES = FaultModel(
    streams={"gyro_t": ("gyro", "force"), "gimbal_t": ("gimbal",), "image_t": ("error", "error_cov")},
    signs={"gyro": ("gyro", AXES), "gimbal": ("gimbal", ("azimuth", "elevation"))},
)
