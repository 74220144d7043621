"""Changes of a planned los recording that may determine more."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from alidade.pipelines.methods import Scenario
from alidade.pipelines.simulation.scenario import sways

# The sway added.
_SWAY = {"amplitude_deg": 5.0, "frequency_hz": 0.29}


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    for words, motion in sways(scenario["carrier"], _SWAY):
        yield f"the carrier: {words}", {**scenario, "carrier": motion}
    # Another target from the middle of the longest stretch without one found anew.
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
