"""How a los result is applied. Frames: m gyro (IMU), b carrier, l line of sight. Methods page, section 1."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.pipelines.methods.formula import Formula, axis_angles, gyro_rate, numbers_of, passive
from alidade.pipelines.methods.los.parameters import (
    CLOCK_SKEW,
    DELAY,
    LOS_SCALE,
    OFFSET,
    ONCE_PER_TURN,
    SCALE,
    SENSITIVITY,
    TEMPERATURE,
)
from alidade.pipelines.methods.los.topics import JOINTS

_LEFT, _MIDDLE = ("camera_roll", "collimation"), "axis_nonperpendicularity"
S = tuple(name for each in SCALE for name in each.names)
DRIVERS = SENSITIVITY.names, TEMPERATURE.names


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With the errors of the sensors that are among the parameters."""
    found = []
    if "delta_pz" in parameters:
        found.append(
            Formula("azimuth zero", "delta_z", "delta_pz - delta_gz", (), lambda v: np.array(v.delta_pz - v.delta_gz))
        )
    angles = axis_angles(JOINTS, ONCE_PER_TURN.names, DELAY.names[0], parameters)
    azimuth, elevation = [angle.name for angle in angles] or JOINTS
    true, measured, rate = gyro_rate(parameters, S, *DRIVERS)
    found += [
        Formula(
            "IMU to carrier, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "M",
            "Rz(delta_z) * Rx(-delta_gx) * Ry(-delta_gy)",
            (),
            lambda v: so3.compose(passive(2, v.delta_z), passive(0, -v.delta_gx), passive(1, -v.delta_gy)),
        ),
        Formula("rate of the carrier, rad/s", "w_b", f"M * ({true})", measured, lambda v: so3.rotate(v.M, rate(v))),
        *angles,
        _camera(parameters, azimuth, elevation),
        Formula(
            "a direction d_b of the carrier in the line-of-sight frame",
            "d_l",
            "lRb * d_b",
            (*JOINTS, "d_b"),
            lambda v: so3.rotate(v.lRb, v.d_b),
        ),
    ]
    if LOS_SCALE.names[0] in parameters:
        found.append(
            Formula(
                "LOS error, rad, from the one measured",
                "los_error",
                "measured_error / (1 + los_scale)",
                ("measured_error",),
                lambda v: np.asarray(v.measured_error / (1.0 + v.los_scale)),
            )
        )
    return [*found, *_clock(parameters)]


def _clock(parameters: Collection[str]) -> list[Formula]:
    """When a picture was taken."""
    offset, skew = OFFSET in parameters, CLOCK_SKEW.names[0] in parameters
    if not (offset or skew):
        return []
    less = f", and less by {CLOCK_SKEW.names[0]} for each second since the first stamp" if skew else ""
    return [
        Formula(
            f"time of a picture on the gyro's clock, s{less}",
            "time",
            "stamp + time_offset" if offset else "stamp",
            ("stamp",),
            lambda v: v.stamp + numbers_of(v, [OFFSET])[0] * offset,
        )
    ]


def _camera(parameters: Collection[str], azimuth: str, elevation: str) -> Formula:
    """The camera in the carrier, with those turns that are calibrated."""
    roll, collimation, tilt = (name in parameters for name in (*_LEFT, _MIDDLE))
    turns = [
        *(["Ry(camera_roll)"] if roll else []),
        *(["Rz(collimation)"] if collimation else []),
        f"Rx({elevation} + delta_px)",
        *(["Ry(axis_nonperpendicularity)"] if tilt else []),
        f"Rz({azimuth})",
    ]

    def compute(v: Any) -> so3.Array:
        return so3.compose(
            *([passive(1, v.camera_roll)] if roll else []),
            *([passive(2, v.collimation)] if collimation else []),
            passive(0, getattr(v, elevation) + v.delta_px),
            *([passive(1, v.axis_nonperpendicularity)] if tilt else []),
            passive(2, getattr(v, azimuth)),
        )

    return Formula("carrier to line of sight", "lRb", " * ".join(turns), JOINTS, compute)
