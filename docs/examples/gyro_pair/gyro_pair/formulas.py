"""How a result is applied."""

from __future__ import annotations

from collections.abc import Collection

from alidade.factors import so3
from alidade.pipelines.methods.formula import Formula


def formulas(_: Collection[str]) -> list[Formula]:
    """The same for all parameters: those that are fixed are reported too."""
    return [
        Formula("gyro b to gyro a", "aRb", "Exp(rotation)", (), lambda v: so3.exp(v.rotation)),
        Formula(
            "what gyro a reads at that moment, its bias included, from a reading of gyro b, rad/s in a",
            "gyro_a",
            "aRb * (gyro_b - bias_difference)",
            ("gyro_b",),
            lambda v: so3.rotate(v.aRb, v.gyro_b - v.bias_difference),
        ),
        Formula(
            "time of that reading on gyro a's clock, s",
            "time",
            "stamp + time_offset",
            ("stamp",),
            lambda v: v.stamp + v.time_offset,
        ),
    ]
