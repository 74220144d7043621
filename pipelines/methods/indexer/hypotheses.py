"""What can be wrong with the data of the indexer method."""

from __future__ import annotations

from dataclasses import replace

from alidade.pipelines.diagnostics.fault_models import AXES, ExactInput, FaultModel
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.settings import Config


def _latitude(data: IndexerData, config: Config, change: float) -> tuple[IndexerData, Config] | None:
    if data.latitude_deg is None:
        return None
    return replace(data, latitude_deg=data.latitude_deg + change), config


HYPOTHESES = FaultModel(
    streams={"gyro_t": ("gyro", "attitude"), "encoder_t": ("outer", "inner")},
    signs={"gyro": ("gyro", AXES), "outer": ("encoder", ("outer",)), "inner": ("encoder", ("inner",))},
    clock=("encoder_t", "encoders"),
    exact=(ExactInput("latitude_deg", "deg", 0.1, _latitude),),
    cut=False,
)
