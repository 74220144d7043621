"""Tasks that several processes do: what comes of them, and when the processes end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from rich.console import Console

from alidade.pipelines import parallel, progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.parallel import LostError

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere there is one process, as here without --jobs"
)


class TwoWordsError(Exception):
    """Pickled with its message, and made of two."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} {other}")


@pytest.fixture
def three() -> Iterator[None]:
    with parallel.processes(3):
        yield


def _root(number: int) -> tuple[float, int]:
    if number < 0:
        raise ValueError(f"{number} has none")
    return number**0.5, os.getpid()


def _end() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _fail() -> None:
    raise TwoWordsError("two", "words")


def _local() -> object:
    return lambda: None


def _speak() -> str:
    return type(sys.stderr).__name__


@pytest.mark.usefixtures("three")
def test_results_are_in_order_and_tasks_go_round() -> None:
    """By three processes that are not this one."""
    found = parallel.done([partial(_root, number**2) for number in range(7)], "roots", 10)
    assert [root for root, _ in found] == list(range(7))
    where = [process for _, process in found]
    assert len({*where, os.getpid()}) == 4
    assert where == where[:3] * 2 + where[:1]
    assert _gone(set(where))


@pytest.mark.parametrize(("jobs", "most"), [(1, 10), (5, 1), (5, 0)])
def test_one_process_does_it_itself(jobs: int, most: int) -> None:
    with parallel.processes(jobs):
        assert parallel.done([os.getpid] * 2, "asking", most) == [os.getpid()] * 2


@pytest.mark.usefixtures("three")
def test_the_first_that_is_raised_is_raised() -> None:
    with pytest.raises(ValueError, match="-1 has none"):
        parallel.done([partial(_root, number) for number in (0, 0, 0, -1, 0, -2, 0)], "roots", 10)


@pytest.mark.usefixtures("three")
def test_a_process_that_is_ended_is_named() -> None:
    with pytest.raises(InputError, match=r"ended from outside.*--jobs 1"):
        parallel.done([_end, os.getpid, os.getpid], "ending", 10)


@pytest.mark.usefixtures("three")
@pytest.mark.parametrize(("task", "message"), [(_fail, "two words"), (_local, "pickle")])
def test_what_cannot_be_sent_is_named(task: Callable[[], object], message: str) -> None:
    with pytest.raises(RuntimeError, match=message):
        parallel.done([task] * 7, "asking", 10)


@pytest.mark.usefixtures("three")
def test_an_interrupt_ends_what_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []

    def interrupted(of: parallel._Worker) -> object:
        started.append(of._process.pid or 0)
        raise KeyboardInterrupt

    monkeypatch.setattr(parallel._Worker, "receive", interrupted)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        parallel.done([partial(time.sleep, 60.0)] * 3, "sleeping", 10)
    assert _gone(set(started))
    assert time.monotonic() - began < 10.0


@pytest.mark.usefixtures("three")
def test_processes_have_streams_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that draws progress may hold this one's when they are forked."""
    monkeypatch.setattr(Console, "is_terminal", True)
    with progress.shown():
        assert type(sys.stderr).__name__ == "FileProxy"
        assert set(parallel.done([_speak] * 7, "asking", 10)) == {"TextIOWrapper"}


def test_a_process_lost_below_another_is_no_answer() -> None:
    with parallel.processes(4), pytest.raises(LostError):
        parallel.done([_lost, _lost], "asking", 2)


def _lost() -> list[None]:
    return parallel.done([_end] * 2, "ending", 2)


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


KILLED = """
import os, signal, time
from functools import partial
from alidade.pipelines import parallel
def task(alone):
    print(os.getpid(), flush=True)
    if alone:
        time.sleep(60.0)
    parallel.done([partial(task, True)] * 2, "sleeping", 2)
with parallel.processes(4):
    if not os.fork():
        time.sleep(1.0)
        os.kill(os.getppid(), signal.SIGKILL)
        os._exit(0)
    parallel.done([partial(task, False)] * 2, "dividing", 2)
"""


def test_processes_end_when_the_main_one_is_killed() -> None:
    """Those below others too."""
    run = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=60)
    assert run.returncode == -signal.SIGKILL
    assert run.stderr == ""
    numbers = {int(process) for process in run.stdout.split()}
    assert len(numbers) == 6
    assert _gone(numbers)


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
