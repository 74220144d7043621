"""The incremental solver over a long recording: cost of an update at the end against the start, memory, batch's answer.

ALIDADE_BENCH_MINUTES=60 python -m benchmarks incremental is the hour; by default it is five minutes.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Sensors
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, IncrementalSolver
from benchmarks.batch import IDEAL, IMAGES_PER_S, los_problem
from benchmarks.measure import Ratio, peak_mib, resident_mib

MINUTES = float(os.environ.get("ALIDADE_BENCH_MINUTES", "5"))
# Of the recording, s, before the window has filled and the last batch re-initialisation is behind.
_FILLED = 60.0
# Recordings in which assumptions are free, s.
_SHORT = 100.0
# Goals, ms: the median for a picture, and the 99.9th percentile of an update.
_MEDIAN, _SLOWEST = 1.0, 5.0


@dataclass(frozen=True)
class _Measured:
    """A run, step by step: its time and the processor time of making its factors and of the update (n,), all in s.

    `pictures` are in each, `young` tells which updates left the run young; `memory` are rows of time, s, and MiB held.
    """

    run: IncrementalSolver
    time: Array
    making: Array
    cost: Array
    pictures: Array
    young: Mask
    memory: Array

    def against_goals(self, name: str, what: str) -> Iterator[Ratio]:
        """Median a picture and 99.9th percentile of an update over their goals, once a run may be no longer young."""
        late = self.time >= _FILLED
        cost, pictures = 1e3 * self.cost[late], self.pictures[late]
        each, slowest = float(np.median(cost / pictures)), float(np.quantile(cost, 0.999))
        compared = (
            f"{what}, {IMAGES_PER_S:g} pictures/s, {np.median(pictures):.0f} of them an update: median {each:.2f} ms a "
            f"picture, {np.median(cost):.2f} ms an update, 99.9th percentile {slowest:.1f} ms of {len(cost)} updates, "
            f"in {int(self.young[late].sum())} of them the run was still young; {self.cost[~late].sum():.1f} s for "
            f"the {_FILLED:.0f} s before"
        )
        yield Ratio(f"{name}.median", compared, each / _MEDIAN, wanted=1.0)
        yield Ratio(f"{name}.slowest", "99.9th percentile of the same", slowest / _SLOWEST, tolerance=1.0, wanted=1.0)


def run() -> Iterator[Ratio]:
    """Los at 50 updates/s with perfect sensors; los and head with the assumptions of the usual data sheets."""
    problem = los_problem(round(MINUTES * 60.0 * IMAGES_PER_S), IDEAL)
    measured = _measured(problem)
    yield from measured.against_goals(
        "incremental.los_perfect", f"los, perfect sensors, {len(problem.quantities)} numbers"
    )
    t, making, cost = measured.time, measured.making, measured.cost
    first, last = (t >= _FILLED) & (t < _FILLED + 60.0), t >= t[-1] - 60.0
    # Within an hour a machine gets faster and slower: making a step's factors, always the same work, tells how much.
    pace = float(np.median(making[last]) / np.median(making[first]))
    growth = float(np.median(cost[last]) / np.median(cost[first]))
    compared = (
        f"median update of the last minute over the second's, {MINUTES:g} min at {IMAGES_PER_S:g}/s: {growth:.2f} on a "
        f"machine that then took {pace:.2f} times as long for the same work; peak {peak_mib():.0f} MiB"
    )
    yield Ratio("incremental.growth", compared, growth / pace, wanted=1.2)
    times, resident = measured.memory.T
    late = resident[times >= t[-1] * 5.0 / 6.0]
    yield Ratio(
        "incremental.memory",
        "memory at the end over that before the last sixth",
        float(late[-1] / late[0]),
        tolerance=0.02,
        wanted=1.02,
    )
    estimate, batch = measured.run.finish(float(cost.sum())), solve_batch(problem)
    off = float((np.abs(estimate.values - batch.values) / batch.sigmas)[:4].max())
    yield Ratio(
        "incremental.answer", "largest difference of the angles from batch, sigmas", off, tolerance=1.0, wanted=0.3
    )
    for name, problem in (("los", _los()), ("head", _head())):
        what = f"{name}, {len(problem.quantities)} numbers with the assumptions"
        yield from _measured(problem).against_goals(f"incremental.{name}", what)


def _los() -> Problem:
    """Errors drawn from the usual data sheets."""
    scenario = LosScenario(duration_s=_SHORT, gyro_rate_hz=1000.0, image_rate_hz=IMAGES_PER_S, sensors=Sensors())
    data, _ = simulate_los(scenario, 0)
    return los.problem(data, load_config(los_config(scenario).encode()))


def _head() -> Problem:
    """The same for head, 500 gyro samples/s."""
    scenario = HeadScenario(duration_s=_SHORT, gyro_rate_hz=500.0, vision_rate_hz=IMAGES_PER_S, sensors=Sensors())
    data, _ = simulate_head(scenario, 0)
    return head.problem(data, load_config(head_config(scenario).encode()))


def _measured(problem: Problem) -> _Measured:
    solver = IncrementalSolver(problem, DEFAULT_WINDOW)
    rows, memory = [], []
    gc.freeze()  # as `alidade follow` does
    begun = time.process_time()
    for step in problem.steps(1):
        made = time.process_time()
        solver.add_step(step)
        done = time.process_time()
        pictures = sum(len(f.measurement.model.time) for f in step.factors if f.measurement is not None)
        rows.append((step.time, made - begun, done - made, pictures, solver.state.marginal is None))
        if len(rows) % 500 == 0:
            memory.append((step.time, resident_mib()))
        begun = time.process_time()
    table = np.array(rows, dtype=float)
    moments, making, cost, pictures, young = table.T
    return _Measured(solver, moments, making, cost, pictures, young > 0.0, np.array(memory))
