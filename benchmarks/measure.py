"""What a benchmark measures: a ratio between two pieces of work done in turns in one run, and whether it got worse."""

from __future__ import annotations

import gc
import importlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

Work = Callable[[], Any]


class Cost(NamedTuple):
    """Median processor time, s, and the peak memory of the process meanwhile, MiB; None where it was not measured."""

    seconds: float
    peak_mib: float | None = None


@dataclass(frozen=True)
class Ratio:
    """One benchmark: ours against a peer.

    Attributes:
        name: by which the baseline knows it.
        compared: what with what.
        value: the ratio, dimensionless.
        better: which way is better.
        tolerance: share of the baseline by which it may get worse before the gate fails.
        wanted: the target, None if there is none.
        ours, theirs: costs of one run, where the ratio comes from two of them.
    """

    name: str
    compared: str
    value: float
    better: Literal["lower", "higher"] = "lower"
    tolerance: float = 0.3
    wanted: float | None = None
    ours: Cost | None = None
    theirs: Cost | None = None

    def worse_than(self, baseline: float) -> bool:
        """Whether the value lies beyond the baseline by more than the tolerance."""
        if self.better == "lower":
            return self.value > baseline * (1.0 + self.tolerance)
        return self.value < baseline / (1.0 + self.tolerance)

    @property
    def met(self) -> bool:
        """Whether the target is met; True if there is none."""
        if self.wanted is None:
            return True
        return self.value <= self.wanted if self.better == "lower" else self.value >= self.wanted

    def __str__(self) -> str:
        """One line: the ratio, what it is between, both times and peaks, and the target."""
        costs = " against ".join(_told(cost) for cost in (self.ours, self.theirs) if cost is not None)
        target = ""
        if self.wanted is not None:
            sign = "<=" if self.better == "lower" else ">="
            target = f" ({sign} {self.wanted:g} wanted{'' if self.met else ': MISSED'})"
        return f"{self.name:24s} {self.value:8.3g}{target}  {self.compared}{f': {costs}' if costs else ''}"


def costs(work: Sequence[Work], rounds: int = 3, warm: bool = True) -> list[Cost]:
    """Cost of each, run one after the other round after round, a round to warm up first.

    Processor time, since others may use the machine; libraries are held to one thread by `python -m benchmarks`.
    """
    seconds = np.empty((rounds + warm, len(work)))
    peaks = np.zeros(len(work))
    for row in seconds:
        for i, run in enumerate(work):
            gc.collect()
            _forget_peak()
            start = time.process_time()
            run()
            row[i] = time.process_time() - start
            peaks[i] = max(peaks[i], peak_mib())
    return [Cost(float(s), float(p)) for s, p in zip(np.median(seconds[warm:], axis=0), peaks, strict=True)]


def run(name: str) -> list[Ratio]:
    """The ratios of a benchmark module, printed as they come."""
    found = []
    for ratio in importlib.import_module(f"benchmarks.{name}").run():
        print(f"  {ratio}", flush=True)
        found.append(ratio)
    return found


def growth(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Exponent of the power of size by which time grows, least squares on the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def worse(found: Sequence[Ratio], baseline: Mapping[str, float]) -> list[str]:
    """A line for each ratio that got worse than its baseline by more than its tolerance."""
    return [
        f"{r.name}: {r.value:.3g} is worse than the baseline {baseline[r.name]:.3g} by more than {r.tolerance:.0%}"
        for r in found
        if r.name in baseline and r.worse_than(baseline[r.name])
    ]


def peak_mib() -> float:
    """High-water mark of this process; getrusage would give the parent's, if that was larger."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM:"))


def resident_mib() -> float:
    """Memory of this process by now."""
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _told(cost: Cost) -> str:
    return f"{cost.seconds:.3g} s" + ("" if cost.peak_mib is None else f", {cost.peak_mib:.0f} MiB")
