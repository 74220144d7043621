"""The report of every method, drawn by a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from alidade.pipelines.methods import simulate
from alidade.pipelines.reports.calibration_report import report_html
from tests.support.browser import drawn, needs_browser, sheets
from tests.support.solved import calibrate

SCENARIOS = {
    "los": "{duration_s: 15, gyro_rate_hz: 200, image_rate_hz: 20}",
    "indexer": "{gyro_rate_hz: 50, encoder_rate_hz: 50}",
    "head": "{duration_s: 15, gyro_rate_hz: 100, vision_rate_hz: 20}",
    "cube": "{poses: 12}",
}


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_browser_draws_the_report_at_the_width_of_a_desktop_and_of_a_phone(name: str, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SCENARIOS[name])
    simulate(name, str(tmp_path / "scenario.yaml"), 1, tmp_path / "s.mcap")
    solver = "incremental" if name == "los" else "batch"
    (calibration,) = calibrate(tmp_path / "s.mcap", [solver], report=True)
    text = report_html(calibration)
    assert drawn(text, tmp_path) == text.count('class="plot"') > 4


# Sheets of paper that the nominal recording's report may take, default sensors.
SHEETS = {"los": 5, "indexer": 5, "head": 5, "cube": 8, "tumble": 4}


@needs_browser
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "tumble")) for n in SHEETS])
def test_a_printed_report_is_short(name: str, tmp_path: Path) -> None:
    simulate(name, None, 1, tmp_path / "s.mcap")
    (calibration,) = calibrate(tmp_path / "s.mcap", ["batch"], report=True)
    assert 1 < sheets(report_html(calibration), tmp_path) <= SHEETS[name]


@needs_browser
def test_a_page_too_wide_for_a_phone_is_caught(tmp_path: Path) -> None:
    wide = '<!doctype html><meta name="viewport" content="width=device-width"><div style="width: {}px">wide</div>'
    for width, where in ((600, "at 390 px"), (1000, "on paper"), (1400, "at 1280 px")):
        with pytest.raises(AssertionError, match=f"{where}: too wide"):
            drawn(wide.format(width), tmp_path)
