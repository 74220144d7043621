"""Pool of processes for long computations: their number, tasks divided among them, and objects that they keep.

with parallel.processes(jobs):                             # the command
    ...
    scores = parallel.done([partial(score, each) for each in trials], "trials", 4)     # a long computation
    pool = WorkerPool(segments, most=4)
    errors = pool.ask(SegmentAt.error, [()] * len(segments), "segment by segment")
"""

from __future__ import annotations

import ctypes
import gc
import math
import multiprocessing
import operator
import os
import pickle
import signal
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Generic, TypeVar

from alidade.pipelines import progress
from alidade.pipelines.errors import InputError

Thing = TypeVar("Thing")
Answer = TypeVar("Answer")

# Memory of the machine, and of a container, on Linux (man 5 proc, cgroup-v2).
_MEMORY, _CONTAINER = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
# One process, unless a command says that there may be more.
_jobs = 1
# This process's ends of the connections to workers. A fork closes them: a connection ends with its last open end.
_open: weakref.WeakSet[Connection] = weakref.WeakSet()


@contextmanager
def processes(jobs: int | None) -> Iterator[None]:
    """Allow `jobs` processes within the block; None: one per core."""
    global _jobs
    before, _jobs = _jobs, jobs or _cores()
    try:
        yield
    finally:
        _jobs = before


def _cores() -> int:
    """Number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def allowed() -> int:
    """Return the number of processes that the current block may use."""
    return _jobs


def room() -> float:
    """Return the free memory for processes, bytes: the machine's, or the container's where that is less.

    Infinite where there is one process alone, which is everywhere but on Linux.
    """
    if sys.platform != "linux":
        return math.inf
    kilobytes = {line.partition(":")[0]: line.split()[1] for line in _MEMORY.read_text().splitlines()}
    free = 1024.0 * float(kilobytes["MemAvailable"])
    try:
        limit, used = ((_CONTAINER / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:
        return free
    return free if limit == "max" else min(free, float(limit) - float(used))


def done(works: Sequence[Callable[[], Answer]], what: str, most: int) -> list[Answer]:
    """Return the results of independent tasks, at most `most` at a time, with progress; see `WorkerPool.ask`."""
    return WorkerPool(works, min(most, len(works))).ask(operator.call, [()] * len(works), what)


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


class WorkerPool(Generic[Thing]):
    """Objects divided among processes that keep them, or all kept by this one.

    Processes are forked: each begins with the state of this one and receives questions only. They end with the pool;
    each may use its share of the allowed processes. Where the system cannot fork safely (all but Linux), there is one.

    Args:
        things: objects, each asked in the process that keeps it; it may keep state there.
        most: largest useful number of processes.
    """

    def __init__(self, things: Sequence[Thing], most: int) -> None:
        self._things = things
        count = min(allowed(), most) if sys.platform == "linux" else 1
        share = max(allowed() // max(count, 1), 1)
        self._workers = [_Worker(things[i::count], share) for i in range(count)] if count > 1 else []

    def ask(self, question: Callable[..., Answer], given: Sequence[tuple[Any, ...]], what: str) -> list[Answer]:
        """Return the answers of all objects to a question, in order, with progress.

        Args:
            question: a function at the top of a module, which can be pickled.
            given: further arguments of the question for each thing.
            what: name of the work in the progress display.

        Raises:
            LostError: a process was ended from outside; the pool is unusable.
            Exception: the first that a question raised, unchanged.
        """
        if not self._workers:
            pairs = zip(self._things, given, strict=True)
            return [question(thing, *args) for thing, args in progress.track(pairs, what, len(given))]
        count = len(self._workers)
        try:
            for i, worker in enumerate(self._workers):
                worker.send((question, given[i::count]))
            turns = progress.track(range(len(given)), what, len(given))
            answers = [self._workers[i % count].receive() for i in turns]
        except BaseException:
            # Answers still in the pipes belong to no later question.
            for worker in self._workers:
                worker.close()
            raise
        for _, error in answers:
            if error is not None:
                raise error
        return [answer for answer, _ in answers]


class _Worker:
    """One process of a WorkerPool, seen from its parent."""

    def __init__(self, things: Sequence[Any], share: int) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        _open.add(self._connection)
        process = context.Process(target=_work, args=(theirs, things, share, os.getpid()))
        with warnings.catch_warnings():
            # A fork needs no threads that draw progress, and does not touch their locks.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
        theirs.close()
        # At the end of this process, before it waits for others.
        Finalize(self, process.kill, exitpriority=10)

    def send(self, message: tuple[Callable[..., Any], Sequence[tuple[Any, ...]]]) -> None:
        try:
            self._connection.send(message)
        except OSError:
            raise LostError from None

    def receive(self) -> tuple[Any, Exception | None]:
        try:
            answer: tuple[Any, Exception | None] = self._connection.recv()
        except (EOFError, OSError):
            raise LostError from None
        return answer

    def close(self) -> None:
        """Close the connection to the worker, whose process ends with it."""
        self._connection.close()


def _work(connection: Connection, things: Sequence[Any], share: int, parent: int) -> None:
    """Main loop of a worker: answer questions until the connection closes. Interrupts are left to the parent."""
    global _jobs
    _jobs = share
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)
    for end in list(_open):
        end.close()
    # The threads that draw progress may have locked these streams at the moment of the fork, and do not exist here.
    progress.hide()
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    # A garbage collection over the parent's objects would copy all of their pages.
    gc.freeze()
    try:
        while True:
            question, given = connection.recv()
            for thing, args in zip(things, given, strict=True):
                connection.send_bytes(_answer(question, thing, args))
    except (EOFError, OSError):
        return  # the parent closed the connection


def _end_with(parent: int) -> None:
    """Have Linux end this process with its parent, whatever it does at that time (prctl(2), PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def _answer(question: Callable[..., Any], thing: Any, args: tuple[Any, ...]) -> bytes:
    """Return the pickled answer to a question, or the exception that the question raised."""
    answer: tuple[Any, Exception | None]
    try:
        answer = question(thing, *args), None
    except Exception as error:
        answer = None, error
    try:
        pickled = pickle.dumps(answer)
        if answer[1] is not None:
            pickle.loads(pickled)  # exceptions may go one way alone
    except Exception as error:
        return pickle.dumps((None, RuntimeError(f"{error!r} on the way, of {answer!r}")))
    return pickled
