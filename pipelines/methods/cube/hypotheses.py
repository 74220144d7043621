"""What can be wrong with the data of the cube method."""

from __future__ import annotations

from typing import Any

from pipelines.judgement.hypotheses import AXES, Hypotheses, Scaling
from pipelines.methods.cube.topics import CubeConfig
from pipelines.settings import Config


def _tag_sizes(data: Any, config: Config, factor: float) -> tuple[Any, Config] | None:
    """All tags larger or smaller than the config says; None where it names none."""
    cube = config.section(CubeConfig)
    if not cube.tags:
        return None
    tags = {i: tag.model_copy(update={"size": factor * tag.size}) for i, tag in cube.tags.items()}
    return data, config.model_copy(update={"cube": cube.model_copy(update={"tags": tags})})


# Opposite signs of accelerometer and magnetometer are part of what is calibrated.
HYPOTHESES = Hypotheses(
    streams={"imu_t": ("gyro", "accel"), "mag_t": ("mag",), "reference_t": ("reference_wxyz", "reference_cov")},
    signs={"gyro": ("gyro", AXES)},
    scalings=(Scaling("the tags are {factor:.3g} times as large as the config says", _tag_sizes),),
    cut=False,
)
