"""What is derived from the chain's factor, against dense least squares of gtsam's linearisation, for every method."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from alidade.factors.array import Array, Mask
from alidade.factors.chi_square import quantile
from alidade.factors.model import Model, Residuals
from alidade.pipelines.estimation.problem import Factor, Problem
from alidade.pipelines.solvers.chain import ChainFactorization, Factorization
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import (
    ColouredNoise,
    Influence,
    added_by_shares,
    added_covariance,
    autocorrelation,
    coloured_noises,
    error_budget,
    most_influential,
    ratio_by_blocks,
    variance_shares,
)
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import Point
from alidade.pipelines.solvers.linearization import NOT_MEASURED, Group, Linearization
from alidade.pipelines.solvers.posterior import (
    Reported,
    chi_square,
    expected_squares,
    leverages,
    moved_to,
    sqrt_information,
)
from alidade.pipelines.solvers.posterior_history import posterior_history, smoothed
from alidade.pipelines.solvers.weak_directions import Posterior, WeakDirections
from tests.support.problems import SCENARIOS, problem


@dataclass(frozen=True, eq=False)
class Dense:
    """A problem near its minimum, its chain, and gtsam's linearisation of the same factors as one dense system."""

    problem: Problem
    factors: list[Factor]
    compiled: Compiled
    point: Point
    rows: list[Array]  # of each factor, over all unknowns
    rights: list[Array]
    numbers: Array  # (n, unknowns) Jacobian of the reported numbers
    columns: dict[int, slice]

    @property
    def linearization(self) -> Linearization:
        return self.point.engine

    @property
    def values(self) -> Values:
        return self.point.values

    @property
    def factorization(self) -> Factorization:
        return self.point.factorization

    @property
    def reported(self) -> Reported:
        return Reported.of(self.compiled, self.values)

    @property
    def posterior(self) -> Posterior:
        """With every direction as the linear system has it."""
        reported = self.reported
        _, sizes, axes = np.linalg.svd(reported.root(self.factorization.root).R)
        strong = WeakDirections(axes.T, np.zeros((len(axes), 0)), 1.0 / sizes, reported.prior)
        return Posterior(self.point, reported, strong, True)

    @property
    def covariance(self) -> Array:
        """(unknowns, unknowns)."""
        inverse = np.linalg.inv(np.linalg.qr(np.vstack(self.rows), mode="r"))
        return np.asarray(inverse @ inverse.T)


@cache
def dense(name: str) -> Dense:
    made = problem(name)
    factors = [f for step in made.steps(10**9) for f in step.factors]
    compiled = Compiled.of(made, "chain")
    layout, point = compiled.layout, Point.of(compiled.engine.under(None), compiled.initial)
    for _ in range(3):
        point = Point.of(point.engine, layout.retract(point.values, Tangent(*point.factorization.solve())))
    at = layout.to_gtsam(point.values)
    graph = gtsam.GaussianFactorGraph()
    for f in factors:
        graph.add((f.factor if f.bound is None else f.bound.under(None).factor).linearize(at))
    dims, end, columns = at.dims(), 0, {}
    for key in at.keys():
        columns[key] = slice(end, end + dims[key])
        end += dims[key]
    rows, rights = [], []
    for i in range(graph.size()):
        linear = graph.at(i)
        A, b = linear.jacobian()
        whole, begin = np.zeros((len(A), end)), 0
        for key in linear.keys():
            whole[:, columns[key]] = A[:, begin : begin + dims[key]]
            begin += dims[key]
        rows.append(whole)
        rights.append(b)
    numbers = []
    for p, key in zip(made.parameters, compiled.keys, strict=True):
        _, J = p.coordinates(at, key)
        block = np.zeros((len(J), end))
        block[:, columns[key]] = J
        numbers.append(block)
    return Dense(made, factors, compiled, point, rows, rights, np.vstack(numbers), columns)


@pytest.mark.parametrize("name", SCENARIOS)
def test_covariance_of_reported_numbers_is_the_dense_marginal(name: str) -> None:
    case = dense(name)
    reported = case.reported
    expected = case.numbers @ case.covariance @ case.numbers.T
    found = reported.covariance(reported.root(case.factorization.root).covariance()) - np.diag(reported.extra**2)
    sigmas = np.sqrt(np.diag(expected))[reported.free]
    block = np.ix_(reported.free, reported.free)
    np.testing.assert_allclose(
        found[block] / np.outer(sigmas, sigmas), expected[block] / np.outer(sigmas, sigmas), atol=1e-6
    )


@pytest.mark.parametrize("name", SCENARIOS)
def test_degrees_of_freedom_are_rows_less_leverages(name: str) -> None:
    case = dense(name)
    covariance, families, total = case.covariance, dict[str, list[float]](), 0.0
    for f, A, b in zip(case.factors, case.rows, case.rights, strict=True):
        if f.family not in NOT_MEASURED:
            h = ((A @ covariance) * A).sum(axis=1)
            value, dof = families.get(f.family, [0.0, 0.0])
            v = f.bound
            count = len(A) if v is None else v.model.rows * len(v.model.time)  # of which a compressed factor has fewer
            families[f.family] = [value + float(b @ b), dof + count - h.sum()]
    system = case.linearization.at(case.values)[0]
    found = leverages(case.linearization, system, case.factorization, case.values)
    assert all((each.h > -1e-9).all() and (each.h < 1.0 + 1e-9).all() for each in found)
    summary = chi_square(found)
    assert set(summary.families) == set(families)
    for family, (value, dof) in families.items():
        if name != "indexer":  # its compressed factors leave out what no unknown changes
            assert summary.families[family][0] == pytest.approx(value, rel=1e-5, abs=1e-6)
        assert summary.families[family][1] == pytest.approx(dof, rel=1e-6, abs=1e-5)
        assert summary.families[family][1] >= 0.0
        total += dof
    assert summary.dof == pytest.approx(total, rel=1e-6)
    squares = expected_squares(case.linearization, system, case.factorization, case.values)
    for family, (_, dof) in summary.families.items():
        assert sum(v for (f, _), v in squares.items() if f == family) == pytest.approx(dof, rel=1e-6, abs=1e-6)


def test_priors_alone_have_no_chi_square_and_do_not_crash() -> None:
    assert chi_square([]).dof == 0.0
    assert chi_square([]).families == {}


@pytest.mark.parametrize("name", SCENARIOS)
def test_budget_and_influence_are_those_of_the_dense_system(name: str) -> None:
    case = dense(name)
    reported = case.reported
    found = reported.root(case.factorization.root)
    influence = Influence.of(case.posterior)
    gains = (case.numbers @ case.covariance)[reported.free]
    variance = np.einsum("ij,ij->i", gains, case.numbers[reported.free])
    families: dict[str, Array] = {}
    for f, A in zip(case.factors, case.rows, strict=True):
        families[f.family] = families.get(f.family, np.zeros(len(gains))) + np.square(gains @ A.T).sum(axis=1)
    covariance = reported.covariance(found.covariance()) - np.diag(reported.extra**2)
    budget = error_budget(influence, {}, covariance)
    for j, name_of in enumerate(influence.names):
        shares = budget[name_of]
        assert sum(shares.values()) == pytest.approx(1.0)
        for family, squares in families.items():
            if family != "prior":
                assert shares.get(family, 0.0) == pytest.approx(squares[j] / variance[j], abs=1e-5)
        priors = sum(share for source, share in shares.items() if source.startswith("prior"))
        assert priors == pytest.approx(families["prior"][j] / variance[j], abs=1e-5)
        assert shares.get("not modelled", 0.0) < 1e-5


def test_budget_is_that_of_the_gum_tree_calculator() -> None:
    """GTC propagates whitened residuals of unit uncertainty through the solution of the dense system by itself."""
    gtc = pytest.importorskip("GTC", reason="GTC is not installed")
    case = dense("tumble at rest")
    reported = case.reported
    found = reported.root(case.factorization.root)
    influence = Influence.of(case.posterior)
    budget = error_budget(influence, {}, reported.covariance(found.covariance()) - np.diag(reported.extra**2))
    Q, R = np.linalg.qr(np.vstack(case.rows))
    residuals = [gtc.ureal(0.0, 1.0) for _ in Q]
    solution = gtc.la.solve(gtc.la.uarray(R.tolist()), gtc.la.matmul(gtc.la.uarray(Q.T.tolist()), residuals))
    families = np.repeat([f.family for f in case.factors], [len(rows) for rows in case.rows])
    for name, number in zip(influence.names, case.numbers[reported.free], strict=True):
        y = sum(float(weight) * x for weight, x in zip(number, solution, strict=True) if weight)
        parts = np.square([gtc.component(y, each) for each in residuals]) / gtc.variance(y)
        for family in {*families} - {"prior"}:
            assert budget[name].get(family, 0.0) == pytest.approx(parts[families == family].sum(), abs=1e-6)


def test_moves_of_a_changed_input_are_those_of_the_dense_system() -> None:
    case = dense("head")
    reported = case.reported
    influence = Influence.of(case.posterior)
    groups = [
        replace(g, weights=np.full((len(g.model.time), g.model.rows), 0.9)) if g.is_measurement else g
        for g in case.linearization.groups
    ]
    moves = influence.moves(replace(case.linearization, groups=groups))
    gradient = np.zeros(case.numbers.shape[1])
    for f, A, b in zip(case.factors, case.rows, case.rights, strict=True):
        if f.measurement is not None:
            gradient += (0.81 - 1.0) * A.T @ b
    expected = (case.numbers @ case.covariance @ gradient)[reported.free]
    np.testing.assert_allclose(moves, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_most_influential_measurements_are_in_balance_with_all_others() -> None:
    case = dense("los")
    reported = case.reported
    found = reported.root(case.factorization.root)
    influence = Influence.of(case.posterior)
    covariance = reported.covariance(found.covariance())
    sigmas = dict(zip(reported.names, np.sqrt(np.diag(covariance)), strict=True))
    first = most_influential(influence, {"delta_px": sigmas["delta_px"]}, 20)
    gain = (case.numbers @ case.covariance)[reported.names.index("delta_px")]
    moves = [
        float(gain @ A[m * i : m * i + m].T @ b[m * i : m * i + m]) / sigmas["delta_px"]
        for f, A, b in zip(case.factors, case.rows, case.rights, strict=True)
        if f.bound is not None and f.family != "prior"
        for m in [f.bound.model.rows]
        for i in range(len(f.bound.model.time))
    ]
    expected = sorted(moves, key=abs, reverse=True)[:20]
    np.testing.assert_allclose([pull.sigmas for pull in first], expected, rtol=1e-4)


# Beginnings of numbers that have a prior together.
JOINT = ("field_", "tag_")


@pytest.mark.parametrize("name", SCENARIOS)
def test_square_root_information_with_device_priors_is_all_there_is(name: str) -> None:
    case = dense(name)
    reported = case.reported
    # Priors of the field, and of the tags of a drawing, are about several numbers together.
    device = {name for i in reported.free[::2] if not (name := reported.names[i]).startswith(JOINT)}
    told = sqrt_information(case.compiled, case.linearization, case.values, device)
    information = told.R.T @ told.R + told.prior_R.T @ told.prior_R
    expected = case.numbers @ case.covariance @ case.numbers.T
    block = expected[np.ix_(reported.free, reported.free)]
    sigmas = np.sqrt(np.diag(block))
    found = np.linalg.inv(information * np.outer(sigmas, sigmas))
    np.testing.assert_allclose(found, block / np.outer(sigmas, sigmas), atol=1e-5)
    assert (np.abs(told.prior_R) > 0.0).sum(axis=1).max(initial=1) >= 1
    # The prior of a bias that walks is about its first node, which is not what is reported.
    walking = {"gyro_bias_x", "gyro_bias_y", "gyro_bias_z"} if case.linearization.layout.sizes[3] else set()
    assert len(told.prior_R) == len(device - walking)


def test_square_root_information_elsewhere_is_linear_there() -> None:
    case = dense("head")
    wanted = {"helmet_mount_x": 0.1}
    values = moved_to(case.compiled, case.linearization, case.values, wanted)
    told = sqrt_information(case.compiled, case.linearization, values, set())
    assert told.at[told.names.index("helmet_mount_x")] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("name", ["los", "head with a bias that walks"])
def test_history_ends_with_the_estimate(name: str) -> None:
    case = dense(name)
    reported = case.reported
    R = reported.root(case.factorization.root).R
    directions = WeakDirections.of(R, reported.prior, reported.calibrated)
    course = posterior_history(case.compiled, Posterior(case.point, reported, directions, True))
    assert course is not None
    np.testing.assert_array_equal(course.covariance[-1], reported.covariance(directions.covariance()))
    assert isinstance(case.factorization, ChainFactorization)
    keyframes, roots = case.factorization.prefix_roots()
    assert keyframes[-1] == case.linearization.layout.sizes[0] - 1
    last = WeakDirections.of(reported.root(roots[-1]).R, reported.prior, reported.calibrated).covariance()
    np.testing.assert_allclose(last, directions.covariance(), rtol=1e-6, atol=1e-9)
    assert len(course.time) > 10
    # What is determined only gets better known.
    widest = np.linalg.eigvalsh(course.covariance[:, reported.free[:, None], reported.free])[:, -1]
    assert widest[-1] <= widest[0] * (1.0 + 1e-9)
    assert not course.steady[[n.startswith("gyro_bias") for n in reported.names]].any()
    assert course.steady[[not n.startswith("gyro_bias") for n in reported.names]].all()


def test_smoothed_bias_has_the_dense_sigmas() -> None:
    case = dense("head with a bias that walks")
    nodes = [int(gtsam.symbol("b", j)) for j in range(case.linearization.layout.sizes[2])]
    expected = [np.sqrt(np.diag(case.covariance[case.columns[key], case.columns[key]])) for key in nodes]
    bias = [i for i, name in enumerate(case.reported.names) if name.startswith("gyro_bias")]
    covariance = case.posterior.covariance
    covariance[bias, bias] = expected[-1] ** 2  # no error without a model, and the last node's is what is reported
    history = smoothed(case.compiled, case.posterior, covariance)
    assert history is not None
    np.testing.assert_allclose(history.sigmas[:, bias], np.array(expected), rtol=1e-6)


def test_autocorrelation_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(0)
    white, walk = rng.standard_normal((4000, 1)), np.zeros((4000, 1))
    for i in range(1, len(walk)):
        walk[i] = 0.9 * walk[i - 1] + rng.standard_normal()
    assert len(autocorrelation(white)) == 0
    assert 10.0 < 1.0 + 2.0 * float(autocorrelation(walk).sum()) < 30.0  # 19 for the process
    # A fifth of white noise that lasts for a hundred measurements: 4.8 of them count as one, and no lag shows it alone.
    faint = 0.2 * lfilter([0.2], [1.0, -0.98], rng.normal(size=20_000))[:, None] + rng.normal(size=(20_000, 1))
    assert 3.0 < 1.0 + 2.0 * float(autocorrelation(faint).sum()) < 7.0


def test_blocks_show_an_error_that_goes_with_the_motion() -> None:
    """A field that differs between two places is no noise to the number that is read from its difference."""
    rng, n = np.random.default_rng(0), 8000
    time = np.arange(n) / 50.0
    L = np.stack([np.ones(n), np.sign(np.sin(2.0 * np.pi * time / 80.0))], axis=1) / n
    nominal = np.square(L).sum(axis=0)
    white = [ratio_by_blocks(time, L * rng.standard_normal((n, 1)), nominal) for _ in range(200)]
    assert np.mean([found.max() > 1.0 for found in white]) < 0.03
    drawn = 0.3 * np.repeat(rng.standard_normal(16), n // 16)[:, None]
    placed = L * (rng.standard_normal((n, 1)) + n * L[:, 1:] * drawn)
    found = ratio_by_blocks(time, placed, nominal)
    variance = nominal[1] + float((drawn[:: n // 16] ** 2).sum()) / 16**2
    assert found[1] == pytest.approx((variance / nominal[1]) ** 0.5, rel=0.3)
    assert found[1] > 3.0
    assert (ratio_by_blocks(time[:20], placed[:20], nominal) == 1.0).all()


def test_correlated_residuals_of_one_family_leave_what_another_determines() -> None:
    """Accelerometer and magnetometer are not tied: correlated field readings widen nothing but the magnetometer's."""
    case = dense("tumble with gyro")
    reported = case.reported
    found = reported.root(case.factorization.root)
    influence = Influence.of(case.posterior)
    families = {g.family for g in case.linearization.groups if g.is_measurement}
    noise = ColouredNoise(share=1.0, length=-1.0 / np.log(0.8), variance=1.0, fall=np.inf)
    added = {family: np.diag(added_covariance(influence, {family: noise})[family]) for family in families}
    names = list(influence.names)
    budget = error_budget(influence, {}, reported.covariance(found.covariance()))
    for family, more in added.items():
        for name, variance in zip(names, more, strict=True):
            # A family adds at most 2 sum of the correlation times what it has in the variance.
            own = budget[name].get(family, 0.0) * found.covariance()[names.index(name), names.index(name)]
            own *= reported.scale[names.index(name)] ** 2
            assert variance <= (noise.together - 1.0) * own * (1.0 + 1e-6) + 1e-30


@dataclass(frozen=True, eq=False)
class Drawn:
    """A model with residuals of its own."""

    model: Model
    residuals: Array

    def __call__(self, *blocks: Array) -> Residuals:
        return self.residuals, self.model(*blocks)[1]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)


def with_a_part_rejected(name: str, family: str, residuals: Array | None = None) -> tuple[Influence, Group, Mask]:
    """Influence where a random 30 % of a family do not count, its group, and which do; residuals may be drawn."""
    case, groups = dense(name), []
    for each in case.linearization.groups:
        if each.family == family:
            used = np.random.default_rng(3).random(len(each.model.time)) > 0.3
            # As where the rest is, whose influences these are; what is rejected lies far off.
            model: Any = each.model if residuals is None else Drawn(each.model, np.where(used[:, None], residuals, 1e3))
            each = replace(each.counting(used), weights=None, model=model)
            found = each, used
        groups.append(each)
    point = Point.of(case.linearization.with_groups(groups), case.values)
    return Influence.of(replace(case.posterior, at=point)), *found


def test_added_variance_is_that_of_drawn_noise() -> None:
    """Autocorrelated noise through the influence of the measurements that count has the variance that is said."""
    noise = ColouredNoise(share=0.7, length=5.0, variance=1.5, fall=np.inf)
    influence, group, used = with_a_part_rejected("head", "vision")
    added, reported = added_covariance(influence, {"vision": noise})["vision"], influence.reported
    L = influence.rows(group)[0][used]
    np.testing.assert_array_equal(noise.correlation, 0.7 * np.exp(-np.arange(1.0, 42.0) / 5.0))  # to e^-8 of the share
    g = 1.5 * toeplitz(np.concatenate([[1.0], noise.correlation, np.zeros(len(L) - 42)])) - np.eye(len(L))
    exact = np.einsum("irk,ij,jrm->km", L, g, L) / np.outer(reported.scale, reported.scale)
    variances, axes = np.linalg.eigh(exact)
    exact = (axes * np.maximum(variances, 0.0)) @ axes.T
    own = added / np.outer(reported.scale, reported.scale)
    np.testing.assert_allclose(own, exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max())


def test_noise_is_as_coloured_as_drawn_whatever_is_rejected() -> None:
    """Of an autoregression with white noise beside it, 30 % of which are left out at random.

    The lag between those that are left is geometric, so that they are one, too, with the same share and variance.
    """
    family, share, a, fits = "accelerometer", 0.7, np.exp(-1.0 / 5.0), []
    (group,) = [g for g in dense("tumble with gyro").linearization.groups if g.family == family]
    for seed in range(10):
        drawn = np.random.default_rng(seed).standard_normal((2, len(group.model.time) + 200, 3))
        colour = lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], drawn[0], axis=0)[200:]
        residuals = np.sqrt(share) * colour + np.sqrt(1.0 - share) * drawn[1, 200:]
        influence, part, used = with_a_part_rejected("tumble with gyro", family, 2.0**0.5 * residuals)
        absorbed = np.linalg.matrix_rank(influence.rows(part)[0].reshape(-1, len(influence.names)), 1e-9)
        squares = {family: (np.nan, 3.0 * float(used.sum()) - float(absorbed))}
        fits.append(coloured_noises(influence, {family: np.empty(0)}, squares)[family])
    b = 0.7 * a / (1.0 - 0.3 * a)
    assert np.median([fit.share for fit in fits]) == pytest.approx(share, rel=0.05)
    assert np.median([fit.together for fit in fits]) == pytest.approx(1.0 + 2.0 * share * b / (1.0 - b), rel=0.1)
    assert np.median([fit.variance for fit in fits]) == pytest.approx(2.0, abs=0.06)


@pytest.mark.parametrize(("share", "length"), [(1.0, 5.0), (0.7, 5.0)])
def test_noise_is_as_coloured_as_drawn_whatever_a_fit_absorbs(share: float, length: float) -> None:
    """Nine numbers of slow motion hide half of the correlation length of 270 residuals."""
    rng, n = np.random.default_rng(0), 270
    phase = np.linspace(0.0, 2.0 * np.pi, n)
    slow = np.stack([np.ones(n), *(f(k * phase) for k in range(1, 5) for f in (np.sin, np.cos))], axis=1)
    basis = np.linalg.qr(slow)[0]
    a = np.exp(-1.0 / length)
    fits, naive, white = [], [], []
    for _ in range(25):
        drawn = rng.standard_normal((2, n + 200))
        colour = lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], drawn[0])[200:]
        noise = np.sqrt(share) * colour + np.sqrt(1.0 - share) * drawn[1, 200:]
        coloured, plain = ((each - basis @ (basis.T @ each))[:, None] for each in (noise, drawn[1, :n]))
        # In units in which the noise drawn has a variance of 2: what lies below the weights' is not found.
        fits.append(ColouredNoise.fitted(2.0**0.5 * coloured, basis[:, None], n - basis.shape[1], 1.0))
        naive.append(1.0 + 2.0 * float(autocorrelation(coloured).sum()))
        white.append(ColouredNoise.fitted(plain, basis[:, None], n - basis.shape[1], 1.0).fall)
    true = 1.0 + 2.0 * share * a / (1.0 - a)
    assert np.median([fit.together for fit in fits]) == pytest.approx(true, rel=0.2)
    assert np.mean(naive) < 0.65 * true
    assert np.median([fit.variance for fit in fits]) == pytest.approx(2.0, abs=0.3)
    assert np.max(white) < quantile(0.999, 2)


@pytest.mark.parametrize("name", ["los", "tumble with gyro"])
def test_correlation_adds_to_what_its_family_causes(name: str) -> None:
    """Of a filter by the shares that families have of the covariance; its noises and its priors cause all of it."""
    posterior, influence = dense(name).posterior, Influence.of(dense(name).posterior)
    shares, directions = variance_shares(posterior), posterior.directions
    rest = np.eye(len(directions.sigmas)) - sum(shares.values(), np.zeros(2 * directions.sigmas.shape))
    assert np.linalg.eigvalsh(rest).min() > -1e-6
    unit, correlated = np.outer(posterior.reported.scale, posterior.reported.scale), sorted(shares)[0]
    L = np.concatenate([influence.rows(g)[0] for g in posterior.at.engine.groups if g.family == correlated])
    caused = np.einsum("nri,nrj->ij", L, L) / unit
    for factor in (1.0, 0.25):  # at the time of the shares, and later
        later = replace(directions, sigmas=factor**0.5 * directions.sigmas)
        more = added_by_shares(later, shares, {correlated: 9.0})
        np.testing.assert_allclose(more, 8.0 * factor * caused, atol=1e-6 * np.abs(caused).max())
    assert not added_by_shares(directions, shares, {}).any()
