"""Changes of a planned head recording that may determine more."""

from __future__ import annotations

from collections.abc import Iterator

from alidade.pipelines.methods import Scenario
from alidade.pipelines.simulation.scenario import sways

# The sway added.
_SWAY = {"amplitude_deg": 20.0, "frequency_hz": 0.29}


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    for who, key in (("head", "head"), ("platform", "platform")):
        for words, motion in sways(scenario[key], _SWAY):
            yield f"the {who}: {words}", {**scenario, key: motion}
