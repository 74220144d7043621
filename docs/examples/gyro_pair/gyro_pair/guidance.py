"""What the person recording two gyros is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem, turned
from alidade.pipelines.settings import Config
from gyro_pair.recording import GyroPairData

# Turns count from this angle on, rad.
_TURN = np.deg2rad(20.0)


def checklist(data: GyroPairData, _: Config) -> Sequence[ChecklistItem]:
    """Turns about the axes of a, two of which are enough."""
    angles = turned(data.a_t, data.a_gyro)
    have = ", ".join(f"{axis} {np.rad2deg(angle):.0f} deg" for axis, angle in zip("xyz", angles, strict=True))
    enough = np.count_nonzero(angles >= _TURN) >= 2
    wanted = "" if enough else f"turn the body by {np.rad2deg(_TURN):.0f} deg about two axes"
    return [ChecklistItem("turns", have, wanted)]
