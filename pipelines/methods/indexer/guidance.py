"""What the person recording an indexer is told of what has been collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.methods.indexer.picture import Axis, turning
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.runs import axis_motion
from alidade.pipelines.settings import Config

_AXES: tuple[tuple[Axis, Axis], ...] = (("outer", "inner"), ("inner", "outer"))
# Whole turns each way that are wanted in a position.
_TURNS = 3


def checklist(data: IndexerData, _: Config) -> Sequence[ChecklistItem]:
    """Turns forward and back about each axis, by the angle at which the other one stands."""
    turns: dict[tuple[str, int], list[int]] = {}
    for run in axis_motion(data).runs:
        if run.axis in ("outer", "inner"):
            # The publication has each axis turn with the other one at 0 and at 180 degrees.
            position = (run.axis, round(np.rad2deg(run.other) / 180.0) % 2 * 180)
            turns.setdefault(position, [0, 0])[0 if run.direction > 0 else 1] += run.whole_turns
    found = []
    for axis, other in _AXES:
        for angle in (0, 180):
            forward, back = turns.get((axis, angle), [0, 0])
            lacking = [word for word, n in (("forward", forward), ("back", back)) if n < _TURNS]
            wanted = f"three whole turns {' and '.join(lacking)}" if lacking else ""
            what = f"{axis} axis, {other} one at {angle} deg"
            words = f"turn the {axis} axis by {wanted}, the {other} one at {angle} deg"
            ways = " ".join({"forward": "end", "back": "start"}[word] for word in lacking)
            found.append(
                ChecklistItem(
                    what,
                    f"{forward} turns forward, {back} back",
                    wanted,
                    (min(forward, _TURNS) + min(back, _TURNS)) / (2 * _TURNS),
                    Motion(words, turning(axis, float(angle), ways)) if lacking else None,
                )
            )
    return found
