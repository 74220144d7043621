"""What noise of the states seems to tell of a parameter is no information."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from alidade import simulate
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.solvers import batch
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental

PRIOR = 0.35
YAW = {"yaw": [{"amplitude_deg": 40.0, "frequency_hz": 0.13}, {"amplitude_deg": 10.0, "frequency_hz": 0.47}]}


def made(**changes: Any) -> Problem:
    """Two minutes of good vision, the head turning about one axis."""
    scenario = {
        "duration_s": 120.0,
        "vision_rate_hz": 10.0,
        "gyro_rate_hz": 100.0,
        "sensors": {},
        "head": YAW,
        "noise": {"vision_attitude": 2e-3},
        **changes,
    }
    simulated = simulate("head", scenario, seed=0)
    return methods.method("head").problem(simulated.data, load_config(simulated.config.encode()))


def widest(estimate: Estimate) -> float:
    """Sigma of the mount about the axis that is known least, over its prior's."""
    return float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[3:6, 3:6])[-1])) / PRIOR


@pytest.mark.slow
def test_minutes_about_one_axis_tell_nothing_of_the_mount_about_it(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = made()
    assert widest(solve_batch(problem)) > 0.85
    monkeypatch.setattr(batch, "information_of_noise", lambda *_: None)
    assert widest(solve_batch(problem)) < 0.75


def test_what_motion_tells_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    # A nod of two degrees tells a little of it, truly.
    nod = {"pitch": [{"amplitude_deg": 2.0, "frequency_hz": 0.2, "end_s": 5.0}]}
    problem = made(duration_s=10.0, head={**YAW, **nod}, noise={"vision_attitude": 2e-2})
    found = widest(solve_batch(problem))
    monkeypatch.setattr(batch, "information_of_noise", lambda *_: None)
    linear = widest(solve_batch(problem))
    assert 0.3 < linear < 0.9
    assert found == pytest.approx(linear, rel=0.05)


def test_what_is_known_well_is_not_asked() -> None:
    problem = made(duration_s=5.0, head=dict.fromkeys(("yaw", "pitch", "roll"), YAW["yaw"]))
    from alidade.pipelines.solvers import spurious

    covariance = solve_batch(problem).covariance
    keys = [p.key for p in problem.parameters]
    assert spurious._doubtful(problem, keys, covariance) == []


@pytest.mark.slow
def test_nor_do_they_online() -> None:
    assert widest(solve_incremental(made())) > 0.85
