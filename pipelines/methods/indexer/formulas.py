"""How an indexer result is applied. Frames: n level, b base, t platform, m IMU on it. Methods page, section 2."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from factors import so3
from factors.gyro import symmetric
from pipelines.methods.formula import Formula, numbers_of, passive, symmetric_text
from pipelines.methods.indexer.parameters import DELAY, ENCODER, ERRORS


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
    if any(name in parameters for name in ERRORS):
        true = f"(inverse({symmetric_text(ERRORS, parameters)}) * {true})"

    def compute(v: Any) -> so3.Array:
        gain = np.eye(3) + symmetric(numbers_of(v, ERRORS))
        return so3.rotate(so3.inverse(v.mRt), (v.gyro - v.gyro_bias) @ np.linalg.inv(gain).T)

    return Formula("rate of the platform, rad/s", "w_it", f"inverse(mRt) * {true}", ("gyro",), compute)


def _angles(parameters: Collection[str]) -> list[Formula]:
    """The axes' angles from what the encoders read."""
    late = f", {DELAY.names[0]} s after the stamp of the reading" if DELAY.names[0] in parameters else ""

    def angle(axis: str, names: Sequence[str]) -> Formula:
        def compute(v: Any) -> so3.Array:
            (sine, cosine), read = numbers_of(v, names), np.asarray(getattr(v, axis))
            return np.asarray(read - sine * np.sin(read) - cosine * np.cos(read))

        sine, cosine = (name if name in parameters else "0" for name in names)
        expression = f"{axis} - {sine} * sin({axis}) - {cosine} * cos({axis})"
        return Formula(f"angle of the {axis} axis, rad{late}", f"{axis}_angle", expression, (axis,), compute)

    return [angle("outer", ENCODER[:2]), angle("inner", ENCODER[2:4])] if _corrected(parameters) else []


def _corrected(parameters: Collection[str]) -> bool:
    return any(name in parameters for name in ENCODER)


def _base(parameters: Collection[str]) -> Formula:
    outer, inner = ("outer_angle", "inner_angle") if _corrected(parameters) else ("outer", "inner")
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
