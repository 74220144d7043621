"""An assumption far beyond its prior makes a calibration inconsistent, and is named."""

from __future__ import annotations

import numpy as np

import alidade
from alidade.pipelines.diagnostics.assumptions import strained
from alidade.pipelines.estimation.problem import Estimate, Quantity

HEAD = {"duration_s": 40.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0}


def assumption(name: str, prior: float = 1e-2) -> Quantity:
    return Quantity(name, "", prior, prior, np.inf, group="assumption")


def estimate(values: list[float], sigmas: list[float], correlation: float = 0.0) -> Estimate:
    rho = np.full((len(values), len(values)), correlation)
    np.fill_diagonal(rho, 1.0)
    covariance = rho * np.outer(sigmas, sigmas)
    return Estimate("batch", tuple("abc"[: len(values)]), np.array(values), covariance, True, "")


def test_pulls_beyond_four_are_named_the_worst_first() -> None:
    found = strained(
        estimate([0.05, 0.08, 0.02], [1e-3, 1e-3, 1e-3]), [assumption("a"), assumption("b"), assumption("c")]
    )
    assert [each.quantity.name for each in found] == ["b", "a"]
    assert found[0].pull > 7.9


def test_what_the_recording_says_nothing_of_does_not_strain() -> None:
    assert strained(estimate([0.1], [9.9e-3]), [assumption("a")]) == ()


def test_assumptions_that_cannot_be_told_apart_are_one() -> None:
    found = strained(estimate([0.05, 0.06], [1e-3, 1e-3], 0.95), [assumption("a"), assumption("b")])
    assert [(each.quantity.name, each.others) for each in found] == [("b", ("a",))]


def test_a_calibrated_parameter_far_from_its_prior_is_no_assumption() -> None:
    mount = Quantity("mount", "rad", 0.1, 0.1, 1e-2)
    assert strained(estimate([1.5], [1e-3]), [mount]) == ()


def test_a_gyro_scale_far_beyond_its_data_sheet_is_inconsistent_and_named_first() -> None:
    """Left out of the graph, a scale of 5 % once ended calibrated with mounts 8 sigmas off."""
    data, _ = alidade.simulate("head", HEAD, seed=2)
    gyro = data.head_gyro * [1.06, 1.0, 1.0]
    wrong = alidade.open({**vars(data), "head_gyro": gyro}, method="head").calibrate()
    assert wrong.status == "inconsistent"
    assert wrong.headline.startswith("Gyro_scale_x is not what was assumed")
    bad_sheet = alidade.Config.model_validate({"sensors": {"gyro": {"scale": 0.06, "skew": 0.02}}})
    told = alidade.open({**vars(data), "head_gyro": gyro}, method="head", config=bad_sheet).calibrate()
    assert told.status != "inconsistent"
    scale = told.parameters["gyro_scale_x"]
    assert abs(scale.value - 0.06) < 4.0 * scale.sigma
