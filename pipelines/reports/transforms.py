"""Mounting rotations of a calibration for programs that want static transforms, with their covariances."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from alidade.factors import so3
from alidade.pipelines.reports.calibration import SavedCalibration, SavedTransform

_SAID = "covariance of small rotations about the parent's axes, rad^2, by rows"
_PLACE = "only the rotation is calibrated: put the translation in"


def _tf(saved: SavedCalibration) -> str:
    """A command of tf2_ros for each."""
    lines = [f"# {_PLACE}."]
    for name, each in saved.transforms.items():
        quaternion = " ".join(f"--q{axis} {value!r}" for axis, value in zip("wxyz", each.wxyz, strict=True))
        lines += [
            f"# {name}: {each.child} to {each.parent}; {_SAID}: {_row(each)}",
            f"ros2 run tf2_ros static_transform_publisher --x 0 --y 0 --z 0 {quaternion} "
            f"--frame-id {each.parent} --child-frame-id {each.child}",
        ]
    return "\n".join([*lines, ""])


def _urdf(saved: SavedCalibration) -> str:
    """A fixed joint for each; rpy turns about fixed x, then y, then z."""
    lines = [f"<!-- {_PLACE}. -->"]
    for name, each in saved.transforms.items():
        angles = " ".join(f"{angle:.12g}" for angle in roll_pitch_yaw(each))
        lines += [
            f"<!-- {name}: {each.child} to {each.parent}; {_SAID}: {_row(each)} -->",
            f'<joint name="{each.parent}_to_{each.child}" type="fixed">',
            f'  <parent link="{each.parent}"/>',
            f'  <child link="{each.child}"/>',
            f'  <origin xyz="0 0 0" rpy="{angles}"/>',
            "</joint>",
        ]
    return "\n".join([*lines, ""])


FORMATS: Mapping[str, Callable[[SavedCalibration], str]] = {"tf": _tf, "urdf": _urdf}


def roll_pitch_yaw(transform: SavedTransform) -> tuple[float, float, float]:
    """Angles, rad, with R = Rz(yaw) Ry(pitch) Rx(roll), active; yaw is 0 where pitch is a right angle."""
    R = so3.matrix(np.array(transform.wxyz))
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = float(np.arctan2(-R[2, 0], level))
    if level < 1e-9:
        return float(np.arctan2(-R[1, 2], R[1, 1])), pitch, 0.0
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def _row(transform: SavedTransform) -> str:
    return " ".join(f"{x:.4g}" for x in transform.covariance)
