"""Files that belong together: of one writer, whole or absent, whoever else writes there and whenever one is killed."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines import files
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import write_file, write_whole

NAMES = ("a", "b", "c", "result")
# Writes rounds of files that all hold the same, one file after the other and slowly.
WRITER = """
import sys, time
from pathlib import Path
from alidade.pipelines.files import require_room, write_whole
who, folder, rounds = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
require_room(folder)
print("begun", flush=True)
sys.stdin.readline()
for i in range(rounds):
    write_whole(folder, dict.fromkeys(("a", "b", "c", "result"), lambda path: path.write_text(f"{who} {i}")))
    print(i, flush=True)
"""


def _writer(who: str, folder: Path, rounds: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", WRITER, who, str(folder), str(rounds)]
    pipe = subprocess.PIPE
    writer = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "begun\n"
    return writer


def _go(writer: subprocess.Popen[str]) -> None:
    assert writer.stdin is not None
    writer.stdin.write("\n")
    writer.stdin.flush()


def _state(folder: Path) -> set[str]:
    """What the files hold that are there; all of them where there is a result."""
    there = [folder / name for name in NAMES if (folder / name).exists()]
    assert len(there) == len(NAMES) or not (folder / "result").exists()
    return {path.read_text() for path in there}


def test_two_processes_never_mix_and_the_later_one_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    writers = [_writer(who, folder, 150) for who in "xy"]
    for writer in writers:
        _go(writer)
    said = [writer.communicate(timeout=120)[1] for writer in writers]
    lost = [writer.returncode for writer in writers].index(1)
    assert writers[1 - lost].returncode == 0, said
    assert "another process has written its results there since this one began" in said[lost]
    assert _state(folder) == {f"{'yx'[lost]} 149"}
    assert sorted(path.name for path in folder.iterdir()) == sorted(NAMES)


@pytest.mark.parametrize("rounds", [15, pytest.param(200, marks=pytest.mark.slow)])
def test_a_process_that_is_killed_leaves_results_whole_or_absent(rounds: int, tmp_path: Path) -> None:
    folder, rng, kept = tmp_path / "out", np.random.default_rng(0), 0
    for _ in range(rounds):
        writer = _writer("x", folder, 10_000)
        assert writer.stdout is not None
        _go(writer)
        writer.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.01))
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
        assert len(_state(folder)) <= 1
        kept += len(_state(folder))

    write_whole(folder, dict.fromkeys(NAMES, "last"))
    assert _state(folder) == {"last"}
    assert sorted(path.name for path in folder.iterdir()) == sorted(NAMES), "what was left of the killed is gone"
    assert kept


def test_who_does_not_get_the_folder_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_PATIENCE_S", 0.1)
    held = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    try:
        with pytest.raises(InputError, match="another process is writing its results there"):
            write_whole(tmp_path, {"x": "never"})
    finally:
        os.close(held)
    assert list(tmp_path.iterdir()) == []


def test_a_file_by_itself_is_whole_or_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.txt"
    write_file(path, "before")

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(InputError, match="No space left on device"):
        write_file(path, "after")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
