"""What a tumble result is used for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Truth, Use
from alidade.pipelines.methods.tumble.recording import ACCEL_SQUARE
from alidade.pipelines.methods.uses import G, gyro_reading, raw_of, triad_uses
from alidade.pipelines.settings import Config


def uses(true: Truth, _config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a tumble calibration: heading, rate and specific force."""
    return triad_uses(true, _readings)


def _readings(true: Truth, nominal: Mapping[str, Array]) -> dict[str, Array]:
    found = {}
    if "mag" in nominal:
        found["mag"] = raw_of(true, "mag", nominal["mag"])
    if "accel" in nominal and "accel_k11" in true:
        f = nominal["accel"]
        found["accel"] = raw_of(true, "accel", f + true.vector(*ACCEL_SQUARE.names)[..., None, :] * f**2)
    if "gyro" in nominal:
        found["gyro"] = gyro_reading(true, nominal["gyro"], nominal.get("accel", np.array([0.0, 0.0, G])))
    return found
