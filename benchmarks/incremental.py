"""The incremental solver over a long recording: cost of an update at the end against the start, memory, batch's answer.

ALIDADE_BENCH_MINUTES=60 python -m benchmarks incremental is the hour; by default it is five minutes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.batch import IMAGES_PER_S, los_problem
from benchmarks.measure import Ratio, peak_mib, resident_mib
from pipelines.solvers.batch import solve_batch
from pipelines.solvers.incremental import DEFAULT_WINDOW, Run

MINUTES = float(os.environ.get("ALIDADE_BENCH_MINUTES", "5"))
# Of the recording, s, before the window has filled and the last batch re-initialisation is behind.
_FILLED = 60.0


def run() -> Iterator[Ratio]:
    """Los at 50 updates/s."""
    problem = los_problem(round(MINUTES * 60.0 * IMAGES_PER_S))
    solver = Run(problem, DEFAULT_WINDOW)
    seconds, memory = [], []
    begun = time.process_time()
    for step in problem.steps(1):
        made = time.process_time()
        solver.add_step(step)
        seconds.append((step.time, made - begun, time.process_time() - made))
        if len(seconds) % 500 == 0:
            memory.append((step.time, resident_mib()))
        begun = time.process_time()
    t, making, cost = np.array(seconds).T
    first, last = (t >= _FILLED) & (t < _FILLED + 60.0), t >= t[-1] - 60.0
    # Within an hour a machine gets faster and slower: making a step's factors, always the same work, tells how much.
    pace = float(np.median(making[last]) / np.median(making[first]))
    growth = float(np.median(cost[last]) / np.median(cost[first]))
    slowest = 1e3 * np.quantile(cost[t >= _FILLED], 0.999)
    compared = (
        f"median update of the last minute over the second's, {MINUTES:g} min at {IMAGES_PER_S:g}/s: {growth:.2f} on a "
        f"machine that then took {pace:.2f} times as long for the same work; {1e3 * np.median(cost[last]):.2f} ms, "
        f"99.9th percentile {slowest:.1f} ms (20 wanted), peak {peak_mib():.0f} MiB"
    )
    yield Ratio("incremental.growth", compared, growth / pace, wanted=1.2)
    times, resident = np.array(memory).T
    late = resident[times >= t[-1] * 5.0 / 6.0]
    yield Ratio(
        "incremental.memory",
        "memory at the end over that before the last sixth",
        float(late[-1] / late[0]),
        tolerance=0.02,
        wanted=1.02,
    )
    estimate, batch = solver.finish(float(cost.sum())), solve_batch(problem)
    off = float((np.abs(estimate.values - batch.values) / batch.sigmas)[:4].max())
    yield Ratio(
        "incremental.answer", "largest difference of the angles from batch, sigmas", off, tolerance=1.0, wanted=0.3
    )
