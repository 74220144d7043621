"""Commands that are killed (SIGKILL) at random moments leave results that are whole, or none, and no process.

200 moments of each command, in parts. tests/test_files.py kills a writer of results a few times,
tests/applications/follow and fleet their commands once.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from alidade.pipelines.applications import cli
from alidade.pipelines.methods import simulate
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.calibration import load_calibration

pytestmark = pytest.mark.slow


def _parts(count: int) -> pytest.MarkDecorator:
    """200 kills in so many parts."""
    return pytest.mark.parametrize(
        ("part", "kills"), [pytest.param(i, 200 // count, id=f"part {i}") for i in range(count)]
    )


# A server of its own forks the commands, which have imported what they need: a fork of a process with threads,
# as that of pytest is after other tests, may never end.
FILES = ("calibration.yaml", "attitude.tum", "estimates.mcap", "foxglove.json", "report.html", "result.json")
_FORK = multiprocessing.get_context("forkserver")
_FORK.set_forkserver_preload([__name__, "alidade.pipelines.solvers.batch"])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    (folder / "scenario.yaml").write_text("{duration_s: 4, gyro_rate_hz: 50, gimbal_rate_hz: 50, image_rate_hz: 5}")
    for seed in range(3):
        simulate("los", str(folder / "scenario.yaml"), seed, folder / f"{seed}.mcap", False)
    return sorted(folder.glob("*.mcap"))


def _command(arguments: list[str], stdin: Path | None) -> None:
    """The command in a process that has imported what it needs."""
    for stream, path in ((0, stdin or os.devnull), (1, os.devnull), (2, os.devnull)):
        os.dup2(os.open(path, os.O_RDWR), stream)
    sys.stdin, sys.argv = open(0), ["alidade", *arguments]  # noqa: SIM115
    cli.main()


def _killed(
    arguments: list[str], out: Path, looked_at: Callable[[], bool], kills: int, seed: int, stdin: Path | None = None
) -> None:
    """Looks after kills at moments spread over a run, with or without results of a run before, and after a last run."""
    arguments, rng, seen, whole = [*arguments, "--out", str(out)], random.Random(seed), list[bool](), 0.0
    for number in range(kills + 2):
        process, start = _FORK.Process(target=_command, args=(arguments, stdin)), time.monotonic()
        process.start()
        if number in (0, kills + 1):
            process.join()
            whole = whole or time.monotonic() - start
        else:
            process.join(rng.uniform(0.0, whole))
        workers = [] if not process.is_alive() else psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.join()
        _, alive = psutil.wait_procs(workers, timeout=30.0)
        assert not alive, "workers outlive the command"
        seen.append(looked_at())
        if seen[-1] and number <= kills and rng.random() < 0.5:
            shutil.rmtree(out)
    print(f"{kills} kills within {whole:.2f} s: {sum(seen)} whole, {len(seen) - sum(seen)} absent")
    assert seen[0]
    assert seen[-1]
    assert not list(out.glob(".alidade.*"))


def _is_whole(out: Path, names: tuple[str, ...] = FILES) -> bool:
    """Whether there are results; all of them then."""
    if not (out / "result.json").exists():
        return False
    result: dict[str, Any] = json.loads((out / "result.json").read_text())
    assert result["parameters"]
    assert load_calibration(out / "calibration.yaml").parameters
    assert (out / "report.html").read_text().rstrip().endswith("</html>")
    assert {path.name for path in out.iterdir() if not path.name.startswith(".alidade.")} <= set(names)
    return True


@_parts(4)
def test_calibrate(part: int, kills: int, recordings: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    _killed(["calibrate", str(recordings[0]), "--quiet"], out, lambda: _is_whole(out), kills, part)


@_parts(5)
def test_follow(part: int, kills: int, recordings: list[Path], tmp_path: Path) -> None:
    """What was recorded until then can be read."""
    out, kept, config = tmp_path / "out", tmp_path / "kept", tmp_path / "config.yaml"
    config.write_bytes(open_recording(recordings[0]).attachment("alidade.yaml") or b"")
    arguments = ["follow", "-", "--record", str(kept), "--config", str(config), "--no-check"]

    def look() -> bool:
        for path in kept.glob("*.mcap"):
            if path.stat().st_size:
                assert open_recording(path).duration_s >= 0.0
            path.unlink()
        return _is_whole(out)

    _killed(arguments, out, look, kills, part, recordings[0])


@_parts(8)
def test_fleet(part: int, kills: int, recordings: list[Path], tmp_path: Path) -> None:
    """A line of results.jsonl is whole; the same command goes on with those that are missing."""
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    arguments = ["fleet", *map(str, recordings), "--jobs", "2", "--quiet"]

    def look() -> bool:
        path = out / "results.jsonl"
        *lines, _ = path.read_bytes().split(b"\n") if path.exists() else [b""]
        names = [json.loads(line)["name"] for line in lines]
        assert len(names) == len(set(names))
        there = {name for name in ("fleet.csv", "fleet.parquet", "changes.csv", "fleet.html") if (out / name).exists()}
        assert not there or len(names) == len(recordings)
        return "fleet.html" in there

    _killed(arguments, out, look, kills, part)
