"""Where the uncertainty of a parameter comes from: in the result, in the report, in words, and before recording."""

from __future__ import annotations

from functools import cache

import pytest

import alidade
from alidade.pipelines.applications.planning import predict
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import result
from alidade.pipelines.reports.sentences import REST, limits
from tests.support.pages import Page

SHORT = {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 10.0}


@cache
def usual() -> Calibration:
    return calibration()


def calibration(**sensors: object) -> Calibration:
    return alidade.open(alidade.simulate("head", {**SHORT, "sensors": sensors}, 1)).calibrate()


def test_shares_of_every_parameter_sum_to_one_and_assumptions_have_none() -> None:
    budget = result(usual()).budget
    assert budget is not None
    assert "gyro_scale_x" not in budget
    for name in ("gyro_bias_x", "helmet_mount_x", "time_offset"):
        assert sum(budget[name].values()) == pytest.approx(1.0, abs=1e-9)
    assert budget["helmet_mount_x"]["vision"] > 0.1


def test_what_a_source_adds_is_gone_without_it() -> None:
    """The variance left without an assumption is the one with it, less its share, where it is small."""
    both = calibration(gyro={"g_sensitivity": 1e-5})
    without = calibration(gyro={"g_sensitivity": 0.0})
    assert both.budget is not None
    name = "gyro_bias_x"
    share = sum(part for source, part in both.budget[name].items() if "gyro_g" in source)
    assert share > 0.01
    ratio = (without.parameters[name].sigma / both.parameters[name].sigma) ** 2
    assert ratio == pytest.approx(1.0 - share, abs=0.2 * share)


def test_sources_are_told_in_words_the_small_ones_together() -> None:
    budget = {"mount": {"prior of gyro_g_xz": 0.4, "prior of gyro_g_yz": 0.3, "vision": 0.295, "gyro": 0.005}}
    quantities = [Quantity(name, "", 1e-4, 1e-4, 1.0, group="assumption") for name in ("gyro_g_xz", "gyro_g_yz")] + [
        Quantity("mount", "rad", 0.1, 0.1, 1e-3)
    ]
    (limit,) = limits(budget, quantities)
    assert [source for source, _ in limit.parts] == ["prior of gyro_g", "vision noise", REST]
    assert [share for _, share in limit.parts] == pytest.approx([0.7, 0.295, 0.005])
    assert limit.sentence.startswith("70 % of the variance of mount: prior of gyro_g; state its data sheet")
    (alone,) = limits({"mount": {"prior of mount": 1.0}}, quantities)
    assert alone.parts == (("its own prior", 1.0),)


def test_the_report_has_the_shares() -> None:
    page = Page(report_html(usual()))
    assert "Error budget" in page.text
    assert "vision noise" in page.text


def test_a_plan_tells_what_will_limit() -> None:
    found = predict("head", dict(SHORT), None, {})
    free = {q.name for q in found.quantities if q.prior_sigma != 0.0}
    assert set(found.budget) == free


@pytest.mark.slow
def test_a_prior_of_a_few_numbers_together_is_named_after_them() -> None:
    """That of the field, most of what limits a cube's magnetometer, was called `prior`."""
    cube = alidade.calibrate(alidade.simulate("cube", {"poses": 20}, seed=1))
    assert cube.budget is not None
    assert cube.budget["mag_k22"]["prior of field_e, field_n, field_u"] > 0.8
    assert cube.budget["mag_k22"].get("prior", 0.0) < 0.01
    (limit,) = limits({"mag_k22": cube.budget["mag_k22"]}, cube.problem.quantities)
    assert limit.parts[0][0] == "prior of field"
