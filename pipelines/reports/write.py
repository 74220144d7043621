"""All files of a result, whole or not at all."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes
from alidade.pipelines.files import Content, write_whole
from alidade.pipelines.reports.calibration import calibration_yaml
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.estimates_mcap import foxglove_layout, write_estimates
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import result_json

# Folder of the recordings of a joint calibration.
PARTS = "recordings"


def write_results(out_dir: Path, calibration: Calibration) -> tuple[Path, ...]:
    """Write every file the calibration has content for, whole or not at all; returns their paths.

    Raises:
        InputError: out_dir is a file, or cannot be written to.
    """
    estimate, history = calibration.estimate, calibration.estimate.history
    attitudes = estimate.attitudes if estimate.attitudes is not None and len(estimate.attitudes.time) else None
    over_time = history if history is not None and len(history.time) else None
    # result.json, gone first and back last, says that the others are its own.
    contents: dict[str, Content] = {
        "calibration.yaml": calibration_yaml(calibration),
        "attitude.tum": tum(attitudes, calibration.facts.epoch_ns) if attitudes else None,
        "estimates.mcap": partial(write_estimates, calibration=calibration, history=over_time) if over_time else None,
        "foxglove.json": foxglove_layout(calibration) if over_time else None,
        "report.html": report_html(calibration),
        "result.json": result_json(calibration),
    }
    return write_whole(out_dir, contents)


def write_part(out_dir: Path, calibration: Calibration) -> None:
    """Write the calibration of one of several recordings into a folder of its own. Raises as `write_results` does."""
    stem, taken = Path(calibration.recording).stem, 1
    name = stem
    while (out_dir / PARTS / name).exists():
        taken += 1
        name = f"{stem}-{taken}"
    write_results(out_dir / PARTS / name, calibration)


def adopt_parts(out_dir: Path, written: Path) -> None:
    """Copy what `write_part` wrote into another folder. Raises InputError when that folder cannot be written to."""
    try:
        shutil.copytree(written / PARTS, out_dir / PARTS, dirs_exist_ok=True)
    except (OSError, shutil.Error) as error:
        raise InputError(f"{out_dir / PARTS}: cannot be written ({error})") from error


def tum(attitudes: Attitudes, epoch_ns: int) -> str:
    """Return attitude.tum: lines `t tx ty tz qx qy qz qw` by time; t is Unix time in s to the ns, the position zero."""
    order = np.argsort(attitudes.time, kind="stable")
    stamps = epoch_ns + np.round(attitudes.time[order] * 1e9).astype(np.int64)
    lines = []
    for t_ns, (w, x, y, z) in zip(stamps.tolist(), attitudes.wxyz[order].tolist(), strict=True):
        # In whole numbers: a double holds today's Unix time to a quarter of a microsecond only.
        seconds, rest = divmod(t_ns, 1_000_000_000)
        lines.append(f"{seconds}.{rest:09d} 0 0 0 {x:.12f} {y:.12f} {z:.12f} {w:.12f}\n")
    return "".join(lines)
