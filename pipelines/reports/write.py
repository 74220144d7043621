"""All files of a result, whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from pipelines.errors import InputError
from pipelines.reports.calibration import calibration_yaml
from pipelines.reports.estimates import write_estimates
from pipelines.reports.foxglove import foxglove_layout
from pipelines.reports.html import report_html
from pipelines.reports.result import Calibration, result_json
from pipelines.reports.trajectory import tum

# In the order in which they take their places: result.json, gone first and back last, says that the others are its own.
FILES = ("calibration.yaml", "attitude.tum", "estimates.mcap", "foxglove.json", "report.html", "result.json")


def write_results(out_dir: Path, calibration: Calibration) -> tuple[Path, ...]:
    """Write every file the calibration has content for; returns their paths.

    They are made in a folder of their own and moved at the end. Files of an earlier result are replaced, or removed
    when this one has none of that name; others in the folder stay.

    Raises:
        InputError: out_dir is a file, or cannot be written to.
    """
    new = not out_dir.exists()
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=".alidade.", dir=out_dir))
    except OSError as error:
        raise InputError(f"{out_dir}: no folder to write results to ({error.strerror})") from error
    try:
        _make(part, calibration)
        return _move(part, out_dir)
    except OSError as error:
        raise InputError(f"{out_dir}: the results cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if new and not (out_dir / FILES[-1]).exists():
            shutil.rmtree(out_dir, ignore_errors=True)


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


def _move(part: Path, out_dir: Path) -> tuple[Path, ...]:
    (out_dir / FILES[-1]).unlink(missing_ok=True)
    written = []
    for name in FILES:
        if (part / name).exists():
            os.replace(part / name, out_dir / name)
            written.append(out_dir / name)
        else:
            (out_dir / name).unlink(missing_ok=True)
    return tuple(written)
