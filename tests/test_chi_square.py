"""The approximation against scipy's exact quantiles."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from factors.chi_square import gate, quantile


@pytest.mark.parametrize("dof", [2, 3, 10, 100, 5000, 1e6])
@pytest.mark.parametrize("p", [0.5, 0.9995, 0.9999])
def test_upper_quantiles(dof: float, p: float) -> None:
    assert quantile(p, dof) == pytest.approx(chi2.ppf(p, dof), rel=0.01 if dof >= 100 else 0.05)


@pytest.mark.parametrize("dof", [100, 5000, 1e6])
def test_lower_quantiles(dof: float) -> None:
    assert quantile(0.0005, dof) == pytest.approx(chi2.ppf(0.0005, dof), rel=0.01)


def test_no_degrees_of_freedom() -> None:
    assert quantile(0.9, 0.0) == 0.0


def test_gate_lets_good_measurements_pass() -> None:
    for rows in (2, 3, 6):
        assert 0.5e-4 < chi2.sf(gate(rows) ** 2, rows) < 1.5e-4
