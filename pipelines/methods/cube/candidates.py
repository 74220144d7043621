"""Changes of a planned cube recording that may determine more."""

from __future__ import annotations

from collections.abc import Iterator

from alidade.pipelines.methods import Scenario
from alidade.pipelines.methods.cube.next_poses import next_poses
from alidade.pipelines.methods.cube.scenario import CubeScenario

# Poses that are proposed together, and the seed of their simulation.
_SERIES, _SEED = 6, 0


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """In words, and the changed scenario."""
    single, series = next_poses(CubeScenario.model_validate(scenario), _SEED, _SERIES)
    for poses in (*([pose] for pose in single), series):
        more = [*scenario["attitudes"], *(pose.model_dump() for pose in poses)]
        words = "; then ".join(str(pose) for pose in poses)
        yield (
            f"{'one more pose' if len(poses) == 1 else f'{len(poses)} more poses'}: {words}",
            {**scenario, "attitudes": more},
        )
    yield "each pose held twice as long", {**scenario, "static_s": 2.0 * scenario["static_s"]}
    if scenario["turn_axes"]:
        yield "turns about any axis", {**scenario, "turn_axes": []}
    if scenario["cube"]["hidden"]:
        yield "every face shown", {**scenario, "cube": {**scenario["cube"], "hidden": []}}
