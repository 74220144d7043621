"""What can be wrong with the data of the cube method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.pipelines.diagnostics.fault_models import AXES, ExactInput, FaultModel, ScaleFactor
from alidade.pipelines.methods.cube.data import CubeData
from alidade.pipelines.methods.cube.parameters import FOCAL, is_stated
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.settings import Config


def _tag_sizes(data: CubeData, config: Config, factor: float) -> tuple[CubeData, Config] | None:
    """All tags larger or smaller than the config says; None where it names none."""
    cube = config.section(CubeConfig)
    if not cube.tags:
        return None
    tags = {i: tag.model_copy(update={"size": factor * tag.size}) for i, tag in cube.tags.items()}
    return data, config.model_copy(update={"cube": cube.model_copy(update={"tags": tags})})


def _latitude(data: CubeData, config: Config, change: float) -> tuple[CubeData, Config] | None:
    if data.latitude is None:
        return None
    return _as_found(data, config, replace(data, latitude=data.latitude + np.deg2rad(change)), config)


def _tag_size(data: CubeData, config: Config, change: float) -> tuple[CubeData, Config] | None:
    changed = _tag_sizes(replace(data), config, 1.0 + change)
    return None if data.camera is None or changed is None else _as_found(data, config, *changed)


def _focal_length(data: CubeData, config: Config, change: float) -> tuple[CubeData, Config] | None:
    # Of one that is free the parameter tells.
    if data.camera is None or is_stated(FOCAL, config):
        return None
    K = data.camera.K * np.array([1.0 + change, 1.0 + change, 1.0])[:, None]
    K[:2, 2] = data.camera.centre
    return _as_found(data, config, replace(data, camera=replace(data.camera, K=K)), config)


def _as_found(data: CubeData, config: Config, changed: CubeData, other: Config) -> tuple[CubeData, Config]:
    """Changed data and config with the poses that were found in the data as they are.

    They would be the same, but for first guesses; finding them takes longer than all the rest.
    """
    before, after = config.model_dump_json(), other.model_dump_json()
    changed.computed.update({(name, after): found for (name, of), found in data.computed.items() if of == before})
    return changed, other


# Opposite signs of accelerometer and magnetometer are part of what is calibrated.
HYPOTHESES = FaultModel(
    streams={"imu_t": ("gyro", "accel"), "mag_t": ("mag",), "reference_t": ("reference_wxyz", "reference_cov")},
    signs={"gyro": ("gyro", AXES)},
    scalings=(ScaleFactor("the tags are {factor:.3g} times as large as the config says", _tag_sizes),),
    exact=(
        ExactInput("latitude_deg", "deg", 0.1, _latitude),
        ExactInput("tag_size", "1", 2e-3, _tag_size),
        ExactInput("focal_length", "1", 5e-3, _focal_length),
    ),
    cut=False,
)
