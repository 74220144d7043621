"""Whether keyframes stand where pictures were taken."""

from __future__ import annotations

import numpy as np
import pytest

from alidade.pipelines.estimation.camera_clock import Clock, Keyframes

KEYFRAMES = Keyframes(Clock(10.0, 0.01), 0.02)


@pytest.mark.parametrize(
    ("clock", "time", "far"),
    [
        (Clock(10.0, 0.025), 500.0, False),
        (Clock(10.0, 0.031), 500.0, True),
        (Clock(10.0, -0.011), 500.0, True),
        (Clock(10.0, 0.01, 1e-4), 205.0, False),
        (Clock(10.0, 0.01, 1e-4), 215.0, True),
        (Clock(10.0, 0.0, -1e-4), 305.0, False),
    ],
)
def test_from_some_time_on_they_are_far(clock: Clock, time: float, far: bool) -> None:
    assert KEYFRAMES.are_far(clock, time) is far


def test_a_clock_that_is_hardly_known_certainly_is_nowhere() -> None:
    drifting = Clock(10.0, 0.01, 1e-4)
    assert KEYFRAMES.are_far(drifting, 310.0, np.diag([1e-4, 1e-6]) ** 2)
    assert not KEYFRAMES.are_far(drifting, 310.0, np.diag([1e-4, 1e-5]) ** 2)
    # Offset and skew may be known but together.
    together = np.outer([0.3, 1e-3], [0.3, 1e-3]) + np.diag([1e-4, 1e-7]) ** 2
    assert KEYFRAMES.are_far(drifting, 310.0, together)
