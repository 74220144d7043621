"""All benchmarks, each in a process of its own: python -m benchmarks [NAME ...] [--json FILE] [--gate] [--save]."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from benchmarks.measure import Ratio, run, worse

BASELINE = Path(__file__).with_name("baseline.json")
SUITE = (
    "reading",
    "gyro",
    "batch",
    "peers",
    "static",
    "incremental",
    "following",
    "detection",
    "command",
    "montecarlo",
    "pages",
)
# One thread each, or the ratio tells how many cores there are.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main(arguments: Sequence[str] | None = None, suite: Iterable[str] = SUITE) -> int:
    """Run the named benchmarks, or all; 1 if the gate fails, 2 for a name that is none."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Ratios between alternatives in one run.")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(suite)}; default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write all that was measured")
    parser.add_argument("--gate", action="store_true", help="fail if a ratio got worse than its baseline")
    parser.add_argument("--save", action="store_true", help="make these ratios the baseline")
    parser.add_argument("--baseline", type=Path, default=BASELINE, metavar="FILE", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in suite]
    if unknown:
        print(f"no benchmark {unknown[0]}; there are {', '.join(suite)}", file=sys.stderr)
        return 2
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    found: list[Ratio] = []
    for name in options.names or suite:
        print(f"== {name}", flush=True)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            found += process.submit(run, name).result()
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(ratio) for ratio in found], indent=1) + "\n")
    baseline: Mapping[str, float] = json.loads(options.baseline.read_text()) if options.baseline.exists() else {}
    if options.save:
        saved = {**baseline, **{ratio.name: float(f"{ratio.value:.3g}") for ratio in found}}
        options.baseline.write_text(json.dumps(saved, indent=1, sort_keys=True) + "\n")
    failures = worse(found, baseline) if options.gate else []
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
