"""What can be wrong with the data of the indexer method."""

from __future__ import annotations

from pipelines.judgement.hypotheses import AXES, Hypotheses

HYPOTHESES = Hypotheses(
    streams={"gyro_t": ("gyro", "attitude"), "encoder_t": ("outer", "inner")},
    signs={"gyro": ("gyro", AXES), "outer": ("encoder", ("outer",)), "inner": ("encoder", ("inner",))},
    clock=("encoder_t", "encoders"),
    cut=False,
)
