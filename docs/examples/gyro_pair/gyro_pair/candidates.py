"""Changes of a planned recording of two gyros that may tell more."""

from __future__ import annotations

from collections.abc import Iterator

from alidade.pipelines.methods import Scenario
from alidade.pipelines.simulation.scenario import sways

# The sway added.
_SWAY = {"amplitude_deg": 20.0, "frequency_hz": 0.29}


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    for words, motion in sways(scenario["motion"], _SWAY):
        yield f"the body: {words}", {**scenario, "motion": motion}
