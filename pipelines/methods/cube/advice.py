"""What motion would make a weak direction of a cube observable."""

from __future__ import annotations

from collections.abc import Mapping

from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.methods.cube.faces import Side
from alidade.pipelines.methods.cube.picture import rested

_UP: dict[str, Side] = {"x": "+x", "y": "+y", "z": "+z"}


def advice(weights: Mapping[str, float]) -> Motion:
    """The motion that would make a weak direction observable."""
    strongest = [name for name, w in weights.items() if abs(w) > 0.3] or list(weights)
    if all(name.startswith("field") for name in strongest):
        return Motion(
            "give tighter priors on field_e, field_n, field_u",
            why="the magnetometer's scale follows the field model's strength",
        )
    gyro = "".join(sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith("gyro_k")}))
    if gyro:
        words = f"turn the cube between poses about its {' and '.join(gyro)} axis, by a quarter turn or more, both ways"
        return Motion(words, swaying(gyro, "cube", (0.8, 0.8, 0.8)))
    still = {name.split("_")[0] for name in strongest if name.startswith(("accel", "mag"))}
    if still:
        axes = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith(("accel_k", "mag_k"))})
        about = f", its {' and '.join(axes)} axis up, down and level" if axes else ""
        picture = rested(_UP[axes[0] if axes else "x"])
        return Motion(f"add static poses in other attitudes{about}", picture, " and ".join(sorted(still)))
    if any(name.startswith("gyro_b") for name in strongest):
        return Motion("let the cube stand still longer")
    if any(name.startswith("tag_") for name in strongest):
        tags = sorted({name.split("_")[1] for name in strongest if name.startswith("tag_")})
        return Motion(f"show tag {' and '.join(tags)} to the camera together with its neighbours")
    return Motion(
        "turn the cube through more attitudes", why="heading, camera mount and field trade against each other"
    )
