"""The engine on real processes: killed workers, recordings that kill, other versions, Ctrl-C, overhead."""

from __future__ import annotations

import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from alidade.pipelines.applications.fleet import engine, fleet
from alidade.pipelines.applications.fleet.engine import cluster, completed, source_version
from alidade.pipelines.applications.fleet.fleet import Settings, calibrate_fleet, calibrate_recording
from alidade.pipelines.applications.fleet.montecarlo import simulate_and_solve
from alidade.pipelines.applications.fleet.recordings import find
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from tests.support.builders import IDEAL
from tests.support.fleet_command import alidade

psutil = pytest.importorskip("psutil", reason="needs the extra alidade[fleet]")
pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")
pytest.importorskip("arro3.io", reason="needs the extra alidade[fleet]")

ROOT = Path(__file__).parents[3]
COUNT = 24

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("recordings"), 4.0)


def written(folder: Path, duration_s: float) -> Path:
    """The folder, with recordings in it."""
    scenario = HeadScenario(
        duration_s=duration_s, gyro_rate_hz=100.0, vision_rate_hz=10.0, truth_rate_hz=1.0, sensors=IDEAL
    )
    for seed in range(COUNT):
        data, truth = simulate_head(scenario, seed)
        method("head").write_data(folder / f"U{seed:02}.mcap", data, truth, head_config(scenario))
    return folder


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a process of its own group on this checkout or another; all end with the test."""
    processes: list[subprocess.Popen[str]] = []

    def run(*words: object, root: Path = ROOT, **environment: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", *map(str, words)],
            cwd=root,
            env={**os.environ, "PYTHONPATH": str(root), **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        processes.append(process)
        return process

    yield run
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def scheduler(start: Start, tmp_path: Path) -> str:
    """Address of a scheduler in a process of its own."""
    return scheduling(start, tmp_path)[1]


def scheduling(start: Start, folder: Path) -> tuple[subprocess.Popen[str], str]:
    """A scheduler's process and address."""
    file = folder / "scheduler.json"
    process = start("dask", "scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--scheduler-file", file)
    # The file is there before it is written.
    told = until(lambda: file.exists() and file.read_text())
    return process, str(json.loads(told)["address"])


def worker(start: Start, scheduler: str, root: Path = ROOT) -> subprocess.Popen[str]:
    return start("dask", "worker", scheduler, "--nthreads", 1, "--no-nanny", "--no-dashboard", root=root)


def until(true: Callable[[], Any], seconds: float = 60.0) -> Any:
    """What comes out, once that is true."""
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
    return found


def finished(out: Path) -> list[str]:
    file = out / "results.jsonl"
    return file.read_text().splitlines() if file.exists() else []


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "fleet.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_worker_killed_midway_costs_nothing(start: Start, scheduler: str, recordings: Path, tmp_path: Path) -> None:
    first, second = worker(start, scheduler), worker(start, scheduler)
    out = tmp_path / "out"
    command = start("alidade", "fleet", recordings / "U0[0-5].mcap", "--scheduler", scheduler, "--out", out)
    until(lambda: len(finished(out)) >= 1)
    first.send_signal(signal.SIGKILL)
    assert len(finished(out)) < 4, "too fast to be midway"
    output, error = command.communicate(timeout=60)
    assert (command.returncode, error) == (0, "")
    assert "6 of 6 recordings, 0 from an earlier run" in output
    rows = rows_of(out)
    assert [Path(row["recording"]).name for row in rows] == [f"U{i:02}.mcap" for i in range(6)]
    assert {row["status"] for row in rows} <= {"calibrated", "weak"}
    assert len(finished(out)) == 6
    assert first.wait() == -signal.SIGKILL
    assert second.poll() is None


# Long enough that some are left when a worker is chosen, however slowly that goes.
SHORT = "{duration_s: 60, gyro_rate_hz: 100, vision_rate_hz: 20, truth_rate_hz: 1, sensors: ideal}"


@pytest.mark.slow
@pytest.mark.parametrize("what", ["fleet", "montecarlo"])
def test_workers_killed_at_random_cost_nothing(start: Start, tmp_path: Path, what: str) -> None:
    """Every result is there once, and is the one that an undisturbed process computes."""
    out, scenario, rng = tmp_path / "out", tmp_path / "short.yaml", random.Random(7)
    scenario.write_text(SHORT)
    if what == "fleet":
        written(tmp_path, 60.0)
    words: dict[str, tuple[object, ...]] = {
        "fleet": (tmp_path / "*.mcap",),
        "montecarlo": ("head", "--scenario", scenario, "--runs", COUNT, "--solvers", "batch"),
    }
    command = start("alidade", what, *words[what], "--jobs", 3, "--out", out)
    killed = 0
    # Each after one more result: workers take seconds to start, and some work must end.
    while len(finished(out)) < COUNT - 4:
        until(partial(has_finished, len(finished(out)) + 1, out))
        time.sleep(rng.uniform(0.0, 0.1))
        # All may be on their way up again, and the one chosen may just have ended.
        worker = rng.choice(until(partial(workers_of, command.pid)))
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)
            killed += 1
    output, error = command.communicate(timeout=100)
    assert (command.returncode, error) == (0, "")
    assert f"{COUNT} of {COUNT} " in output
    assert killed >= 4
    entries = [json.loads(line) for line in finished(out)]
    assert len(entries) == COUNT
    kept = {entry["name"]: untimed(entry["result"]) for entry in entries}
    if what == "fleet":
        found = find([f"{tmp_path}/*.mcap"])
        alone = {name: untimed(calibrate_recording(each, Settings())) for name, each in found.items()}
    else:
        settings = method("head").settings(str(scenario))
        solved = {str(seed): simulate_and_solve("head", settings, seed, ["batch"], 1.0) for seed in range(COUNT)}
        alone = {seed: untimed(result) for seed, result in solved.items()}
    assert kept == alone


def has_finished(count: int, out: Path) -> bool:
    return len(finished(out)) >= count


def workers_of(command: int) -> list[int]:
    """Process ids of the workers that a command started on this machine."""
    found = []
    for child in psutil.Process(command).children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            found += [child.pid] if "multiprocessing.spawn" in " ".join(child.cmdline()) else []
    return found


def untimed(result: Any) -> Any:
    """A result as it is kept, without how long it took."""
    result = json.loads(json.dumps(result))
    for each in (result, result.get("batch", {})):
        each.pop("seconds", None)
    return result


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished(
    start: Start,
    local_cluster: str,
    recordings: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    words = ("fleet", recordings / "U0[0-4].mcap", "--out", out)
    command = start("alidade", *words, "--jobs", 1)
    until(lambda: len(finished(out)) >= 1)
    # As a terminal does: to every process of the group.
    os.killpg(command.pid, signal.SIGINT)
    output, error = command.communicate(timeout=60)
    assert (command.returncode, error) == (130, "interrupted: what is finished is written\n")
    assert "interrupted; the same command continues" in output
    kept = len(finished(out))
    assert 1 <= kept < 5
    assert len(rows_of(out)) == kept
    assert alidade(monkeypatch, *words, "--scheduler", local_cluster) == 0
    assert f"5 of 5 recordings, {kept} from an earlier run" in capsys.readouterr().out
    assert len(rows_of(out)) == 5


@pytest.mark.slow
@pytest.mark.parametrize("after", [3.0, 4.5, 6.0])
def test_ctrl_c_is_heard_while_workers_start(after: float, start: Start, tmp_path: Path) -> None:
    out, runs = tmp_path / "out", 5000
    command = start("alidade", "montecarlo", "head", "--runs", runs, "--solvers", "batch", "--out", out, "--jobs", 2)
    time.sleep(after)
    os.killpg(command.pid, signal.SIGINT)
    _, error = command.communicate(timeout=60)
    assert command.returncode in (130, -signal.SIGINT)
    assert "Traceback" not in error
    assert len(finished(out)) < runs


@pytest.mark.slow
def test_a_recording_that_kills_workers_is_set_aside(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And those that only waited on the same worker are not."""
    import dask

    def deadly(recording: Any, *_: object) -> Any:
        if recording.file.path.endswith("U03.mcap"):
            os.kill(os.getpid(), signal.SIGKILL)
        return {"sha256": recording.file.path, "status": "calibrated", "exit_code": 0, "reason": "", "parameters": {}}

    monkeypatch.setattr(fleet, "calibrate_recording", deadly)
    # One worker and no second chance make every neighbour a suspect.
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        outcome = calibrate_fleet(find([f"{recordings}/*.mcap"]), Settings(), tmp_path / "out", jobs=1)
    bad = {name for name, result in outcome.results.items() if result["exit_code"] != 0}
    assert {Path(name).name for name in bad} == {"U03.mcap"}
    assert len(outcome.results) == COUNT
    assert any("quarantined" in line and "U03.mcap" in line for line in outcome.summary)
    assert outcome.results[bad.pop()]["exit_code"] == 137
    assert len(finished(tmp_path / "out")) == COUNT - 1


@pytest.mark.slow
def test_workers_of_another_version_are_refused(start: Start, scheduler: str, recordings: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(ROOT / "alidade", other / "alidade", ignore=shutil.ignore_patterns("__pycache__"))
    with (other / "alidade" / "factors" / "so3.py").open("a") as stream:
        stream.write("# another\n")
    process = worker(start, scheduler, root=other)
    out = tmp_path / "out"
    command = start("alidade", "fleet", recordings / "*.mcap", "--scheduler", scheduler, "--out", out)
    output, error = command.communicate(timeout=60)
    assert process.poll() is None
    assert (command.returncode, output) == (2, "")
    assert len(error.splitlines()) == 1
    assert source_version() in error
    assert "install the same on both" in error
    named = error.split(" has alidade ")[1].split(",")[0]
    assert named != source_version()
    assert named.split("+")[0] == source_version().split("+")[0]


def test_a_scheduler_without_workers_is_told(scheduler: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_REACH", 1.0)
    with pytest.raises(InputError, match=f"{scheduler} has no workers: start some with `dask worker {scheduler}`"):
        cluster(scheduler, None).__enter__()


def test_overhead_order_and_faults(local_cluster: str) -> None:
    """Nothing to do, many times over: what a task costs besides its work, far below 5 % of 2 s on two workers."""

    def nothing(number: int) -> dict[str, float]:
        if number < 0:
            raise InputError(f"number {number}: not this one")
        return {f"parameter {i}": float(number) for i in range(50)}

    count = 200
    with cluster(local_cluster, None) as client:
        list(completed(client, nothing, {str(i): (i,) for i in range(10)}))
        begin = time.perf_counter()
        results = dict(completed(client, nothing, {str(i): (i,) for i in range(count)}))
        overhead = (time.perf_counter() - begin) / count
        with pytest.raises(InputError, match="number -1: not this one"):
            list(completed(client, nothing, {str(i): (i,) for i in range(-1, 5)}))
    assert results == {str(i): nothing(i) for i in range(count)}
    # Two workers do 2 s tasks at one a second.
    assert overhead < 0.05 * 2.0 / 2


@pytest.mark.slow
def test_a_scheduler_that_dies_midway_is_told(start: Start, recordings: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process, address = scheduling(start, tmp_path)
    worker(start, address)
    command = start("alidade", "fleet", recordings / "*.mcap", "--scheduler", address, "--out", out)
    until(lambda: len(finished(out)) >= 2)
    process.kill()
    _, error = command.communicate(timeout=60)
    assert command.returncode == 2
    assert error.splitlines() == [
        f"alidade: the scheduler at {address} is gone; what is finished is kept, the same command continues"
    ]
    assert 2 <= len(finished(out)) < COUNT
