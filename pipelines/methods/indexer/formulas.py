"""How an indexer result is applied. Frames: n level, b base, t platform, m IMU on it. Methods page, section 2."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from factors import so3
from factors.gyro import symmetric
from pipelines.methods.formula import Formula, passive
from pipelines.methods.indexer.parameters import ENCODER, ERRORS, SCALE


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With errors of gyro and encoders and tilt of the axes where these are among the parameters."""
    return [
        Formula(
            "platform to IMU, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "mRt",
            "Rx(theta_x) * Ry(theta_y) * Rz(theta_z)",
            (),
            lambda v: so3.compose(passive(0, v.theta_x), passive(1, v.theta_y), passive(2, v.theta_z)),
        ),
        _rate(parameters),
        *_angles(parameters),
        _base(parameters),
        Formula(
            "attitude of the carrier from that of the IMU",
            "nRb",
            "nRm * mRt * inverse(bRt)",
            ("outer", "inner", "nRm"),
            lambda v: so3.compose(v.nRm, v.mRt, so3.inverse(v.bRt)),
        ),
    ]


def _rate(parameters: Collection[str]) -> Formula:
    true = "(gyro - gyro_bias)"
    if SCALE.names[0] in parameters:
        xx, yy, zz, xy, xz, yz = (name if name in parameters else "0" for name in ERRORS)
        rows = f"[[1 + {xx}, {xy}, {xz}], [{xy}, 1 + {yy}, {yz}], [{xz}, {yz}, 1 + {zz}]]"
        true = f"(inverse({rows}) * {true})"

    def compute(v: Any) -> so3.Array:
        gain = np.eye(3) + symmetric(np.array([getattr(v, name, 0.0) for name in ERRORS]))
        return so3.rotate(so3.inverse(v.mRt), (v.gyro - v.gyro_bias) @ np.linalg.inv(gain).T)

    return Formula("rate of the platform, rad/s", "w_it", f"inverse(mRt) * {true}", ("gyro",), compute)


def _angles(parameters: Collection[str]) -> list[Formula]:
    """The axes' angles from what the encoders read."""
    if ENCODER[0] not in parameters:
        return []

    def angle(axis: str, sine: str, cosine: str) -> Formula:
        def compute(v: Any) -> so3.Array:
            read = np.asarray(getattr(v, axis))
            return np.asarray(read - getattr(v, sine) * np.sin(read) - getattr(v, cosine) * np.cos(read))

        expression = f"{axis} - {sine} * sin({axis}) - {cosine} * cos({axis})"
        meaning = f"angle of the {axis} axis, rad, encoder_delay s after the stamp of the reading"
        return Formula(meaning, f"{axis}_angle", expression, (axis,), compute)

    return [angle("outer", *ENCODER[:2]), angle("inner", *ENCODER[2:4])]


def _base(parameters: Collection[str]) -> Formula:
    outer, inner = ("outer_angle", "inner_angle") if ENCODER[0] in parameters else ("outer", "inner")
    tilt = "Exp(axis_nonperpendicularity ey) * " if "axis_nonperpendicularity" in parameters else ""
    return Formula(
        "platform to base, from the encoders' angles",
        "bRt",
        f"Exp({outer} ex) * {tilt}Exp({inner} ez)",
        ("outer", "inner"),
        lambda v: so3.compose(
            passive(0, -getattr(v, outer)),
            passive(1, -getattr(v, "axis_nonperpendicularity", 0.0)),
            passive(2, -getattr(v, inner)),
        ),
    )
