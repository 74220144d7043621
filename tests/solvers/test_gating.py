"""The innovation gate: which measurements are used, and what correlated innovations do to the covariance."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from alidade.pipelines.estimation.problem import Array, Parameter, Problem, Quantity
from alidade.pipelines.solvers.gating import InnovationGate, RowBuffer, binomial_tail, correlation_inflation
from alidade.pipelines.solvers.incremental import IncrementalSolver, solve_incremental
from tests.support.chain import Walk


def _counted(**families: tuple[int, int]) -> InnovationGate:
    """A gate with so many measurements used, and rejected, of each family."""
    gate = InnovationGate()
    for family, (used, rejected) in families.items():
        flags = np.repeat([1.0, 0.0], [used, rejected])
        gate.families[family] = RowBuffer(np.column_stack([np.arange(len(flags)), flags, flags]))
    return gate


def test_binomial_tail() -> None:
    for rejected, count, share in ((0, 5, 0.1), (2, 7, 0.3), (7, 7, 0.2), (40, 1000, 0.02)):
        assert binomial_tail(rejected, count, share) == pytest.approx(binom.sf(rejected - 1, count, share))


@pytest.mark.parametrize(
    ("used", "rejected", "undecided"),
    [(3, 0, False), (8, 3, True), (7, 6, True), (20, 1, False), (100, 20, False), (55, 45, True)],
)
def test_outliers_among_few_measurements_cannot_be_told(used: int, rejected: int, undecided: bool) -> None:
    assert _counted(los=(used, rejected)).too_few_to_decide() is undecided
    # Whatever else there is.
    assert _counted(los=(used, rejected), other=(1000, 1)).too_few_to_decide() is undecided


def _two(correlation: float) -> tuple[Problem, Array, InnovationGate]:
    """Two numbers, each known from its own family of measurements; innovations of the first are correlated."""
    quantities = tuple(Quantity(name, "", 1.0, 1.0, 0.1) for name in ("first", "second"))
    problem = Problem("two", (Parameter(int(gtsam.symbol("p", 0)), quantities),), lambda _: iter(()))
    information = np.diag([400.0, 900.0])
    gate = InnovationGate()
    rng = np.random.default_rng(2)
    for i, (family, share) in enumerate((("first", correlation), ("second", 0.0))):
        white = rng.standard_normal(4000)
        coloured = lfilter([np.sqrt(1.0 - share**2)], [1.0, -share], white)
        gate.families[family] = RowBuffer(np.column_stack([np.arange(4000.0), np.ones(4000), coloured]))
        gate.information[family] = np.diag([information[0, 0] * (i == 0), information[1, 1] * (i == 1)])
    return problem, np.diag(1.0 / (np.diag(information) + 1.0)), gate


def test_correlated_innovations_inflate_what_their_family_determines() -> None:
    problem, covariance, gate = _two(0.8)
    grown, lengths = correlation_inflation(problem, covariance, gate, np.eye(2))
    assert set(lengths) == {"first"}
    # (1 + 0.8) / (1 - 0.8)
    assert lengths["first"] == pytest.approx(9.0, rel=0.25)
    assert grown[0, 0] == pytest.approx(1.0 / (1.0 + 400.0 / lengths["first"]), rel=1e-6)
    assert grown[1, 1] == pytest.approx(covariance[1, 1], rel=1e-6)


def test_white_innovations_inflate_nothing() -> None:
    problem, covariance, gate = _two(0.0)
    grown, lengths = correlation_inflation(problem, covariance, gate, np.eye(2))
    assert not lengths
    np.testing.assert_array_equal(grown, covariance)


def test_the_information_of_the_gate_is_that_of_the_posterior() -> None:
    """All but the prior's and that of the initialisation phase, which was solved in batch."""
    walk, _ = Walk.random(4, n=200)
    solver = IncrementalSolver(walk.problem(), 1.0)
    begun: Array | None = None
    for step in walk.problem().steps(1):
        solver.add_step(step)
        if not solver.initialising and begun is None:
            solver.gate.families["another"] = RowBuffer(np.ones((1, 3)))  # of a single one nothing is recorded
            begun = np.asarray(np.linalg.inv(solver.covariance()), dtype=float)
    assert begun is not None
    added = np.linalg.inv(solver.covariance()) - begun
    np.testing.assert_allclose(solver.gate.information["seen"], added, rtol=1e-6, atol=1e-6 * np.abs(added).max())


def test_one_white_family_is_left_as_it_is() -> None:
    walk, _ = Walk.random(5)
    estimate = solve_incremental(walk.problem())
    assert not estimate.colours
    np.testing.assert_array_equal(estimate.inflations, 1.0)
