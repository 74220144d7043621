"""Spectrum of innovations against the model's, and the warning of errors that no noise explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import alidade
from alidade.factors.chi_square import interval
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.plots import common_plots, power_spectrum
from alidade.pipelines.reports.sentences import headline, short_verdict
from tests.support.builders import make_calibration


@pytest.mark.parametrize("n", [150, 3000])
def test_spectrum_of_white_noise_is_within_its_band(n: int) -> None:
    beyond = []
    for seed in range(40):
        rows = np.random.default_rng(seed).standard_normal((n, 3))
        frequency, power, dof = power_spectrum(0.05, rows)
        assert frequency[0] > 0.0
        assert frequency[-1] <= 10.0
        ratios = np.array([interval(0.99, each) for each in dof])
        beyond.append((power * ratios[:, :1] > 1.0) | (power * ratios[:, 1:] < 1.0))
    assert 0.002 < np.mean(np.concatenate(beyond)) < 0.025


def test_spectrum_shows_a_slow_error() -> None:
    rng = np.random.default_rng(1)
    slow = np.cumsum(0.1 * rng.standard_normal((3000, 3)), axis=0)
    _, power, dof = power_spectrum(0.05, rng.standard_normal((3000, 3)) + slow)
    assert (power[0] > 3.0 * interval(0.99, dof[0])[1]).all()
    assert (power[-1] < 1.2).all()


def test_report_of_head_has_the_spectrum_of_vision() -> None:
    calibration = alidade.open(
        alidade.simulate("head", {"duration_s": 8.0, "gyro_rate_hz": 50.0, "vision_rate_hz": 20.0})
    ).calibrate()
    assert "Spectrum of vision" in [plot.title for plot in common_plots(calibration)]
    e = calibration.estimate.innovations["vision"].whitened
    assert abs((e**2).mean() - 1.0) < 5.0 * (2.0 / e.size) ** 0.5


def test_slow_errors_that_double_sigmas_are_a_warning() -> None:
    """In the headline, in the report's verdict and among its badges; below that a note alone."""
    for ratio, warned in ((1.5, False), (2.5, True)):
        found = [Finding("slow_error", Severity.NOTE, {"parameter": "helmet_mount_z", "ratio": ratio})]
        assert ("Warning: sigmas × 2.5" in headline(found, {}, {})) == warned
        assert ("Warning: sigmas × 2.5" in short_verdict(found, {}, {}, "")[0]) == warned
        page = report_html(replace(make_calibration(), findings=tuple(found)))
        assert ("sigmas × 2.5 for slow errors" in page) == warned
