"""What a measurement says about the unknowns: factors for anybody's gtsam graph, and the mathematics under them.

The names below are imported when they are first asked for, so that importing this package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "attitude": ("VisionAttitudeFactor",),
    "gimbal": ("GimbalPath", "LocalMotion"),
    "gyro": ("GyroIncrementFactor",),
    "indexer": ("AxisPath", "IndexerAverageFactor"),
    "los": ("LosDirectionFactor", "LosContext"),
    "loss": ("TruncatedLoss",),
    "model": ("POSE3", "ROT3", "Model"),
    "preintegration": ("GyroPath", "Increments"),
    "triad": (
        "AccelFactor",
        "FieldPriorFactor",
        "GyroStaticFactor",
        "MagFactor",
        "TagAttitudeFactor",
        "TriadPriorFactor",
    ),
    "turns": ("GyroRotationFactor",),
    "bridge": ("BoundModel",),
}
_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
