"""Uncertainty in use: bands against Monte Carlo, and sensors against the formulas that undo them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Applied, Line, Posterior, Truth, Use, coverage, use_bands
from alidade.pipelines.methods.formula import input_kind, results
from alidade.pipelines.methods.triads import deviation_coefficients, triad_of
from alidade.pipelines.reports.result import Calibration, posterior_of

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


def test_an_undetermined_direction_is_off_by_half_a_turn_at_most() -> None:
    """A compass that was turned on the spot: linear bands before calibration are many turns wide."""
    c = alidade.calibrate(alidade.simulate("tumble", "tumble_car", seed=3))
    (heading,) = (found for found in c.uses if found.use.unit == "deg")
    assert 90.0 < heading.after <= heading.before == 180.0


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


def _smith(K: Array, b: Array, field: float, dip: float, h: Array) -> Array:
    """Deviation, rad, of a compass that reads K^-1 (field - b): Smith's exact formula; x fore, y starboard, z down."""
    down = np.diag([1.0, -1.0, -1.0])
    (a, s, c), (d, e, f), _ = (down @ np.linalg.inv(K) @ down - np.eye(3)).tolist()
    P, Q, _ = -down @ np.linalg.solve(K, b) / (field * np.cos(dip))
    A, D, E = (d - s) / 2.0, (a - e) / 2.0, (d + s) / 2.0
    B, C = c * np.tan(dip) + P, f * np.tan(dip) + Q
    lam = 1.0 + (a + e) / 2.0
    across = A + B * np.sin(h) + C * np.cos(h) + D * np.sin(2 * h) + E * np.cos(2 * h)
    along = lam + B * np.cos(h) - C * np.sin(h) + D * np.cos(2 * h) - E * np.sin(2 * h)
    return np.arctan2(across, along)


@pytest.mark.parametrize(
    "beside", [pytest.param({}, marks=pytest.mark.slow), {"gyro": {"rate_hz": 25.0, "mounting_deg": 4.0}}]
)
def test_deviation_coefficients_are_those_of_smiths_formula_integrated(beside: dict[str, object]) -> None:
    """Values by quadrature over 360 headings, sigmas by draws from the joint posterior; a gyro makes K whole."""
    scenario = {"attitudes": 15, "magnetometer": {"rate_hz": 20.0, "hard_iron": 1e-5}, **beside}
    c = alidade.calibrate(alidade.simulate("tumble", scenario, seed=1))
    found, posterior = c.uses[0], posterior_of(c)
    h = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    waves = np.stack([0.5 * np.ones_like(h), np.sin(h), np.cos(h), np.sin(2 * h), np.cos(2 * h)]) * 2.0 / len(h)

    def direct(x: Array, applied: Mapping[str, float] | None) -> Array:
        values = {**c.problem.constants, **dict(zip(posterior.names, x.tolist(), strict=True))}
        K, b = triad_of("mag", values)
        if applied is not None:  # K_a raw + b_a is the reading of a compass with K K_a^-1 and b - K K_a^-1 b_a
            K_a, b_a = triad_of("mag", applied)
            K = K @ np.linalg.inv(K_a)
            b = b - K @ b_a
        return np.degrees(waves @ _smith(K, b, values["field_strength"], values["field_dip"], h))

    assert found.coefficients is not None
    draws = np.random.default_rng(3).multivariate_normal(posterior.x, posterior.P, 4000, method="eigh")
    # Across the axes of a symmetric K nothing turns, so that A is 0 but for rounding before.
    shown = slice(0 if beside else 1, None)
    sizes = {}
    for when, applied in (("before", None), ("after", posterior.applied.values)):
        mean, sigma = (
            np.array([found.coefficients["level"][name][key] for name in "ABCDE"]) for key in (when, f"{when}_sigma")
        )
        assert mean == pytest.approx(direct(posterior.x, applied), abs=1e-3 if applied is None else 1e-6)
        assert sigma[shown] == pytest.approx(np.std([direct(x, applied) for x in draws], axis=0)[shown], rel=0.05)
        sizes[when] = np.abs(mean).max(), sigma.max()
    assert sizes["before"][0] > 5.0 > 50.0 * sizes["after"][1] > 50.0 * sizes["after"][0]


def test_deviation_of_a_compass_that_does_not_turn_has_no_coefficients() -> None:
    """Hard iron stronger than the horizontal field: the compass heading comes back without having turned once."""
    h = np.deg2rad(np.arange(0.0, 361.0, 5.0))
    weak, strong = (np.angle(np.exp(1j * h) + iron) - h for iron in (0.5, 1.5))
    assert deviation_coefficients(np.angle(np.exp(1j * weak)))[1] == pytest.approx(0.5, abs=1e-3)
    assert np.isnan(deviation_coefficients(np.angle(np.exp(1j * strong)))).all()


@pytest.mark.parametrize("name", CASES)
def test_values_applied_leave_hardly_more_than_all_estimates_would(name: str) -> None:
    """head once left .60 deg after 10 s: the bias had been estimated with a g-sensitivity that no formula applies."""
    for found in calibrated(name).uses:
        assert found.after < 1.1 * found.figure(lambda band: band.whole), found.use.name


def test_what_was_estimated_with_parameters_left_out_is_applied_without_them() -> None:
    c = calibrated("head")
    estimates = replace(posterior_of(c), applied=replace(c.application(), values=c.values))
    (outage,) = (found for found in c.uses if found.use.name == "outage")
    assert outage.after < 0.5 * use_bands(outage.use, estimates).after
    assert c.parameters["gyro_bias_x"].value == c.values["gyro_bias_x"] != c.applied_values["gyro_bias_x"]


@pytest.mark.parametrize("name", CASES)
def test_results_have_the_sigmas_of_draws(name: str, tmp_path: Path) -> None:
    """Root mean square of what is applied less what drawn true parameters give."""
    c = calibrated(name)
    everything = c.method.report.formulas([q.name for q in c.problem.quantities], c.config)
    rng = np.random.default_rng(4)
    inputs = dict.fromkeys(name for formula in everything for name in formula.inputs)
    measured = {
        each: {"rotation": so3.exp(rng.normal(size=(5, 3))), "vector": rng.normal(size=(5, 3))}.get(
            input_kind(each), rng.normal(size=5)
        )
        for each in inputs
    }
    constants = {**dict.fromkeys((q.name for q in c.problem.quantities), 0.0), **c.problem.constants}
    errors: dict[str, list[Array]] = {}
    found = c.apply(sigma=True, **measured)
    for draw in rng.multivariate_normal(c.estimate.values, c.covariance, 1000):
        space = {**constants, **dict(zip(c.estimate.names, draw.tolist(), strict=True))}
        for name, true in results(everything, space, measured).items():
            if name in found:
                turned = true.kind == "rotation"
                value = found[name].value
                off = so3.log(so3.multiply(value, so3.inverse(true.array))) if turned else value - true.array
                errors.setdefault(name, []).append(off)
    assert errors.keys() == found.keys()
    for name, each in errors.items():
        rms = np.sqrt(np.mean(np.square(each), axis=0))
        np.testing.assert_allclose(found[name].sigma, rms, rtol=0.08, atol=2e-8, err_msg=name)  # rounding
    c.write(tmp_path)
    loaded = alidade.load(tmp_path / "calibration.yaml").apply(sigma=True, **measured)
    for name, (_, sigma) in found.items():
        np.testing.assert_allclose(loaded[name].sigma, sigma, rtol=1e-4, atol=1e-9)


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
