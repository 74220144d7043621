"""How a los result is applied. Frames: m gyro (IMU), b carrier, l line of sight. Methods page, section 1."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from factors import so3
from pipelines.methods.formula import Formula, passive

_LEFT, _MIDDLE = ("camera_roll", "collimation"), "axis_nonperpendicularity"


def formulas(parameters: Collection[str]) -> list[Formula]:
    """With the options that are among the parameters."""
    found = []
    if "delta_pz" in parameters:
        found.append(
            Formula("azimuth zero", "delta_z", "delta_pz - delta_gz", (), lambda v: np.array(v.delta_pz - v.delta_gz))
        )
    found += [
        Formula(
            "IMU to carrier, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "M",
            "Rz(delta_z) * Rx(-delta_gx) * Ry(-delta_gy)",
            (),
            lambda v: so3.compose(passive(2, v.delta_z), passive(0, -v.delta_gx), passive(1, -v.delta_gy)),
        ),
        Formula(
            "rate of the carrier, rad/s",
            "w_b",
            "M * (gyro - gyro_bias)",
            ("gyro",),
            lambda v: so3.rotate(v.M, v.gyro - v.gyro_bias),
        ),
        _camera(parameters),
        Formula(
            "a direction d_b of the carrier in the line-of-sight frame",
            "d_l",
            "lRb * d_b",
            ("azimuth", "elevation", "d_b"),
            lambda v: so3.rotate(v.lRb, v.d_b),
        ),
    ]
    if "time_offset" in parameters:
        found.append(
            Formula(
                "time of a picture on the gyro's clock, s",
                "time",
                "stamp + time_offset",
                ("stamp",),
                lambda v: v.stamp + v.time_offset,
            )
        )
    return found


def _camera(parameters: Collection[str]) -> Formula:
    """The camera in the carrier, with those turns that are calibrated."""
    roll, collimation, tilt = (name in parameters for name in (*_LEFT, _MIDDLE))
    turns = [
        *(["Ry(camera_roll)"] if roll else []),
        *(["Rz(collimation)"] if collimation else []),
        "Rx(elevation + delta_px)",
        *(["Ry(axis_nonperpendicularity)"] if tilt else []),
        "Rz(azimuth)",
    ]

    def compute(v: object) -> so3.Array:
        given = vars(v)
        return so3.compose(
            passive(1, given.get("camera_roll", 0.0)),
            passive(2, given.get("collimation", 0.0)),
            passive(0, given["elevation"] + given["delta_px"]),
            passive(1, given.get("axis_nonperpendicularity", 0.0)),
            passive(2, given["azimuth"]),
        )

    return Formula("carrier to line of sight", "lRb", " * ".join(turns), ("azimuth", "elevation"), compute)
