"""Tables of the cube method: K taken apart, noise at rest, static poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from alidade.pipelines.display.sphere_map import described
from alidade.pipelines.display.table import Table
from alidade.pipelines.display.units import rounded, to_digits_of
from alidade.pipelines.reports.result import Calibration

NAMES = {"accel": "accelerometer", "gyro": "gyro", "mag": "magnetometer"}
_NOISE = {"accel": ("µg/√Hz", 1e6 / 9.80665), "gyro": ("deg/√h", np.rad2deg(60.0)), "mag": ("nT/√Hz", 1e9)}
_PARTS = (
    ("scale", "%", ("x", "y", "z")),
    ("nonorthogonality", "deg", ("xy", "xz", "yz")),
    ("mounting", "deg", ("x", "y", "z")),
)
# A part of K known no better than this, %, or deg, is not known.
_UNKNOWN = 20.0


def cube_tables(calibration: Calibration) -> list[Table]:
    """Of what was found beside the parameters; empty ones are left out."""
    tables = (_taken_apart(calibration), _noise(calibration), _static_poses(calibration), _disturbed(calibration))
    return [table for table in tables if table.rows]


def rows_of(calibration: Calibration, name: str) -> Sequence[Mapping[str, Any]]:
    """Rows of a table of findings; none if there is no such table."""
    return calibration.tables.get(name, ())


def _taken_apart(calibration: Calibration) -> Table:
    """K of each triad as scale, non-orthogonality and mounting."""
    triads = rows_of(calibration, "triads")
    rows = []
    for part, unit, axes in _PARTS if triads else ():
        for i, axis in enumerate(axes):
            cells = [_number(part, triad[part][i], triad[f"{part}_sigma"][i], unit) for triad in triads]
            what = {"nonorthogonality": "non-orthogonality", "scale": "scale error"}.get(part, part)
            rows.append((f"{what} {axis}, {unit}", *cells))
    return Table(
        "Scale, non-orthogonality, misalignment",
        "What is in K: by how much each axis says too much, by how much two of them are closer than a right angle, "
        "and the rotation vector that turns the body's axes into the sensor's, with sigmas.",
        ("", *(NAMES[triad["sensor"]] for triad in triads)),
        tuple(rows),
    )


def _number(part: str, value: float, sigma: float, unit: str) -> str:
    factor = 100.0 if unit == "%" else np.rad2deg(1.0)
    shown, spread = factor * (value - (part == "scale")), factor * sigma
    if not spread < _UNKNOWN:
        return "unknown"
    return f"{to_digits_of(shown, spread)} ± {rounded(spread)}" if spread > 0.0 else f"{to_digits_of(shown, 0.0)} fixed"


def _noise(calibration: Calibration) -> Table:
    rows = []
    for row in rows_of(calibration, "noise"):
        unit, factor = _NOISE[row["sensor"]]
        axes = (f"{factor * density:.3g}" for density in row["density"])
        rows.append((NAMES[row["sensor"]], *axes, f"{factor * row['stated']:.3g}", unit, f"{row['rate_hz']:.5g}"))
    return Table(
        "White noise at rest",
        "With K applied, from the Allan deviation over a quarter of a second in the static poses; stated is what "
        "the solution took it to be.",
        ("sensor", "x", "y", "z", "stated", "unit", "rate, Hz"),
        tuple(rows),
    )


def _disturbed(calibration: Calibration) -> Table:
    rows = [
        (str(row["pose"]), f"{row['start_s']:.2f}", f"{row['end_s']:.2f}", f"{1e6 * row['size']:.2g}")
        for row in rows_of(calibration, "disturbed_poses")
    ]
    return Table(
        "Poses with another field",
        "Their magnetometer was left out: the field there is off by more than noise, as near iron or a current.",
        ("pose", "from, s", "to, s", "off by, µT"),
        tuple(rows),
    )


def _static_poses(calibration: Calibration) -> Table:
    found = rows_of(calibration, "static_poses")
    whole = list(dict.fromkeys(family for row in found for family in row["used"]))
    rows = [
        (
            str(k + 1),
            f"{row['start_s']:.2f}",
            f"{row['end_s']:.2f}",
            described(row["up"]),
            ", ".join(family for family in whole if family not in row["used"]),
        )
        for k, row in enumerate(found)
    ]
    return Table(
        "Static poses",
        f"When gyro and accelerometer were quiet, and which side was up. Used of each: {', '.join(whole)}, but for "
        "what is named as not used.",
        ("pose", "from, s", "to, s", "up", "not used"),
        tuple(rows),
    )
