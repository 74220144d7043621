"""What the person who turns a device is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.judgement.checklist import ChecklistItem
from pipelines.methods.tumble.model import prepare
from pipelines.methods.tumble.recording import TumbleData
from pipelines.reports.sphere_map import described, share_near, widest_gap
from pipelines.settings import Config

# Part of all directions that a vector has to have come near, and the widest gap that is none, rad.
_ENOUGH, _GAP = 0.9, np.deg2rad(45.0)
_WHAT = {"mag": "directions of the field", "accel": "sides up"}
_TURN = {"mag": "turn the device so that the field goes along", "accel": "rest it with this side up:"}


def checklist(data: TumbleData, config: Config) -> Sequence[ChecklistItem]:
    """Directions covered, and where to turn the device next; rests of the accelerometer."""
    found = []
    for sensor in prepare(data, config).sensors:
        share, (gap, where) = share_near(sensor.directions), widest_gap(sensor.directions)
        wanted = f"{_TURN[sensor.name]} {described(where)}" if share < _ENOUGH or gap > _GAP else ""
        have = f"{100.0 * share:.0f} % within 30 deg, {len(sensor.raw)} readings"
        found.append(ChecklistItem(_WHAT[sensor.name], have, wanted))
    return found
