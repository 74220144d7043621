"""Prior conflicts: a nuisance parameter far beyond its prior makes a calibration inconsistent where that matters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import alidade
from alidade.factors.array import Array
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.stated_priors import with_conflicts
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.parameters import prior_z_score, quantities
from alidade.pipelines.estimation.problem import Estimate, Quantity
from alidade.pipelines.methods.head.parameters import VISION_FILTER
from alidade.pipelines.reports.sentences import headline, sentence

HEAD = {"duration_s": 40.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0}


def assumption(name: str, prior: float = 1e-2) -> Quantity:
    return Quantity(name, "", prior, prior, np.inf, group="assumption")


def estimate(values: list[float], sigmas: list[float], correlation: float = 0.0) -> Estimate:
    rho = np.full((len(values), len(values)), correlation)
    np.fill_diagonal(rho, 1.0)
    covariance = rho * np.outer(sigmas, sigmas)
    return Estimate("batch", tuple("abc"[: len(values)]), np.array(values), covariance, True, "")


REQUIRED = Quantity("angle", "rad", 1.0, 1.0, 0.01)


def conflicts(found: Estimate, quantities: list[Quantity]) -> list[Finding]:
    return [finding for finding in diagnose(found, quantities) if finding.kind == "prior_conflict"]


def test_z_scores_beyond_four_are_named_the_worst_first() -> None:
    quantities = [assumption("a"), assumption("b"), assumption("c")]
    found = conflicts(estimate([0.05, 0.08, 0.02], [1e-3, 1e-3, 1e-3]), quantities)
    assert [each.evidence["parameter"] for each in found] == ["b", "a"]
    assert found[0].evidence["z"] > 7.9


def test_what_the_recording_does_not_determine_is_no_conflict() -> None:
    assert conflicts(estimate([0.1], [9.9e-3]), [assumption("a")]) == []


def test_inseparable_nuisance_parameters_are_one_conflict() -> None:
    found = conflicts(estimate([0.05, 0.06], [1e-3, 1e-3], 0.95), [assumption("a"), assumption("b")])
    assert [(each.evidence["parameter"], each.evidence["inseparable"]) for each in found] == [("b", ("a",))]


@pytest.mark.parametrize(
    ("correlation", "sigma", "severity"),
    [
        (0.5, 1e-3, Severity.INCONSISTENT),  # moves the angle by half of 2 sigma, times 80 sigmas of the scale
        (0.05, 1e-3, Severity.NOTE),  # by .004 of .01: immaterial
        (0.5, 7.5e-3, Severity.NOTE),  # the recording adds little to the prior
    ],
)
def test_conflict_counts_where_determined_and_material(correlation: float, sigma: float, severity: Severity) -> None:
    """likelihood.md's rule: posterior sigma below .7 of the prior's, effect above half of the requirement."""
    value = 0.08 if sigma < 5e-3 else 0.06
    (found,) = conflicts(estimate([0.0, value], [1e-3, sigma], correlation), [REQUIRED, assumption("b")])
    assert found.severity == severity
    shift = correlation * 1e-3 / sigma * value
    assert found.evidence["effect"]["angle"] == pytest.approx(shift)


def test_slow_errors_of_a_nuisance_parameter_leave_its_effect_as_it_is() -> None:
    """The sandwich widens each number by itself: eight times the sigma of a clock once hid what its skew does."""
    plain, widened = estimate([0.0, 0.08], [1e-3, 1e-3], 0.5), np.array([1.0, 4.0])
    slow = replace(plain, covariance=plain.covariance * np.outer(widened, widened), sandwich=widened)
    (found,) = conflicts(slow, [REQUIRED, assumption("b")])
    assert found.evidence["effect"]["angle"] == pytest.approx(0.04)


def test_a_calibrated_parameter_far_from_its_prior_is_a_note() -> None:
    mount = Quantity("mount", "rad", 0.1, 0.1, 1e-2)
    (found,) = conflicts(estimate([1.5], [1e-3]), [mount])
    assert found.severity == Severity.NOTE
    assert found.evidence["z"] == pytest.approx(15.0)


@pytest.mark.slow
def test_a_gyro_scale_far_beyond_its_data_sheet_is_inconsistent_and_named_first() -> None:
    """Left out of the graph, a scale of 5 % once ended calibrated with mounts 8 sigmas off."""
    data, _ = alidade.simulate("head", HEAD, seed=2)
    gyro = data.head_gyro * [1.06, 1.0, 1.0]
    opened = {**vars(data), "head_gyro": gyro}
    coarse = alidade.open(opened, method="head").calibrate(report=False)
    assert coarse.status == "calibrated"  # helmet_mount_z is moved by 3.3 mrad, 10 are required
    assert any("gyro_scale_x contradicts its data sheet: " in note for note in coarse.notes)
    fine = alidade.Config.model_validate({"require": {f"helmet_mount_{axis}": 3e-3 for axis in "xyz"}})
    wrong = alidade.open(opened, method="head", config=fine).calibrate(report=False)
    assert wrong.status == "inconsistent"
    assert wrong.findings[0].kind == "prior_conflict"
    assert wrong.findings[0].evidence["parameter"] == "gyro_scale_x"
    bad_sheet = alidade.Config.model_validate({"sensors": {"gyro": {"scale": 0.06, "skew": 0.02}}})
    right = alidade.open({**vars(data), "head_gyro": gyro}, method="head", config=bad_sheet).calibrate(report=False)
    assert right.status != "inconsistent"
    scale = right.parameters["gyro_scale_x"]
    assert abs(scale.value - 0.06) < 4.0 * scale.sigma


def test_slow_errors_neither_hide_a_departure_nor_make_one() -> None:
    """Of white noise 5e-3 of a prior of 1e-2 is determined, though its sandwich is 1.6e-2, beyond the prior."""
    slow = replace(estimate([0.16], [1.6e-2]), sandwich=np.array([3.2]))
    (found,) = conflicts(slow, [assumption("a")])
    by_itself = (1e-2 - 5e-3**2 / 1e-2) ** 2  # p, s0 and V of `prior_z_score`
    elsewhere = 1.6e-2**2 - (5e-3**2 / 1e-2) ** 2
    assert found.evidence["z"] == pytest.approx(0.16 / np.sqrt(by_itself + elsewhere))
    # Of a sigma near the prior's the shift has that of the slow errors, not next to none.
    near = replace(estimate([0.03], [9e-3]), sandwich=np.array([1.8]))
    assert conflicts(near, [assumption("a")]) == []


def test_a_departure_where_the_model_is_not_valid_is_judged_by_where_it_is() -> None:
    """However wide the prior: what the recording leaves unknown counts as without it."""
    (q,) = quantities(VISION_FILTER, load_config(b"sensors: {camera: {filter: 3.0e-4}}"))
    assert prior_z_score(q, -6e-5, 4.9e-5) == pytest.approx(-0.87, abs=0.02)
    assert prior_z_score(q, -1e-3, 5.5e-5) == pytest.approx(-13.6, abs=0.2)
    assert prior_z_score(q, 2.8e-4, 1e-5) == pytest.approx(0.93, abs=0.02)


@pytest.mark.parametrize("config", ["{}", "{sensors: {camera: {filter: 3.0e-4}}}", "{priors: {vision_filter: 3.0e-4}}"])
def test_no_sheet_of_vision_allows_for_a_gyro_that_is_low_passed_more(config: str) -> None:
    """BROAD 21 behind 5 Hz, with the line that was advised, was `calibrated` with its mount 1.2 deg off."""
    of = [REQUIRED, *quantities(VISION_FILTER, load_config(config.encode()))]
    gyro, vision = (estimate([0.0, value], [2e-3, 1e-5], 0.3) for value in (-2.8e-4, 2.8e-4))
    (found,) = conflicts(gyro, of)
    assert found.severity == Severity.INCONSISTENT
    assert found.evidence["z"] == pytest.approx(-5.6, abs=0.2)
    named = {q.name: q for q in of}
    renamed = replace(found, evidence={**found.evidence, "parameter": "vision_filter"})
    assert "prior 0 ± 0.000050 s^2" in sentence(renamed, named)
    advice = headline([renamed], named, {})
    assert "A negative vision_filter suggests a gyro that is low-passed more than vision" in advice
    assert "state it" not in advice
    assert bool(conflicts(vision, of)) is (config == "{}")


def linear(truth: list[float], rows: Array, priors: list[float]) -> tuple[Estimate, list[Quantity]]:
    """Posterior of an angle, required, and of nuisance parameters by rows of unit noise, here without any."""
    prior = np.diag(np.array(priors) ** -2.0)
    P: Array = np.asarray(np.linalg.inv(rows.T @ rows + prior), dtype=float)
    values = P @ rows.T @ rows @ truth
    own = [
        REQUIRED,
        *(replace(assumption(name, p), sheet="accel.cube") for name, p in zip("ab", priors[1:], strict=True)),
    ]
    return Estimate("batch", ("angle", "a", "b"), values, P, True, ""), own


def test_what_an_immaterial_conflict_costs_is_in_the_sigmas() -> None:
    """The angle is drawn by 8 of its sigmas; what the data sheet says of a it says of b, which no row determines."""
    rows = np.array([[1e4, 60.0, 90.0], [0.0, 90.0, 0.0]])
    found, quantities = linear([1e-3, 0.1, 0.1], rows, [1.0, 1e-2, 1e-2])
    own = conflicts(found, quantities)
    assert [(each.evidence["parameter"], each.severity) for each in own] == [("a", Severity.NOTE)]
    assert abs(found.values[0] - 1e-3) > 6.0 * found.sigmas[0]
    wide = with_conflicts(found, quantities, own)
    assert np.abs((wide.values - [1e-3, 0.1, 0.1]) / wide.sigmas).max() < 2.0
    np.testing.assert_array_equal(wide.values, found.values)
    kept = [finding for finding in diagnose(wide, quantities, conflicts=own) if finding.kind == "prior_conflict"]
    assert kept == own
    assert with_conflicts(found, quantities, []) is found


def test_a_figure_that_no_row_determines_is_named() -> None:
    """An error of it is the angle's, and nothing contradicts it."""
    found, quantities = linear([1e-3, 0.0, 0.1], np.array([[1e4, 0.0, 90.0], [0.0, 1e4, 0.0]]), [1.0, 1e-2, 1e-2])
    assert abs(found.values[0] - 1e-3) > 6.0 * found.sigmas[0]
    (note,) = (finding for finding in diagnose(found, quantities) if finding.kind == "dominant_prior")
    assert note.severity == Severity.NOTE
    assert note.evidence["figure"] == "accel.cube"
    assert note.evidence["share"] > 0.4
    assert "check sensors.accel.cube (now 0.01)" in sentence(note, {})
    found, quantities = linear(
        [1e-3, 0.0, 0.0], np.array([[1e4, 0.0, 90.0], [0.0, 1e4, 0.0], [0.0, 0.0, 1e3]]), [1.0, 1e-2, 1e-2]
    )
    assert not [finding for finding in diagnose(found, quantities) if finding.kind == "dominant_prior"]


def test_conflict_comes_before_the_noise_that_hides_it() -> None:
    """Of a gyro that feels force the noise took most: the conflict was a note, and only the noise was named."""
    quantities = [REQUIRED, replace(assumption("a"), sheet="gyro.g_sensitivity")]
    level = Level(Noise("gyro_density", 1e-4, "config", 0.1, ("gyro",)), 20.0, 20.0, 2.0)
    noisy = replace(estimate([0.0, 0.02], [1e-3, 9e-3]), names=("angle", "a"), levels=(level,))
    findings = diagnose(noisy, quantities)
    assert [f.kind for f in findings if f.severity == Severity.INCONSISTENT] == ["prior_conflict", "noise"]
    named = {q.name: q for q in quantities}
    # 4.6 times the prior, which drew it to .02.
    assert "gyro: {g_sensitivity: 0.05}" in headline(findings, named, {})
    calm = diagnose(replace(noisy, levels=()), quantities)
    assert all(f.severity == Severity.NOTE for f in calm)
