"""Uncertainty in use: bands against Monte Carlo, and sensors against the formulas that undo them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import alidade
from alidade.pipelines.diagnostics.use import Applied, Line, Posterior, Truth, Use, coverage, use_bands
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.uses import posterior_of

SCENARIOS: dict[str, object] = {
    "tumble": None,
    "head": "head_mounts",
    "los": {"duration_s": 20.0},
    "cube": {"poses": 20},
    "indexer": {"gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0},
}
CASES = [pytest.param(name, marks=[pytest.mark.slow] * (name not in ("tumble", "head"))) for name in SCENARIOS]


@cache
def calibrated(name: str) -> Calibration:
    return alidade.calibrate(alidade.simulate(name, SCENARIOS[name], seed=1))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", CASES)
def test_bands_cover_95_percent_of_exact_errors_at_every_operating_point(name: str) -> None:
    """Truths drawn from the posterior, errors without linearising; 10,000 draws have a sigma of 0.22 %."""
    c = calibrated(name)
    posterior = posterior_of(c)
    assert c.uses
    for found in c.uses:
        for line, shares in coverage(found, posterior, 10_000, seed=7).items():
            known = shares[np.isfinite(shares)]
            assert len(known), (found.use.name, line)
            assert known.min() > 0.94, (found.use.name, line, known.min())
            assert known.max() < 0.96, (found.use.name, line, known.max())


@pytest.mark.parametrize("name", CASES)
def test_true_values_applied_leave_no_error(name: str) -> None:
    """Readings of a sensor with some parameters, through the formulas with the same ones."""
    c = calibrated(name)
    posterior = posterior_of(c)
    true = Truth(posterior.names, posterior.x)
    noise = {each.name: each.used for each in c.noises}
    for use in c.method.report.uses(true, c.config, noise):
        for line in use.lines:
            left = line.error(posterior.whole, true)
            before = line.error(posterior.nominal, true)
            # vision_scale and encoder delays are undone by no formula.
            share = 0.05 if name in ("head", "los") else 1e-6
            assert np.abs(left).max() <= share * np.abs(before).max(), (use.name, line.name)


def test_before_is_worse_than_after_and_actual_error_lies_within_the_bound() -> None:
    c = calibrated("tumble")
    (found,) = c.uses
    (band,) = found.bands.values()
    assert found.before > 50.0 * found.after
    assert band.actual is not None
    assert np.abs(band.actual - band.after).max() < 2.0 * band.bound.max()
    # The strength of the field is common to all of K and leaves the heading alone.
    assert band.uncorrelated.max() > 3.0 * band.bound.max()


class _Identity:
    values: Mapping[str, float] = {}

    def __call__(self, **measured: Array) -> Mapping[str, Array]:
        return measured


def _posterior(sigma: float) -> Posterior:
    one = _Identity()
    return Posterior(("a",), np.zeros(1), np.full((1, 1), sigma**2), np.ones(1), one, one, one)


def test_bounds_of_an_error_that_is_not_linear_are_quantiles_of_draws() -> None:
    def square(_: Applied, true: Truth) -> Array:
        a = true.get("a")[..., None]
        return np.stack([a + a**2, 0.0 * a], axis=-1)

    use = Use("", "", np.zeros(1), "", "", "", 1.0, (Line("a", square),), "", "", "")
    small, large = (use_bands(use, _posterior(sigma)) for sigma in (1e-3, 1.0))
    assert not small.drawn
    assert small.bands["a"].bound[0] == pytest.approx(1.96e-3, rel=0.01)
    assert large.drawn
    a = np.random.default_rng(5).standard_normal(200_000)
    assert large.bands["a"].bound[0] == pytest.approx(np.quantile(np.abs(a + a**2), 0.95), rel=0.05)


def test_noise_of_the_use_widens_the_band() -> None:
    def plain(_: Applied, true: Truth) -> Array:
        return true.get("a")[..., None, None] * np.ones((1, 1))

    line = Line("a", plain)
    use = Use("", "", np.zeros(1), "", "", "", 1.0, (line,), "", "", "")
    noisy = replace(use, lines=(replace(line, noise=np.array([3.0])),))
    assert use_bands(use, _posterior(1.0)).after == pytest.approx(1.96, rel=1e-3)
    assert use_bands(noisy, _posterior(1.0)).after == pytest.approx(2.0 * 1.96, rel=1e-3)


def test_a_device_that_warms_has_its_uses() -> None:
    """Formulas that need no temperature are applied without it."""
    settings = {"duration_s": 10.0, "temperature": {"start_c": 20.0, "rise_k": 10.0, "time_constant_s": 20.0}}
    c = alidade.calibrate(alidade.simulate("head", settings, seed=1))
    assert "first_temperature" in c.problem.constants
    assert [found.use.name for found in c.uses] == ["attitude", "outage"]
