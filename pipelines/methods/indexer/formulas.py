"""How an indexer result is applied. Frames: n level, b base, t platform, m IMU on it. Methods page, section 2."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from factors import so3
from pipelines.methods.formula import Formula, passive


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With gyro scale and tilt of the axes where these are among the parameters."""
    scaled, tilted = "gyro_scale_x" in parameters, "axis_nonperpendicularity" in parameters
    return [
        Formula(
            "platform to IMU, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "mRt",
            "Rx(theta_x) * Ry(theta_y) * Rz(theta_z)",
            (),
            lambda v: so3.compose(passive(0, v.theta_x), passive(1, v.theta_y), passive(2, v.theta_z)),
        ),
        Formula(
            "rate of the platform, rad/s" + (", the quotient by component" if scaled else ""),
            "w_it",
            "inverse(mRt) * ((gyro - gyro_bias) / (1 + gyro_scale))" if scaled else "inverse(mRt) * (gyro - gyro_bias)",
            ("gyro",),
            lambda v: so3.rotate(
                so3.inverse(v.mRt), (v.gyro - v.gyro_bias) / (1.0 + getattr(v, "gyro_scale", np.zeros(3)))
            ),
        ),
        Formula(
            "platform to base, from the encoders' angles",
            "bRt",
            f"Exp(outer ex) * {'Exp(axis_nonperpendicularity ey) * ' if tilted else ''}Exp(inner ez)",
            ("outer", "inner"),
            lambda v: so3.compose(
                passive(0, -v.outer), passive(1, -getattr(v, "axis_nonperpendicularity", 0.0)), passive(2, -v.inner)
            ),
        ),
        Formula(
            "attitude of the carrier from that of the IMU",
            "nRb",
            "nRm * mRt * inverse(bRt)",
            ("outer", "inner", "nRm"),
            lambda v: so3.compose(v.nRm, v.mRt, so3.inverse(v.bRt)),
        ),
    ]
