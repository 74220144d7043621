"""Which directions of the cube were up, on a map of all directions."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.display.figure import Plot
from alidade.pipelines.display.sphere_map import described, sphere_map, widest_gap
from alidade.pipelines.methods.cube.tables import rows_of
from alidade.pipelines.reports.result import Calibration


def coverage(calibration: Calibration) -> Plot | None:
    """Directions of up in the body, on an equal-area map of the sphere, with the gaps between them."""
    up = np.array([row["up"] for row in rows_of(calibration, "static_poses")])
    if not len(up):
        return None
    gap, where = widest_gap(up)
    names = [f"pose {k + 1}: {described(direction)}" for k, direction in enumerate(up)]
    return Plot(
        "Attitudes covered",
        f"Which direction of the body was up in each of the {len(up)} static poses, on an equal-area map of all "
        f"directions. The middle of the widest gap is {np.rad2deg(gap):.0f} deg from every pose, "
        f"at {described(where)}.",
        sphere_map(up, names, "pose"),
    )
