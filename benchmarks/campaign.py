"""What a recording of a large campaign costs, step by step: python -m benchmarks.campaign [--kept 20000].

Processor time, medians. The recordings lie on an S3 server of this machine, in a process of its own: what it and a
network take is not in these numbers.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import fsspec
import numpy as np

from alidade.pipelines import methods
from alidade.pipelines.applications.fleet.analysis import counting, populations
from alidade.pipelines.applications.fleet.fleet import Outcome, Settings, calibrate_recording, write_fleet
from alidade.pipelines.applications.fleet.histories import histories, packed, unpacked
from alidade.pipelines.applications.fleet.recordings import Recording, find, local
from alidade.pipelines.applications.fleet.store import RecordingResult, Store, UnitResult
from alidade.pipelines.applications.session import Session
from alidade.pipelines.recording.recording import open_recording
from benchmarks.measure import peak_mib

# Of a unit, in the table that is compared.
_RECORDINGS = 5
_WEEK = 7 * 86400


def main(arguments: Sequence[str] | None = None) -> None:
    """Print two tables: of a worker, a line a method; of the process that collects, a line a step."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.campaign", description=__doc__)
    parser.add_argument("--methods", nargs="+", default=["head", "los", "indexer"], help="nominal recordings of these")
    parser.add_argument("--recordings", type=int, default=5, help="of each method")
    parser.add_argument("--kept", type=int, default=20000, help="results that are compared")
    options = parser.parse_args(arguments)
    print("| method | MB | fetch, s | read, s | solve and judge, s | all, s | result, kB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        results: list[RecordingResult] = []
        with bucket() as address:
            for method in options.methods:
                result, *costs = worker_costs(method, options.recordings, Path(folder), address)
                results.append(result)
                print(f"| {method} | {' | '.join(f'{cost:.3g}' for cost in costs)} |", flush=True)
        most = max(results, key=lambda result: len(counting(result)))
        kept = Path(folder) / "campaign"
        print(f"\n| {options.kept} of {most['method']} collected, each | ms | kB |\n| --- | --- | --- |")
        seconds = _keep(Store(kept, "", UnitResult), most, options.kept)
        print(f"| kept in results.jsonl | {1e3 * seconds / options.kept:.3g} | {len(json.dumps(most)) / 1e3:.3g} |")
        # Alone in its process, so that the largest memory is that of each step.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            for step, seconds, size in process.submit(collecting_costs, kept).result():
                print(f"| {step} | {1e3 * seconds:.3g} | {1e-3 * size:.3g} |")


def worker_costs(method: str, count: int, folder: Path, address: str) -> tuple[Any, ...]:
    """A result, and medians: size, MB; fetch, read, solve and judge, all, s; the result's size, kB.

    All is what a worker does, with hashing and packing.
    """
    costs = []
    for seed in range(count + 1):
        path = folder / f"{method}{seed}.mcap"
        methods.simulate(method, methods.method(method).default_scenario(), seed, path)
        fsspec.filesystem("s3").put_file(str(path), f"{address}/{path.name}")
        (remote,) = find([f"{address}/{path.name}"]).values()
        (here,) = find([str(path)]).values()
        fetch, _ = taken(partial(_fetched, remote))
        read, session = taken(partial(_read, path))
        solve, _ = taken(partial(session.calibrations, ["batch"]))
        whole, result = taken(partial(calibrate_recording, here, Settings()))
        size = len(json.dumps(result)) / 1e3
        costs.append((path.stat().st_size / 1e6, fetch, read, solve, whole + fetch, size))
        path.unlink()
    return result, *(median(column) for column in zip(*costs[1:], strict=True))  # the first warms up


def collecting_costs(folder: Path) -> list[tuple[str, float, float]]:
    """Step, s and bytes a recording, of what becomes of kept results: read, compared, written.

    Bytes of the first steps are the largest memory until then, of the last the size of a file.
    """
    before = peak_mib()
    found: list[tuple[str, float, float]] = []
    seconds, store = taken(partial(Store, folder, ""))
    results, count = store.results, len(store.results)

    def told(step: str, seconds: float) -> None:
        found.append((step, seconds / count, (peak_mib() - before) * 2**20 / count))

    told("read by the next run; memory so far", seconds)
    seconds, several = taken(lambda: histories(results, {name: counting(each) for name, each in results.items()}))
    told(f"units compared, {_RECORDINGS} recordings each; memory so far", seconds)
    seconds, fleet = taken(lambda: populations(results, several))
    told("parameters compared; memory so far", seconds)
    seconds, files = taken(lambda: write_fleet(folder, Outcome(results, count, 0, False), fleet, several))
    told("tables and page written; memory so far", seconds)
    return found + [(path.name, 0.0, path.stat().st_size / count) for path in files]


def taken(work: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time, s, and what the work gives."""
    begin = time.process_time()
    made = work()
    return time.process_time() - begin, made


@contextmanager
def bucket() -> Iterator[str]:
    """s3://campaign on a server that lives as long as the block."""
    command = [sys.executable, "-c", _SERVER]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        os.environ |= _access(server.stdout.readline().strip())
        fsspec.filesystem("s3").mkdir("campaign")
        try:
            yield "s3://campaign"
        finally:
            server.kill()


_SERVER = """
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print("http://{}:{}".format(*server.get_host_and_port()), flush=True)
server._thread.join()
"""


def _access(endpoint: str) -> Mapping[str, str]:
    key = {"AWS_ACCESS_KEY_ID": "nobody", "AWS_SECRET_ACCESS_KEY": "nothing"}
    return {"AWS_ENDPOINT_URL": endpoint, "AWS_DEFAULT_REGION": "us-east-1", **key}


def _fetched(recording: Recording) -> None:
    with local(recording.file):
        pass


def _read(path: Path) -> Session:
    return Session.read(open_recording(path), None, None)


def _keep(store: Store[Any], result: RecordingResult, count: int) -> float:
    """Keeps results scattered by their sigmas, of units recorded weekly; s that keeping took."""
    rng = np.random.default_rng(0)
    told, text, seconds = unpacked(result["told"]), json.dumps(result), 0.0
    for i in range(count):
        unit, week = divmod(i, _RECORDINGS)
        each = json.loads(text)
        for parameter in each["parameters"].values():
            parameter["value"] += parameter["sigma"] * float(rng.standard_normal())
        at = [each["parameters"][name]["value"] for name in told.names]
        each |= {"told": packed(replace(told, at=np.array(at))), "unit": f"U{unit:06}", "date": float(week * _WEEK)}
        seconds += taken(partial(store.add, f"s3://campaign/U{unit:06}_{week}.mcap", each))[0]
    return seconds


if __name__ == "__main__":
    main()
