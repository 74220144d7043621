"""Processes for long computations: their number, and independent tasks divided among them.

with parallel.processes(jobs):                             # the command
    ...
    scores = parallel.done([partial(score, each) for each in trials], "trials", 4)     # a long computation
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from alidade.pipelines import progress
from alidade.pipelines.errors import InputError

Answer = TypeVar("Answer")

# One process, unless a command says that there may be more.
_jobs = 1


@contextmanager
def processes(jobs: int | None) -> Iterator[None]:
    """Allow `jobs` processes within the block; None: one per core."""
    global _jobs
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    before, _jobs = _jobs, jobs or cores
    try:
        yield
    finally:
        _jobs = before


def allowed() -> int:
    """Return the number of processes that the current block may use."""
    return _jobs


def done(works: Sequence[Callable[[], Answer]], what: str, most: int) -> list[Answer]:
    """Return the results of independent tasks, in order, at most `most` at a time, with progress.

    Tasks are divided among processes, which are forked: each begins with the state of this one, and may use its share
    of the allowed processes. Where the system cannot fork safely (all but Linux), this one does everything.

    Raises:
        LostError: a process was ended from outside.
        Exception: the first that a task raised, unchanged.
    """
    count = min(allowed(), most, len(works)) if sys.platform == "linux" else 1
    if count <= 1:
        return [work() for work in progress.track(works, what, len(works))]
    workers: list[_Worker] = []
    try:
        workers.extend(_Worker(works[i::count], allowed() // count) for i in range(count))
        turns = progress.track(range(len(works)), what, len(works))
        answers = [workers[i % count].receive() for i in turns]
    finally:
        for worker in workers:
            worker.end()
    for _, error in answers:
        if error is not None:
            raise error
    return [answer for answer, _ in answers]


class LostError(InputError):
    """Raised where a worker process was ended from outside."""

    def __init__(self) -> None:
        super().__init__(
            "a process that was to do a part of the work was ended from outside, most likely for want of memory; "
            "let there be fewer of them (--jobs 1)"
        )

    def __reduce__(self) -> tuple[type[LostError], tuple[()]]:
        """Pickle the error without a message, which the constructor does not take."""
        return LostError, ()


class _Worker:
    """One process that does tasks, seen from its parent."""

    def __init__(self, works: Sequence[Callable[[], Any]], share: int) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(theirs, works, share, os.getpid()))
        with warnings.catch_warnings():
            # A fork needs no threads that draw progress, and does not touch their locks.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        theirs.close()

    def receive(self) -> tuple[Any, Exception | None]:
        """Return the next result, or what a task raised. Raises LostError."""
        try:
            answer: tuple[Any, Exception | None] = self._connection.recv()
        except (EOFError, OSError):
            raise LostError from None
        return answer

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self._connection.close()


def _work(connection: Connection, works: Sequence[Callable[[], Any]], share: int, parent: int) -> None:
    """Do tasks in a process of their own and send their results. Interrupts are left to the parent."""
    global _jobs
    _jobs = share
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)
    # The threads that draw progress may have locked these streams at the moment of the fork, and do not exist here.
    progress.hide()
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    # A garbage collection over the parent's objects would copy all of their pages.
    gc.freeze()
    for work in works:
        connection.send_bytes(_answer(work))


def _end_with(parent: int) -> None:
    """Have Linux end this process with its parent, whatever it does at that time (prctl(2), PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def _answer(work: Callable[[], Any]) -> bytes:
    """Return the pickled result of a task, or the exception that it raised."""
    answer: tuple[Any, Exception | None]
    try:
        answer = work(), None
    except Exception as error:
        answer = None, error
    try:
        pickled = pickle.dumps(answer)
        if answer[1] is not None:
            pickle.loads(pickled)  # exceptions may go one way alone
    except Exception as error:
        return pickle.dumps((None, RuntimeError(f"{error!r} on the way, of {answer!r}")))
    return pickled
