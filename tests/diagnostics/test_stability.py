"""A calibration that changes while it is recorded is found, with the time; one that does not raises no alarm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.applications.follow.guidance import View, Watch
from alidade.pipelines.diagnostics.change_test import CHANGE, Stability, change_finding, stability, with_change
from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.parameters import prior_z_score
from alidade.pipelines.estimation.problem import Estimate, History, PosteriorHistory, Quantity, SqrtInformation
from alidade.pipelines.estimation.widening import by_wider_priors
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, IncrementalSolver

IDEAL = Config.model_validate({"sensors": "ideal"})
HEAD = {"duration_s": 60.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0}


def session(seed: int, slip_deg: float, config: Config | None = None, **scenario: float) -> alidade.Session:
    """A minute of head motion; half way the markers slip on the helmet."""
    simulated = alidade.simulate("head", HEAD | scenario, seed)
    wxyz = simulated.data.vision_wxyz.copy()
    late = simulated.data.vision_t > 30.0
    wxyz[late] = so3.multiply(wxyz[late], so3.exp(np.deg2rad([slip_deg, 0.0, 0.0])))
    return alidade.open(replace(simulated, data=replace(simulated.data, vision_wxyz=wxyz)), config=config)


def watched(session: alidade.Session) -> tuple[IncrementalSolver, list[tuple[float, float]]]:
    """A run that is watched, and each time at which it was seen to have changed, with when it changed, s."""
    problem = session.problem()
    run, watch, alarms = IncrementalSolver(problem, DEFAULT_WINDOW), Watch(), []
    for step in problem.steps(1):
        run.add_step(step)
        watch.look(run)
        if watch.change is not None:
            alarms.append((step.time, watch.change.evidence["time_s"]))
    return run, alarms


def walk(rng: np.random.Generator, change: float = 0.0, n: int = 40) -> tuple[Estimate, tuple[Quantity, ...]]:
    """Means of the first k of n unit normal vectors, shifted by `change` in the second half."""
    z = rng.standard_normal((n, 2))
    z[n // 2 :, 0] += change
    k = np.arange(1, n + 1)
    values = np.cumsum(z, axis=0) / k[:, None]
    P = np.eye(2) / k[:, None, None]
    posterior_history = PosteriorHistory(k.astype(float), values, P, np.array([True, True]))
    quantities = tuple(Quantity(name, "rad", 10.0, 10.0, 1.0) for name in "ab")
    return Estimate("batch", ("a", "b"), values[-1], P[-1], True, "", posterior_history=posterior_history), quantities


def test_the_level_is_what_it_says() -> None:
    """Levels of recordings in which nothing changes are spread evenly between 0 and 1."""
    rng = np.random.default_rng(0)
    levels = np.sort([found.level for _ in range(60) if (found := stability(*walk(rng)))])
    assert len(levels) == 60
    # Kolmogorov and Smirnov's bound, 99.9 %.
    assert np.abs(levels - (np.arange(60) + 0.5) / 60).max() < 1.95 / np.sqrt(60)


def test_a_change_is_found_where_it_is() -> None:
    found = stability(*walk(np.random.default_rng(1), change=3.0))
    assert found is not None
    assert found.changed
    assert found.time_s == pytest.approx(20.0, abs=2.0)
    assert next(iter(found.departures)) == "a"


def test_a_value_far_beyond_its_prior_is_no_change() -> None:
    """The mean of readings of 10, with a prior of 0 +- 1: as precise as one of them."""
    rng = np.random.default_rng(2)
    n = 40
    k = np.arange(1, n + 1)
    values = np.cumsum(rng.normal(10.0, 1.0, n)) / (k + 1)
    P = np.asarray(1.0 / (k + 1.0), dtype=float)
    posterior_history = PosteriorHistory(k.astype(float), values[:, None], P[:, None, None], np.array([True]))
    estimate = Estimate(
        "batch", ("a",), values[-1:], np.array([[P[-1]]]), True, "", posterior_history=posterior_history
    )
    found = stability(estimate, [Quantity("a", "rad", 1.0, 1.0, 1.0)])
    assert found is not None
    assert not found.changed
    taken_for_true = stability(estimate, [Quantity("a", "rad", None, 1.0, 1.0)])
    assert taken_for_true is not None
    assert taken_for_true.changed


def test_numbers_whose_sum_is_known_far_better_are_inflated_alike() -> None:
    """Inflated each by its own factor, the sum would no longer be what is known."""
    estimate, quantities = walk(np.random.default_rng(4))
    posterior_history = estimate.posterior_history
    assert posterior_history is not None
    mix = np.array([[1.0, 1e-3], [-1.0, 1e-3]])
    mixed = replace(
        posterior_history,
        values=posterior_history.values @ mix.T,
        covariance=mix @ posterior_history.covariance @ mix.T,
    )
    last = {"values": mixed.values[-1], "covariance": mixed.covariance[-1], "posterior_history": mixed}
    found = stability(replace(estimate, **last, inflation=np.array([1.0, 2.0])), quantities)
    assert found is not None
    assert not found.changed


def test_what_is_hardly_better_known_than_before_cannot_be_seen_to_change() -> None:
    estimate, quantities = walk(np.random.default_rng(1), change=3.0)
    narrow = replace(quantities[0], prior_sigma=1.5 * float(estimate.sigmas[0]))
    found = stability(estimate, (narrow, quantities[1]))
    assert found is not None
    assert not found.changed
    assert set(found.departures) == {"b"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_minutes_at_which_nothing_changes_raise_no_alarm(seed: int) -> None:
    """What a camera's scale of 0.999 of its prior's sigma is moved by, noise of the states, passed for 9 sigmas."""
    rates = {"duration_s": 240.0, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 100.0}
    found = alidade.open(alidade.simulate("los", rates, seed)).calibrate(report=False).stability
    assert found is not None
    assert not found.changed


@pytest.mark.parametrize(("departure", "excess"), [(30.0, 0.0), (1e6, 3.0)])
def test_numbers_far_beyond_their_priors_have_wider_ones(departure: float, excess: float) -> None:
    """Exactly where variances are below the priors', and finite where second order has them above."""
    n, rng = 12, np.random.default_rng(0)
    root = rng.standard_normal((n, n))
    P: Array = np.asarray(np.linalg.inv(root @ root.T + np.eye(n)), dtype=float)
    values, steady = departure + rng.standard_normal((3, n)), np.ones(n, dtype=bool)
    posterior_history = PosteriorHistory(np.arange(3.0), values, np.tile((1.0 + excess) * P, (3, 1, 1)), steady)
    quantities = tuple(Quantity(f"q{i}", "rad", 1.0, 1.0, 1.0) for i in range(n))
    sizes = np.array(
        [prior_z_score(q, v, s) for q, v, s in zip(quantities, values[-1], np.sqrt(np.diag(P)), strict=True)]
    )
    covariance = posterior_history.covariance
    wider = by_wider_priors(quantities, np.abs(sizes.astype(float)), values, covariance)
    assert wider is not None
    values, covariance = values + wider[0], covariance + wider[1] @ np.swapaxes(wider[1], 1, 2)
    assert np.isfinite(values).all()
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    assert (np.diagonal(covariance, axis1=1, axis2=2) <= 4.0 * departure**2 * (1.0 + excess)).all()
    if not excess:
        information = np.linalg.inv(P) - np.diag(1.0 - sizes.astype(float) ** -2)
        np.testing.assert_allclose(covariance[-1], np.linalg.inv(information), rtol=1e-6)
        gradient = np.linalg.inv(P) @ posterior_history.values[-1]
        np.testing.assert_allclose(values[-1], np.linalg.solve(information, gradient), rtol=1e-6)


def test_what_walks_or_is_fixed_may_change() -> None:
    estimate, quantities = walk(np.random.default_rng(1), change=3.0)
    posterior_history = estimate.posterior_history
    assert posterior_history is not None
    walking = replace(estimate, posterior_history=replace(posterior_history, steady=np.array([False, True])))
    found = stability(walking, quantities)
    assert found is not None
    assert not found.changed
    assert stability(estimate, [replace(q, prior_sigma=0.0) for q in quantities]) is None
    assert stability(replace(estimate, posterior_history=None), quantities) is None


def test_a_mount_that_slips_is_inconsistent_with_the_time_and_the_step() -> None:
    """A slip of 0.5 deg once went through as calibrated, 14 sigmas off."""
    calibration = session(0, 0.5, vision_rate_hz=10.0, gyro_rate_hz=50.0).calibrate(report=False)
    assert calibration.status == "inconsistent"
    assert calibration.stability is not None
    assert calibration.stability.time_s == pytest.approx(30.0, abs=5.0)
    (change,) = [finding for finding in calibration.findings if finding.kind == "change"]
    name, (step, sigma) = next(iter(change.evidence["steps"].items()))
    assert name == "helmet_mount_x"
    assert np.rad2deg(step) == pytest.approx(0.5, abs=0.2)
    assert step > 3.0 * sigma
    assert "Change at 3" in calibration.headline


def test_an_immaterial_step_is_a_note_and_in_the_covariance_of_everybody() -> None:
    """Less than half of what is required: P + s s', read by the history, the budget and joint calibrations alike."""
    quantities = (Quantity("a", "rad", 1.0, 1.0, 1.0), Quantity("b", "rad", 1.0, 1.0, 1.0))
    found = Stability(7.0, 0.0, 30.0, {"a": (0.2, 0.02)})
    parts = {"a": SplitHalf(0.0, 0.05, 0.4, 0.05), "b": SplitHalf(0.0, 0.05, 0.3, 0.05)}
    small = change_finding(found, parts, quantities)
    assert small is not None
    assert small.severity == Severity.NOTE
    assert list(small.evidence["steps"]) == ["a", "b"]
    R = np.linalg.cholesky(np.linalg.inv(0.01 * np.eye(2))).T
    sqrt_info = SqrtInformation(
        ("a", "b"), np.zeros(2), R, np.array([1.0, 2.0]), np.empty((0, 2)), np.empty(0), np.ones(2)
    )
    history = History(np.array([10.0, 40.0]), np.zeros((2, 2)), np.full((2, 2), 0.1))
    budget = {"a": {"vision": 1.0}, "b": {"vision": 1.0}}
    narrow = Estimate(
        "batch",
        ("a", "b"),
        np.zeros(2),
        0.01 * np.eye(2),
        True,
        "",
        history=history,
        budget=budget,
        sqrt_info=sqrt_info,
    )
    wide = with_change(narrow, small)
    step = np.array([0.4, 0.3])
    expected = 0.01 * np.eye(2) + np.outer(step, step)
    np.testing.assert_allclose(wide.covariance, expected)
    assert wide.history is not None
    assert wide.sqrt_info is not None
    assert wide.budget is not None
    np.testing.assert_allclose(wide.history.sigmas[0], [0.1, 0.1])
    np.testing.assert_allclose(wide.history.sigmas[1], np.sqrt(np.diag(expected)))
    np.testing.assert_allclose(np.linalg.inv(wide.sqrt_info.R.T @ wide.sqrt_info.R), expected)
    np.testing.assert_allclose(np.linalg.solve(wide.sqrt_info.R, wide.sqrt_info.d), np.linalg.solve(R, sqrt_info.d))
    assert wide.budget["a"] == pytest.approx({CHANGE: 0.16 / 0.17, "vision": 0.01 / 0.17})
    large = change_finding(found, {"a": SplitHalf(0.0, 0.05, 0.7, 0.05)}, quantities)
    assert large is not None
    assert large.severity == Severity.INCONSISTENT
    unknown = change_finding(found, {}, quantities)
    assert unknown is not None
    assert unknown.severity == Severity.INCONSISTENT
    assert unknown.evidence["steps"] == {"a": (0.2, 0.02)}
    nuisance = change_finding(found, {}, [replace(quantity, require=np.inf) for quantity in quantities])
    assert nuisance is not None
    assert nuisance.severity == Severity.NOTE


def test_a_mount_that_stays_is_calibrated() -> None:
    calibration = session(0, 0.0, vision_rate_hz=10.0, gyro_rate_hz=50.0).calibrate(report=False)
    assert calibration.status == "calibrated"
    assert calibration.stability is not None
    assert not calibration.stability.changed


@pytest.mark.slow
def test_a_slip_is_seen_while_it_is_recorded() -> None:
    """In the initialisation phase, and the same after the run has continued from a Gaussian."""
    run, alarms = watched(session(0, 0.8, IDEAL, vision_rate_hz=4.0))
    assert run.state.moments.array[-1, 0] > 55.0
    assert alarms
    sqrt_info, when = alarms[0]
    assert sqrt_info < 46.0
    assert when == pytest.approx(30.0, abs=6.0)
    found = stability(run.finish(0.0), run.problem.quantities)
    assert found is not None
    assert found.changed
    assert next(iter(found.departures)) == "helmet_mount_x"


def test_the_person_is_told_what_moved_and_when() -> None:
    steps = {"helmet_mount_x": (8e-3, 1e-3)}
    change = Finding("change", Severity.INCONSISTENT, {"since_s": 31.0, "time_s": 31.0, "steps": steps})
    quantities = (Quantity("helmet_mount_x", "rad", 0.1, 0.1, 1e-3),)
    view = View(40.0, 43_200 * 10**9, quantities, np.zeros(1), np.eye(1) * 1e-8, (), change)
    assert not view.done
    assert view.headline.startswith("Change at 31 s: helmet_mount_x by 0.458 ± 0.057 deg.")
    assert "12:00:31 UTC" in view.headline
    assert replace(view, change=None).done


@pytest.mark.slow
def test_the_incremental_solver_finds_slips_and_raises_no_false_alarms() -> None:
    for seed in range(4):
        calibration = session(seed, 0.5).calibrate("incremental")
        assert calibration.status == "inconsistent"
        assert calibration.stability is not None
        assert calibration.stability.time_s == pytest.approx(30.0, abs=5.0)
    for seed in range(12):
        run, alarms = watched(session(seed, 0.0))
        assert not alarms
        found = stability(run.finish(0.0), run.problem.quantities)
        assert found is not None
        assert not found.changed


@pytest.mark.slow
def test_slips_are_found_at_all_seeds_and_false_alarms_are_rare() -> None:
    for seed in range(12):
        slipped = session(seed, 0.5)
        found = stability(solve_batch(slipped.problem(), history=True), slipped.problem().quantities)
        assert found is not None
        assert found.changed
        assert found.time_s == pytest.approx(30.0, abs=5.0)
    alarms = 0
    for seed in range(40):
        clean = session(seed, 0.0)
        found = stability(solve_batch(clean.problem(), history=True), clean.problem().quantities)
        assert found is not None
        alarms += found.changed
    assert alarms <= 1
