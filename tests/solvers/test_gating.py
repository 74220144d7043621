"""The innovation gate: which measurements are used, and what correlated innovations do to the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from alidade.pipelines.solvers.gating import InnovationGate, RowBuffer, binomial_tail
from alidade.pipelines.solvers.incremental import solve_incremental
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


def test_correlation_lengths_are_those_of_the_innovations() -> None:
    rng, gate = np.random.default_rng(2), InnovationGate()
    for family, share in (("first", 0.8), ("second", 0.0)):
        coloured = lfilter([np.sqrt(1.0 - share**2)], [1.0, -share], rng.standard_normal(4000))
        gate.families[family] = RowBuffer(np.column_stack([np.arange(4000.0), np.ones(4000), coloured]))
    lengths = gate.correlation_lengths()
    assert set(lengths) == {"first"}
    assert lengths["first"] == pytest.approx(9.0, rel=0.25)  # (1 + 0.8) / (1 - 0.8)


@pytest.mark.usefixtures("early_smoother")
def test_one_white_family_is_left_as_it_is() -> None:
    walk, _ = Walk.random(5)
    estimate = solve_incremental(walk.problem())
    assert not estimate.colours
    np.testing.assert_array_equal(estimate.inflations, 1.0)
