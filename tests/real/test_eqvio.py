"""Camera mount from real EuRoC data: the published one within its sigma, and closer than two views alone get."""

from __future__ import annotations

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.testing import assert_jacobians
from alidade.pipelines.estimation.problem import Estimate
from alidade.pipelines.solvers.batch import solve_batch
from tests.support import eqvio


@pytest.fixture(scope="module")
def recording() -> eqvio.Recording:
    return eqvio.read()


@pytest.fixture(scope="module")
def guess(recording: eqvio.Recording) -> tuple[Array, Array]:
    return eqvio.hand_eye(recording)


def _off(vRc: Array, recording: eqvio.Recording) -> float:
    return float(np.rad2deg(np.linalg.norm(eqvio.error(vRc, recording.published))))


def _agrees(estimate: Estimate, recording: eqvio.Recording) -> bool:
    error = eqvio.error(so3.exp(estimate.values[3:6]), recording.published)
    return bool((np.abs(error) < 3.0 * estimate.sigmas[3:6]).all())


def test_jacobians_of_features() -> None:
    rng = np.random.default_rng(0)
    n = 5
    rate_a, rate = rng.normal(size=(2, n, 3))
    model = eqvio.FeatureFactor(np.arange(5.0), rng.normal(size=(n, 2)), rate_a, rate, 0.1)
    turns = so3.exp(0.2 * rng.normal(size=(3, n, 3)))
    point = np.column_stack([0.3 * rng.normal(size=(n, 2)), rng.uniform(0.1, 0.5, n)])
    places = 0.3 * rng.normal(size=(2, n, 3))
    assert_jacobians(model, [*turns, *places, point, np.full((n, 1), 0.01)])


def test_two_views_give_a_mount_to_start_with(recording: eqvio.Recording, guess: tuple[Array, Array]) -> None:
    assert _off(guess[0], recording) < 0.5


@pytest.mark.slow
def test_a_third_of_the_recording_gives_the_published_mount(
    recording: eqvio.Recording, guess: tuple[Array, Array]
) -> None:
    estimate = solve_batch(eqvio.problem(recording.thinned(4, start=20.0), *guess))
    assert estimate.converged
    assert _off(so3.exp(estimate.values[3:6]), recording) < 0.4
    assert _agrees(estimate, recording)
    np.testing.assert_allclose(guess[1], estimate.values[:3], atol=2e-3)
    assert abs(estimate.values[6]) < 3.0 * estimate.sigmas[6]
    assert estimate.chi_square is not None
    for family in ("gyro", "features"):
        square, dof = estimate.chi_square.families[family]
        assert 0.7 * dof < square < 1.4 * dof


@pytest.mark.slow
def test_the_whole_recording_gives_the_published_mount(recording: eqvio.Recording) -> None:
    _, estimate = eqvio.solve(recording)
    assert estimate.converged
    assert _off(so3.exp(estimate.values[3:6]), recording) < 0.2
    assert _agrees(estimate, recording)
