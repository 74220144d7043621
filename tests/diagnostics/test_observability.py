"""Verdicts per parameter and direction, and consistency."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from alidade.pipelines.diagnostics.goodness_of_fit import Fit, InnovationTest
from alidade.pipelines.diagnostics.observability import time_to_accuracy
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.problem import ChiSquare, History, Quantity, Residuals
from tests.support.judged import Judged, judge

GOOD_FIT = ChiSquare(1000.0, 1000.0, {"vision": (1000.0, 1000.0)})


def quantity(name: str, prior: float | None = 1.0, require: float = 0.1, scale: float = 1.0) -> Quantity:
    return Quantity(name, "rad", prior, scale, require)


def judged(quantities: list[Quantity], covariance: np.ndarray, chi: ChiSquare | None = GOOD_FIT) -> Judged:
    return judge(quantities, covariance, chi, None)


@pytest.mark.parametrize(
    ("prior", "require", "sigma", "verdict"),
    [
        (0.0, 0.1, 0.0, "fixed"),
        (0.0, 0.1, 5.0, "fixed"),
        (1.0, 0.1, 0.05, "observable"),
        (1.0, 0.1, 0.1, "observable"),
        (0.1, 0.1, 0.0899, "observable"),
        (0.1, 0.1, 0.0901, "prior"),
        (0.05, 0.1, 0.05, "prior"),
        (1.0, 0.1, 0.1001, "weak"),
        (1.0, 0.1, 0.899, "weak"),
        (1.0, 0.1, 0.901, "unobservable"),
        (None, 0.1, 0.05, "observable"),
        (None, 0.1, 0.5, "weak"),  # a free one is measured by the default prior, here 1
        (None, 0.1, 1e4, "unobservable"),
    ],
)
def test_verdicts_follow_the_contract(prior: float | None, require: float, sigma: float, verdict: str) -> None:
    found = judged([quantity("a", prior, require)], np.array([[sigma**2]]))
    assert found.verdicts == {"a": verdict}
    status = verdict if verdict in ("weak", "unobservable") else "calibrated"
    assert found.status == status
    assert [d.severity.name.lower() for d in found.directions] == ([status] if status != "calibrated" else [])


def test_gauge_is_named_where_no_single_parameter_is_unobservable() -> None:
    """Only pz - gz is measured: each parameter alone looks weak, together they have a null direction."""
    prior = 0.1
    information = np.eye(2) / prior**2 + 1e8 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    quantities = [quantity("delta_pz", prior, 1e-3), quantity("delta_gz", prior, 1e-3)]
    found = judged(quantities, np.linalg.inv(information))
    assert set(found.verdicts.values()) == {"weak"}
    assert found.status == "unobservable"
    (direction,) = found.directions
    assert direction.evidence["sigma_ratio"] == pytest.approx(1.0, abs=1e-4)
    half = np.sqrt(0.5)
    assert direction.evidence["weights"] == pytest.approx({"delta_pz": half, "delta_gz": half}, abs=1e-3)
    assert "delta_pz" in found.headline
    assert "delta_gz" in found.headline


def test_direction_held_by_priors_tight_enough_is_no_complaint() -> None:
    """Heading and mount of the cube: only their sum counts, and both priors are within what is required."""
    information = np.diag([1.0 / 1e-2**2, 1.0 / 5e-3**2]) + 1e10 * np.ones((2, 2))
    quantities = [quantity("reference_heading", 1e-2, 1e-2), quantity("camera_mount_z", 5e-3, 1e-2)]
    found = judged(quantities, np.linalg.inv(information))
    assert found.status == "calibrated"
    assert found.directions == ()


def test_directions_of_equal_sigma_are_untangled() -> None:
    """Three camera axes against three helmet axes: eigenvectors of a threefold eigenvalue are arbitrary mixtures."""
    rng = np.random.default_rng(1)
    mixed = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    null = np.vstack([mixed, -mixed]) / np.sqrt(2.0)
    rest = np.eye(6) - null @ null.T
    covariance = null @ null.T + 1e-6 * rest
    names = [f"{mount}_{axis}" for mount in ("camera", "helmet") for axis in "xyz"]
    found = judged([quantity(name) for name in names], covariance)
    assert {frozenset(d.evidence["weights"]) for d in found.directions} == {
        frozenset({f"camera_{axis}", f"helmet_{axis}"}) for axis in "xyz"
    }


@pytest.mark.parametrize("seed", range(20))
def test_a_direction_is_blamed_exactly_when_a_parameter_is_not_good_enough(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    scale = 10.0 ** rng.uniform(-4, 1, n)
    root = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-4, 0, n)
    covariance = np.outer(scale, scale) * (root @ root.T)
    quantities = [quantity(f"p{i}", None, float(s * 10.0 ** rng.uniform(-3, 0)), float(s)) for i, s in enumerate(scale)]
    found = judged(quantities, covariance)
    short = [name for name, verdict in found.verdicts.items() if verdict in ("weak", "unobservable")]
    assert bool(found.directions) == bool(short)
    for direction in found.directions:
        norm = np.linalg.norm(list(direction.evidence["weights"].values()))
        assert 0.9 < norm <= 1.0 + 1e-9
        assert set(direction.evidence["weights"]) & set(short)
        assert min(abs(w) for w in direction.evidence["weights"].values()) >= 0.1
    ratios = [d.evidence["sigma_ratio"] for d in found.directions]
    assert all(b <= a / 0.9 for a, b in pairwise(ratios))


def test_fixed_parameters_take_no_part() -> None:
    covariance = np.array([[0.0025, 3.0], [3.0, 9.0]])
    found = judged([quantity("a"), quantity("b", 0.0)], covariance)
    assert found.verdicts == {"a": "observable", "b": "fixed"}
    assert found.status == "calibrated"
    assert found.sigmas[1] == 0.0
    assert found.covariance[0, 1] == 0.0


@pytest.mark.parametrize(
    "covariance",
    [
        np.full((2, 2), np.nan),
        np.diag([np.inf, 1e-4]),
        np.array([[1e-4, np.nan], [np.nan, 1e-4]]),
        np.diag([-1.0, 1e-4]),
        np.ones((2, 2)),
        np.zeros((2, 2)),
        np.diag([1e12, 1e-30]),
    ],
)
def test_singular_or_broken_input_gives_a_verdict_and_finite_numbers(covariance: np.ndarray) -> None:
    found = judged([quantity("a"), quantity("b")], covariance)
    assert np.isfinite(found.covariance).all()
    assert np.isfinite(found.sigmas).all()
    evidence = [d.evidence for d in found.directions]
    assert all(np.isfinite([e["sigma_ratio"], *e["weights"].values()]).all() for e in evidence)
    if not np.isfinite(covariance[0, 0]) or covariance[0, 0] < 0.0:
        assert found.verdicts["a"] == "unobservable"


def test_nothing_to_judge() -> None:
    assert judged([], np.zeros((0, 0))).status == "calibrated"
    assert judged([quantity("a", 0.0)], np.zeros((1, 1))).directions == ()


def test_advice_is_the_methods_own_and_gets_the_weights() -> None:
    seen = []

    def advice(weights: object) -> Motion:
        seen.append(weights)
        return Motion("nod")

    found = judge([quantity("a")], np.eye(1), GOOD_FIT, advice)
    assert found.directions[0].evidence["advice"] == "nod"
    assert seen == [{"a": 1.0}]
    assert "Nod." in found.headline
    assert judge([quantity("a")], np.eye(1), GOOD_FIT, None).directions[0].evidence["advice"]


@pytest.mark.parametrize("dof", [30.0, 300.0, 5000.0, 1e5])
def test_bounds_are_the_99_9_percent_interval(dof: float) -> None:
    fit = Fit.of(dof, dof)
    assert fit.low == pytest.approx(stats.chi2.ppf(0.0005, dof), rel=0.01)
    assert fit.high == pytest.approx(stats.chi2.ppf(0.9995, dof), rel=0.01)


def test_too_small_noise_is_inconsistent_and_names_the_worst_family() -> None:
    chi = ChiSquare(26000.0, 2000.0, {"gyro": (1000.0, 1000.0), "vision": (25000.0, 1000.0)})
    found = judged([quantity("a")], 1e-4 * np.eye(1), chi)
    assert found.status == "inconsistent"
    (misfit,) = found.findings
    assert misfit.evidence["largest"] == "vision"
    assert misfit.evidence["noise_factor"] == pytest.approx(5.0)


def test_too_large_noise_is_a_note_only() -> None:
    chi = ChiSquare(1040.0, 2000.0, {"gyro": (1000.0, 1000.0), "vision": (40.0, 1000.0)})
    found = judged([quantity("a")], 1e-4 * np.eye(1), chi)
    assert found.status == "calibrated"
    (misfit,) = found.findings
    assert misfit.kind == "misfit"
    assert misfit.evidence["largest"] == "vision"
    assert misfit.evidence["noise_factor"] == pytest.approx(0.2)


@pytest.mark.parametrize(("sigma", "status"), [(0.05, "inconsistent"), (0.5, "inconsistent"), (0.95, "unobservable")])
def test_status_is_the_first_that_applies(sigma: float, status: str) -> None:
    bad = ChiSquare(2000.0, 1000.0, {})
    assert judged([quantity("a")], np.array([[sigma**2]]), bad).status == status


def test_no_chi_square_and_no_redundancy_are_no_inconsistency() -> None:
    assert judged([quantity("a")], 1e-4 * np.eye(1), None).findings == ()
    assert judged([quantity("a")], 1e-4 * np.eye(1), ChiSquare(1e-9, 0.0, {})).findings == ()


def test_a_family_with_less_than_one_degree_of_freedom_has_no_interval() -> None:
    walk = Fit.of(0.5, 0.03)
    assert np.isnan([walk.low, walk.high]).all()
    chi = ChiSquare(1000.5, 1000.5, {"vision": (1000.0, 1000.0), "bias walk": (0.5, 0.03)})
    assert judged([quantity("a")], 1e-4 * np.eye(1), chi).findings == ()


def test_chi_square_that_is_no_number_is_inconsistent() -> None:
    found = judged([quantity("a")], 1e-4 * np.eye(1), replace(GOOD_FIT, value=float("nan")))
    assert found.status == "inconsistent"


def test_calibrated_by_prior_alone_says_so() -> None:
    found = judged([quantity("a"), quantity("b", 0.05)], np.diag([1e-4, 0.05**2]))
    assert found.status == "calibrated"
    assert "b by prior alone" in found.headline


@pytest.mark.parametrize("seed", range(5))
def test_white_innovations_pass_and_correlated_ones_do_not(seed: int) -> None:
    rows = np.random.default_rng(seed).standard_normal((2000, 3))
    time, used = np.arange(2000.0), np.ones(2000, dtype=bool)
    white = InnovationTest.of(Residuals(time, rows, used))
    assert white is not None
    assert max(map(abs, white.autocorrelation)) <= white.bound
    assert white.low < white.nis < white.high
    coloured = InnovationTest.of(Residuals(time, rows + 0.5 * np.roll(rows, 1, axis=0), used))
    assert coloured is not None
    assert coloured.autocorrelation[0] == pytest.approx(0.4, abs=0.05)  # 0.5 / (1 + 0.5^2)
    assert max(map(abs, coloured.autocorrelation)) > coloured.bound
    assert coloured.nis > coloured.high
    assert InnovationTest.of(Residuals(time[:5], rows[:5], used[:5])) is None


def test_time_to_accuracy_and_the_most_informative_tenth() -> None:
    """Information at a steady small rate, and at a hundred times that rate from 40 to 50 s."""
    time = np.linspace(0.0, 100.0, 501)
    information = 1.0 + 0.1 * time + 10.0 * np.clip(time - 40.0, 0.0, 10.0)
    sigmas = np.column_stack([information**-0.5, np.ones(501), np.zeros(501)])
    quantities = [quantity("a", require=0.2), quantity("b", require=0.2), quantity("c", 0.0)]
    found = time_to_accuracy(History(time, np.zeros((501, 3)), sigmas), ("a", "b", "c"), quantities)
    assert set(found) == {"a", "b"}
    assert found["a"].stretch == pytest.approx((40.0, 50.0))
    assert found["a"].share == pytest.approx(101.0 / 110.0)  # the prior's 1 is no information of the recording
    assert found["a"].met_s == pytest.approx(42.0, abs=0.5)  # 1 + 4 + 10 * 2 = 1 / 0.2^2
    assert found["b"].met_s is None


def test_prior_is_no_information_of_the_first_tenth() -> None:
    """Prior .05, and information that grows evenly: a tenth in each tenth."""
    time = np.linspace(0.0, 100.0, 501)
    sigmas = ((0.05**-2 + 10.0 * time) ** -0.5)[:, None]
    found = time_to_accuracy(History(time, np.zeros((501, 1)), sigmas), ("a",), [quantity("a", 0.05, 0.04)])
    assert found["a"].share == pytest.approx(0.1, abs=1e-6)
