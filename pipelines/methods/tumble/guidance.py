"""Guidance for the person who rotates the device, coverage so far; what can be wrong with the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from alidade.factors import so3
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.display.drawing import along, covered, resting
from alidade.pipelines.display.sphere_map import described, share_near, widest_gap
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.methods import Guidance, Scenario
from alidade.pipelines.methods.tumble.model import prepare
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.settings import Config

# Part of all directions that a vector has to have come near, and the widest gap that is none, rad.
_ENOUGH, _GAP = 0.9, np.deg2rad(45.0)
_UP = (0.0, 0.0, 1.0)
_WHAT = {"mag": "directions of the field", "accel": "sides up"}
_TURN = {"mag": "turn the device so that the field goes along", "accel": "rest it with this side up:"}


def checklist(data: TumbleData, config: Config) -> Sequence[ChecklistItem]:
    """Checklist of directions covered, the next rotation of the device, and rests of the accelerometer."""
    found = []
    for sensor in prepare(data, config).sensors:
        share, (gap, where) = share_near(sensor.directions), widest_gap(sensor.directions)
        wanted = f"{_TURN[sensor.name]} {described(where)}" if share < _ENOUGH or gap > _GAP else ""
        have = f"{100.0 * share:.0f} % within 30 deg, {len(sensor.raw)} readings"
        motion = None
        if wanted:
            toward = along(where, "field") if sensor.name == "mag" else resting(so3.shortest(where, _UP), lit=where)
            motion = Motion(wanted, toward)
        chart = covered(sensor.directions, _WHAT[sensor.name])
        found.append(ChecklistItem(_WHAT[sensor.name], have, wanted, min(share / _ENOUGH, 1.0), motion, chart))
    return found


# Longer than an accelerometer needs to be seen at rest, s.
_REST = 1.5


def variations(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Planned motions, in words, that may determine more, with the changed scenario."""
    yield "twice as many attitudes", {**scenario, "attitudes": 2 * scenario["attitudes"]}
    if scenario["tilt_deg"] < 180.0:
        yield "turned upside down too", {**scenario, "tilt_deg": 180.0}
    if scenario["accelerometer"] and scenario["rest_s"] < _REST:
        yield f"{_REST:g} s of rest in each attitude", {**scenario, "rest_s": _REST}


# Signs, order and scale of axes are what is calibrated.
FAULTS = FaultModel(streams={"mag_t": ("mag",), "accel_t": ("accel",), "gyro_t": ("gyro",)}, signs={})
GUIDANCE = Guidance(checklist=checklist, variations=variations)
