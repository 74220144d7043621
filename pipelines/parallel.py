"""Several processes for long work: how many there may be, work divided among them, and things that they keep.

with parallel.processes(jobs):                             # the command
    ...
    scores = parallel.done([partial(score, each) for each in trials], "trials", 4)     # whoever works long
    crew = Crew(stretches, most=4)
    errors = crew.ask(StretchAt.error, [()] * len(stretches), "stretch by stretch")
"""

from __future__ import annotations

import ctypes
import gc
import math
import multiprocessing
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

# What Linux says of the memory of the machine, and of a container (man 5 proc, cgroup-v2).
_MEMORY, _CONTAINER = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
# One process, unless a command says that there may be more.
_jobs = 1
# This process's ends of the connections to others, which a fork closes: a connection ends with the last that is open.
_open: weakref.WeakSet[Connection] = weakref.WeakSet()


@contextmanager
def processes(jobs: int | None) -> Iterator[None]:
    """Within the block so many processes may be used; None: one a core."""
    global _jobs
    before, _jobs = _jobs, jobs or _cores()
    try:
        yield
    finally:
        _jobs = before


def _cores() -> int:
    """Those that this process may run on, where the system says which."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def allowed() -> int:
    """How many processes may be used."""
    return _jobs


def room() -> float:
    """Bytes of memory that are free for processes: of the machine, and of a container with a limit.

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
    """What pieces of work give, shown as it comes in, at `most` so many done at a time; see `Crew` and its `ask`."""
    return Crew(works, min(most, len(works))).ask(_done, [()] * len(works), what)


def _done(work: Callable[[], Answer]) -> Answer:
    return work()


class LostError(InputError):
    """A process was ended from outside."""

    def __init__(self) -> None:
        super().__init__(
            "a process that was to do a part of the work was ended from outside, most likely for want of memory; "
            "let there be fewer of them (--jobs 1)"
        )

    def __reduce__(self) -> tuple[type[LostError], tuple[()]]:
        """It takes no message."""
        return LostError, ()


class Crew(Generic[Thing]):
    """Things divided among processes that keep them, or all kept by this one.

    Processes are forked, so that each begins with all that there is, and nothing is sent to it but questions. They end
    with the crew, and may each use their share of the processes that there may be. Where the system cannot fork safely,
    which is everywhere but on Linux, there is one process.

    Args:
        things: each is asked in the process that keeps it, and may keep there what it finds.
        most: processes that are worth while.
    """

    def __init__(self, things: Sequence[Thing], most: int) -> None:
        self._things = things
        count = min(allowed(), most) if sys.platform == "linux" else 1
        share = max(allowed() // max(count, 1), 1)
        self._hands = [_Hand(things[i::count], share) for i in range(count)] if count > 1 else []

    def ask(self, question: Callable[..., Answer], given: Sequence[tuple[Any, ...]], what: str) -> list[Answer]:
        """What a question gives of each thing, shown as it comes in.

        Args:
            question: a function at the top of a module, since it may go to another process.
            given: for each thing what the question takes besides.
            what: is done, for who watches.

        Raises:
            LostError: a process was ended from outside; nothing can be asked any more.
            Exception: the first that the question raised, as it is.
        """
        if not self._hands:
            together = zip(self._things, given, strict=True)
            return [question(thing, *args) for thing, args in progress.track(together, what, len(given))]
        count = len(self._hands)
        try:
            for i, hand in enumerate(self._hands):
                hand.send((question, given[i::count]))
            turns = progress.track(range(len(given)), what, len(given))
            answers = [self._hands[i % count].receive() for i in turns]
        except BaseException:
            # Answers that are still on their way are none to the next question.
            for hand in self._hands:
                hand.close()
            raise
        for _, error in answers:
            if error is not None:
                raise error
        return [answer for answer, _ in answers]


class _Hand:
    """One process of a crew."""

    def __init__(self, things: Sequence[Any], share: int) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        _open.add(self._connection)
        process = context.Process(target=_work, args=(theirs, things, share, os.getpid()))
        with warnings.catch_warnings():
            # Threads that draw progress are not needed in a fork, which leaves them and what they may hold alone.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
        theirs.close()
        # At the end of this process before others are waited for.
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
        """Ask nothing any more."""
        self._connection.close()


def _work(connection: Connection, things: Sequence[Any], share: int, parent: int) -> None:
    """Answer as long as somebody asks. An interruption is for the main process to handle."""
    global _jobs
    _jobs = share
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)
    for end in list(_open):
        end.close()
    # Whoever draws progress may hold these at the moment of the fork, and is not here to let go of them.
    progress.hide()
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    # To look for garbage in what was there before would have all of it copied.
    gc.freeze()
    try:
        while True:
            question, given = connection.recv()
            for thing, args in zip(things, given, strict=True):
                connection.send_bytes(_answer(question, thing, args))
    except (EOFError, OSError):
        return  # whoever asked is gone


def _end_with(parent: int) -> None:
    """Have Linux end this process with its parent, whatever it does at that time (prctl(2), PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def _answer(question: Callable[..., Any], thing: Any, args: tuple[Any, ...]) -> bytes:
    """What a question gives or raises, ready to be sent."""
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
