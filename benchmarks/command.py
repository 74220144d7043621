"""The command line, whole processes: `alidade --help` and `alidade calibrate` on ten minutes of los."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from benchmarks.batch import native_los, solve_native
from benchmarks.measure import Cost, Ratio, costs

MINUTES = LosScenario(duration_s=600.0, gyro_rate_hz=1000.0, gimbal_rate_hz=1000.0, image_rate_hz=50.0)
Clock = Callable[[], float]
_ALIDADE = (sys.executable, "-m", "alidade")


def process(*command: str, rounds: int = 3, clock: Clock | None = None) -> Cost:
    """Median time of a command, of the processors unless there is a clock, and the peak memory of its largest process.

    The first run is left out: modules are compiled by it, as they are once it is installed.
    """
    clock, seconds = clock or _of_children, []
    with tempfile.TemporaryDirectory() as compiled:
        environment = {**os.environ, "PYTHONPYCACHEPREFIX": compiled, "PYTHONDONTWRITEBYTECODE": ""}
        for _ in range(rounds + 1):
            before = clock()
            subprocess.run(command, check=True, capture_output=True, env=environment)
            seconds.append(clock() - before)
    return Cost(float(np.median(seconds[1:])), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0)


def _of_children() -> float:
    """Processor time of all processes that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run() -> Iterator[Ratio]:
    """Help against importing what it needs, and a calibration with all outputs against the bare optimisation."""
    a, b = process(*_ALIDADE, "--help", rounds=9), process(sys.executable, "-c", "import typer", rounds=9)
    yield Ratio("command.help", "alidade --help over import typer", a.seconds / b.seconds, wanted=1.5, ours=a, theirs=b)
    data, truth = simulate_los(MINUTES, 0)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.mcap"
        method("los").write_data(session, data, truth, los_config(MINUTES))
        command = (*_ALIDADE, "calibrate", str(session), "--out", str(Path(folder) / "out"))
        a = process(*command, rounds=2)
        two, one = (process(*command, "--jobs", jobs, clock=time.perf_counter) for jobs in ("2", "1"))
    graph = native_los(data)
    (b,) = costs([lambda: solve_native(graph)])
    compared = "alidade calibrate, 10 min of los at 1 kHz, all outputs, over solving its native-only graph"
    yield Ratio("command.calibrate", compared, a.seconds / b.seconds, wanted=3.0, ours=a, theirs=b)
    compared = "alidade calibrate, 10 min of los, by two processes over one, on the clock"
    yield Ratio("command.processes.10", compared, two.seconds / one.seconds, ours=two, theirs=one)
