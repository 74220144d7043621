"""The report's first page: verdict, what the calibration is good for, results in engineering units."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.pipelines.display.figure import Figure
from alidade.pipelines.display.table import Interval
from alidade.pipelines.display.units import human_unit, rounded, to_digits_of
from alidade.pipelines.methods import Report, method, names
from alidade.pipelines.methods.triads import parts_of, sensor_model
from alidade.pipelines.reports.calibration_report import calibration_report, report_html
from alidade.pipelines.reports.html import interval_bar, svg, ticks
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.results_table import result_cards
from alidade.pipelines.reports.terminal import console, print_report
from tests.support.browser import CHROMIUM, DESKTOP, PHONE, needs_browser, running
from tests.support.builders import make_calibration
from tests.support.pages import Page

# Open content, px, that a report may have at both widths.
MAX_HEIGHT = 6000
SCENARIOS: dict[str, object] = {"tumble": None, "head": "head_mounts", "los": None, "cube": None, "indexer": None}
CASES = [pytest.param(name, marks=[pytest.mark.slow] * (name != "tumble")) for name in SCENARIOS]


@pytest.mark.parametrize("name", names())
def test_cards_are_of_parameters(name: str) -> None:
    groups = [group for card in method(name).report.cards.values() for group in card]
    for parameter in (each for _, _, parameters in groups for each in parameters):
        assert method(name).describe(parameter), parameter


@cache
def calibrated(name: str) -> Calibration:
    return alidade.calibrate(alidade.simulate(name, SCENARIOS[name], seed=1))  # type: ignore[arg-type]


@needs_browser
@pytest.mark.parametrize("name", CASES)
def test_open_content_is_short_and_does_not_scroll_sideways(name: str, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(report_html(calibrated(name)), encoding="utf-8")
    tab = running()
    for width in (DESKTOP, PHONE):
        tab.complaints.clear()
        tab.size(width)
        tab.screen()
        tab.open((tmp_path / "page.html").as_uri())
        tab.wait("document.readyState == 'complete'")
        assert tab.value("document.documentElement.scrollHeight") <= MAX_HEIGHT
        assert tab.value("document.documentElement.scrollWidth") <= width
        assert not tab.complaints
        first = "document.querySelector('#results').getBoundingClientRect().top + scrollY"
        assert tab.value(first) < (500 if width == DESKTOP else 900)


@pytest.mark.slow
@needs_browser
def test_print_to_pdf_has_the_plots_that_are_collapsed_on_the_screen(tmp_path: Path) -> None:
    """A headless browser prints as soon as the page is loaded."""
    text = report_html(calibrated("tumble"))
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    pdf, page = tmp_path / "page.pdf", (tmp_path / "page.html").as_uri()
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}")
    subprocess.run([str(CHROMIUM), *options, f"--print-to-pdf={pdf}", page], check=True, capture_output=True)
    # An image a canvas; frames, grids and lines are of Bokeh's canvas.
    assert pdf.read_bytes().count(b"/Subtype /Image") >= text.count('class="plot"') > 4


def test_a_card_in_a_unit_that_is_not_known_has_that_of_its_numbers() -> None:
    c = make_calibration()
    name = next(iter(c.values))
    cards = {"Own": (("Numbers", "furlong", (name,)),)}
    own = replace(c, method=replace(c.method, report=Report(cards=cards)))
    (group,) = result_cards(own)[0].groups
    unit, factor = human_unit(c.quantities[name])
    assert (group.unit, group.rows[0].value) == (unit, factor * c.values[name])


def test_sections_come_in_the_order_in_which_they_are_asked_for() -> None:
    report = calibration_report(calibrated("tumble"))
    titles = [section.title for section in report.sections if section.blocks and section.title]
    assert titles == ["Results", "Uncertainty in use", "Frames", "Apply", "Diagnostics", "Details"]
    page = Page(report_html(calibrated("tumble")))
    first = ["All 9 required parameters", "heading, any direction", "Mean scale error, %"]
    order = [*first, "In plain words", "Parameters parameter value"]
    assert sorted(order, key=page.text.index) == order
    assert report.summary is not None
    assert len(report.summary.next_steps) == 1


def test_a_terminal_and_a_notebook_show_what_the_page_begins_with() -> None:
    c = calibrated("tumble")
    text = str(c)
    order = [
        "calibrated. All 9 required",
        "heading, any direction",
        "Mean scale error, %",
        "Scale error about mean x, %",
        "Bias z, µT",
    ]
    assert sorted(order, key=text.index) == order
    assert max(len(line) for line in text.splitlines() if "observable" in line) <= 80
    assert "mag_k11" not in text
    with console.capture() as capture:
        print_report(calibration_report(c), everything=True)
    assert "mag_k11" in capture.get()
    page, notebook = Page(report_html(c)).text, Page(unescape(c._repr_html_())).text
    for _, row in result_cards(c)[0].rows:
        numbers = (to_digits_of(row.value, row.sigma), rounded(row.sigma))
        assert all(number in shown for number in numbers for shown in (text, page, notebook))


@pytest.mark.slow
def test_the_verdict_is_one_sentence_whatever_fails() -> None:
    """A cube of three poses once had eleven lines of names."""
    few = alidade.calibrate(alidade.simulate("cube", {"poses": 3}, seed=1))
    summary = calibration_report(few).summary
    assert summary is not None
    assert few.status == "unobservable"
    assert summary.text.startswith("The recording does not determine this calibration: ")
    assert len(summary.text) < 200
    assert len(summary.next_steps) == 1
    assert summary.next_steps[0].startswith("What to do: ")


def test_a_verdict_names_a_parameter_where_nothing_derived_misses_its_requirement() -> None:
    """Figures that differ in the third digit are shown with three."""
    simulated = alidade.simulate("tumble", seed=1)
    sigma = calibrated("tumble").parameters["mag_k12"].sigma
    summary = calibration_report(alidade.calibrate(simulated, config={"require": {"mag_k12": 0.998 * sigma}})).summary
    assert summary is not None
    assert summary.text.startswith("1 of 9 parameters miss their required accuracy, worst mag_k12 (magnetometer cross-")
    stated, required = re.findall(r"± ([\d.]+) .*where ([\d.]+) is required", summary.text)[0]
    assert float(stated) > float(required) == pytest.approx(float(stated), rel=5e-3)


def test_scale_angles_and_bias_have_the_sigmas_of_draws() -> None:
    c = calibrated("tumble")
    (card, *_) = result_cards(c)
    titles = [group.title for group in card.groups]
    assert titles == ["Mean scale error", "Scale error about mean", "Non-orthogonality", "Misalignment", "Bias"]
    names = list(c.values)
    draws = np.random.default_rng(0).multivariate_normal(c.estimate.values, c.covariance, 2000)
    parts = []
    for draw in draws:
        K, bias = sensor_model("mag", dict(zip(names, draw.tolist(), strict=True)))
        found = parts_of(K)
        mean = found[:3].mean()
        relative = [mean - 1.0, *(found[:3] / mean - 1.0)]
        parts.append([*(100.0 * np.array(relative)), *np.rad2deg(found[3:6]), *(1e6 * bias)])
    rows = [row for _, row in card.rows]
    np.testing.assert_allclose([row.value for row in rows], np.mean(parts, axis=0), rtol=1e-2, atol=2e-3)
    np.testing.assert_allclose([row.sigma for row in rows], np.std(parts, axis=0), rtol=0.05)
    assert all(row.verdict == "observable" for row in rows)
    assert all(abs(row.error or 0.0) < 4.0 * row.sigma for row in rows)


def test_figures_of_a_use_are_drawn_in_a_notebook() -> None:
    c = calibrated("tumble")
    page = c.plot("heading")
    assert page.html.count('<svg class="curve"') == 2
    assert "<iframe" in page._repr_html_()
    assert 'id="bokeh"' not in page.html
    assert "Correlation of the parameters" in c.plot("Correlation of the parameters").html
    with pytest.raises(alidade.InputError, match="no plot 'headin'; there are heading, "):
        c.plot("headin")


def test_small_figures_have_round_ticks_and_begin_at_zero() -> None:
    out = Figure("error, deg", "heading, deg", 236)
    out.line(np.arange(0.0, 361.0), np.full(361, 0.07), "level", "x", "dashed")
    out.band(np.arange(0.0, 361.0), np.zeros(361), np.full(361, 0.07), "x", "level")
    text = svg(out)
    assert all(f">{number}</text>" in text for number in ("0", "90", "180", "270", "360", "0.02"))
    assert "var(--x)" in text
    assert [text for _, text in ticks(-0.3, 0.3, 4)] == ["−0.2", "0", "0.2"]


@pytest.mark.parametrize(
    ("interval", "parts"),
    [
        (Interval(0.1, 1.0), ("track", "bar")),
        (Interval(5.0, 1.0), ("track", "bar", "over")),
        (Interval(0.1), ("none", "bar")),
        (Interval(0.1, 1.0, 0.2), ("track", "bar", "truth")),
        (Interval(0.0, 1.0), ()),
    ],
)
def test_an_interval_shows_sigma_requirement_and_truth(interval: Interval, parts: tuple[str, ...]) -> None:
    text = interval_bar(interval)
    assert [part for part in ("track", "none", "bar", "over", "truth") if f'class="{part}"' in text] == sorted(
        parts, key=("track", "none", "bar", "over", "truth").index
    )
