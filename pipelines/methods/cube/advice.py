"""What motion would make a weak direction of a cube observable."""

from __future__ import annotations

from collections.abc import Mapping


def advice(weights: Mapping[str, float]) -> str:
    """The motion that would make a weak direction observable."""
    strongest = [name for name, w in weights.items() if abs(w) > 0.3] or list(weights)
    if all(name.startswith("field") for name in strongest):
        return (
            "the magnetometer's scale follows the field model's strength: tighter priors on field_e, field_n, field_u"
        )
    gyro = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith("gyro_k")})
    if gyro:
        return f"turn the cube between poses about its {' and '.join(gyro)} axis, by a quarter turn or more, both ways"
    still = {name.split("_")[0] for name in strongest if name.startswith(("accel", "mag"))}
    if still:
        axes = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith(("accel_k", "mag_k"))})
        about = f", its {' and '.join(axes)} axis up, down and level" if axes else ""
        return f"{' and '.join(sorted(still))}: add static poses in other attitudes{about}"
    if any(name.startswith("gyro_b") for name in strongest):
        return "let the cube stand still longer"
    if any(name.startswith("tag_") for name in strongest):
        tags = sorted({name.split("_")[1] for name in strongest if name.startswith("tag_")})
        return f"show tag {' and '.join(tags)} to the camera together with its neighbours"
    return "heading, camera mount and field trade against each other: turn the cube through more attitudes"
