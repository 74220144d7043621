"""Slips put into recordings: python -m benchmarks.slips RECORDING ... [--deg 0 1 2 3], or --simulated [WHAT ...].

A line a slip: verdict, what was found and when, and of head the test of the best step. Markers slip in recordings as
head reads them, and in trials of BROAD (.mat), with `--noise` added to these. In simulated recordings of the other
methods sensors slip (deg), and offsets step (m/s^2, T).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.methods.head.recording import HeadData
from datasets.broad import read_trial, to_session


@dataclass(frozen=True)
class Slip:
    """What changes in a simulated recording from some time on.

    Attributes:
        method, settings: of the recording.
        stamps: field of the data with the times of `field`.
        field: readings that change.
        change: readings and size -> readings as they are after it.
        sizes: deg, m/s^2 or T.
        names: a parameter that moves begins with one of these.
    """

    method: str
    settings: Mapping[str, Any]
    stamps: str
    field: str
    change: Callable[[Array, float], Array]
    sizes: Sequence[float]
    names: tuple[str, ...]

    def put_into(self, data: Any, size: float, share: float) -> tuple[Any, float]:
        """Data that change after a share of the recording, and that time, s."""
        time, before = getattr(data, self.stamps), getattr(data, self.field)
        at = float(time[0] + share * (time[-1] - time[0]))
        late = (time >= at).reshape(-1, *[1] * (before.ndim - 1))
        return replace(data, **{self.field: np.where(late, self.change(before, size), before)}), at


def _turned(axis: Sequence[float], readings: Array, size: float) -> Array:
    return np.asarray(readings @ so3.matrix(so3.exp(np.deg2rad(size) * np.asarray(axis))).T)


def _moved(to: Sequence[float] | float, readings: Array, size: float) -> Array:
    return np.asarray(readings + size * np.asarray(to))


_AXIS = (0.0, 0.86, 0.51)
_RAD = float(np.deg2rad(1.0))
_SHORT = {"duration_s": 30.0, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 20.0}
SIMULATED = {
    "gimbal-gyro": Slip(
        "los", _SHORT, "gyro_t", "gyro", partial(_turned, _AXIS), (0.2, 1.0, 5.0, 20.0), ("delta_", "gyro_")
    ),
    "gimbal-encoder": Slip(
        "los", _SHORT, "gimbal_t", "gimbal", partial(_moved, (_RAD, 0.0)), (0.2, 1.0, 5.0), ("delta_",)
    ),
    "indexer-gyro": Slip(
        "indexer", {}, "gyro_t", "gyro", partial(_turned, _AXIS), (0.01, 0.1, 1.0, 5.0, 20.0), ("theta_",)
    ),
    "indexer-encoder": Slip(
        "indexer", {}, "encoder_t", "inner", partial(_moved, _RAD), (0.01, 0.1, 1.0, 5.0), ("theta_z",)
    ),
    "compass-iron": Slip("tumble", {}, "mag_t", "mag", partial(_moved, (0.0, 1.0, 0.0)), (1e-6, 5e-6, 2e-5), ("mag_",)),
    "compass-with-gyro-iron": Slip(
        "tumble", {"gyro": {}}, "mag_t", "mag", partial(_moved, (0.0, 1.0, 0.0)), (1e-6, 5e-6, 2e-5), ("mag_b",)
    ),
    "cube-accelerometer": Slip(
        "cube", {}, "imu_t", "accel", partial(_moved, (0.0, 1.0, 0.0)), (0.02, 0.1, 0.5), ("accel_b",)
    ),
    "cube-iron": Slip("cube", {}, "mag_t", "mag", partial(_moved, (0.0, 1.0, 0.0)), (1e-6, 5e-6, 2e-5), ("mag_b",)),
}


def slipped(data: HeadData, deg: float, share: float, seed: int = 1) -> tuple[HeadData, float]:
    """Markers turned about a random axis from a share of the recording on, and that time, s."""
    start, stop = max(data.vision_t[0], data.head_t[0]), min(data.vision_t[-1], data.head_t[-1])
    time = float(start + share * (stop - start))
    axis = np.random.default_rng(seed).standard_normal(3)
    turn = np.where((data.vision_t >= time)[:, None], np.deg2rad(deg) * axis / np.linalg.norm(axis), 0.0)
    return replace(data, vision_wxyz=so3.multiply(data.vision_wxyz, so3.exp(turn))), time


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slips", description="Slips and steps, put in.")
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--simulated", nargs="*", choices=SIMULATED, metavar="WHAT", help=f"of {', '.join(SIMULATED)}")
    parser.add_argument("--seeds", type=int, default=3, help="of each simulated slip")
    parser.add_argument("--deg", nargs="+", type=float, default=[0.0, 1.0, 2.0, 3.0])
    parser.add_argument("--at", nargs="+", type=float, default=[0.3, 0.5, 0.7], help="shares of the recording")
    parser.add_argument("--noise", type=float, default=0.0, help="added to BROAD's motion capture, deg")
    options = parser.parse_args(arguments)
    if not options.recordings and options.simulated is None:
        parser.error("recordings, or --simulated")
    for what in () if options.simulated is None else options.simulated or SIMULATED:
        for line in _simulated(what, options.at, range(options.seeds)):
            print(line, flush=True)
    for path in options.recordings:
        session = _opened(path, float(np.deg2rad(options.noise)))
        for deg in options.deg:
            for share in options.at if deg else options.at[:1]:
                data, time = slipped(session.data, deg, share)
                print(f"{path.stem} {deg:g} deg at {time:.1f} s: {_line(replace(session, data=data))}", flush=True)
    return 0


def _simulated(what: str, shares: Sequence[float], seeds: Sequence[int]) -> Iterator[str]:
    """Yield a line for each slip of a kind, size, time and seed."""
    slip = SIMULATED[what]
    for size, share, seed in product(slip.sizes, shares, seeds):
        simulated = alidade.simulate(slip.method, slip.settings, seed)
        data, time = slip.put_into(simulated.data, size, share)
        found = alidade.open(replace(simulated, data=data))
        yield f"{what} {size:g} at {time:.1f} s, seed {seed}: {_line(found)}"


def _opened(path: Path, noise: float) -> Session:
    if path.suffix == ".mat":
        return Session(methods.method("head"), to_session(read_trial(path), 0, noise), load_config(None))
    return alidade.open(path, method="head")


def _line(session: Session) -> str:
    """Of one recording."""
    found = session.calibrate(report=False)
    kinds = [f"{f.kind} at {f.evidence['time_s']:.1f} s" for f in found.findings if f.kind in ("change", "jump")]
    best = max(found.estimate.steps or (), key=lambda step: step.statistic, default=None)
    test = "" if best is None else f", S {best.statistic:.1f} (jump {best.fall:.0f}, motion {best.by_motion:.0f})"
    return f"{found.status}, {', '.join(kinds) or 'nothing found'}{test}"


if __name__ == "__main__":
    raise SystemExit(main())
