"""The report of every method, drawn by a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.methods import simulate
from pipelines.reports.html import report_html
from pipelines.session import calibrate
from tests.browser import drawn, needs_browser

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
    (calibration,) = calibrate(tmp_path / "s.mcap", [solver])
    text = report_html(calibration)
    assert drawn(text, tmp_path) == text.count('class="plot"') > 4


@needs_browser
def test_a_page_too_wide_for_a_phone_is_caught(tmp_path: Path) -> None:
    wide = '<!doctype html><meta name="viewport" content="width=device-width"><div style="width: {}px">wide</div>'
    for width, where in ((600, "at 390 px"), (1000, "on paper"), (1400, "at 1280 px")):
        with pytest.raises(AssertionError, match=f"{where}: too wide"):
            drawn(wide.format(width), tmp_path)
