"""Guidance of the indexer method: motion while recording and of a plan, faults of the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np

from alidade.factors import so3
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.fault_models import ExactInput, FaultModel
from alidade.pipelines.display.drawing import BEHIND, Drawing
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.methods import Guidance, Scenario
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.windows import axis_motion
from alidade.pipelines.settings import Config

_AXES: tuple[tuple[Axis, Axis], ...] = (("outer", "inner"), ("inner", "outer"))
# Whole turns each way that are wanted in a position.
_TURNS = 3


def checklist(data: IndexerData, _: Config) -> Sequence[ChecklistItem]:
    """Checklist of turns forward and back about each axis, by the angle of the other axis."""
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


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Yield changes of a scenario worth trying: a phrase, and the changed scenario."""
    for axis in ("outer", "inner"):
        for other in (0.0, 90.0, 180.0, 270.0):
            position = {"axis": axis, "other_deg": other, "turns": 3.0}
            words = f"three turns each way about the {axis} axis, the other at {other:g} deg"
            yield words, {**scenario, "positions": [*scenario["positions"], position]}
    if not scenario["record_moves"]:
        yield "record the moves between positions too", {**scenario, "record_moves": True}


def _latitude(data: IndexerData, config: Config, change: float) -> tuple[IndexerData, Config] | None:
    if data.latitude_deg is None:
        return None
    return replace(data, latitude_deg=data.latitude_deg + change), config


FAULTS = FaultModel(
    streams={"gyro_t": ("gyro", "attitude"), "encoder_t": ("outer", "inner")},
    signs={"gyro": ("gyro", AXES), "outer": ("encoder", ("outer",)), "inner": ("encoder", ("inner",))},
    clock=("encoder_t", "encoders"),
    exact=(ExactInput("latitude_deg", "deg", 0.1, _latitude),),
    cut=False,
)


# Half the width and height of the outer frame, radius of the platform.
_WIDE, _HIGH, _PLATFORM = 1.1, 1.0, 0.75


Axis = Literal["outer", "inner"]


@cache
def turning(axis: Axis, other_deg: float, ways: str = "start end") -> str:
    """Drawing of one axis turning while the other axis stands at an angle.

    Args:
        axis: that turns.
        other_deg: where the other one stands.
        ways: "end" forward, "start" back, or both.
    """
    out = Drawing(BEHIND)
    ex, ez = np.eye(3)[0], np.eye(3)[2]
    outer = so3.exp(np.deg2rad(other_deg if axis == "inner" else 0.0) * ex)
    inner = so3.exp(np.deg2rad(other_deg if axis == "outer" else 0.0) * ez)

    # What is fixed: two posts that carry the outer axis.
    for side in (-1.0, 1.0):
        post, foot = 1.45 * side * ex, 1.45 * side * ex - 1.3 * ez
        out.line([post, foot], width=2.5)
        out.line([foot - 0.3 * np.eye(3)[1], foot + 0.3 * np.eye(3)[1]], width=2.5)
        out.line([post, _WIDE * side * ex], axis == "outer", 3.5)
    # The frame that turns about it, with a mark at the end of the inner axis that is up at 0 deg.
    corners = np.array([[a * _WIDE, 0.0, b * _HIGH] for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))])
    out.line(so3.rotate(outer, corners), width=2.5)
    up = so3.rotate(outer, ez)
    for end in (-1.0, 1.0):
        out.line([end * _HIGH * up, 0.0 * up], axis == "inner", 3.5 if axis == "inner" else 1.5)
    # The platform, with a mark that is to the right at 0 deg.
    circle = np.deg2rad(np.linspace(0.0, 360.0, 49))[:, None]
    attitude = so3.multiply(outer, inner)
    out.face(so3.rotate(attitude, _PLATFORM * np.hstack([np.cos(circle), np.sin(circle), 0.0 * circle])))
    out.line(so3.rotate(attitude, np.array([[0.15, 0.0, 0.0], [_PLATFORM, 0.0, 0.0]])), width=3.0, arrows="end")
    if axis == "outer":
        out.arc(ex, 1.75 * ex, 0.4, (-120.0, 120.0), ways)
    else:
        out.arc(up, 1.3 * up, 0.4, (-120.0, 120.0), ways)
    standing = "inner" if axis == "outer" else "outer"
    out.word(np.array([0.0, 0.0, -2.0]), f"{standing} axis at {other_deg:g} deg")
    return out.svg(f"the {axis} axis turning, the {standing} one at {other_deg:g} deg")


GUIDANCE = Guidance(checklist=checklist, variations=candidates)
