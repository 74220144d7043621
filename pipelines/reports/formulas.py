"""How each method's result is applied, for calibration.yaml and the report. Methods page, one section a method."""

from __future__ import annotations

# Rotation-vector parameter -> the rotation it is.
ROTATIONS = {"helmet_mount": "vRh", "camera_mount": "cRb"}

# Method -> formulas, in the names of the parameters.
FORMULAS: dict[str, tuple[str, ...]] = {
    "head": (
        "vRh = Exp(helmet_mount), cRb = Exp(camera_mount): v helmet IMU, h markers, c camera, b platform",
        "rate of the helmet, rad/s in v: w_iv = gyro - gyro_bias",
        "attitude of the helmet on the platform from a camera measurement cRh: bRv = inverse(cRb) * cRh * inverse(vRh)",
        "time of that attitude on the gyro's clock, s: stamp of the picture + time_offset",
    ),
}
