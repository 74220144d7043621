"""How a head result is applied. Frames: v helmet IMU, h markers, c camera, b platform. Methods page, section 3."""

from __future__ import annotations

from collections.abc import Collection

from factors import so3
from pipelines.methods.formula import Formula


def formulas(_: Collection[str]) -> list[Formula]:
    """The same for all parameters: those that are fixed are reported too."""
    return [
        Formula("markers to helmet IMU", "vRh", "Exp(helmet_mount)", (), lambda v: so3.exp(v.helmet_mount)),
        Formula("platform to camera", "cRb", "Exp(camera_mount)", (), lambda v: so3.exp(v.camera_mount)),
        Formula(
            "rate of the helmet, rad/s in v", "w_iv", "gyro - gyro_bias", ("gyro",), lambda v: v.gyro - v.gyro_bias
        ),
        Formula(
            "attitude of the helmet on the platform from a camera measurement cRh",
            "bRv",
            "inverse(cRb) * cRh * inverse(vRh)",
            ("cRh",),
            lambda v: so3.compose(so3.inverse(v.cRb), v.cRh, so3.inverse(v.vRh)),
        ),
        Formula(
            "time of that attitude on the gyro's clock, s",
            "time",
            "stamp + time_offset",
            ("stamp",),
            lambda v: v.stamp + v.time_offset,
        ),
    ]
