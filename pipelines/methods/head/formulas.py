"""How a head result is applied. Frames: v helmet IMU, h markers, c camera, b platform. Methods page, section 3."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.factors.gyro import symmetric
from alidade.pipelines.methods.formula import Formula, gyro_rate, numbers_of, symmetric_text, vector_text
from alidade.pipelines.methods.head.parameters import (
    CLOCK_SKEW,
    PLATFORM_BIAS,
    PLATFORM_SCALE,
    SCALE,
    SENSITIVITY,
    TEMPERATURE,
)

_S, _PLATFORM_S = (tuple(name for each in scale for name in each.names) for scale in (SCALE, PLATFORM_SCALE))
_DRIVERS = SENSITIVITY.names, TEMPERATURE.names


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With those errors of gyros and clock that are among the parameters."""
    return [
        Formula("markers to helmet IMU", "vRh", "Exp(helmet_mount)", (), lambda v: so3.exp(v.helmet_mount)),
        Formula("platform to camera", "cRb", "Exp(camera_mount)", (), lambda v: so3.exp(v.camera_mount)),
        Formula("rate of the helmet, rad/s in v", "w_iv", *gyro_rate(parameters, _S, *_DRIVERS)),
        *_platform_rate(parameters),
        Formula(
            "attitude of the helmet on the platform from a camera measurement cRh",
            "bRv",
            "inverse(cRb) * cRh * inverse(vRh)",
            ("cRh",),
            lambda v: so3.compose(so3.inverse(v.cRb), v.cRh, so3.inverse(v.vRh)),
        ),
        _time(parameters),
    ]


def _platform_rate(parameters: Collection[str]) -> list[Formula]:
    """Where the recording says what the platform's gyro is off."""
    if not any(name in parameters for name in (*PLATFORM_BIAS.names, *_PLATFORM_S)):
        return []

    def compute(v: Any) -> so3.Array:
        gain = np.eye(3) + symmetric(numbers_of(v, _PLATFORM_S))
        return np.asarray((v.platform_gyro - numbers_of(v, PLATFORM_BIAS.names)) @ np.linalg.inv(gain))

    text = _scaled(f"platform_gyro - {vector_text(PLATFORM_BIAS.names, parameters)}", _PLATFORM_S, parameters)
    return [Formula("rate of the platform, rad/s in b", "w_ib", text, ("platform_gyro",), compute)]


def _scaled(rate: str, names: tuple[str, ...], parameters: Collection[str]) -> str:
    """A rate through the inverse of I + S, where S is known."""
    known = any(name in parameters for name in names)
    return f"inverse({symmetric_text(names, parameters)}) * ({rate})" if known else rate


def _time(parameters: Collection[str]) -> Formula:
    skew = CLOCK_SKEW.names[0]
    less = f", and less by {skew} for each second since the first stamp" if skew in parameters else ""
    return Formula(
        f"time of that attitude on the gyro's clock, s{less}",
        "time",
        "stamp + time_offset",
        ("stamp",),
        lambda v: v.stamp + v.time_offset,
    )
