"""Changes of a planned tumbling that may determine more."""

from __future__ import annotations

from collections.abc import Iterator

from alidade.pipelines.methods import Scenario

# Longer than an accelerometer needs to be seen at rest, s.
_REST = 1.5


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    yield "twice as many attitudes", {**scenario, "attitudes": 2 * scenario["attitudes"]}
    if scenario["tilt_deg"] < 180.0:
        yield "turned upside down too", {**scenario, "tilt_deg": 180.0}
    if scenario["accelerometer"] and scenario["rest_s"] < _REST:
        yield f"{_REST:g} s of rest in each attitude", {**scenario, "rest_s": _REST}
