"""A misfit is never taken for noise without the word: corners that scatter, families of which most is rejected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.pipelines.diagnostics import hypothesis_tests
from alidade.pipelines.diagnostics.cross_validation import TrialFit
from alidade.pipelines.diagnostics.diagnose import diagnose, is_suspect
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.problem import ChiSquare, Residuals
from alidade.pipelines.noises import NOISES
from tests.support.builders import make_calibration


@pytest.mark.parametrize(("noise", "most"), [("corner_px", 5.0), ("vision_attitude", 7.0), ("gyro_density", 60.0)])
@pytest.mark.parametrize(
    ("share", "severities"),
    [(0.4, []), (0.9, [Severity.NOTE]), (1.1, [Severity.INCONSISTENT])],
    ids=["less", "note", "more"],
)
def test_what_scatters_by_many_times_its_default_does_not_fit(
    noise: str, most: float, share: float, severities: list[Severity]
) -> None:
    calibration = make_calibration()
    scale = share * most
    level = Level(Noise(noise, NOISES[noise].default or 0.0, "default", 1.0, ("tags",)), scale, scale, 0.1)
    estimate = replace(calibration.estimate, levels=(level,))
    findings = diagnose(estimate, calibration.problem.quantities)
    found = [each for each in findings if each.kind == "noise"]
    assert [each.severity for each in found] == severities
    assert all(each.evidence["noise"] == noise for each in found)
    assert is_suspect(estimate, findings, calibration.problem.quantities) is (share > 1.0)


@pytest.mark.parametrize(("count", "rejected", "told"), [(6, 4, True), (6, 3, False), (3, 3, False), (20, 4, False)])
def test_most_of_a_small_family_rejected_is_told(count: int, rejected: int, told: bool) -> None:
    calibration = make_calibration()
    used = np.arange(count) >= rejected
    family = Residuals(np.arange(float(count)), np.ones((count, 3)), used)
    estimate = replace(calibration.estimate, residuals={"tags": family})
    findings = diagnose(estimate, calibration.problem.quantities)
    found = [each for each in findings if each.kind == "rejection"]
    assert [each.severity for each in found if each.severity > Severity.NOTE] == told * [Severity.INCONSISTENT]
    judged = replace(calibration, findings=findings, estimate=estimate)
    assert "observable" in calibration.verdicts.values()
    assert ("observable" not in judged.verdicts.values()) is told
    assert ("weak" in judged.verdicts.values()) is told
    joined = Finding("recording", Severity.INCONSISTENT, {"recording": "a.mcap", "findings": findings})
    assert replace(judged, findings=(joined,)).verdicts == judged.verdicts


@pytest.mark.parametrize(
    ("left", "grown", "explains"),
    [
        (1.0, 1.0, True),
        (1.0, 57.3, True),
        (0.1, 57.3, True),
        (0.05, 57.3, False),
        (0.01, 1.0, True),
        (9.0, 1.0, True),
        (11.0, 1.0, False),
        (200.0, 1.0, False),
    ],
)
def test_what_leaves_chi_square_far_from_its_freedom_is_no_explanation(
    left: float, grown: float, explains: bool
) -> None:
    """Far below it where the correction enlarges the noise; where it does not, the noise was stated too large."""

    def fit(chi_square: float, density: float) -> TrialFit:
        level = Level(Noise("gyro_density", density, "default", 1.0, ("gyro",)))
        estimate = replace(make_calibration().estimate, levels=(level,))
        return TrialFit((), estimate, ChiSquare(chi_square, 1000, {}), 0.0, 1000.0)

    assert hypothesis_tests._explains(fit(1e6, 5e-5), fit(1e3 * left, 5e-5 * grown)) is explains


@pytest.mark.parametrize(("share", "severities"), [(0.6, [Severity.NOTE]), (0.8, [Severity.INCONSISTENT])])
def test_noises_of_the_same_measurements_are_judged_together(share: float, severities: list[Severity]) -> None:
    """Neither is beyond what is no noise, and both are by the root of the sum of squares."""
    calibration = make_calibration()
    white = Noise("gyro_density", 5e-5, "default", 1.0, ("gyro",), no_noise=0.01)
    by_rate = Noise("gyro_rate_noise", 5e-5, "default", 1.0, ("gyro",), beside=True, no_noise=0.02)
    levels = Level(white, 0.99 * share * 0.01 / 5e-5), Level(by_rate, share * 0.02 / 5e-5)
    findings = diagnose(replace(calibration.estimate, levels=levels), calibration.problem.quantities)
    found = [each for each in findings if each.kind == "noise"]
    assert [(each.evidence["noise"], each.severity) for each in found] == [("gyro_rate_noise", s) for s in severities]
