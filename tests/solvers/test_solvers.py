"""Batch and incremental on linear Gaussian problems, whose answers have closed forms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from alidade.factors.array import Array
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import Model, Residuals
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import IndeterminateError
from alidade.pipelines.estimation.problem import Estimate, Factor, Parameter, Problem, Quantity, Step
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.solvers import levenberg
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.incremental import solve_incremental
from alidade.pipelines.solvers.layout import Tangent
from alidade.pipelines.solvers.posterior import Reported
from alidade.pipelines.solvers.window import Keyframes
from benchmarks.batch import solve as minimum
from tests.support import chain
from tests.support.chain import INTERVAL, PARAMETER, PRIOR, Walk
from tests.support.judged import judge

# Slopes of a gyro's bias, rad/s/K.
WARMING = (1.5e-4, -2e-4, 2.5e-4)


# A chain has 60 steps.
pytestmark = pytest.mark.usefixtures("early_smoother", "few_solutions")


@cache
def solved_walks(weak: bool, runs: int) -> list[tuple[Estimate, Array]]:
    """Estimates of walks with the same rows, weak: priors decide as much as the data do, and the true parameters."""
    rng = np.random.default_rng(9)
    h = 0.02 * rng.random((30, 2)) if weak else rng.standard_normal((30, 2))
    walks = [Walk.random(seed, h) for seed in range(runs)]
    return [(solve_batch(walk.problem()), truth) for walk, truth in walks]


def assert_same(estimate: Estimate, value: Array, covariance: Array, tolerance: float = 1e-8) -> None:
    np.testing.assert_allclose(estimate.values, value, atol=tolerance)
    np.testing.assert_allclose(estimate.covariance, covariance, rtol=1e3 * tolerance, atol=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_batch_is_the_closed_form(seed: int) -> None:
    walk, _ = Walk.random(seed)
    estimate = solve_batch(walk.problem())
    value, covariance, square = walk.closed_form()
    assert_same(estimate, value, covariance)
    assert estimate.converged
    assert estimate.chi_square is not None
    assert estimate.chi_square.value == pytest.approx(square, rel=1e-9)


RUNS = pytest.mark.parametrize("runs", [15, pytest.param(200, marks=pytest.mark.slow)])


@RUNS
@pytest.mark.parametrize("weak", [False, True])
def test_degrees_of_freedom_are_the_expected_sum_of_squares(weak: bool, runs: int) -> None:
    found = [estimate.chi_square for estimate, _ in solved_walks(weak, runs)]
    value, dof = (np.array([getattr(c, what) for c in found]) for what in ("value", "dof"))
    assert np.ptp(dof) < 1e-6
    # Standard deviation of the mean: sqrt(2 dof / runs).
    assert abs(value.mean() - dof[0]) < 3.5 * np.sqrt(2.0 * dof[0] / len(dof))
    for family in ("seen", "walk"):
        squares, expected = (np.array([c.families[family][i] for c in found if c]) for i in (0, 1))
        assert squares.mean() == pytest.approx(expected.mean(), rel=0.15)


def test_families_share_the_freedoms_of_a_tight_process_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the normal equations have lost their digits: never a whole that goes to the first family."""
    monkeypatch.setattr(chain, "WALK", 1e-10)
    walk, _ = Walk.random(1)
    summary = solve_batch(walk.problem()).chi_square
    assert summary is not None
    # A walk this tight is no measurement of anything: its rows take as many unknowns away as they are.
    assert summary.families["walk"][1] == pytest.approx(0.0, abs=1e-3)
    assert summary.families["seen"][1] == pytest.approx(57.0, abs=1.0)


@RUNS
def test_errors_are_as_large_as_the_covariance_says(runs: int) -> None:
    nees = []
    for estimate, truth in solved_walks(False, runs):
        error = estimate.values - truth
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
    low, high = chi2.ppf([0.005, 0.995], 2 * runs)
    assert low < sum(nees) < high


@pytest.mark.parametrize("solve", [solve_batch, solve_incremental])
def test_unknown_direction_is_named_not_raised(solve: Callable[[Problem], Estimate]) -> None:
    """Both slopes act alike, their difference is free: a null prior makes the system singular."""
    walk, truth = Walk.random(1, np.repeat(np.random.default_rng(2).standard_normal((40, 1)), 2, axis=1))
    walk = replace(walk, prior=None)
    problem = walk.problem()
    estimate = solve(problem)
    assert np.isfinite(estimate.values).all()
    assert estimate.values.sum() == pytest.approx(truth.sum(), abs=0.5)
    assessment = judge(problem.quantities, estimate.covariance, estimate.chi_square, None)
    assert assessment.status == "unobservable"
    (direction,) = assessment.directions
    first, second = direction.evidence["weights"].values()
    assert set(direction.evidence["weights"]) == {"slope_0", "slope_1"}
    assert (first, second) == pytest.approx((2**-0.5, -(2**-0.5)), abs=1e-6)
    # The sum is known as well as a single slope with that row would be.
    A, _, _ = Walk(walk.h[:, :1], walk.z, prior=None).whitened()
    of_sum = float(np.ones(2) @ estimate.covariance @ np.ones(2))
    assert of_sum == pytest.approx(np.linalg.inv(A.T @ A)[0, 0], rel=1e-3)


@dataclass(frozen=True)
class HalfSeen(Model):
    """Sees the first of two components of a state."""

    time: Array
    rows: int = 1
    blocks = (2, 2)

    def __call__(self, s: Array, p: Array) -> Residuals:
        first = np.tile([[[1.0, 0.0]]], (len(s), 1, 1))
        return s[:, :1] + p[:, :1], lambda: (first, np.tile([[[1.0, 0.0]]], (len(s), 1, 1)))


def test_undetermined_state_is_named() -> None:
    walk, _ = Walk.random(1)

    def steps(chunk: int) -> Iterator[Step]:
        yield from walk.steps(chunk, None)
        initial = gtsam.Values()
        initial.insert(gtsam.symbol("q", 7), np.zeros(2))
        half = HalfSeen(np.array([9.0])).on(gtsam.symbol("q", 7), PARAMETER)
        yield Step(9.0, initial, [Factor.of("half", half)])

    with pytest.raises(IndeterminateError, match="state q7"):
        solve_batch(replace(walk.problem(), steps=steps))


@pytest.mark.parametrize("window", [0.35, pytest.param(1.0, marks=pytest.mark.slow), Keyframes(3), None])
def test_incremental_is_batch(window: float | None) -> None:
    """A linear problem loses nothing when states are marginalised out of the window."""
    walk, _ = Walk.random(4)
    batch, incremental = solve_batch(walk.problem()), solve_incremental(walk.problem(), window)
    assert_same(incremental, batch.values, batch.covariance, 1e-7)


@pytest.mark.parametrize("window", [1.0, pytest.param(None, marks=pytest.mark.slow)])
def test_history_is_what_batch_finds_on_the_data_so_far(window: float | None) -> None:
    walk, _ = Walk.random(5)
    history = solve_incremental(walk.problem(), window).history
    assert history is not None
    for time, value, sigma in list(zip(history.time, history.values, history.sigmas, strict=True))[3::7]:
        n = round(time / INTERVAL) + 1
        so_far, covariance, _ = Walk(walk.h[:n], walk.z[:n]).closed_form()
        np.testing.assert_allclose(value, so_far, atol=1e-7)
        np.testing.assert_allclose(sigma, np.sqrt(np.diag(covariance)), rtol=1e-5)


@pytest.mark.parametrize("runs", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_innovations_are_white(runs: int) -> None:
    """Their squares have the mean of their dimension."""
    squares = []
    for seed in range(runs):
        residuals = solve_incremental(Walk.random(seed, n=80)[0].problem(), None).residuals["seen"]
        late = residuals.time > 3.0  # innovations proper; what came before was solved in batch
        squares.append(residuals.whitened[late] ** 2)
    n = sum(map(len, squares))
    assert abs(np.concatenate(squares).mean() - 1.0) < 3.5 * np.sqrt(2.0 / n)


@pytest.mark.parametrize("solve", [solve_batch, solve_incremental])
def test_outliers_are_left_out_and_cost_nothing(solve: Callable[[Problem], Estimate]) -> None:
    """As good as if the bad measurements had not been made."""
    walk, _ = Walk.random(6)
    bad = np.array([13, 30, 44])
    spoilt = replace(walk, z=walk.z + 40.0 * np.isin(np.arange(60), bad))
    estimate = solve(spoilt.problem(TruncatedLoss(4.0)))
    assert estimate.rejected == {"seen": 3}
    A, b, _ = walk.whitened()
    good = np.ones(len(b), dtype=bool)
    good[len(b) - 60 + bad] = False
    covariance = np.asarray(np.linalg.inv(A[good].T @ A[good]), dtype=float)
    value = covariance @ A[good].T @ b[good]
    assert_same(estimate, value[:2], covariance[:2, :2], 1e-7)


def test_nothing_is_known_but_the_prior() -> None:
    walk, _ = Walk.random(7, np.zeros((20, 2)))
    estimate = solve_batch(walk.problem())
    assert_same(estimate, np.zeros(2), PRIOR**2 * np.eye(2))
    assert estimate.chi_square is not None
    assert estimate.chi_square.dof == pytest.approx(20.0, abs=1e-6)


def test_fixed_quantities_cost_the_others_no_digits() -> None:
    """A pinned number has some 1e16 times the information of a weak one; the others' covariance stays exact."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(8, 4)) * [1.0, 1e-4, 1e8, 1.0]
    quantities = [Quantity(f"q{i}", "", 0.0 if i == 2 else 1.0, 1.0, 0.1) for i in range(4)]
    values = gtsam.Values()
    values.insert(0, np.zeros(4))
    problem = Problem("", (Parameter(0, tuple(quantities)),), lambda _: iter(()))
    reported = Reported.at(problem, values, [0], [np.eye(4)])
    root = np.asarray(np.linalg.qr(np.column_stack([A, np.zeros(len(A))]), mode="r"), dtype=float)
    covariance = reported.covariance(reported.root(root).covariance())
    free = [0, 1, 3]
    expected = np.linalg.inv(A[:, free].T @ A[:, free])
    np.testing.assert_allclose(covariance[np.ix_(free, free)], expected, rtol=1e-6)
    assert not covariance[2].any()
    assert not covariance[:, 2].any()


def test_a_lengthened_step_that_goes_too_far_proves_no_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """At .05 sigma from the minimum, where a single step that raises the cost proves one."""
    compiled = Compiled.of(Walk.random(0)[0].problem())
    engine, start = compiled.engine.under(None), levenberg.Point.of(compiled.engine, compiled.initial)
    least = start.factorization.minimum
    step, share = Tangent(*start.factorization.solve()), 0.05 / (start.cost - least) ** 0.5
    near = engine.layout.retract(start.values, step.times(1.0 - share))
    lengths = iter((3.0, *(10 * [1.0])))
    monkeypatch.setattr(levenberg, "_length", lambda *_: next(lengths))
    found = levenberg.minimize(engine, near, levenberg.LevenbergConfig(corrections=0))
    assert engine.cost(near) - least == pytest.approx(0.05**2, rel=1e-3)
    assert found.converged
    assert found.cost - least < 1e-6


@dataclass(frozen=True)
class Bent(Model):
    """Sees x, and K + c x^2 / (2 K): the true curvature is 1 + c times that of the linear system."""

    time: Array
    c: float
    K: float = 10.0
    rows: int = 2
    blocks = (1,)

    def __call__(self, x: Array) -> Residuals:
        residuals = np.hstack([x, self.K + self.c * x**2 / (2.0 * self.K)])
        return residuals, lambda: (np.stack([np.ones_like(x), self.c * x / self.K], axis=1),)


# Gauss-Newton's steps alone: 33, 35 and more than 100 iterations.
@pytest.mark.parametrize(("c", "most"), [(-0.7, 5), (0.7, 6), (0.99, 6), (20.0, 60)])
def test_steps_of_the_wrong_length_are_made_right(c: float, most: int) -> None:
    initial = gtsam.Values()
    initial.insert(0, np.array([0.05 if c > 1.0 else 0.5]))
    step = Step(0.0, initial, [Factor.of("bent", Bent(np.zeros(1), c).on(0))])
    problem = Problem("", (Parameter(0, (Quantity("x", "", None, 1.0, 0.1),)),), lambda _: iter([step]))
    compiled = Compiled.of(problem, "gtsam")
    found = levenberg.minimize(compiled.engine, compiled.initial)
    assert found.converged
    assert found.iterations <= most
    assert found.cost - Bent.K**2 < 1e-4


@pytest.mark.parametrize("before", [0.5, -0.5, 0.0])
def test_a_decrease_that_is_negative_by_rounding_gives_a_full_step(before: float) -> None:
    assert levenberg._length(-1e-9, before) == 1.0


@pytest.mark.parametrize("pictures_hz", [5.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_where_measurements_do_not_fit_steps_get_the_right_length(pictures_hz: float) -> None:
    """A gyro warms up and nobody says so: residuals are tens of sigmas, and bend the error as much as Jacobians do.

    With full steps alone 49 and 58 iterations, most of them for the same share of what is left.
    """
    scenario = LosScenario.model_validate(
        {"duration_s": 30.0, "image_rate_hz": pictures_hz, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 100.0}
        | {"temperature": {"rise_k": 20.0, "time_constant_s": 10.0}}
        | {"effects": {f"gyro_temperature_{axis}": slope for axis, slope in zip("xyz", WARMING, strict=True)}}
    )
    data = replace(simulate_los(scenario, 1).data, temperature=None)
    problem = los.problem(data, load_config(los_config(scenario).encode()))
    compiled = Compiled.of(problem)
    engine, config = compiled.engine.under(None), levenberg.LevenbergConfig()
    found = levenberg.minimize(engine, compiled.initial, config)
    assert found.converged
    assert found.iterations < 40
    measured = sum(len(group.model.time) * group.model.rows for group in engine.groups if group.is_measurement)
    assert found.cost > 20.0 * measured
    least = levenberg.minimize(engine, found.values, replace(config, cost_tolerance=1e-9)).cost
    # Of a sigma as large as the residuals say, 0.02.
    assert found.cost - least < 0.02**2 * found.cost / measured


@pytest.mark.parametrize(
    ("duration_s", "seed", "most"),
    [(200.0, 1, 4), *(pytest.param(600.0, seed, 8, marks=pytest.mark.slow) for seed in (1, 2))],
)
def test_a_roll_that_pictures_do_not_determine_does_not_swing(duration_s: float, seed: int, most: int) -> None:
    """Minutes of los with all nuisance parameters: few iterations, and no more to be gained.

    From states that are aligned with single pictures, whose noise the scale of LOS errors then explains, 5 and 13.
    """
    scenario = LosScenario(duration_s=duration_s, gyro_rate_hz=200.0, image_rate_hz=50.0)
    problem = los.problem(simulate_los(scenario, seed).data, load_config(los_config(scenario).encode()))
    compiled = Compiled.of(problem)
    found = minimum(compiled)
    assert found.iterations <= most
    last = levenberg.minimize(found.engine, found.values, levenberg.LevenbergConfig(cost_tolerance=1e-9))
    assert found.engine.cost(found.values) - last.cost < 0.01**2
