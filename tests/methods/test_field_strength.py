"""The strength of the field, which no motion tells from the magnetometer's scale: stated, assumed, or not asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import alidade
from alidade.factors.array import Array
from alidade.pipelines.applications.session import Session
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import Method, method
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.results_table import result_cards
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import Simulated

SHORT: dict[str, dict[str, Any]] = {
    "tumble": {"attitudes": 20, "magnetometer": {"rate_hz": 10.0}},
    "cube": {"poses": 14, "static_s": 1.5, "turn_rad_s": 1.6, "imu_rate_hz": 50.0, "camera": None, "reference": None},
}
SHAPE = Config.model_validate({"require": {"mag_shape": 5e-3}})


def _field(name: str, off: float, measured: float | None) -> dict[str, Any]:
    """A field that is off its model by one sigma, T, of a strength that is measured with another."""
    if name == "tumble":
        return {"field_error": off, "field_measured": measured}
    return {"field": {"direction": off, "strength": off, "measured": measured}}


def _simulated(name: str, seed: int, **field: Any) -> tuple[Method, Simulated]:
    found = method(name)
    return found, found.simulate(found.scenario.model_validate({**SHORT[name], **field}), seed)


def _calibrated(
    name: str, seed: int, config: Config | None = None, solver: str = "batch", **field: Any
) -> tuple[Calibration, Simulated]:
    found, simulated = _simulated(name, seed, **field)
    return Session.of(found, simulated, config).calibrate(solver, report=False), simulated


def _z_of_scale(c: Calibration, truth: dict[str, float]) -> float:
    """Error of the size of K in its sigmas."""
    names = [name for name in c.values if name.startswith("mag_k")]
    K = np.array([c.values[name] for name in names])
    error = K - [truth[name] for name in names]
    return float(K @ error / np.sqrt(K @ c.covariance_of(names) @ K))


def _assert_sigma_of_scale(name: str, measured: float | None, seeds: range, solver: str = "batch") -> None:
    """NEES of the scale over draws of the field and, where it is measured, of what is measured."""
    found = [_calibrated(name, seed, None, solver, **_field(name, 5e-7, measured)) for seed in seeds]
    nees = sum(_z_of_scale(c, dict(simulated.truth)) ** 2 for c, simulated in found)
    low, high = chi2.ppf([0.005, 0.995], len(seeds))
    assert low < nees < high
    assert {c.status for c, _ in found} == {"weak" if measured is None else "calibrated"}
    for c, _ in found:
        scale, shape = c.derived
        assert (scale.verdict, shape.verdict) == ("weak" if measured is None else "observable", "observable")


@pytest.mark.parametrize(
    ("name", "measured"),
    [
        *((name, None) for name in SHORT),
        ("tumble", 1e-7),
        pytest.param("cube", 1e-7, marks=pytest.mark.slow),
    ],
)
def test_sigma_of_the_scale_is_true(name: str, measured: float | None) -> None:
    _assert_sigma_of_scale(name, measured, range(8 if name == "tumble" else 2))


@pytest.mark.parametrize("seed", [19, pytest.param(32, marks=pytest.mark.slow)])
def test_a_strength_measured_where_a_building_turns_the_field(seed: int) -> None:
    """5e-6 T across the model are 230 nT of strength beyond its component along it: else K is 8 sigmas off."""
    indoors = Config.model_validate({"sensors": {"field": {"model_error": 5e-6}}})
    seen: dict[str, Any] = {"camera": {"rate_hz": 5.0}, "reference": {}}
    c, simulated = _calibrated("cube", seed, indoors, **_field("cube", 5e-6, 1e-7), **seen)
    assert c.status == "calibrated"
    assert abs(_z_of_scale(c, dict(simulated.truth))) < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
@pytest.mark.parametrize("measured", [None, 1e-7])
@pytest.mark.parametrize("solver", ["batch", "incremental"])
def test_sigma_of_the_scale_is_true_over_forty_runs(name: str, measured: float | None, solver: str) -> None:
    _assert_sigma_of_scale(name, measured, range(100, 140), solver)


@pytest.mark.parametrize("name", SHORT)
def test_a_field_that_nobody_measured_leaves_the_scale_weak_and_the_shape_good(name: str) -> None:
    """The field is 2e-6 T off: K is no better than that, its shape and the offset are, and the advice is to measure."""
    found, simulated = _simulated(name, 1, **_field(name, 2e-6, None))
    c = Session.of(found, simulated).calibrate(report=False)
    assert [each.evidence["weights"] for each in c.directions] == [{"mag_scale": 1.0}]
    assert "proton or calibrated magnetometer" in c.headline
    assert "field: {strength: {value: " in c.headline
    assert "require: {mag_shape: " in c.headline
    gains = [c.verdicts[f"mag_k{i}{i}"] for i in "123"]
    assert gains == ["weak"] * 3
    assert {c.verdicts[f"mag_b{i}"] for i in "123"} == {"observable"}
    of_shape = Session.of(found, simulated, SHAPE).calibrate(report=False)
    assert of_shape.status == "calibrated"
    assert of_shape.verdicts["mag_shape"] == "observable"
    assert of_shape.parameters["mag_k11"].require is None
    assert of_shape.parameters["mag_k11"].observability is None
    assert "mag_k11" not in of_shape.verdicts
    assert [each.verdict for each in of_shape.derived] == [None, "observable"]
    np.testing.assert_array_equal(of_shape.estimate.sigmas, c.estimate.sigmas)


def _shape(values: dict[str, float]) -> Array:
    """K and b over the size of K."""
    names = [f"mag_k{i}{j}" for i in "123" for j in "123" if f"mag_k{i}{j}" in values]
    numbers = np.array([values[name] for name in [*names, "mag_b1", "mag_b2", "mag_b3"]])
    return np.asarray(numbers / np.linalg.norm(numbers[: len(names)]))


@pytest.mark.parametrize("name", SHORT)
def test_no_strength_touches_the_shape(name: str) -> None:
    """Stated 10 % too large: K and b grow alike."""
    found, simulated = _simulated(name, 2, **_field(name, 0.0, None))
    shapes, sizes = [], []
    for value in (5e-5, 5.5e-5):
        stated = Config.model_validate({"field": {"strength": {"value": value, "sigma": 1e-7}}})
        c = Session.of(found, simulated, stated).calibrate(report=False)
        shapes.append(_shape(c.values))
        sizes.append(c.values["mag_k11"])
    assert sizes[1] / sizes[0] == pytest.approx(1.1, rel=2e-3)
    np.testing.assert_allclose(shapes[1], shapes[0], atol=2e-4)


def test_a_shape_of_few_attitudes_is_weak() -> None:
    few = {**SHORT["tumble"], "attitudes": 6, "tilt_deg": 20.0}
    c = alidade.calibrate(alidade.simulate("tumble", few, seed=1), config=SHAPE)
    assert c.status in ("weak", "unobservable")
    assert c.verdicts["mag_shape"] in ("weak", "unobservable")
    assert "mag_scale" not in c.headline


def test_a_scale_that_no_motion_determines_is_no_better_for_a_strength_that_was_measured() -> None:
    c = alidade.calibrate(alidade.simulate("tumble", "tumble_car", seed=3))
    (row,) = result_cards(c)[0].groups[0].rows
    assert row.verdict in ("weak", "unobservable")
    assert "mag_scale" not in c.headline


def test_what_is_named_beside_a_shape_is_required_too() -> None:
    asked = Config.model_validate({"require": {"mag_shape": 5e-3, "mag_k11": 1e-3}})
    c, _ = _calibrated("tumble", 1, asked)
    assert c.parameters["mag_k11"].require == 1e-3
    assert [each.evidence["weights"] for each in c.directions] == [{"mag_scale": 1.0}]


def test_a_strength_makes_numbers_in_tesla_where_no_place_is_known() -> None:
    found, simulated = _simulated("tumble", 1, latitude_deg=None)
    stated = Config.model_validate({"field": {"strength": {"value": 4.8e-5, "sigma": 1e-7}}})
    c = Session.of(found, simulated, stated).calibrate(report=False)
    assert c.parameters["field_strength"].unit == "T"
    assert c.parameters["mag_k11"].unit == "1"
    assert not any("strength is unknown" in note for note in c.notes)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"value": 48200.0, "sigma": 100.0}, r"field.strength: value and sigma are in T; the earth's field has 2.2e-5"),
        ({"value": 4.8e-5, "sigma": 100.0}, "field.strength: value and sigma are in T"),
        ({"value": 4.8e-5}, "field.strength"),
    ],
)
def test_a_strength_in_another_unit_is_refused(stated: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        alidade.calibrate(alidade.simulate("tumble", SHORT["tumble"], seed=1), config={"field": {"strength": stated}})


def test_a_method_without_magnetometer_has_no_use_for_a_strength() -> None:
    stated = {"field": {"strength": {"value": 4.8e-5, "sigma": 1e-7}}}
    with pytest.raises(InputError, match="field: method los has no use for it"):
        alidade.calibrate(alidade.simulate("los", {"duration_s": 5.0}, seed=1), config=stated)
