"""Figures of the los method: the LOS error as measured and as predicted, and what is left of it.

A prediction starts from the first picture of a target and is carried on by gyro, gimbal and calibration alone.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.factors.gimbal import SMOOTHING
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.display.units import rounded
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.los.corrected import angles, rates, taken
from alidade.pipelines.methods.los.guess import camera, carried_errors
from alidade.pipelines.methods.los.parameters import ANGLES, OFFSET
from alidade.pipelines.methods.los.pictures import select_pictures
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import DEFAULT_NOISE, first_given

_AXES = ("phx", "phz")
_MRAD = 1e3
_URAD = 1e6
# What is left is shown out to so many times its usual size; outliers lie beyond.
_SHOWN = 6.0


def los_plots(data: LosData, calibration: Calibration) -> list[Plot]:
    """LOS error measured and predicted, and their difference with and without the mounting angles."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    sigma = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
    margin = SMOOTHING if OFFSET in values else 0.0
    rows, starts, _ = select_pictures(data, np.full(len(data.image_t), sigma), margin)
    time, measured = data.image_t[rows], data.error[rows]
    chains = np.split(np.arange(len(rows)), np.flatnonzero(starts)[1:])
    unmounted = {name: value for name, value in values.items() if name not in ANGLES}
    gyro = GyroPath(data.gyro_t, rates(data, values))
    with_angles, without = (
        np.concatenate([_predicted(data, gyro, time[chain], measured[chain], v) for chain in chains])
        for v in (values, unmounted)
    )
    return [
        _measured_and_predicted(time, measured[:, :2], with_angles),
        _left(time, measured[:, :2] - without, measured[:, :2] - with_angles),
    ]


def _predicted(data: LosData, gyro: GyroPath, time: Array, measured: Array, values: Mapping[str, float]) -> Array:
    """phx, phz (n, 2) of one target's pictures as carried on from the first, rad."""
    names = tuple(name for name in ANGLES if name in values)
    at = taken(data, time, values)
    cRm = camera(angles(data, at, values), np.array([values[name] for name in names]), names)
    scale = np.array([1.0 + values.get("los_scale", 0.0)] * 2 + [1.0])
    target_rate = np.array([values.get("target_rate_x", 0.0), 0.0, values.get("target_rate_z", 0.0)])
    return scale[:2] * carried_errors(at, cRm, measured / scale, gyro, target_rate)


def _measured_and_predicted(time: Array, measured: Array, predicted: Array) -> Plot:
    out = Figure("LOS error, mrad")
    for i, axis in enumerate(_AXES):
        out.points(time, _MRAD * measured[:, i], f"{axis} measured", COLORS[i], 3, alpha=0.45)
        out.line(time, _MRAD * predicted[:, i], f"{axis} predicted", COLORS[i])
    reach = 1.2 * _MRAD * max(float(np.abs(predicted).max()), _SHOWN * float(robust_sigma(measured - predicted)))
    middle = _MRAD * float(np.median(measured))
    out.y_range = (middle - reach, middle + reach)
    return Plot(
        "LOS error measured and predicted",
        "Points: where the camera saw the target. Lines: where it should be by gyro, gimbal and calibration alone, "
        "from the first picture of a target on.",
        out,
    )


def _left(time: Array, without: Array, compensated: Array) -> Plot:
    out = Figure("measured less predicted, µrad")
    for i, axis in enumerate(_AXES):
        out.points(time, _URAD * without[:, i], f"{axis}, mounting angles zero", COLORS[4 + 2 * i], 3)
    for i, axis in enumerate(_AXES):
        out.points(time, _URAD * compensated[:, i], f"{axis}, mounting angles found", COLORS[i], 3)
    spread = [_URAD * robust_sigma(errors) for errors in (without, compensated)]
    reach = _SHOWN * max(*spread, 1.0)
    out.y_range = (-reach, reach)
    return Plot(
        "What gyro, gimbal and calibration leave of the LOS error",
        f"phx is the angle to the target below, phz to the right. Per axis {rounded(spread[0], 3)} µrad with the "
        f"mounting angles zero, {rounded(spread[1], 3)} µrad with those found (standard deviations, from the median). "
        "The gyro's noise adds up from a target's first picture on, so what is left may wander; it should not follow "
        "the sway.",
        out,
    )
