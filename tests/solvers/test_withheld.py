"""Numbers of which nothing can be told yet are reported at their priors while a run is young."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.stats import chi2

from alidade.pipelines.estimation.problem import Array, Problem
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, Run
from alidade.pipelines.solvers.innovations import Innovations
from alidade.pipelines.solvers.rows import Rows
from alidade.pipelines.solvers.withheld import covariance_without, values_without, with_prior
from benchmarks.young import CASES, made, nees
from tests.support.judged import judge

FEW, SHARE = 20, 0.25


def begun(method: str, case: str, number: int, until: float) -> tuple[Run, Array]:
    """A run that has been followed for some s, and the true values."""
    settings, _ = CASES[method][case](number)
    problem, truth = made(method, settings, number)
    run = Run(problem, DEFAULT_WINDOW)
    go_on(run, until)
    return run, truth


def go_on(run: Run, until: float) -> None:
    for step in run.problem.steps(1):
        if run.time < step.time <= until:
            run.add_step(step)


def assert_withheld(run: Run, names: set[str]) -> None:
    """These and no others: value, sigma, correlation and verdict."""
    quantities, estimate = run.problem.quantities, run.estimate()
    assert {q.name for q, each in zip(quantities, run.withheld, strict=True) if each} == names
    verdicts = judge(quantities, estimate.covariance, estimate.chi_square, None).verdicts
    history = estimate.history
    assert history is not None
    for i, q in enumerate(quantities):
        if q.name in names:
            assert estimate.values[i] == history.values[-1, i] == q.prior_mean
            assert estimate.sigmas[i] == history.sigmas[-1, i] == pytest.approx(q.prior_sigma, rel=1e-9)
            assert np.count_nonzero(estimate.covariance[i]) == 1
            assert verdicts.get(q.name) in ("unobservable", None)


def test_the_first_attitudes_of_a_tumbled_magnetometer() -> None:
    """Their covariance of second order does not go far enough: of some recordings it is off by hundreds."""
    run, truth = begun("tumble", "rest", 2, 9.0)
    *triad, strength = [q.name for q in run.problem.quantities]
    assert_withheld(run, set(triad))
    assert strength not in triad
    assert_ends_as_batch(run)
    go_on(run, 13.0)
    assert_withheld(run, set())
    size, numbers = nees(run.values(), run.covariance(), truth)
    assert size < chi2.ppf(0.999, numbers)
    assert (run.estimate().sigmas[:-1] < 0.5 * np.array([q.scale for q in run.problem.quantities[:-1]])).any()


def assert_ends_as_batch(run: Run) -> None:
    """The final answer has nothing withheld."""
    steps = list(islice(run.problem.steps(1), len(run.past)))
    batch, final = solve_batch(replace(run.problem, steps=lambda _: iter(steps))), run.finish(0.0)
    np.testing.assert_allclose(final.values, batch.values, atol=1e-3 * batch.sigmas.max())
    np.testing.assert_allclose(final.sigmas, batch.sigmas, rtol=0.05)


def with_priors(run: Run) -> set[str]:
    return {q.name for q in run.problem.quantities if q.prior_sigma}


def test_outliers_among_few_pictures() -> None:
    """Three of eleven pictures are rejected."""
    run, _ = begun("los", "outliers", 4010, 1.05)
    assert_withheld(run, with_priors(run))


@pytest.mark.slow
def test_outliers_that_agree_by_chance() -> None:
    """Six of thirteen pictures are rejected, the wrong ones: it is 425 of 35 off, until more have come."""
    run, truth = begun("los", "outliers", 4047, 1.25)
    assert_withheld(run, with_priors(run))
    go_on(run, 1.35)
    assert_withheld(run, set())
    size, numbers = nees(run.values(), run.covariance(), truth)
    assert size < chi2.ppf(0.999, numbers)


def test_outliers_among_many_or_few_of_them_can_be_told() -> None:
    def undecided(*families: list[float]) -> bool:
        rows = [Rows(np.array([[0.0, used, 1.0] for used in family])) for family in families]
        return Innovations({str(i): each for i, each in enumerate(rows)}).undecided(FEW, SHARE)

    assert not undecided()
    assert undecided([1.0] * 8 + [0.0] * 3)
    assert undecided([1.0] * 8, [0.0] * 3)
    assert not undecided([1.0] * 9 + [0.0] * 3)
    assert not undecided([1.0] * 12 + [0.0] * 8)
    assert not undecided([1.0] * 20, [1.0, 0.0])


def test_what_has_no_prior_is_told_and_priors_are_not_about_nought() -> None:
    settings, _ = CASES["indexer"]["mount"](3001)
    problem, _ = made("indexer", settings, 3001)
    some = with_prior(problem)
    free = [q.prior_sigma is None for q in problem.quantities]
    assert any(free)
    assert not (some & free).any()
    off = _about(problem, 0.3)
    n = len(some)
    values, covariance = values_without(np.ones(n), some, off), covariance_without(np.ones((n, n)), some, off)
    np.testing.assert_array_equal(values, np.where(some, 0.3, 1.0))
    np.testing.assert_array_equal(covariance[np.ix_(~some, ~some)], 1.0)
    np.testing.assert_array_equal(covariance[np.ix_(some, ~some)], 0.0)
    np.testing.assert_allclose(np.diag(covariance)[some], [q.prior_sigma**2 for q in off.quantities if q.prior_sigma])


def _about(problem: Problem, mean: float) -> Problem:
    """With other priors' means."""
    parameters = (
        replace(p, quantities=tuple(replace(q, prior_mean=mean) for q in p.quantities)) for p in problem.parameters
    )
    return replace(problem, parameters=tuple(parameters))
