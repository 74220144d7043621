"""Parts of BROAD trials altered in known ways: python -m benchmarks.altered [--parts N] [--first SEED] [--solver ...].

A random part of a trial, its gyro turned, scaled, biased and at a lower rate; its motion capture at the rate and with
the noise, delay, outliers and slip of other systems. A line a part: verdict, what moved, how far mount and time offset
are from those of the whole trial as it is. Then the errors of healthy parts in sigmas, and what each verdict was.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.reports.result import Calibration
from benchmarks.broad import DATA
from datasets.broad import read_trial, to_session

_MOUNT = tuple(f"helmet_mount_{axis}" for axis in "xyz")
# Sigmas of the mount, rad, and the time offset, s, that the whole trial gives.
_KNOWN_MOUNT, _KNOWN_OFFSET = np.deg2rad(0.03), 2e-4


@dataclass(frozen=True)
class Alteration:
    """What is done to a part of a trial.

    Attributes:
        trial: index among the trials.
        begin, length: of the part, s.
        turned: (4,) the gyro's frame to the altered one, v'Rv.
        scale, bias: of the gyro, and (3,) rad/s.
        every: samples of the gyro that are averaged.
        rate_hz, noise, delay: of motion capture, Hz, rad, s.
        outliers: share of attitudes turned by .3 rad an axis.
        slip, at: (3,) rad of the markers, and from when on, s.
        seed: of all noise.
    """

    trial: int
    begin: float
    length: float
    turned: Array
    scale: float
    bias: Array
    every: int
    rate_hz: float
    noise: float
    delay: float
    outliers: float
    slip: Array
    at: float
    seed: int

    @classmethod
    def drawn(cls, seed: int, durations: Sequence[float]) -> Alteration:
        """Draw an alteration of one of some trials, by their durations, s."""
        rng = np.random.default_rng(seed)
        trial = int(rng.integers(len(durations)))
        length = min(float(rng.choice([25.0, 40.0, 60.0, 120.0])), durations[trial])
        begin, axis = float(rng.uniform(0.0, durations[trial] - length)), rng.standard_normal(3)
        deg = float(rng.choice([1.0, 2.0, 4.0, 8.0])) * (rng.random() < 0.25)
        return cls(
            trial,
            begin,
            length,
            so3.exp(rng.standard_normal(3) * (rng.random() < 0.7)),
            0.01 * rng.standard_normal() * (rng.random() < 0.5),
            np.deg2rad(0.5) * rng.standard_normal(3) * (rng.random() < 0.5),
            int(rng.choice([1, 1, 2, 3])),
            float(rng.choice([10.0, 15.0, 25.0, 30.0, 50.0])),
            float(np.deg2rad(rng.choice([0.0, 0.1, 0.3, 1.0]))),
            0.04 * rng.standard_normal() * (rng.random() < 0.7),
            float(rng.choice([0.0, 0.0, 0.03])),
            np.deg2rad(deg) * axis / np.linalg.norm(axis),
            begin + length * float(rng.uniform(0.3, 0.7)),
            seed,
        )

    def of(self, data: HeadData) -> HeadData:
        """Alter a whole trial, whose vision has `rate_hz` and no noise, and cut the part out."""
        rng, n = np.random.default_rng([self.seed, 1]), len(data.head_t) // self.every
        assert data.head_force is not None

        def averaged(x: Array) -> Array:
            return np.asarray(x[: n * self.every].reshape(n, self.every, -1).mean(axis=1))

        t, wxyz = data.vision_t + self.delay, data.vision_wxyz
        wild = rng.random((len(t), 1)) < self.outliers
        off = self.noise * rng.standard_normal((len(t), 3)) + 0.3 * wild * rng.standard_normal((len(t), 3))
        wxyz = so3.compose(wxyz, so3.exp(np.where((t > self.at)[:, None], self.slip, 0.0)), so3.exp(off))
        altered = replace(
            data,
            head_t=averaged(data.head_t)[:, 0],
            head_gyro=(1.0 + self.scale) * so3.rotate(self.turned, averaged(data.head_gyro)) + self.bias,
            head_force=so3.rotate(self.turned, averaged(data.head_force)),
            vision_t=t,
            vision_wxyz=wxyz,
            vision_cov=None,
            truth_t=None,
            truth_wxyz=None,
        )
        return methods.method("head").faults.segment(altered, self.begin, self.begin + self.length)


def calibrated(data: HeadData, solver: str = "batch") -> Calibration:
    """Calibrate a recording by one solver, without any config and without the other one as a check."""
    return Session(methods.method("head"), data, load_config(None)).calibrate(solver, check=False)


def errors(found: Calibration, whole: Calibration, by: Alteration) -> tuple[Array, Array]:
    """Errors (4,) of the mount, rad, and the time offset, s, against the whole trial's, and their sigmas."""
    mount, true = (np.array([each.values[name] for name in _MOUNT]) for each in (found, whole))
    off = so3.local(so3.multiply(by.turned, so3.exp(true)), so3.exp(mount))
    rows = [found.estimate.names.index(name) for name in _MOUNT]
    J = so3.right_jacobian(mount)
    covariance = J @ found.estimate.covariance[np.ix_(rows, rows)] @ J.T
    late = found.values["time_offset"] - whole.values["time_offset"] + by.delay
    sigmas = np.append(np.sqrt(np.diag(covariance) + _KNOWN_MOUNT**2), 0.0)
    sigmas[3] = np.hypot(found.parameters["time_offset"].sigma, _KNOWN_OFFSET)
    return np.append(off, late), sigmas


def main(arguments: Sequence[str] | None = None) -> int:
    """Print how altered parts of BROAD trials are calibrated, a line each; then shares of errors, and verdicts."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.altered", description="Real recordings, altered.")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the trials")
    parser.add_argument("--parts", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first part")
    parser.add_argument("--solver", default="batch", choices=("batch", "incremental"))
    options = parser.parse_args(arguments)
    paths = sorted(options.data.glob("*.mat"))
    trials = [read_trial(path) for path in paths]
    durations = [float(trial.t[np.isfinite(trial.attitude[:, 0])][-1]) for trial in trials]

    @cache
    def whole(trial: int) -> Calibration:
        return calibrated(to_session(trials[trial], 0, 0.0))

    verdicts, z = Counter[tuple[str, str]](), []
    for seed in range(options.first, options.first + options.parts):
        by = Alteration.drawn(seed, durations)
        found = calibrated(by.of(to_session(trials[by.trial], 0, 0.0, by.rate_hz)), options.solver)
        off, sigmas = errors(found, whole(by.trial), by)
        moved = sorted({f.kind for f in found.findings} & {"change", "jump", "hypothesis"})
        deg = float(np.rad2deg(np.linalg.norm(by.slip)))
        if not deg:
            z.append(np.abs(off / sigmas))
        verdicts["slip" if deg else "healthy", f"{found.status}{', named' if deg and moved else ''}"] += 1
        print(
            f"{seed:4d} {paths[by.trial].name[:2]} {by.begin:3.0f}+{by.length:3.0f} s, camera {by.rate_hz:2.0f} Hz "
            f"{np.rad2deg(by.noise):.1f} deg, slip {deg:.0f} deg: {found.status:12s} {', '.join(moved):18s} mount off "
            f"{np.rad2deg(np.linalg.norm(off[:3])):.2f} deg ({np.abs(off / sigmas)[:3].max():.1f} sigmas), "
            f"offset {1e3 * off[3]:.2f} ms ({np.abs(off / sigmas)[3]:.1f})",
            flush=True,
        )
    each = np.concatenate(z) if z else np.zeros(0)
    shares = [f"{100.0 * np.mean(each < k):.1f} % within {k}" for k in (1, 2, 3)]
    print(f"healthy: of {len(each)} errors {', '.join(shares)} sigmas")
    for (what, verdict), count in sorted(verdicts.items()):
        print(f"{what:8s} {verdict:24s} {count}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
