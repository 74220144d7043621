"""What the person recording a head is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem, swayed, turned
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.settings import Config

# Turns of a head and of the platform it sits in count from these angles on, rad.
_NOD, _MANOEUVRE = np.deg2rad(10.0), np.deg2rad(5.0)


def checklist(data: HeadData, _: Config) -> Sequence[ChecklistItem]:
    """Motion of the head, and of the platform where there is one."""
    found = [ChecklistItem("vision", f"{1.0 / np.median(np.diff(data.vision_t)):.3g} attitudes/s")]
    found += swayed("head", turned(data.head_t, data.head_gyro), _NOD, "turn the head about its", "helmet")
    if data.platform_t is not None and data.platform_gyro is not None:
        platform = turned(data.platform_t, data.platform_gyro)
        found += swayed("platform", platform, _MANOEUVRE, "turn the platform about its", "platform")
    return found
