"""What the person recording a swaying carrier is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem, swayed, turned
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.settings import Config

# Sway of a carrier counts from this angle on, rad.
_SWAY = np.deg2rad(2.0)


def checklist(data: LosData, _: Config) -> Sequence[ChecklistItem]:
    """Sway about each axis of the carrier, and whether the target was in sight."""
    seen = f"{1.0 / np.median(np.diff(data.image_t)):.3g} LOS errors/s"
    sway = turned(data.gyro_t, data.gyro)
    spread = np.rad2deg(np.ptp(data.gimbal, axis=0))
    return (
        ChecklistItem("target", seen),
        *swayed("sway", sway, _SWAY, "sway the carrier about its", "carrier"),
        ChecklistItem("gimbal", f"azimuth over {spread[0]:.0f}, elevation over {spread[1]:.0f} deg"),
    )
