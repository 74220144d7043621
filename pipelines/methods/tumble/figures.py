"""Figures of the tumble method: what was found in words, lengths before and after, directions covered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.pipelines.display.figure import BEFORE, COLORS, Figure, Plot, thin
from alidade.pipelines.display.sphere_map import described, sphere_map
from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.triads import triad_of
from alidade.pipelines.methods.tumble.findings import NAMES, directions
from alidade.pipelines.methods.tumble.model import Sensor, prepare
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.reports.result import Calibration


def figures(data: TumbleData, calibration: Calibration) -> list[Plot | Table]:
    """With the estimate applied."""
    estimate = calibration.estimate
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    found: list[Plot | Table] = [_words(calibration)]
    for sensor in prepare(data, calibration.config).sensors:
        if f"{sensor.name}_k11" in values:
            found += [_lengths(sensor, values), _sphere(sensor, values), _covered(sensor, values)]
    return found


def _words(calibration: Calibration) -> Table:
    kinds = ("offsets", "stretches", "coverage")
    rows = [(NAMES[str(row["sensor"])], str(row["says"])) for kind in kinds for row in calibration.tables[kind]]
    columns = ("sensor", Column("what was found", "prose"))
    return Table("In plain words", "Directions are those of the device's axes.", columns, tuple(rows))


def _lengths(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    K, b = triad_of(sensor.name, values)
    raw = np.linalg.norm(sensor.raw, axis=1)
    lengths = [raw / raw.mean(), np.linalg.norm(sensor.raw @ K.T + b, axis=1) / sensor.strength]
    misses = [100.0 * (length - 1.0) for length in lengths]
    out = Figure("length, % off")
    some = thin(2 * len(raw))
    for words, miss, color in zip(("uncalibrated", "calibrated"), misses, (BEFORE, COLORS[0]), strict=True):
        out.points(sensor.time[some], miss[some], words, color, 4)
    rms = [float(np.sqrt((miss**2).mean())) for miss in misses]
    return Plot(
        f"Length of what the {NAMES[sensor.name]} reads",
        f"It should be the same in every attitude: {rms[0]:.2g} % RMS off its mean as recorded, {rms[1]:.2g} % off "
        "calibrated.",
        out,
    )


def _sphere(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    """Readings in two views, as recorded about their own centre, and calibrated."""
    K, b = triad_of(sensor.name, values)
    clouds = (sensor.raw / sensor.radius, (sensor.raw @ K.T + b) / sensor.strength)
    some = thin(3 * len(sensor.raw))
    views = []
    for i, j in ((0, 1), (0, 2)):
        out = Figure("xyz"[j], "xyz"[i], 420, 0.5, square=True)
        for name, cloud, color in zip(("as recorded", "calibrated"), clouds, (BEFORE, COLORS[0]), strict=True):
            out.points(cloud[some, i], cloud[some, j], name, color, 3)
        views.append(out)
    return Plot(
        f"Readings of the {NAMES[sensor.name]}",
        "Seen along z and along y, in units of what is measured: an ellipsoid about the offset as recorded, the unit "
        "sphere about zero calibrated.",
        views[0],
        (views[1],),
    )


def _covered(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    reached: Array = directions(sensor, values)
    reached = reached[thin(3 * len(reached))]
    names = [described(direction) for direction in reached]
    what = "the field" if sensor.name == "mag" else "up"
    return Plot(
        f"Directions covered by the {NAMES[sensor.name]}",
        f"Where {what} was, in the device's axes, on an equal-area map of all directions.",
        sphere_map(reached, names, "reading"),
    )
