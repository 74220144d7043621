"""The numbers of a calibration as parameters of a ROS 2 node, YAML."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from alidade.pipelines.reports.calibration import SavedCalibration


def ros_parameters(saved: SavedCalibration, names: Collection[str]) -> str:
    """The parameters of these names, SI, three of them name_x, name_y, name_z as one list, and the transforms."""
    content: dict[str, Any] = {"method": saved.method, "sha256": saved.recording.sha256}
    for name in names:
        stem, _, axis = name.rpartition("_")
        triple = [f"{stem}_{each}" for each in "xyz"]
        if axis in "xyz" and all(each in saved.parameters for each in triple):
            content.setdefault(stem, [saved.value(each) for each in triple])
        else:
            content[name] = saved.value(name)
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
    text = repr(value) if isinstance(value, float) else str(value)
    # 1e-05 is a string to some readers of YAML, 1.0e-05 to none.
    return text.replace("e", ".0e") if isinstance(value, float) and "e" in text and "." not in text else text
