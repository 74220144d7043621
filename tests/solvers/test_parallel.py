"""Things that several processes keep: what they answer, and when they end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from rich.console import Console

from alidade.pipelines import parallel, progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.parallel import LostError, WorkerPool

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere there is one process, as here without --jobs"
)


@dataclass
class Counter:
    """Counts what it is given."""

    own: int
    given: list[int] = field(default_factory=list)

    def add(self, number: int) -> int:
        if number < 0:
            raise ValueError(f"{number} of {self.own}")
        self.given.append(number)
        return self.own + sum(self.given)

    def process(self) -> int:
        return os.getpid()

    def end(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def speak(self) -> str:
        return type(sys.stderr).__name__

    def fail(self) -> None:
        raise TwoWordsError("two", "words")

    def local(self) -> object:
        return lambda: self.own

    def sleep(self) -> None:
        time.sleep(60.0)


class TwoWordsError(Exception):
    """Pickled with its message, and made of two."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


@pytest.fixture
def three() -> Iterator[None]:
    with parallel.processes(3):
        yield


def pool(count: int = 7) -> WorkerPool[Counter]:
    return WorkerPool([Counter(i) for i in range(count)], most=10)


def ask(of: WorkerPool[Counter], *numbers: int) -> list[int]:
    return of.ask(Counter.add, [(number,) for number in numbers], "adding")


def processes(of: WorkerPool[Counter]) -> list[int]:
    return of.ask(Counter.process, [()] * 7, "asking")


@pytest.mark.usefixtures("three")
def test_things_are_kept_where_they_are() -> None:
    """In turns, by three processes that are not this one, and asked again they know what they were given."""
    of = pool()
    assert ask(of, *range(7)) == [0, 2, 4, 6, 8, 10, 12]
    assert ask(of, *[1] * 7) == [1, 3, 5, 7, 9, 11, 13]
    where = processes(of)
    assert len({*where, os.getpid()}) == 4
    assert where == where[:3] * 2 + where[:1]


@pytest.mark.parametrize(("jobs", "most"), [(1, 10), (5, 1), (5, 0)])
def test_one_process_does_it_itself(jobs: int, most: int) -> None:
    with parallel.processes(jobs):
        of = WorkerPool([Counter(1), Counter(2)], most)
    assert of.ask(Counter.process, [()] * 2, "asking") == [os.getpid()] * 2


@pytest.mark.usefixtures("three")
def test_what_one_raises_is_raised_and_the_others_go_on() -> None:
    of = pool()
    with pytest.raises(ValueError, match="-1 of 3"):
        ask(of, 0, 0, 0, -1, 0, -2, 0)
    assert ask(of, *[0] * 7) == list(range(7))


@pytest.mark.usefixtures("three")
def test_processes_end_with_their_crew() -> None:
    of, other = pool(), pool()
    here, there = set(processes(of)), set(processes(other))
    assert not here & there
    del of
    assert _gone(here)
    assert processes(other)


@pytest.mark.usefixtures("three")
def test_a_process_that_is_ended_is_told() -> None:
    """And what others had answered by then is no answer to the next question."""
    of = pool()
    with pytest.raises(InputError, match=r"ended from outside.*--jobs 1"):
        of.ask(Counter.end, [()] * 7, "ending")
    with pytest.raises(LostError):
        ask(of, *[0] * 7)


@pytest.mark.usefixtures("three")
@pytest.mark.parametrize(("question", "told"), [(Counter.fail, "two words"), (Counter.local, "pickle")])
def test_what_cannot_be_sent_is_told(question: Callable[[Counter], object], told: str) -> None:
    of = pool()
    with pytest.raises(RuntimeError, match=told):
        of.ask(question, [()] * 7, "asking")
    assert ask(of, *[0] * 7) == list(range(7))


@pytest.mark.usefixtures("three")
def test_processes_have_streams_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that draws progress may hold this one's when they are forked."""
    monkeypatch.setattr(Console, "is_terminal", True)
    with progress.shown():
        assert type(sys.stderr).__name__ == "FileProxy"
        assert set(pool().ask(Counter.speak, [()] * 7, "asking")) == {"TextIOWrapper"}


def test_a_process_lost_below_another_is_no_answer() -> None:
    with parallel.processes(4), pytest.raises(LostError):
        parallel.done([_lost, _lost], "asking", 2)


def _lost() -> list[None]:
    return WorkerPool([Counter(0)] * 2, 2).ask(Counter.end, [()] * 2, "ending")


@pytest.mark.parametrize(("jobs", "share"), [(3, 1), (4, 2), (1, 1)])
def test_work_is_divided_and_may_be_divided_again(jobs: int, share: int) -> None:
    """Processes may have their share of those that there may be."""
    with parallel.processes(jobs):
        found = parallel.done([_divided, _divided], "dividing", 2)
    assert [allowed for allowed, _ in found] == [share, share]
    where = [process for _, inner in found for process in inner]
    assert len(set(where)) == {1: 1, 3: 2, 4: 4}[jobs]


def _divided() -> tuple[int, list[int]]:
    return parallel.allowed(), parallel.done([os.getpid, os.getpid], "dividing again", 2)


def test_one_piece_of_work_at_a_time_where_no_more_are_worth_while() -> None:
    with parallel.processes(2):
        assert parallel.done([os.getpid] * 2, "asking", 1) == [os.getpid()] * 2


@pytest.mark.parametrize(("limit", "free"), [(None, 3 << 30), ("max", 3 << 30), (str(2 << 30), 1 << 30)])
def test_room_is_what_machine_and_container_leave(
    limit: str | None, free: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert parallel.room() > 1 << 20
    (tmp_path / "meminfo").write_text(f"MemTotal: {8 << 20} kB\nMemFree: 1 kB\nMemAvailable: {3 << 20} kB\n")
    monkeypatch.setattr(parallel, "_MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(parallel, "_CONTAINER", tmp_path)
    if limit is not None:
        (tmp_path / "memory.max").write_text(f"{limit}\n")
        (tmp_path / "memory.current").write_text(f"{1 << 30}\n")
    assert parallel.room() == free


KILLED = """
import os, signal
from alidade.pipelines import parallel
from tests.solvers.test_parallel import Counter, pool, processes
with parallel.processes(3):
    first, second = pool(), pool()
    print(*processes(first), *processes(second), flush=True)
    for worker in second._workers:
        worker.send((Counter.sleep, [()] * 3))
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_processes_end_when_the_main_one_is_killed() -> None:
    """Whether they have something to do or not."""
    run = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=60)
    assert run.returncode == -signal.SIGKILL
    assert run.stderr == ""
    assert _gone({int(process) for process in run.stdout.split()})


def _gone(processes: set[int], within_s: float = 10.0) -> bool:
    """Whether processes end in time, or have ended and are only to be waited for."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        if not any(map(_runs, processes)):
            return True
        time.sleep(0.02)
    return False


def _runs(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat", encoding="ascii") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
