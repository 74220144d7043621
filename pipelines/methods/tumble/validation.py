"""Validation: strengths without and with a calibration, which are to be the same in every attitude."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.temperature import FIRST
from alidade.pipelines.methods.triads import triad_of
from alidade.pipelines.methods.tumble.model import prepare
from alidade.pipelines.methods.tumble.parameters import STRENGTHS
from alidade.pipelines.methods.tumble.recording import ACCEL_SLOPE, TumbleData
from alidade.pipelines.settings import Config

_WHAT = {"accel": "specific force at rest, its strength", "mag": "magnetic field, its strength"}


def validate(data: TumbleData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Lengths less the strength calibrated against; before compensation scaled to that strength on average.

    Raises InputError when the calibration has none of the recording's sensors.
    """
    found = []
    for sensor in prepare(data, config).sensors:
        if f"{sensor.name}_k11" not in values:
            continue
        K, b = triad_of(sensor.name, values)
        strength = values.get(STRENGTHS[sensor.name], sensor.strength)
        raw = np.linalg.norm(sensor.raw, axis=1)
        drift = np.zeros((1, 3))
        for i, cause in enumerate(sensor.driven):
            driver = sensor.drivers[:, 3 * i : 3 * i + 3] if sensor.drivers is not None else drift
            if cause is ACCEL_SLOPE:
                if data.temperature is None or FIRST not in values:
                    continue
                driver = driver + (data.temperature.first - values[FIRST])
            drift = drift + driver * [values.get(name, 0.0) for name in cause.names]
        after = np.linalg.norm(sensor.raw @ K.T + b - drift, axis=1) - strength
        before = raw * strength / np.mean(raw) - strength
        found.append(Validation(_WHAT[sensor.name], sensor.unit, sensor.time, before[:, None], after[:, None]))
    if not found:
        raise InputError("the calibration is of none of the sensors in the recording")
    return found
