"""How a cube result is applied. Frames: b cube's body, B reference, C camera, n level. Methods page, section 4."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from factors import so3
from pipelines.methods.formula import Formula

_TRIADS = {
    "accel": ("specific force along the cube's axes, m/s^2", "f_b"),
    "gyro": ("rate along the cube's axes, rad/s", "w_b"),
    "mag": ("field along the cube's axes, T", "m_b"),
}


def formulas(parameters: Collection[str]) -> list[Formula]:
    """Of the sensors, mounts and tags that are among the parameters; raw numbers are as recorded."""
    found = [_triad(name) for name in _TRIADS if f"{name}_k11" in parameters]
    if "camera_mount_x" in parameters:
        found.append(
            Formula(
                "camera to reference, camera_rotation as the config gives it",
                "BRC",
                "camera_rotation * Exp(camera_mount)",
                ("camera_rotation",),
                lambda v: so3.multiply(v.camera_rotation, so3.exp(v.camera_mount)),
            )
        )
    tags = sorted(int(name[4:-2]) for name in parameters if name.startswith("tag_") and name.endswith("_x"))
    found += [_tag(tag) for tag in tags]
    if "reference_heading" in parameters:
        found.append(
            Formula(
                "reference to level, from its own attitude nRB_said in East-North-Up",
                "nRB",
                "Exp(reference_heading ez) * nRB_said",
                ("nRB_said",),
                lambda v: so3.multiply(so3.exp(v.reference_heading * np.eye(3)[2]), v.nRB_said),
            )
        )
    if "camera_mount_x" in parameters and "reference_heading" in parameters:
        found.append(
            Formula(
                "attitude of the cube from a tag seen at CRT that stands on it at bodyRtag",
                "nRb",
                "nRB * BRC * CRT * inverse(bodyRtag)",
                ("camera_rotation", "nRB_said", "CRT", "bodyRtag"),
                lambda v: so3.compose(v.nRB, v.BRC, v.CRT, so3.inverse(v.bodyRtag)),
            )
        )
    return found


def _triad(name: str) -> Formula:
    meaning, result = _TRIADS[name]
    rows = ", ".join(f"[{', '.join(f'{name}_k{i}{j}' for j in '123')}]" for i in "123")

    def compute(v: Any) -> so3.Array:
        K = np.array([[getattr(v, f"{name}_k{i}{j}") for j in "123"] for i in "123"])
        b = np.array([getattr(v, f"{name}_b{i}") for i in "123"])
        return np.asarray(getattr(v, name) @ K.T + b)

    bias = f"[{', '.join(f'{name}_b{i}' for i in '123')}]"
    return Formula(meaning, result, f"[{rows}] * {name} + {bias}", (name,), compute)


def _tag(tag: int) -> Formula:
    return Formula(
        f"tag {tag} to cube, rotation_{tag} as the config gives it",
        f"bodyRtag_{tag}",
        f"rotation_{tag} * Exp(tag_{tag})",
        (f"rotation_{tag}",),
        lambda v: so3.multiply(getattr(v, f"rotation_{tag}"), so3.exp(getattr(v, f"tag_{tag}"))),
    )
