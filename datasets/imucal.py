"""The Ferraris session of imucal as a session of the `indexer` method.

imucal (MaD Lab, FAU Erlangen-Nuernberg, MIT licence) has an IMU held still in six positions and turned by hand once
about each of its axes. A turn about x or y plays a turn of the outer axis, the inner one standing at 0 or -90 degrees;
a turn about z plays one of the inner axis:

    python -m datasets.imucal annotated_session.csv --out imucal.mcap

There is no encoder. What is known of a turn is that it ends where it began, at rest: its encoder turns uniformly from
the first sample of the part to the last. The config says so with an encoder noise of one degree, far above the scatter
at rest, so that each turn is a single window of which only the ends count.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.indexer.recording import IndexerData

EPOCH_NS = 1_600_000_000_000_000_000  # the session carries no date
RATE_HZ = 204.8
# Nominal counts per deg/s of the gyro's range of 2000 deg/s; what it really is, the calibration's scale says.
COUNTS = 16.4
# Between two annotated parts the recording is cut; they are set this far apart, s.
_PAUSE = 1.0
_STILL = ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a")
# Driven axis of the indexer, angle of its inner axis.
_TURNS = {"x_rot": ("outer", 0.0), "y_rot": ("outer", -0.5 * np.pi), "z_rot": ("inner", 0.0)}

CONFIG = """\
method: indexer
noise: {gyro_density: 3.0e-4, gyro_bias_walk: 0.0, encoder: 1.75e-2}
priors: {theta_x: 0.1, theta_y: 0.1, theta_z: 0.1, gyro_bias_x: 1.0e-2, gyro_bias_y: 1.0e-2, gyro_bias_z: 1.0e-2,
         gyro_scale_x: 0.05, gyro_scale_y: 0.05, gyro_scale_z: 0.05, axis_nonperpendicularity: 1.0e-2}
require: {theta_x: 2.0e-2, theta_y: 2.0e-2, theta_z: 2.0e-2, gyro_bias_x: 1.0e-3, gyro_bias_y: 1.0e-3,
          gyro_bias_z: 1.0e-3, gyro_scale_x: 1.0e-2, gyro_scale_y: 1.0e-2, gyro_scale_z: 1.0e-2,
          axis_nonperpendicularity: 2.0e-2}
"""


def read_parts(path: Path) -> dict[str, Array]:
    """Read the gyro counts (n, 3) of each annotated part.

    Raises:
        InputError: the file is not there or is not the annotated session.
    """
    parts: dict[str, list[list[float]]] = {}
    try:
        with path.open() as table:
            for row in csv.DictReader(table):
                parts.setdefault(row["part"], []).append([float(row[f"gyr_{axis}"]) for axis in "xyz"])
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: not imucal's annotated session (part, gyr_x, gyr_y, gyr_z): {error}") from error
    missing = [name for name in (*_STILL, *_TURNS) if name not in parts]
    if missing:
        raise InputError(f"{path}: no part {', '.join(missing)}")
    return {name: np.array(rows) for name, rows in parts.items()}


def to_session(parts: dict[str, Array]) -> IndexerData:
    """Concatenate the parts to a session, gyro and encoder at the same stamps."""
    t: list[Array] = []
    angles: list[Array] = []
    now = 0.0
    for name in (*_STILL, *_TURNS):
        n = len(parts[name])
        t.append(now + np.arange(n) / RATE_HZ)
        now = float(t[-1][-1]) + _PAUSE
        angle = np.zeros((n, 2))
        if name in _TURNS:
            driven, inner = _TURNS[name]
            angle[:, 1] = inner
            angle[:, 0 if driven == "outer" else 1] = np.linspace(0.0, 2.0 * np.pi, n)
        angles.append(angle)
    stamps = np.round(np.concatenate(t) * 1e9) * 1e-9
    outer, inner_angles = np.concatenate(angles).T
    gyro = np.deg2rad(np.concatenate([parts[name] for name in (*_STILL, *_TURNS)]) / COUNTS)
    return IndexerData(EPOCH_NS, stamps, gyro, stamps, outer, inner_angles, latitude_deg=None)


def main() -> None:
    """Convert the parts to a session file."""
    parser = argparse.ArgumentParser(description="Turn imucal's Ferraris session into a session of the indexer method.")
    parser.add_argument("session", type=Path, help="annotated_session.csv")
    parser.add_argument("--out", type=Path, required=True, help="the session to write (.mcap)")
    options = parser.parse_args()
    try:
        method("indexer").write_data(options.out, to_session(read_parts(options.session)), config_yaml=CONFIG)
    except InputError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
