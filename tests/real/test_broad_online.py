"""The incremental solver on real recordings that begin at rest: what it says, from the first second on, is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications.session import Session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.broad_trials import TRIALS, converted

# The first half of this is rest.
SECONDS = 70.0
# Once a second, and a while apart where batch has to be asked.
MOMENTS, ASKED = np.arange(1.0, SECONDS), (6.0, 12.0, 30.0, 45.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIALS)
def test_every_second_is_within_the_sigmas_given_then(name: str, shared_data: Path, tmp_path: Path) -> None:
    converted(shared_data / "broad" / f"{name}.mat", tmp_path / "s.mcap")
    session = Session.read(open_recording(tmp_path / "s.mcap"), None, None)
    method, config = session.method, session.config
    whole = method.graph(method.faults.segment(session.data, 0.0, SECONDS), config)
    final, online = solve_batch(whole), solve_incremental(whole)
    history = online.history
    assert history is not None
    fixed = final.sigmas == 0.0
    steady = ~fixed & ~np.array([q.startswith("gyro_bias") for q in final.names])
    rows = np.unique(np.searchsorted(history.time, MOMENTS).clip(max=len(history.time) - 1))
    off = np.abs(history.values - final.values)[rows][:, steady] / history.sigmas[rows][:, steady]
    assert off.max() < 4.0
    for moment in ASKED:
        then = solve_batch(method.graph(method.faults.segment(session.data, 0.0, moment), config))
        row = int(np.searchsorted(history.time, moment, side="right")) - 1
        assert (history.sigmas[row, ~fixed] > 0.7 * then.sigmas[~fixed]).all(), moment
    assert (np.abs(online.values - final.values)[~fixed] < 0.5 * final.sigmas[~fixed]).all()
