"""All files of a result, whole or not at all."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from pipelines.reports.calibration import calibration_yaml
from pipelines.reports.estimates import write_estimates
from pipelines.reports.foxglove import foxglove_layout
from pipelines.reports.html import report_html
from pipelines.reports.result import Calibration, result_json
from pipelines.reports.trajectory import tum
from pipelines.reports.whole import write_whole

# In the order in which they take their places: result.json, gone first and back last, says that the others are its own.
FILES = ("calibration.yaml", "attitude.tum", "estimates.mcap", "foxglove.json", "report.html", "result.json")


def write_results(out_dir: Path, calibration: Calibration) -> tuple[Path, ...]:
    """Write every file the calibration has content for, whole or not at all; returns their paths.

    Raises:
        InputError: out_dir is a file, or cannot be written to.
    """
    return write_whole(out_dir, FILES, partial(_make, calibration=calibration))


def _make(folder: Path, calibration: Calibration) -> None:
    estimate = calibration.estimate
    (folder / "result.json").write_text(result_json(calibration), encoding="utf-8")
    (folder / "calibration.yaml").write_text(calibration_yaml(calibration), encoding="utf-8")
    (folder / "report.html").write_text(report_html(calibration), encoding="utf-8")
    if estimate.attitudes is not None and len(estimate.attitudes.time):
        (folder / "attitude.tum").write_text(tum(estimate.attitudes, calibration.facts.epoch_ns), encoding="utf-8")
    if estimate.history is not None and len(estimate.history.time):
        write_estimates(folder / "estimates.mcap", calibration, estimate.history)
        (folder / "foxglove.json").write_text(foxglove_layout(calibration), encoding="utf-8")
