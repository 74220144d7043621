"""Guidance of the los method: motion while recording and of a plan, faults of the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem, swayed, turned
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.methods import Guidance, Scenario
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import sways

# Sway of a carrier counts from this angle on, rad.
_LEAST_SWAY_RAD = np.deg2rad(2.0)


def checklist(data: LosData, _: Config) -> Sequence[ChecklistItem]:
    """Checklist of sway about each axis of the carrier, and of the target's visibility."""
    seen = f"{1.0 / np.median(np.diff(data.image_t)):.3g} LOS errors/s"
    sway = turned(data.gyro_t, data.gyro)
    spread = np.rad2deg(np.ptp(data.gimbal, axis=0))
    return (
        ChecklistItem("target", seen),
        *swayed("sway", sway, _LEAST_SWAY_RAD, "sway the carrier about its", "carrier"),
        ChecklistItem("gimbal", f"azimuth over {spread[0]:.0f}, elevation over {spread[1]:.0f} deg"),
    )


# The sway added.
_ADDED_SWAY = {"amplitude_deg": 5.0, "frequency_hz": 0.29}


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Yield changes of a scenario worth trying: a phrase, and the changed scenario."""
    yield from sways(scenario, "carrier", "the carrier", _ADDED_SWAY)
    # Another target from the middle of the longest segment of one target.
    found = sorted([0.0, *(loss["end_s"] for loss in scenario["losses"]), scenario["duration_s"]])
    i = int(np.argmax(np.diff(found)))
    middle = 0.5 * (found[i] + found[i + 1])
    for words, key, step in (
        ("25 deg higher", "elevation_step_deg", 25.0),
        ("25 deg lower", "elevation_step_deg", -25.0),
        ("40 deg to the side", "azimuth_step_deg", 40.0),
    ):
        loss = {"start_s": middle - 1.0, "end_s": middle + 1.0, key: step}
        yield f"from {middle + 1.0:g} s on a target {words}", {**scenario, "losses": [*scenario["losses"], loss]}


FAULTS = FaultModel(
    streams={"gyro_t": ("gyro", "force"), "gimbal_t": ("gimbal",), "image_t": ("error", "error_cov")},
    signs={"gyro": ("gyro", AXES), "gimbal": ("gimbal", ("azimuth", "elevation"))},
)

GUIDANCE = Guidance(checklist=checklist, variations=candidates)
