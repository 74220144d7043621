"""Parts of real recordings altered in known ways: slips are found, and healthy parts are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.altered import Alteration, calibrated, errors
from datasets.broad import read_trial, to_session

_PARTS = [pytest.param((1, 2), id="two"), pytest.param((0, *range(3, 24)), id="all", marks=pytest.mark.slow)]


@pytest.mark.parametrize("seeds", _PARTS)
def test_slips_are_found_and_healthy_parts_are_right(seeds: tuple[int, ...], shared_data: Path) -> None:
    trials = [read_trial(path) for path in sorted((shared_data / "broad").glob("*.mat"))]
    durations = [float(trial.t[np.isfinite(trial.attitude[:, 0])][-1]) for trial in trials]
    for seed in seeds:
        by = Alteration.drawn(seed, durations)
        trial = trials[by.trial]
        found = calibrated(by.of(to_session(trial, 0, 0.0, by.rate_hz)))
        if by.slip.any():
            assert {finding.kind for finding in found.findings} & {"change", "jump", "hypothesis"}, seed
            assert found.status != "calibrated", seed
        else:
            assert found.status != "inconsistent", (seed, found.headline)
            off, sigmas = errors(found, calibrated(to_session(trial, 0, 0.0)), by)
            assert np.abs(off / sigmas).max() < 4.0, seed
