"""Parts of real recordings altered in known ways: slips are found, and healthy parts are right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.finding import Severity
from benchmarks.altered import Alteration, calibrated, errors
from datasets.broad import read_trial, to_session

_PARTS = [pytest.param((1,), id="one"), pytest.param((0, *range(2, 24)), id="all", marks=pytest.mark.slow)]


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


def _correlated(t: Array, sigma: float, length: float, seed: int) -> Array:
    """Errors (n, 3), rad, of a sigma, whose correlation falls to 1 / e within `length` s."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-np.diff(t, prepend=-np.inf) / length)
    x = sigma * rng.standard_normal((len(t), 3)) * np.sqrt(1.0 - kept**2)[:, None]
    for k in range(1, len(t)):
        x[k] += kept[k] * x[k - 1]
    return x


@pytest.mark.parametrize(
    ("name", "begin", "length", "seed"),
    [
        ("30_disturbed_stationary_magnet_C", 80.0, 0.1, 0),
        pytest.param("28_disturbed_stationary_magnet_A", 80.0, 0.1, 2, marks=pytest.mark.slow),
        pytest.param("28_disturbed_stationary_magnet_A", 80.0, 2.0, 3, marks=pytest.mark.slow),
    ],
)
def test_correlated_errors_of_vision_are_no_slip(
    name: str, begin: float, length: float, seed: int, shared_data: Path
) -> None:
    """Of half a degree: near an end of the recording a few seconds of them would pass for a step of the mount."""
    trial = read_trial(shared_data / "broad" / f"{name}.mat")
    data = methods.method("head").faults.segment(to_session(trial, 0, 0.0, 15.0), begin, begin + 45.0)
    errors = so3.exp(_correlated(data.vision_t, np.deg2rad(0.5), length, seed))
    found = calibrated(replace(data, vision_wxyz=so3.multiply(data.vision_wxyz, errors)))
    assert not {finding.kind for finding in found.findings if finding.severity > Severity.NOTE} & {"change", "jump"}


@pytest.mark.slow
def test_known_biases_do_not_hide_that_vision_errs_with_the_attitude(shared_data: Path) -> None:
    """Errors of .2 deg move a bias by two sigmas of what an earlier calibration knew; mounts were 5 sigmas off."""
    known = b"priors: {gyro_bias_x: {mean: 0.0, sigma: 5.0e-4}, gyro_bias_y: {mean: 0.0, sigma: 5.0e-4}}"
    data = to_session(read_trial(shared_data / "broad" / "01_undisturbed_slow_rotation_A.mat"), 0, 0.0)
    session = alidade.open(data, "head", config=load_config(known))
    faults = session.method.faults
    start, stop = (np.array([[0.4, 0.6], [0.1, 0.9]]) @ faults.span(data)).tolist()
    found = replace(session, data=faults.segment(data, start, stop)).calibrate("batch", report=False)
    assert found.estimate.error_map is not None
    assert min(found.parameters[f"helmet_mount_{axis}"].sigma for axis in "xyz") > np.deg2rad(0.05)
