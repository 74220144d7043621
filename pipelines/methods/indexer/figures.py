"""Figures of the indexer method: half differences, misfit by turn, what each position says, attitude output."""

from __future__ import annotations

from itertools import cycle

import numpy as np

from alidade.factors import so3
from alidade.factors.indexer import IndexerAverageFactor, mounting
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.indexer.groups import Group, groups_of
from alidade.pipelines.methods.indexer.parameters import BIAS, THETA
from alidade.pipelines.methods.indexer.published import half_differences
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.runs import axis_motion
from alidade.pipelines.methods.indexer.validation import misfit, validate
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config

_ARCSEC = np.rad2deg(1.0) * 3600.0
_AXES = "xyz"


def indexer_plots(data: IndexerData, calibration: Calibration) -> list[Plot]:
    """The method's own figures; those that the recording has no data for are left out."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    turning = [g for g in groups_of(data, config, axis_motion(data)) if g.position is not None]
    plots = [_misfit(turning, values), _contributions(turning, values)]
    half = _half_differences(data, values)
    if half is not None:
        plots.insert(0, half)
    if data.attitude is not None:
        plots.insert(0, _attitude(data, config, values))
    return plots


def _angles(values: dict[str, float]) -> Array:
    return np.array([values.get(name, 0.0) for name in THETA])


def _half_differences(data: IndexerData, values: dict[str, float]) -> Plot | None:
    """Direction of each position's half difference across its axis, before and after turning it by theta."""
    try:
        found = half_differences(data)
    except InputError:
        return None
    out = Figure("across the axis, arcsec", x_title="position")
    rows: list[list[float]] = []
    for name, theta, color in (
        ("as measured", np.zeros(3), COLORS[6]),
        ("compensated", _angles(values), COLORS[0]),
    ):
        labels, across = [], []
        for half in found:
            in_t = so3.rotate(mounting(theta), half.rate) / np.linalg.norm(half.rate) * _ARCSEC
            for axis in (1, 2) if half.axis == "outer" else (0, 1):
                labels.append(f"{half.position} {_AXES[axis]}t")
                across.append(float(in_t[axis]))
        out.x_labels = tuple(labels)
        out.bars(across, name, color, (len(rows), 2))
        rows.append(across)
    return Plot(
        "Half differences",
        "Half the difference of the forward and the backward mean rate: components across the axis in the platform's "
        f"frame. After compensation the largest is {np.abs(rows[1]).max():.3g} arcsec.",
        out,
    )


def _misfit(turning: list[Group], values: dict[str, float]) -> Plot:
    """Mean gyro less prediction over each turn or move, as an angle of the axis."""
    out = Figure("gyro less encoders, arcsec")
    time, error = misfit(turning, values)
    for i, axis in enumerate(_AXES):
        out.points(time, error[:, i] * _ARCSEC, f"{axis}t", COLORS[i], 6)
    return Plot(
        "Misfit by turn",
        "Mean rate of each turn or move less what encoders, earth and calibration say, over the rate: the angle by "
        "which the axis seems to be off.",
        out,
    )


def _contributions(turning: list[Group], values: dict[str, float]) -> Plot:
    """Share of each position in what is known of the angles."""
    information: dict[str, Array] = {}
    for group in turning:
        n = len(group.gyro)
        factor = IndexerAverageFactor.of(group.gyro, group.rates, 1.0, 0.0)
        bias = [values.get(name, 0.0) for name in BIAS]
        by_theta = factor(*(np.tile(block, (n, 1)) for block in (_angles(values), bias)))[1]()[0].reshape(-1, 3)
        position = f"{group.run.axis}, other at {round(np.rad2deg(group.run.other)) % 360} deg"
        information[position] = information.get(position, np.zeros(3)) + (by_theta**2).sum(axis=0)
    total = np.sum(list(information.values()), axis=0)
    out = Figure("share, %", x_title="", x_labels=THETA)
    below, left = np.zeros(len(THETA)), np.arange(len(THETA)) - 0.4
    for (position, own), color in zip(information.items(), cycle(COLORS)):
        share = 100.0 * own / np.maximum(total, 1e-300)
        out.boxes(left, left + 0.8, below, below + share, position, color)
        below = below + share
    return Plot(
        "What each position says",
        "Share of the turns and moves about each axis, the other axis standing at an angle, in the information on the "
        "mounting angles by gyro noise alone.",
        out,
    )


def _attitude(data: IndexerData, config: Config, values: dict[str, float]) -> Plot:
    """Error of the carrier's attitude put out, before and after compensation."""
    found = validate(data, config, values)[0]
    out = Figure("attitude error, deg", y_scale="log")
    said = []
    for name, error, color in (("before", found.before, COLORS[6]), ("after", found.after, COLORS[0])):
        angle = np.rad2deg(np.linalg.norm(error, axis=1))
        out.line(found.time, angle, name, color)
        rms = float(np.sqrt((angle**2).mean()))
        said.append(f"{name} compensation {rms:.4g} deg ({3600.0 * rms:.3g} arcsec) RMS")
    out.levels(0.005, dash="dashed", name="published claim")
    return Plot("Attitude output", "Angle between nRb put out and the base's attitude: " + ", ".join(said) + ".", out)
