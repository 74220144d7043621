"""Attitudes to rest a cube in next: those that add most information beyond the poses there are.

What a pose adds is judged sensor by sensor. Accelerometer and magnetometer at rest tell of a triad's twelve numbers by
x = (n, 1), n the direction of gravity or field in the body: a pose adds log(1 + x' N^-1 x), N the sum of xx' so far
(D-optimal design). The gyro is told of by the turns between poses in the same way, x the turn's rotation vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.earth import magnetic_field
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.cube.faces import SIDES, Resting
from alidade.pipelines.methods.cube.scenario import YEAR, CubeScenario
from alidade.pipelines.methods.cube.simulation import attitudes

_LEANS = (0.0, 45.0)
# Fisher information before any pose, small beside what one adds: makes the sum invertible.
_REGULARISER = 1e-3


@dataclass(frozen=True, eq=False)
class _FisherInformation:
    """Of accelerometer, magnetometer (if any) and turns, and the attitude rested in last."""

    accel: Array
    mag: Array | None
    turns: Array
    last: Array | None


def next_poses(scenario: CubeScenario, seed: int, together: int) -> tuple[list[Resting], list[Resting]]:
    """Single poses that tell most, of one sensor or of all, and the best so many to rest in one after the other."""
    field = None
    if scenario.magnetometer:
        place = np.deg2rad([scenario.place.latitude_deg, scenario.place.longitude_deg])
        field = magnetic_field(float(place[0]), float(place[1]), scenario.place.height, YEAR)
        field = field / np.linalg.norm(field)
    known = _FisherInformation(
        _REGULARISER * np.eye(4), None if field is None else _REGULARISER * np.eye(4), _REGULARISER * np.eye(3), None
    )
    for nRb in attitudes(scenario, seed):
        known = _after(known, nRb, field)
    choices = [
        Resting(up=up, north=north, lean_deg=lean)
        for up in SIDES
        for north in SIDES
        for lean in _LEANS
        if up[1] != north[1]
    ]
    gains = _gains(known, choices, field)
    single = [choices[int(np.argmax(column))] for column in [gains.sum(axis=1), *gains.T]]
    series: list[Resting] = []
    for _ in range(together):
        series.append(choices[int(np.argmax(_gains(known, choices, field).sum(axis=1)))])
        known = _after(known, series[-1].nRb, field)
    return list(dict.fromkeys(single)), series


def _rows(known: _FisherInformation, nRb: Array, field: Array | None) -> list[tuple[Array, Array]]:
    """Information so far and the row that resting in nRb next adds to it, of each sensor."""
    bRn = so3.inverse(nRb)
    found = [(known.accel, np.append(so3.rotate(bRn, [0.0, 0.0, 1.0]), 1.0))]
    if field is not None and known.mag is not None:
        found.append((known.mag, np.append(so3.rotate(bRn, field), 1.0)))
    turned = np.zeros(3) if known.last is None else so3.log(so3.multiply(so3.inverse(known.last), nRb))
    return [*found, (known.turns, turned)]


def _after(known: _FisherInformation, nRb: Array, field: Array | None) -> _FisherInformation:
    sums = [information + np.outer(row, row) for information, row in _rows(known, nRb, field)]
    return _FisherInformation(sums[0], sums[1] if len(sums) > 2 else None, sums[-1], nRb)


def _gains(known: _FisherInformation, choices: Sequence[Resting], field: Array | None) -> Array:
    """(choices, sensors)"""
    return np.array(
        [
            [np.log1p(row @ np.linalg.solve(information, row)) for information, row in _rows(known, each.nRb, field)]
            for each in choices
        ]
    )
