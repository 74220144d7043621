"""report.html: what it says, that it needs nothing but itself, and that a browser draws it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.pipelines.diagnostics.observability import weak_directions
from alidade.pipelines.display.units import human_unit, to_digits_of
from alidade.pipelines.estimation.finding import Finding, Motion, Severity
from alidade.pipelines.estimation.problem import Attitudes, Parameter, Quantity, Residuals
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.report import head_plots
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.plots import common_plots, histories
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from tests.support.browser import drawn, needs_browser
from tests.support.builders import make_calibration
from tests.support.pages import Page


def test_the_report_loads_nothing_and_is_smaller_than_a_megabyte() -> None:
    text = report_html(make_calibration())
    assert Page(text).loaded == []
    assert "default-src 'none'" in text
    assert text.count('<script type="text/plain" id="bokeh">') == 1
    assert len(text) < 1_000_000


def test_the_verdict_comes_first_and_numbers_are_for_people() -> None:
    page = Page(report_html(make_calibration(truth={"time_offset": 0.0125})))
    assert page.text.index("meet the required accuracy") < page.text.index("helmet_mount_x")
    assert "12.00 0.20 ms 50.0 5.00 observable -0.50 (-2.5 σ)" in page.text
    assert "1.719 0.057 deg" in page.text
    assert "Error is the estimate minus the truth" in page.text
    assert "/vision/attitude: not finite: 3" in page.text
    assert "vision: outliers: 4" in page.text
    assert "Error is" not in Page(report_html(make_calibration())).text


def test_weak_directions_come_with_advice_and_no_formula_to_apply() -> None:
    covariance = np.diag([1e-6, 1e-6, 0.35**2, 1e-8, 1e-8, 0.0])
    calibration = make_calibration(covariance=covariance)
    quantities, values = calibration.problem.quantities, calibration.estimate.values
    found = weak_directions(quantities, covariance, lambda _: Motion("nod and shake the head"), values)
    page = Page(report_html(replace(calibration, findings=found)))
    assert page.text.count("What to do: nod and shake the head.") == 1
    assert page.text.count("od and shake the head") == 3  # in the verdict, by direction, in all findings
    assert "Apply import alidade" not in page.text


def test_free_and_undetermined_parameters_show_no_silly_number() -> None:
    covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-8, (1e4 * 0.05) ** 2, 0.0])
    page = Page(report_html(make_calibration(covariance=covariance)))
    assert "free unknown unknown deg/s free 0.115 unobservable" in page.text


def test_names_from_the_recording_are_escaped() -> None:
    calibration = make_calibration(
        recording="<script>alert(1)</script>.mcap", config=Config(topics={"imu": TopicSource(topic="</pre><script>")})
    )
    page = Page(report_html(calibration))
    assert page.scripts == Page(report_html(make_calibration())).scripts
    assert "<script>alert(1)</script>.mcap" in page.text


def test_long_recordings_are_thinned_and_outliers_are_not_lost() -> None:
    n = 200_000
    used = np.ones(n, dtype=bool)
    used[[17, 123_457]] = False
    rows = np.random.default_rng(0).standard_normal((n, 2))
    rows[~used] = 50.0
    calibration = make_calibration(residuals={"vision": Residuals(np.arange(n) / 100.0, rows, used)}, history=None)
    residuals, squares, *_ = common_plots(calibration)
    for plot in (residuals, squares):
        assert max(len(column) for mark in plot.figure.marks for column in mark.columns.values()) <= 3000
    (rejected,) = residuals.figure.named("rejected (length)")
    np.testing.assert_allclose(rejected.x, [0.17, 1234.57])
    assert residuals.figure.y_range is not None
    assert max(rejected.y) <= residuals.figure.y_range[1]


def test_mean_innovation_squared_is_drawn() -> None:
    n = 1000
    rows = np.random.default_rng(0).standard_normal((n, 3))
    calibration = make_calibration(residuals={"vision": Residuals(np.arange(n) / 10.0, rows, np.ones(n, dtype=bool))})
    plot = next(p for p in common_plots(calibration) if "squared" in p.title)
    mean = plot.figure.marks[1].y
    assert 2.0 < mean.min() < 3.0 < mean.max() < 4.0


def test_nuisance_parameters_over_time_are_on_paper_only_where_one_contradicts_its_prior() -> None:
    calibration = make_calibration()
    mount, offset, *others = calibration.problem.parameters
    nuisance = replace(offset, quantities=tuple(replace(q, group="assumption") for q in offset.quantities))
    calibration = replace(calibration, problem=replace(calibration.problem, parameters=(mount, nuisance, *others)))
    evidence = {"parameter": "time_offset", "value": 0.3, "sigma": 0.01, "z": 6.0, "inseparable": [], "effect": {}}
    conflict = Finding("prior_conflict", Severity.INCONSISTENT, evidence)
    for findings, count in (((), 1), ((conflict,), 0)):
        plots = histories(replace(calibration, findings=findings))
        assert [plot.title for plot in plots if not plot.printed] == ["time_offset over time"][:count]
        page = report_html(replace(calibration, findings=findings))
        assert page.count('class="card figure screen"') == count


@pytest.mark.parametrize(
    ("unit", "require", "shown"),
    [
        ("rad", 1e-2, "deg"),
        ("rad", 5e-5, "arcsec"),
        ("rad/s", 2e-3, "deg/s"),
        ("rad/s", 1e-5, "deg/h"),
        ("s", 5e-3, "ms"),
        ("T", 5e-7, "nT"),
        ("m/s^2", 0.02, "m/s²"),
        ("1", 5e-3, ""),
    ],
)
def test_units_people_read(unit: str, require: float, shown: str) -> None:
    factors = {
        "deg": 57.29577951,
        "arcsec": 206264.806,
        "deg/s": 57.29577951,
        "deg/h": 206264.806,
        "ms": 1e3,
        "nT": 1e9,
    }
    label, factor = human_unit(Quantity("a", unit, 1.0, 1.0, require))
    assert label == shown
    assert factor == pytest.approx(factors.get(shown, 1.0))


def test_a_share_is_read_in_percent_or_in_ppm_by_its_usual_prior() -> None:
    """A gyro's scale error and a clock's, in tables and in notes alike."""
    assert human_unit(Quantity("gyro_scale_x", "", 1e-4, 1e-2, np.inf)) == ("%", 100.0)
    assert human_unit(Quantity("clock_skew", "", 1e-2, 1e-4, np.inf)) == ("ppm", 1e6)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1.23456, 0.012, "1.235"),
        (-0.0004, 20.0, "0"),
        (1234.5, 120.0, "1234"),
        (1.5, 0.0, "1.5"),
        (-7.3e-13, 0.0, "0"),
        (3e-12, 1e-13, "3.00e-12"),
    ],
)
def test_digits_follow_the_sigma(value: float, sigma: float, text: str) -> None:
    assert to_digits_of(value, sigma) == text


def test_robust_sigma_ignores_outliers() -> None:
    values = np.random.default_rng(0).normal(0.0, 2.0, 20_000)
    values[::20] = 1e6
    assert robust_sigma(values) == pytest.approx(2.0, rel=0.1)


def turning(n: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n) / 25.0
    return t, so3.exp(np.column_stack([0.3 * np.sin(t), 0.2 * np.sin(1.3 * t), 0.5 * np.sin(0.7 * t)]))


def head_case(camera_known: bool) -> tuple[HeadData, Calibration]:
    """A head session with its exact attitude; without the camera mount that attitude is off by it."""
    t, bRv = turning(250)
    vRh, cRb = so3.exp(np.array([0.03, -0.02, 0.5])), so3.exp(np.array([0.1, 0.2, -0.1]))
    noise = so3.exp(np.random.default_rng(0).normal(0.0, 0.01, (250, 3)))
    vision = so3.multiply(so3.compose(cRb, bRv, vRh), noise)
    found = bRv if camera_known else so3.multiply(cRb, bRv)
    values = np.array([0.03, -0.02, 0.5, 0.012, 0.0, 0.0])
    calibration = make_calibration(values=values, attitudes=Attitudes(t, found))
    data = HeadData(0, t, np.zeros((250, 3)), None, None, t - 0.012, vision, None, t, bRv)
    if not camera_known:
        mount = tuple(Quantity(f"camera_mount_{axis}", "rad", 0.35, 0.35, 1e-2) for axis in "xyz")
        problem = replace(calibration.problem, parameters=(*calibration.problem.parameters, Parameter(9, mount)))
        n = len(calibration.estimate.names)
        covariance = 0.35**2 * np.eye(n + 3)
        covariance[:n, :n] = calibration.covariance
        estimate = replace(
            calibration.estimate,
            names=(*calibration.estimate.names, *(q.name for q in mount)),
            values=np.append(values, np.zeros(3)),
            covariance=covariance,
            history=None,
        )
        return data, replace(calibration, problem=problem, estimate=estimate)
    names = (*calibration.estimate.names[:4], "free", "pinned")
    return data, replace(calibration, estimate=replace(calibration.estimate, names=names))


def test_attitude_error_leaves_out_a_camera_mount_that_is_not_known() -> None:
    data, calibration = head_case(camera_known=False)
    error, _, difference = head_plots(data, calibration)
    (fused,) = error.figure.named("fused")
    assert np.abs(fused.y).max() < 1e-4
    assert "camera mount that is not known" in error.caption
    # Vision against fused has only the vision noise of 0.573 deg: mounts and time offset are undone.
    assert robust_sigma(np.concatenate([mark.y for mark in difference.figure.marks])) == pytest.approx(0.573, rel=0.1)


def test_head_figures_are_in_the_report() -> None:
    data, calibration = head_case(camera_known=False)
    calibration = replace(calibration, plots=partial(head_plots, data))
    text = Page(report_html(calibration)).text
    for title in ("Attitude against the truth", "Vision against the fused attitude", "Innovations of vision"):
        assert title in text
    assert head_plots(data, replace(calibration, estimate=replace(calibration.estimate, attitudes=None))) == []


def test_parameters_of_a_partial_estimate_keep_their_units() -> None:
    calibration = make_calibration(
        names=("time_offset",), values=np.zeros(1), covariance=np.eye(1) * 1e-8, history=None
    )
    assert [p.unit for p in calibration.parameters.values()] == ["s"]
    assert "Correlation" not in Page(report_html(calibration)).text


@pytest.mark.usefixtures("few_solutions")
def test_the_page_solves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside an incremental estimate stands the published one, which the session has solved before."""
    rates = {"gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 5.0}
    opened = alidade.open(alidade.simulate("los", {"duration_s": 2.5, "sensors": "ideal", **rates}, seed=1))
    calibration = opened.calibrate("incremental", check=False)
    assert calibration.beside is not None
    assert opened.calibrate("incremental", check=False, report=False).beside is None

    def solves(*_: object) -> None:
        raise AssertionError("a page solves a problem")

    monkeypatch.setattr(type(opened.method), "published", solves)
    monkeypatch.setattr(type(opened.method), "graph", solves)
    assert "dotted is the published solver" in Page(report_html(calibration)).text


@needs_browser
def test_a_browser_draws_the_figures_without_complaint(tmp_path: Path) -> None:
    assert drawn(report_html(make_calibration()), tmp_path) == len(common_plots(make_calibration()))
