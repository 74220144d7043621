"""Statistics of studies and fleets against scipy and against populations made to order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pipelines.fleet import statistics
from pipelines.fleet.analysis import populations
from pipelines.fleet.store import Result


@pytest.mark.parametrize("dof", [3, 6, 36])
@pytest.mark.parametrize("runs", [30, 200])
def test_interval_of_the_mean_nees(dof: int, runs: int) -> None:
    rng = np.random.default_rng(dof + runs)
    nees = statistics.mean_nees(rng.chisquare(dof, runs), np.full(runs, float(dof)))
    low, high = stats.chi2.interval(0.99, dof * runs)
    assert (nees.low, nees.high) == pytest.approx((low / runs, high / runs), rel=1e-2)
    assert nees.dof == dof
    assert nees.consistent == (nees.low <= nees.mean <= nees.high)
    # Sigmas 20 % too small are found out.
    assert not statistics.mean_nees(1.44 * rng.chisquare(dof, runs), np.full(runs, float(dof))).consistent or runs == 30


def test_intervals_hold_99_of_100_studies() -> None:
    rng = np.random.default_rng(1)
    inside = [statistics.mean_nees(rng.chisquare(3, 50), np.full(50, 3.0)).consistent for _ in range(2000)]
    assert 0.98 < np.mean(inside) < 0.998


def test_accuracy_of_normal_errors() -> None:
    rng = np.random.default_rng(2)
    sigmas = rng.uniform(1.0, 3.0, 20000)
    found = statistics.accuracy(0.5 + sigmas * rng.standard_normal(20000), sigmas)
    assert found.bias == pytest.approx(0.5, abs=4.0 * found.bias_sigma)
    assert found.bias_sigma == pytest.approx(found.sigma / np.sqrt(20000), rel=0.05)
    assert found.rms == pytest.approx(np.hypot(found.sigma, 0.5), rel=0.02)
    unbiased = statistics.accuracy(sigmas * rng.standard_normal(20000), sigmas)
    assert unbiased.coverage == pytest.approx((0.6827, 0.9545, 0.9973), abs=0.012)


@pytest.mark.parametrize("outliers", [0, 400])
@pytest.mark.parametrize("tau", [0.0, 0.5, 5.0])
def test_spread_is_told_from_sigmas_and_outliers_do_not_count(tau: float, outliers: int) -> None:
    rng = np.random.default_rng(3)
    sigmas = rng.uniform(0.5, 2.0, 4000)
    values = 7.0 + tau * rng.standard_normal(4000) + sigmas * rng.standard_normal(4000)
    values[:outliers] += 1000.0
    found = statistics.spread(values, sigmas)
    own = np.sqrt((sigmas**2).mean())
    total = np.hypot(tau, own)
    # By a tenth of outliers on one side a median moves to the quantile 5/9 of the good ones; half of these lie as close
    # to it as 5/9 of all did before.
    shift = stats.norm.ppf(5 / 9) * (outliers > 0)
    wider = stats.norm.ppf(0.5 + 2.5 / 9) / stats.norm.ppf(0.75) if outliers else 1.0
    assert found.centre == pytest.approx(7.0 + shift * total, abs=0.1 * total)
    assert np.hypot(found.tau, own) == pytest.approx(wider * total, rel=0.05)
    assert not outliers or np.abs(found.z(values, sigmas)[:outliers]).min() > 100.0


def test_equal_values_have_no_spread() -> None:
    found = statistics.spread(np.full(8, 2.0), np.full(8, 0.1))
    assert (found.centre, found.tau) == (2.0, 0.0)


@pytest.mark.parametrize(("count", "too_large"), [(12, 0.1), (40, 0.02), (500, 0.01)])
def test_limit_is_students(count: int, too_large: float) -> None:
    """Or, from few values, a little more."""
    dof = 0.37 * (count - 1)
    p = 1.0 - 0.5 * statistics.FALSE_ALARM / (6 * count)
    exact = stats.t.ppf(p, dof)
    assert 0.999 * exact < statistics.limit(6 * count, count) < (1.0 + too_large) * exact
    assert statistics.limit(6 * count) == pytest.approx(stats.norm.ppf(p))


def test_trend_is_the_weighted_line() -> None:
    rng = np.random.default_rng(4)
    time, sigmas = rng.uniform(0.0, 90.0, 30), rng.uniform(0.5, 2.0, 30)
    values = 3.0 + 0.1 * time + sigmas * rng.standard_normal(30)
    found = statistics.trend(time, values, sigmas)
    (slope, _), covariance = np.polyfit(time, values, 1, w=1.0 / sigmas, cov="unscaled")
    assert found is not None
    assert (found.slope, found.sigma) == pytest.approx((slope, covariance[0, 0] ** 0.5))
    assert statistics.trend(np.zeros(5), values[:5], sigmas[:5]) is None


def test_changes_are_steps_and_the_whole() -> None:
    assert statistics.changes([5.0]) == []
    assert statistics.changes([5.0, 1.0]) == [(1, 0)]
    assert statistics.changes([5.0, 1.0, 9.0]) == [(1, 0), (0, 2), (1, 2)]


def a_fleet(seed: int, units: int = 30, dates: int = 3, wander: float = 0.0, slope: float = 0.0) -> dict[str, Result]:
    """Results of units whose parameter a is steady and b another in every session; SI."""
    rng = np.random.default_rng(seed)
    results: dict[str, Result] = {}
    for unit in range(units):
        own = 0.01 * rng.standard_normal()
        for date in range(dates):
            sigma = rng.uniform(0.001, 0.003)
            a = own + wander * date * (unit == 4) + slope * date + sigma * rng.standard_normal()
            b = 0.1 * rng.standard_normal()
            parameters = {
                name: {"value": value, "sigma": sigma, "unit": "rad", "require": 1e-2, "verdict": "observable"}
                for name, value in (("a", a), ("b", b))
            }
            results[f"{unit}-{date}"] = {
                "unit": f"U{unit}",
                "date": 86400.0 * 30.0 * date,
                "method": "head",
                "status": "calibrated",
                "exit_code": 0,
                "reason": "",
                "parameters": parameters,
            }
    return results


def test_a_good_fleet_raises_no_alarm() -> None:
    """One page in a hundred may, by each of the three kinds of test."""
    alarms = 0
    for seed in range(40):
        fleet = populations(a_fleet(seed))
        alarms += any(p.outlying.any() or p.drifts or any(c.changed for c in p.changes) for p in fleet)
    assert alarms <= 4


def test_a_unit_that_drifts_slowly_is_found_by_first_and_last() -> None:
    """Two sigmas a step, eight in all."""
    a, b = populations(a_fleet(5, dates=6, wander=0.006))
    flagged = [(c.unit, c.before % 6, c.after % 6) for c in a.changes if c.changed]
    assert ("U4", 0, 5) in flagged
    assert {unit for unit, *_ in flagged} == {"U4"}
    assert a.repeatability is None
    assert b.repeatability == pytest.approx(0.1, rel=0.3)


def test_what_belongs_to_a_recording_does_not_change() -> None:
    """A turn-on bias of two sessions, too few to tell that they differ by nature."""
    results = a_fleet(1, units=1, dates=2)
    for result in results.values():
        result["parameters"]["gyro_bias_x"] = result["parameters"].pop("b") | {"sigma": 1e-4}
    results["0-1"]["parameters"]["a"]["value"] += 1.0
    a, bias = populations(results)
    assert [c.changed for c in a.changes] == [True]
    assert abs(bias.changes[0].z) > 100.0
    assert not bias.changes[0].changed


def test_a_drift_of_the_whole_fleet_is_found() -> None:
    a, b = populations(a_fleet(6, units=60, slope=0.006))
    assert a.drift is not None
    assert a.drifts
    assert not b.drifts
    assert 30.0 * a.drift.slope == pytest.approx(0.006, abs=4.0 * 30.0 * a.drift.sigma)


def test_what_the_recording_did_not_determine_does_not_count() -> None:
    results = a_fleet(7)
    results["0-0"]["status"] = "inconsistent"
    results["1-0"]["status"] = "unobservable"
    results["2-0"]["parameters"]["a"]["verdict"] = "prior"
    a, b = populations(results)
    assert len(a.values) == 87
    assert len(b.values) == 88


def test_few_units_have_no_spread() -> None:
    for p in populations(a_fleet(8, units=4, dates=1)):
        assert p.spread is None
        assert p.control is None
        assert p.beyond == 0
        assert not p.outlying.any()
