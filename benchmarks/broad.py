"""BROAD trials without any config, scored: python -m benchmarks.broad [TRIAL ...] [--noise DEG ...] [--window S].

A line a trial: verdict, attitude against motion capture (carried by the gyro to every sample; averaged over 1 s, where
motion capture's own noise hardly counts), bias against the mean rate at rest, and what the noise was found to be. With
`--judge` also a judge that shares nothing with vision or gyro: the acceleration turned by the attitude against the
second derivative of the captured position, for the estimate and for motion capture itself.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.methods.head.report import helmet_gyro
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from datasets.broad import Trial, marker_attitudes, read_trial, score, to_session

DATA = Path("../shared/data/broad")
# Hz, where the judge compares; s at the ends of a piece that its filter spoils, and the shortest piece it takes.
_BAND, _SPOILT_S, _SHORTEST_S = (0.8, 3.0), 1.0, 8.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.broad", description="Real recordings, scored.")
    parser.add_argument("trials", nargs="*", help="first letters of their files' names; default: all there are")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the trials")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.5], help="added to motion capture, deg")
    parser.add_argument("--solver", nargs="+", default=["batch"], choices=("batch", "incremental"))
    parser.add_argument("--no-check", action="store_true", help="incremental: without a final batch solution")
    parser.add_argument("--config", type=Path, help="by default none")
    parser.add_argument("--window", type=float, default=np.inf, help="calibrate disjoint parts of so many seconds")
    parser.add_argument("--judge", action="store_true", help="compare accelerations too")
    options = parser.parse_args(arguments)
    for path in sorted(options.data.glob("*.mat")):
        if options.trials and not path.name.startswith(tuple(options.trials)):
            continue
        trial = read_trial(path)
        for noise in options.noise:
            config = load_config(None, options.config)
            for begin, session in _parts(trial, float(np.deg2rad(noise)), options.window, config):
                for solver in options.solver:
                    start = time.process_time()
                    calibration = session.calibrate(solver, check=not options.no_check)
                    seconds = time.process_time() - start
                    named = f"{path.name[:2]} {noise:.1f} {begin:3.0f} s {solver:11s}"
                    print(f"{named} {_line(trial, calibration)} {seconds:.0f} s", flush=True)
                    if options.judge:
                        print(f"   {judged(path, trial, calibration)}", flush=True)
    return 0


def _parts(trial: Trial, noise: float, window: float, config: Config) -> Iterator[tuple[float, Session]]:
    """Sessions of disjoint windows (s) and when they begin, s; of an infinite window, of the whole trial."""
    head, data = methods.method("head"), to_session(trial, 0, noise)
    end = float(min(data.head_t[-1], data.vision_t[-1]))
    for begin in np.arange(max(1.0, end // window)) * min(window, end):
        part = data if window > end else head.faults.segment(data, begin, begin + window)
        yield float(begin), Session(head, part, config)


def _line(trial: Trial, calibration: Calibration) -> str:
    """Of one calibration."""
    estimate = calibration.estimate
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    sigmas = dict(zip(estimate.names, estimate.sigmas.tolist(), strict=True))
    assert estimate.attitudes is not None
    found = score(trial, values, estimate.attitudes.time, estimate.attitudes.wxyz)
    at_rest = _at_rest(trial, estimate.names)
    z = found.bias_error / np.sqrt(np.diag(at_rest @ estimate.covariance @ at_rest.T))
    kappa = values.get("vision_filter", 0.0)
    levels = {level.noise.name: level.used for level in estimate.levels}
    rejected = sum(estimate.rejected.values()) / max(sum(len(r.time) for r in estimate.residuals.values()), 1)
    return (
        f"{calibration.status:12s} rms {np.rad2deg(found.attitude_rms):.3f} slow {np.rad2deg(found.slow_rms):.3f} deg, "
        f"offset {1e3 * found.time_offset:.2f}+-{1e3 * sigmas['time_offset']:.2f} ms, "
        f"bias z {np.abs(z).max():.1f} ({np.rad2deg(np.abs(found.bias_error).max()):.3f} deg/s), "
        f"vision scale {100.0 * values.get('vision_scale', 0.0):.2f}+-{100.0 * sigmas.get('vision_scale', 0.0):.2f} %, "
        f"filter {1e3 * np.sign(kappa) * np.sqrt(2.0 * abs(kappa)):.1f} ms, rejected {100.0 * rejected:.1f} %, "
        f"{' '.join(f'{name} {level:.2g}' for name, level in levels.items())}"
    )


def _at_rest(trial: Trial, names: Sequence[str]) -> Array:
    """(3, n) derivative of what the gyro shows at rest by the reported numbers."""
    force = trial.force[~trial.moving].mean(axis=0)
    J = np.zeros((3, len(names)))
    for i, row in enumerate("xyz"):
        J[i, names.index(f"gyro_bias_{row}")] = 1.0
        for j, column in enumerate("xyz"):
            if (name := f"gyro_g_{row}{column}") in names:
                J[i, names.index(name)] = force[j]
    return J


def judged(path: Path, trial: Trial, calibration: Calibration) -> str:
    """What is left of the captured position's acceleration, mm/s^2 RMS, by motion capture and by the estimate."""
    from scipy.io import loadmat

    estimate = calibration.estimate
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    position, gyro = loadmat(str(path))["opt_pos"], helmet_gyro(to_session(trial, 0), values)
    assert estimate.attitudes is not None
    left: dict[str, list[tuple[Array, Array]]] = {"motion capture": [], "estimate": []}
    for piece in _pieces(trial, position):
        at = trial.t[piece] + values["time_offset"]
        shown = marker_attitudes(trial, values, estimate.attitudes.time, estimate.attitudes.wxyz, at)
        for name, bRh in (("motion capture", trial.attitude[piece]), ("estimate", shown)):
            left[name].append(_accelerations(trial, values, gyro, at, bRh, position[piece]))
    out = []
    for name, parts in left.items():
        y, A = (np.concatenate(each) for each in zip(*parts, strict=True))
        rest = y - A @ np.linalg.lstsq(A, y)[0]
        out.append(f"{name} {1e3 * np.sqrt((rest**2).mean()):.1f}")
    return f"acceleration off by, mm/s^2 RMS, {_BAND[0]} to {_BAND[1]} Hz: {', '.join(out)}"


def _pieces(trial: Trial, position: Array) -> list[slice]:
    """The three longest in motion and in sight."""
    good = np.isfinite(trial.attitude[:, 0]) & np.isfinite(position[:, 0]) & trial.moving
    ends = np.flatnonzero(np.diff(np.r_[0, good.astype(int), 0])).reshape(-1, 2)
    ends = ends[np.argsort(ends[:, 0] - ends[:, 1])][:3]
    return [slice(a, b) for a, b in ends.tolist() if trial.t[b - 1] - trial.t[a] > _SHORTEST_S]


def _accelerations(
    trial: Trial, values: dict[str, float], gyro: object, at: Array, bRh: Array, position: Array
) -> tuple[Array, Array]:
    """Filtered difference, and what lever arm, offset and errors of the accelerometer add to it (15 columns)."""
    from scipy.signal import butter, sosfiltfilt

    step = trial.t[1] - trial.t[0]
    passed = butter(2, _BAND, "bandpass", fs=1.0 / step, output="sos")
    cut = round(_SPOILT_S / step)

    def kept(x: Array) -> Array:
        return np.asarray(sosfiltfilt(passed, x, axis=0)[cut:-cut])

    vRh = so3.exp(np.array([values[f"helmet_mount_{axis}"] for axis in "xyz"]))
    bRv = so3.matrix(so3.multiply(bRh, so3.inverse(np.broadcast_to(vRh, bRh.shape))))
    force = np.column_stack([np.interp(at, trial.t, trial.force[:, i]) for i in range(3)])
    w = gyro.rate(at)  # type: ignore[attr-defined]
    turned = so3.hat(np.gradient(w, step, axis=0)) + so3.hat(w) @ so3.hat(w)
    accelerated = np.gradient(np.gradient(position, step, axis=0), step, axis=0)
    columns = [bRv @ turned, bRv, np.einsum("nij,nk->nijk", bRv, force).reshape(len(at), 3, 9)]
    A = kept(np.concatenate(columns, axis=2).reshape(len(at), -1)).reshape(-1, 15)
    return kept(np.einsum("nij,nj->ni", bRv, force) - accelerated).ravel(), A


if __name__ == "__main__":
    sys.exit(main())
