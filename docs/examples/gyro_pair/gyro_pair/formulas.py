"""How a result is applied."""

from __future__ import annotations

from collections.abc import Collection

from alidade.pipelines.methods.formula import Formula
from alidade.pipelines.settings import Config


def formulas(_: Collection[str], _config: Config) -> list[Formula]:
    """The same for all parameters: those that are fixed are reported too."""
    return [
        Formula("gyro b to gyro a", "aRb", "Exp(rotation)", ()),
        Formula(
            "what gyro a reads at that moment, its bias included, from a reading of gyro b, rad/s in a",
            "gyro_a",
            "aRb * (gyro_b - bias_difference)",
            ("gyro_b",),
        ),
        Formula(
            "time of that reading on gyro a's clock, s",
            "time",
            "stamp + time_offset",
            ("stamp",),
        ),
    ]
