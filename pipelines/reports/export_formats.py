"""A calibration for the programs that apply it: static transforms, ROS 2 parameters, formats of triads."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import yaml_float
from alidade.pipelines.methods.triads import TRIADS
from alidade.pipelines.reports import triad_export
from alidade.pipelines.reports.calibration import SavedCalibration, SavedTransform, as_saved
from alidade.pipelines.reports.result import Calibration

_SAID = "covariance of small rotations about the parent's axes, rad^2, by rows"
_PLACE = "only the rotation is calibrated: put the translation in"


def export(calibration: str | Path | Calibration | SavedCalibration, form: str) -> str:
    """The text of a calibration: px4, ardupilot, betaflight, inav, ros2, kalibr, openvins, realsense, oak; tf, urdf.

    Gain and offset of sensors of three axes, or mounting rotations as static transforms.

    Raises:
        InputError: the calibration cannot be used, or has no such format.
    """
    saved = as_saved(calibration)
    has_triad = any(f"{name}_k11" in saved.parameters for name in TRIADS)
    formats = {**(triad_export.FORMATS if has_triad else {}), **(MOUNT_FORMATS if saved.transforms else {})}
    if not formats:
        raise InputError(f"this calibration of {saved.method} holds nothing that another program could be given")
    if form not in formats:
        raise InputError(f"a calibration of {saved.method} has no format {form}; it has {', '.join(formats)}")
    return formats[form](saved)


def _tf(saved: SavedCalibration) -> str:
    """Return a command of tf2_ros, static_transform_publisher, for each transform."""
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
    """Return a fixed URDF joint for each transform; rpy turns about fixed x, then y, then z."""
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


MOUNT_FORMATS: Mapping[str, Callable[[SavedCalibration], str]] = {"tf": _tf, "urdf": _urdf}


def ros_parameters(saved: SavedCalibration, names: Collection[str]) -> str:
    """Return a ROS 2 parameter file of the values in formulas, SI, x, y, z as one list, and of the transforms."""
    content: dict[str, Any] = {"method": saved.method, "sha256": saved.recording.sha256}
    for name in names:
        stem, _, axis = name.rpartition("_")
        triple = [f"{stem}_{each}" for each in "xyz"]
        if axis in "xyz" and all(each in saved.parameters for each in triple):
            content.setdefault(stem, [saved.parameters[each].in_formulas if each in names else 0.0 for each in triple])
        else:
            content[name] = saved.parameters[name].in_formulas
    lines = ["/**:", "  ros__parameters:", "    alidade:"]
    lines += [f"      {name}: {_text(value)}" for name, value in content.items()]
    for name, each in saved.transforms.items():
        w, x, y, z = each.wxyz
        lines += [f"      {name}:", f"        frame_id: {each.parent}", f"        child_frame_id: {each.child}"]
        lines.append(f"        rotation_xyzw: {_text([x, y, z, w])}")
    return "\n".join([*lines, ""])


def _text(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    return yaml_float(value) if isinstance(value, float) else str(value)
