"""The approximation against scipy's exact quantiles."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from alidade.factors.chi_square import gate, interval, quantile


@pytest.mark.parametrize("dof", [2, 3, 10, 100, 5000, 1e6])
@pytest.mark.parametrize("p", [0.5, 0.9995, 0.9999])
def test_upper_quantiles(dof: float, p: float) -> None:
    assert quantile(p, dof) == pytest.approx(chi2.ppf(p, dof), rel=0.01 if dof >= 100 else 0.05)


@pytest.mark.parametrize("dof", [100, 5000, 1e6])
def test_lower_quantiles(dof: float) -> None:
    assert quantile(0.0005, dof) == pytest.approx(chi2.ppf(0.0005, dof), rel=0.01)


@pytest.mark.parametrize("dof", [0.7, 1.0, 1.9, 4.4, 12.0, 29.9, 30.1, 60.0])
@pytest.mark.parametrize("p", [0.001, 0.025, 0.3, 0.975, 0.9999])
def test_few_degrees_of_freedom_at_both_ends(dof: float, p: float) -> None:
    assert quantile(p, dof) == pytest.approx(chi2.ppf(p, dof), rel=0.01, abs=1e-6)


def test_interval_of_a_variance() -> None:
    low, high = interval(0.95, 5.0)
    assert (low, high) == pytest.approx((5.0 / chi2.ppf(0.975, 5), 5.0 / chi2.ppf(0.025, 5)), rel=1e-3)


def test_no_degrees_of_freedom() -> None:
    assert quantile(0.9, 0.0) == 0.0


def test_gate_lets_good_measurements_pass() -> None:
    for rows in (2, 3, 6):
        assert 0.5e-4 < chi2.sf(gate(rows) ** 2, rows) < 1.5e-4
