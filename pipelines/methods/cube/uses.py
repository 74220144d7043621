"""Uses of a cube result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Truth, Use
from alidade.pipelines.methods.cube.parameters import CUBE, SQUARE
from alidade.pipelines.methods.cube.recording import CubeConfig, nominal, recorded
from alidade.pipelines.methods.uses import along, raw_of, triad_uses
from alidade.pipelines.settings import Config


def uses(true: Truth, config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a cube calibration: heading, rate and specific force."""
    raw = config.section(CubeConfig).raw

    def readings(true: Truth, ideal: Mapping[str, Array]) -> dict[str, Array]:
        found = {}
        if "mag" in ideal:
            found["mag"] = raw_of(true, "mag", ideal["mag"])
        if "accel" in ideal and "accel_k11" in true:
            u = nominal(raw_of(true, "accel", ideal["accel"]), raw.accel)
            square, cube = (true.vector(*each.names)[..., None, :] for each in (SQUARE, CUBE))
            found["accel"] = recorded(u * (1.0 + u * (square + u * cube)), raw.accel)
        if "gyro" in ideal:
            sensitivity = true.matrix([[f"gyro_g_{i}{j}" for j in "xyz"] for i in "xyz"])
            u = nominal(raw_of(true, "gyro", ideal["gyro"]), raw.gyro) + along(sensitivity, ideal["accel"])
            found["gyro"] = recorded(u, raw.gyro)
        return found

    return triad_uses(true, readings)
