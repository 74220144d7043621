"""foxglove.json: a layout that shows estimates.mcap, imported in Foxglove or Lichtblick by its layout menu."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import cycle
from typing import Any

from alidade.pipelines.display.figure import COLORS, PALETTE
from alidade.pipelines.reports.plots import variables
from alidade.pipelines.reports.result import Calibration

_PLOT = {
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "showLegend": True,
    "legendDisplay": "floating",
    "showPlotValuesInLegend": True,
    "isSynced": True,
    "xAxisVal": "timestamp",
    "sidebarDimension": 240,
}


def foxglove_layout(calibration: Calibration) -> str:
    """The layout as JSON: a plot a variable, with the values of its numbers and the edges of their one-sigma bands."""
    panels = {}
    for title, unit, members in variables(calibration):
        paths = [
            {
                "value": f"/estimate/{q.name}.{field}",
                "label": q.name if field == "value" else f"{q.name} {field}",
                "enabled": True,
                "color": PALETTE[color][0],
                "lineSize": 2 if field == "value" else 0.5,
                "timestampMethod": "headerStamp",
            }
            for q, color in zip(members, cycle(COLORS))
            for field in ("value", "lower", "upper")
        ]
        panels[f"Plot!{title}"] = {"title": f"{title}, {unit}", "paths": paths, **_PLOT}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(list(panels), "row"),
    }
    return json.dumps(layout, indent=1) + "\n"


def _split(panels: Sequence[str], direction: str) -> Any:
    """Panels side by side and one above the other, in turns, as evenly as it goes."""
    if len(panels) == 1:
        return panels[0]
    half = (len(panels) + 1) // 2
    other = "column" if direction == "row" else "row"
    return {
        "direction": direction,
        "first": _split(panels[:half], other),
        "second": _split(panels[half:], other),
        "splitPercentage": round(100 * half / len(panels)),
    }
