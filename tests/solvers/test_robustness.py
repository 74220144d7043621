"""Estimates from spoilt measurements and from far starts: as good as without, or said not to be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import alidade
from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.cube import model as cube
from alidade.pipelines.methods.cube.simulation import CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.indexer import model as indexer
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, indexer_config, simulate_indexer
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.simulation import LosAngles, LosScenario, los_config, simulate_los
from alidade.pipelines.methods.triads import triad_names
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from alidade.pipelines.solvers.linearization import Group
from tests.support.judged import judge

SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.15)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.31)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.21)],
)
LOS = LosScenario(duration_s=20.0, carrier=SWAY, image_rate_hz=12.0, gyro_rate_hz=50.0, gimbal_rate_hz=50.0)
INDEXER = IndexerScenario(gyro_rate_hz=50.0, encoder_rate_hz=50.0)
CUBE = CubeScenario(poses=14)

Made = tuple[Problem, dict[str, float]]


def _far_los() -> Made:
    angles = LosAngles(delta_px=30, delta_gx=-30, delta_gy=30, delta_pz=30)
    scenario = LOS.model_copy(update={"angles_deg": angles})
    data, truth = simulate_los(scenario, 1)
    return los.problem(data, load_config(los_config(scenario).encode())), truth


def _far_indexer() -> Made:
    scenario = INDEXER.model_copy(update={"mounting_deg": (30.0, -30.0, 30.0)})
    data, truth = simulate_indexer(scenario, 1)
    return indexer.problem(data, load_config(indexer_config(scenario).encode())), truth


def _far_cube() -> Made:
    """The whole device turned in the cube: what it reads is turned, and K turns it back."""
    found = simulate_cube(CUBE, 1)
    data, truth = found.data, dict(found.truth)
    R = so3.matrix(so3.exp(np.deg2rad([30.0, -30.0, 30.0])))
    assert data.mag is not None
    turned = replace(data, gyro=data.gyro @ R.T, accel=data.accel @ R.T, mag=data.mag @ R.T)
    for triad in ("accel", "gyro", "mag"):
        names = triad_names(triad)[:9]
        K = np.array([truth[name] for name in names]).reshape(3, 3) @ R.T
        truth |= dict(zip(names, K.ravel().tolist(), strict=True))
    return cube.problem(turned, load_config(found.config.encode())), truth


def _worst(estimate: Estimate, truth: dict[str, float]) -> float:
    free = estimate.sigmas > 0.0
    error = estimate.values - [truth.get(name, 0.0) for name in estimate.names]
    return float(np.abs(error[free] / estimate.sigmas[free]).max())


@pytest.mark.parametrize("make", [_far_los, _far_indexer, _far_cube])
@pytest.mark.parametrize("solve", [solve_batch, pytest.param(solve_incremental, marks=pytest.mark.slow)])
def test_mounts_30_degrees_off_are_found(make: Callable[[], Made], solve: Callable[[Problem], Estimate]) -> None:
    problem, truth = make()
    estimate = solve(problem)
    assert estimate.converged
    assert _worst(estimate, truth) < 4.0
    judged = judge(problem.quantities, estimate.covariance, estimate.chi_square, problem.advice)
    # The first innovations of the indexer are those of a start 30 deg off, and are called too large.
    assert judged.status == "calibrated" or (make is _far_indexer and solve is solve_incremental)


def _apart(one: Estimate, other: Estimate, but: Sequence[str] = ()) -> float:
    free = (other.sigmas > 0.0) & ~np.isin(other.names, but)
    return float(np.abs((one.values - other.values)[free] / other.sigmas[free]).max())


def _spoilt(count: int, share: float) -> NDArray[np.bool_]:
    return np.asarray(np.random.default_rng(3).random(count) < share)


@pytest.mark.parametrize("share", [pytest.param(0.05, marks=pytest.mark.slow), 0.2])
def test_gross_los_errors_cost_no_more_than_knowing_them_would(share: float) -> None:
    data, truth = simulate_los(LOS, 1)
    config = load_config(los_config(LOS).encode())
    wrong = _spoilt(len(data.image_t), share)
    error = data.error.copy()
    error[wrong, :2] += np.random.default_rng(4).normal(scale=0.02, size=(int(wrong.sum()), 2))
    estimate = solve_batch(los.problem(replace(data, error=error), config))
    known = solve_batch(los.problem(replace(data, image_t=data.image_t[~wrong], error=data.error[~wrong]), config))
    clean = solve_batch(los.problem(data, config))
    # A wrong error may be as small as a right one.
    assert _apart(estimate, known, but=("los_scale",)) < 0.1
    # The scale goes by foreseen errors that are smoothed over all that were measured, the wrong ones among them.
    assert _apart(estimate, known) < 0.15
    assert _apart(estimate, clean) < 1.5
    assert _worst(estimate, truth) < 3.5


@pytest.mark.slow
def test_gross_tag_corners_cost_no_more_than_knowing_them_would() -> None:
    data, truth = simulate_cube(CUBE, 1)
    config = load_config(cube_config(CUBE).encode())
    seen = data.sightings
    assert seen is not None
    wrong = _spoilt(len(seen.ids), 0.2)
    corners = seen.corners.copy()
    corners[wrong] += np.random.default_rng(4).normal(scale=20.0, size=(int(wrong.sum()), 4, 2))
    without = replace(
        seen,
        frame=seen.frame[~wrong],
        ids=seen.ids[~wrong],
        corners=seen.corners[~wrong],
        covariance=None if seen.covariance is None else seen.covariance[~wrong],
    )
    estimate, known, clean = (
        solve_batch(cube.problem(replace(data, sightings=sightings), config))
        for sightings in (replace(seen, corners=corners), without, seen)
    )
    assert _apart(estimate, known) < 0.1
    # Of 54 parameters one moves by more than a sigma for want of the measurements alone.
    assert _apart(estimate, clean) < 1.5
    assert _worst(estimate, truth) < 4.0


def test_an_estimate_that_is_no_solution_is_never_calibrated(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = alidade.open(alidade.simulate("tumble", {"attitudes": 12, "magnetometer": {"rate_hz": 10.0}}))
    # What gtsam's own optimizers return silently as if it was a solution.
    monkeypatch.setattr(Group, "cost", lambda *_: np.nan)
    found = opened.calibrate(report=False)
    assert found.status == "inconsistent"
    assert [finding.kind for finding in found.findings] == ["not_converged"]
    assert found.headline.startswith("No solution: the residuals at the start are not")
