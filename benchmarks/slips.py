"""Slips of the markers put into recordings of head: python -m benchmarks.slips RECORDING ... [--deg 0 1 2 3].

A line a slip: verdict, what was found and when, and the test of the best step. Recordings as head reads them, or trials
of BROAD (.mat), with `--noise` added to these.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import alidade
from alidade.factors import so3
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.methods.head.recording import HeadData
from datasets.broad import read_trial, to_session


def slipped(data: HeadData, deg: float, share: float, seed: int = 1) -> tuple[HeadData, float]:
    """Markers turned about a random axis from a share of the recording on, and that time, s."""
    start, stop = max(data.vision_t[0], data.head_t[0]), min(data.vision_t[-1], data.head_t[-1])
    time = float(start + share * (stop - start))
    axis = np.random.default_rng(seed).standard_normal(3)
    turn = np.where((data.vision_t >= time)[:, None], np.deg2rad(deg) * axis / np.linalg.norm(axis), 0.0)
    return replace(data, vision_wxyz=so3.multiply(data.vision_wxyz, so3.exp(turn))), time


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.slips", description="Slips of the markers, put in.")
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--deg", nargs="+", type=float, default=[0.0, 1.0, 2.0, 3.0])
    parser.add_argument("--at", nargs="+", type=float, default=[0.3, 0.5, 0.7], help="shares of the recording")
    parser.add_argument("--noise", type=float, default=0.0, help="added to BROAD's motion capture, deg")
    options = parser.parse_args(arguments)
    for path in options.recordings:
        session = _opened(path, float(np.deg2rad(options.noise)))
        for deg in options.deg:
            for share in options.at if deg else options.at[:1]:
                data, time = slipped(session.data, deg, share)
                print(f"{path.stem} {deg:g} deg at {time:.1f} s: {_line(replace(session, data=data))}", flush=True)
    return 0


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
