"""Changes of a planned indexer recording that may determine more."""

from __future__ import annotations

from collections.abc import Iterator

from alidade.pipelines.methods import Scenario


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    for axis in ("outer", "inner"):
        for other in (0.0, 90.0, 180.0, 270.0):
            position = {"axis": axis, "other_deg": other, "turns": 3.0}
            words = f"three turns each way about the {axis} axis, the other at {other:g} deg"
            yield words, {**scenario, "positions": [*scenario["positions"], position]}
    if not scenario["record_moves"]:
        yield "record the moves between positions too", {**scenario, "record_moves": True}
