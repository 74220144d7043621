"""What the sensors of a los recording measured, with the errors that a calibration found taken off.

`values` are calibrated parameters by name, SI; those that are not there are zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from alidade.factors.gimbal import GimbalPath
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.formula import gyro_rate
from alidade.pipelines.methods.los.formulas import DRIVERS, S
from alidade.pipelines.methods.los.parameters import BIAS, ONCE_PER_TURN, SENSITIVITY, TEMPERATURE
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.temperature import FIRST

# Samples of the gyro worked on together.
_BLOCK = 100_000


def rates(data: LosData, values: Mapping[str, float]) -> Array:
    """True rates (N, 3) at the gyro's samples, rad/s; what nobody measured the cause of stays in."""
    warm = None if data.temperature is None or FIRST not in values else data.temperature.above(0.0, data.gyro_t)
    causes = {SENSITIVITY: data.force, TEMPERATURE: warm}
    unknown = {name for each, cause in causes.items() if cause is None for name in each.names}
    known = {name: value for name, value in values.items() if name not in unknown}
    bias = np.array([values.get(name, 0.0) for name in BIAS])
    compute, out = gyro_rate(known, S, *DRIVERS)[2], np.empty_like(data.gyro)
    for begin in range(0, len(out), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        accel, temperature = (None if each is None else each[some] for each in (data.force, warm))
        out[some] = compute(
            SimpleNamespace(**known, gyro=data.gyro[some], gyro_bias=bias, accel=accel, temperature=temperature)
        )
    return out


def taken(data: LosData, stamps: Array, values: Mapping[str, float]) -> Array:
    """When pictures were taken (n,), s, no further than gyro and gimbal were recorded."""
    skew = values.get("clock_skew", 0.0) * (stamps - data.image_t[0])
    delay = values.get("encoder_delay", 0.0)
    first = max(data.gyro_t[0], data.gimbal_t[0] + delay)
    last = min(data.gyro_t[-1], data.gimbal_t[-1] + delay)
    return np.clip(stamps + values.get("time_offset", 0.0) - skew, first, last)


def angles(data: LosData, at: Array, values: Mapping[str, float]) -> Array:
    """Angles of azimuth and elevation (n, 2), rad, at true times."""
    read = GimbalPath(data.gimbal_t, data.gimbal).at(at - values.get("encoder_delay", 0.0))
    s, c = np.array([values.get(name, 0.0) for name in ONCE_PER_TURN.names]).reshape(2, 2).T
    return np.asarray(read - s * np.sin(read) - c * np.cos(read))
