"""Figures of the report: both gyros' rates in one frame, and their difference."""

from __future__ import annotations

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import rms
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.reports.result import Calibration
from gyro_pair.recording import GyroPairData
from gyro_pair.validation import rates


def figures(data: GyroPairData, calibration: Calibration) -> list[Plot]:
    """With the estimate applied."""
    estimate = calibration.estimate
    start, by_b, predicted = rates(data, dict(zip(estimate.names, estimate.values.tolist(), strict=True)))
    both, left = Figure("rate in b, deg/s"), Figure("rate of b less a's, deg/s")
    for i, axis in enumerate("xyz"):
        both.points(start, np.rad2deg(by_b[:, i]), f"gyro b {axis}", COLORS[i], 3)
        both.line(start, np.rad2deg(predicted[:, i]), f"from gyro a {axis}", COLORS[i])
        left.points(start, np.rad2deg(by_b - predicted)[:, i], axis, COLORS[i], 3)
    said = "Gyro b less gyro a, turned, shifted in time and by the bias difference"
    return [
        Plot("Both gyros in one frame", "Mean rates over windows: points by gyro b, lines by gyro a, turned.", both),
        Plot("What is left between the gyros", f"{said}: {np.rad2deg(rms(by_b - predicted)):.3g} deg/s RMS.", left),
    ]
