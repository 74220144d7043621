"""The thin-shell search: each case of its rule, exact half differences, and what the publication leaves open."""

from __future__ import annotations

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.indexer.published import HalfDifference, cost, half_differences, search
from alidade.pipelines.methods.indexer.simulation import (
    ARCSEC,
    IndexerNoise,
    IndexerScenario,
    Position,
    simulate_indexer,
)
from alidade.pipelines.simulation.scenario import load_scenario

RATE = np.deg2rad(10.0)
TWO_DEG = np.deg2rad(2.0)


def _exact(theta: np.ndarray, positions: tuple[int, ...] = (1, 2, 3, 4)) -> tuple[HalfDifference, ...]:
    """Half differences of a noise-free platform: the axis in t, turned into m."""
    passive = [so3.matrix(so3.exp(theta[i] * e)).T for i, e in enumerate(np.eye(3))]
    C_t_m = passive[0] @ passive[1] @ passive[2]
    axes = {1: [1, 0, 0], 2: [-1, 0, 0], 3: [0, 0, 1], 4: [0, 0, 1]}
    return tuple(
        HalfDifference(p, "outer" if p < 3 else "inner", RATE * C_t_m @ np.array(axes[p], dtype=float), 216.0)
        for p in positions
    )


def test_cost_vanishes_at_the_true_angles_and_nowhere_near() -> None:
    theta = np.deg2rad([0.7, -0.4, 1.1])
    assert cost(theta, _exact(theta)) < 1e-30
    for axis in np.eye(3):
        assert cost(theta + 1e-4 * axis, _exact(theta)) > 1e-10


def test_search_finds_small_angles() -> None:
    theta = np.deg2rad([0.7, -0.4, 1.1])
    assert np.abs(search(_exact(theta), TWO_DEG, 40).theta - theta).max() < 0.1 * ARCSEC


def test_angles_outside_the_start_interval_end_at_its_edge_and_are_reported() -> None:
    theta = np.deg2rad([0.1, 0.2, 5.0])
    found = search(_exact(theta), TWO_DEG)
    assert found.at_edge == (False, False, True)
    assert search(_exact(theta), np.deg2rad(8.0), 40).theta == pytest.approx(theta, abs=1e-6)


def test_positions_one_and_two_leave_theta_x_flat_and_it_stays_in_the_middle() -> None:
    found = search(_exact(np.deg2rad([0.5, 0.0, 0.3]), (1, 2)), TWO_DEG)
    assert found.flat == (True, False, False)
    assert found.theta[0] == 0.0
    # Half a degree of theta_x left out turns theta_z, to second order.
    assert found.theta[2] == pytest.approx(np.deg2rad(0.3) * np.cos(np.deg2rad(0.5)), abs=1e-7)


def test_fourth_case_is_counted_and_keeps_the_lower_end() -> None:
    """Ends at +-100 degrees about a cost that is largest in the middle: the half towards the angle is kept."""
    theta = np.array([0.0, 0.0, np.deg2rad(91.0)])
    found = search(_exact(theta), np.deg2rad(100.0), 40)
    assert found.fourth_cases > 0
    assert found.theta[2] == pytest.approx(theta[2], abs=1e-7)


def test_half_differences_are_free_of_bias_and_earth_rate() -> None:
    scenario = IndexerScenario(noise=IndexerNoise(gyro_density=0.0), mounting_deg=(0.7, -0.4, 1.1), gyro_bias_deg_h=50)
    data, _ = simulate_indexer(scenario, 1)
    found = half_differences(data)
    assert [h.position for h in found] == [1, 2, 3, 4]
    for half, exact in zip(found, _exact(np.deg2rad([0.7, -0.4, 1.1])), strict=True):
        across = half.rate / np.linalg.norm(half.rate) - exact.rate / RATE
        assert np.linalg.norm(across) < 0.02 * ARCSEC


def test_recovers_the_ideal_run() -> None:
    data, truth = simulate_indexer(load_scenario(IndexerScenario, "indexer_ideal"), 2)
    expected = np.array([truth[f"theta_{a}"] for a in "xyz"])
    assert np.abs(search(half_differences(data)).theta - expected).max() < 0.15 * ARCSEC


def test_five_degrees_need_a_wider_interval() -> None:
    data, truth = simulate_indexer(load_scenario(IndexerScenario, "indexer_large_angles"), 2)
    expected = np.array([truth[f"theta_{a}"] for a in "xyz"])
    measured = half_differences(data)
    assert all(search(measured).at_edge)
    assert np.abs(search(measured, np.deg2rad(8.0), 32).theta - expected).max() < 0.2 * ARCSEC


def test_turns_one_way_only_are_refused() -> None:
    data, _ = simulate_indexer(IndexerScenario(positions=[Position(axis="outer", other_deg=90, turns=1)]), 1)
    with pytest.raises(InputError, match="whole turns forward and back"):
        half_differences(data)
