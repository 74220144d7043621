"""What can be wrong with the data of the tumble method."""

from __future__ import annotations

from alidade.pipelines.diagnostics.fault_models import FaultModel

# Signs, order and scale of axes are what is calibrated.
FAULTS = FaultModel(streams={"mag_t": ("mag",), "accel_t": ("accel",), "gyro_t": ("gyro",)}, signs={})
