"""What can be wrong with the data of the head method."""

from __future__ import annotations

from pipelines.judgement.hypotheses import AXES, Hypotheses

HYPOTHESES = Hypotheses(
    streams={
        "head_t": ("head_gyro", "head_force"),
        "platform_t": ("platform_gyro",),
        "vision_t": ("vision_wxyz", "vision_cov"),
        "truth_t": ("truth_wxyz",),
    },
    signs={"head_gyro": ("helmet gyro", AXES), "platform_gyro": ("platform gyro", AXES)},
    noise={
        "vision_attitude": ("vision_cov", ("vision",)),
        "gyro_density": ("gyro_density", ("gyro",)),
        "platform_gyro_density": ("platform_gyro_density", ("gyro",)),
    },
    offset=True,
)
