"""How an indexer result is applied. Frames: n level, b base, t platform, m IMU on it. Methods page, section 2."""

from __future__ import annotations

from collections.abc import Collection

from alidade.factors import so3
from alidade.pipelines.methods.formula import Formula, axis_angles, gyro_rate, passive
from alidade.pipelines.methods.indexer.parameters import DELAY, ERRORS, ONCE_PER_TURN, TEMPERATURE

_AXES = ("outer", "inner")


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With errors of gyro and encoders and tilt of the axes where these are among the parameters."""
    angles = axis_angles(_AXES, ONCE_PER_TURN.names, DELAY.names[0], parameters)
    outer, inner = [angle.name for angle in angles] or _AXES
    return [
        Formula(
            "platform to IMU, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "mRt",
            "Rx(theta_x) * Ry(theta_y) * Rz(theta_z)",
            (),
            lambda v: so3.compose(passive(0, v.theta_x), passive(1, v.theta_y), passive(2, v.theta_z)),
        ),
        _rate(parameters),
        *angles,
        _base(parameters, outer, inner),
        Formula(
            "attitude of the carrier from that of the IMU",
            "nRb",
            "nRm * mRt * inverse(bRt)",
            ("outer", "inner", "nRm"),
            lambda v: so3.compose(v.nRm, v.mRt, so3.inverse(v.bRt)),
        ),
    ]


def _rate(parameters: Collection[str]) -> Formula:
    true, measured, rate = gyro_rate(parameters, ERRORS, (), TEMPERATURE.names)
    return Formula(
        "rate of the platform, rad/s",
        "w_it",
        f"inverse(mRt) * ({true})",
        measured,
        lambda v: so3.rotate(so3.inverse(v.mRt), rate(v)),
    )


def _base(parameters: Collection[str], outer: str, inner: str) -> Formula:
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
