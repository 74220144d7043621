"""Statistics of studies and fleets against scipy and against populations made to order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.analysis import Population, counting, populations, units_of_interest
from alidade.pipelines.applications.fleet.histories import History, change_table, histories, packed
from alidade.pipelines.applications.fleet.pages import population_plot
from alidade.pipelines.applications.fleet.store import ParameterNumbers, UnitResult
from alidade.pipelines.gaussian_prior import independent
from alidade.pipelines.solvers.posterior import sqrt_information_of


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


def a_fleet(
    seed: int, units: int = 30, dates: int = 3, wander: float = 0.0, slope: float = 0.0
) -> dict[str, UnitResult]:
    """Results of units whose parameter a is steady and b another in every session; SI."""
    rng = np.random.default_rng(seed)
    results: dict[str, UnitResult] = {}
    for unit in range(units):
        own = 0.01 * rng.standard_normal()
        for date in range(dates):
            sigma = rng.uniform(0.001, 0.003)
            a = own + wander * date * (unit == 4) + slope * date + sigma * rng.standard_normal()
            b = 0.1 * rng.standard_normal()
            parameters: dict[str, ParameterNumbers] = {
                name: {
                    "value": value,
                    "sigma": sigma,
                    "unit": "rad",
                    "require": 1e-2,
                    "verdict": "observable",
                    "inflation": 1.0,
                }
                for name, value in (("a", a), ("b", b))
            }
            says = independent(["a", "b"], [a, b], [sigma, sigma])
            results[f"{unit}-{date}"] = {
                "device": {"a": 0.0},
                "told": packed(sqrt_information_of(says, [1.0, 1.0])),
                "unit": f"U{unit}",
                "date": 86400.0 * 30.0 * date,
                "method": "head",
                "status": "calibrated",
                "exit_code": 0,
                "reason": "",
                "parameters": parameters,
            }
    return results


def judged(results: dict[str, UnitResult]) -> tuple[list[Population], list[History]]:
    found = histories(results, {name: counting(result) for name, result in results.items()})
    return populations(results, found), found


@pytest.mark.parametrize("fleets", [6, pytest.param(12, marks=pytest.mark.slow)])
def test_a_good_fleet_raises_no_alarm(fleets: int) -> None:
    """One page in a hundred may, by each of the three kinds of test."""
    alarms = 0
    for seed in range(fleets):
        fleet, found = judged(a_fleet(seed))
        alarms += any(p.outlying.any() or p.drifts for p in fleet)
        alarms += any(h.found or h.together for h in found)
    assert alarms <= 1


def test_a_unit_that_drifts_slowly_is_found() -> None:
    """Two sigmas a step, eight in all; what belongs to a recording is another one each time, by many sigmas."""
    results = a_fleet(5, dates=6, wander=0.006)
    (a, b), found = judged(results)
    red = [(h.unit, step.name) for h in found for step in h.found]
    assert set(red) == {("U4", "a")}
    assert {row["parameter"] for row in change_table(found)} == {"a"}
    (unit,) = units_of_interest(results, [a, b], found)
    assert unit.name == "U4"
    assert "a changed by" in unit.findings[0].text


def test_a_step_of_one_unit_is_found_and_where() -> None:
    results = a_fleet(1, units=1, dates=2)
    results["0-1"]["told"] = packed(sqrt_information_of(independent(["a", "b"], [1.0, 5.0], [1e-3, 1e-3]), [1.0, 1.0]))
    _, (history,) = judged(results)
    assert [(step.name, history.after(step)) for step in history.found] == [("a", ("0-1",))]


def test_numbers_that_differ_in_every_unit_differ_by_nature() -> None:
    """A device's number that no recording repeats is not a change of each unit, but a repeatability."""
    results = a_fleet(2)
    rng = np.random.default_rng(9)
    for result in results.values():
        p = result["parameters"]["a"]
        p["value"] += 0.05 * rng.standard_normal()
        result["told"] = packed(sqrt_information_of(independent(["a"], [p["value"]], [p["sigma"]]), [1.0]))
    (a, _), found = judged(results)
    assert not any(h.found for h in found)
    assert a.repeatability is not None
    assert a.repeatability.value == pytest.approx(0.05, abs=3.0 * a.repeatability.sigma)


@pytest.mark.parametrize("fleets", [80, pytest.param(200, marks=pytest.mark.slow)])
def test_variance_components_are_told_with_their_sigmas(fleets: int) -> None:
    """Both standard deviations lie within one of their sigmas in two of three fleets, and of none there is a bound."""
    rng = np.random.default_rng(11)
    pulls, bounded, seen_in_nothing = [], [], []
    for _ in range(fleets):
        units = np.repeat(np.arange(20), 3)
        sigmas = rng.uniform(0.5, 1.5, 60)
        noise = sigmas * rng.standard_normal(60)
        values = 3.0 * rng.standard_normal(20)[units] + 2.0 * rng.standard_normal(60) + noise
        population, repeatability = statistics.components(values, sigmas, units)
        assert population is not None
        assert repeatability is not None
        pulls.append([(population.value - 3.0) / population.sigma, (repeatability.value - 2.0) / repeatability.sigma])
        _, nothing = statistics.components(noise, sigmas, units)
        assert nothing is not None
        bounded.append((population.upper > 3.0, repeatability.upper > 2.0))
        seen_in_nothing.append(nothing.value - 3.0 * np.nan_to_num(nothing.sigma) > 0.0)
    within = (np.abs(pulls) < 1.0).mean(axis=0)
    assert (np.abs(within - 0.683) < 0.1).all()
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.5
    assert (np.mean(bounded, axis=0) > 0.94).all()
    assert np.mean(seen_in_nothing) < 0.05


def test_components_of_equal_sigmas_are_those_of_analysis_of_variance() -> None:
    """Balanced, and positive, the restricted likelihood has its maximum at the moments' estimates."""
    rng = np.random.default_rng(12)
    values = 3.0 * rng.standard_normal((8, 1)) + rng.standard_normal((8, 4))
    within = values.var(axis=1, ddof=1).mean()
    population, repeatability = statistics.components(values.ravel(), np.full(32, 1e-6), np.repeat(np.arange(8), 4))
    assert population is not None
    assert repeatability is not None
    assert repeatability.value == pytest.approx(within**0.5, rel=1e-4)
    assert population.value == pytest.approx((values.mean(axis=1).var(ddof=1) - within / 4.0) ** 0.5, rel=1e-3)
    assert repeatability.sigma == pytest.approx((within / (2.0 * 24.0)) ** 0.5, rel=1e-3)


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


def test_a_plot_joins_the_recordings_of_a_unit_and_shows_the_control_limits() -> None:
    p, _ = populations(a_fleet(6, units=20))
    figure = population_plot(p).figure
    (line,) = [mark for mark in figure.marks if mark.kind == "line"]
    dates, values = (line.columns[name] for name in "xy")
    pieces = np.split(values, np.flatnonzero(np.isnan(values)))
    assert sorted(len(piece[~np.isnan(piece)]) for piece in pieces) == [3] * 20
    assert all(
        np.diff(piece[~np.isnan(piece)]).min() > 0.0 for piece in np.split(dates, np.flatnonzero(np.isnan(dates)))
    )
    assert p.control is not None
    assert figure.y_range is not None
    low, high = figure.y_range
    factor = np.nanmax(values) / p.values.max()
    assert all(low < factor * limit < high for limit in p.control)


def test_few_units_have_no_spread() -> None:
    for p in populations(a_fleet(8, units=4, dates=1)):
        assert p.spread is None
        assert p.control is None
        assert p.beyond == 0
        assert not p.outlying.any()


def test_a_study_needs_runs_enough_to_see_sigmas_a_fifth_too_small() -> None:
    """At so many runs the 99 % interval ends below 1.44, at half as many it does not."""
    for dof in (4.0, 22.0):
        needed = statistics.Nees(1.0, 0.0, 0.0, 1, dof).needed
        assert statistics.mean_nees(np.ones(needed), np.full(needed, dof)).high / dof < 1.5
        assert statistics.mean_nees(np.ones(needed // 2), np.full(needed // 2, dof)).high / dof > 1.5
