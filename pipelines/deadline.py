"""Deadline of a calibration: long computations ask for it and stop with their result so far.

    with deadline.within(60.0):                     # the command, or a session where no command has
        ...
        if deadline.passed("the search for causes"):    # a long computation; `stopped()` names it
            return ()

Minimisations end after their iteration, runs after their step, trials before they begin: the solution first, trials
last, and a result in any case. The deadline is that of the thread, and of the processes that are forked from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TypeVar

Item = TypeVar("Item")

# Batch has the greater of these: s, and a share of the recording's length; online the recording's length itself.
LEAST_S, SHARE = 60.0, 0.1


@dataclass
class _Deadline:
    limit: float  # s
    until: float  # by the clock
    clock: Callable[[], float]
    usual: bool = False
    stopped: list[str] = field(default_factory=list)


_deadline: ContextVar[_Deadline | None] = ContextVar("deadline", default=None)


@contextmanager
def _set(deadline: _Deadline) -> Iterator[None]:
    """Context manager that sets a deadline."""
    token = _deadline.set(deadline)
    try:
        yield
    finally:
        _deadline.reset(token)


def within(limit: float | None) -> AbstractContextManager[None]:
    """Context manager that sets a deadline in `limit` s; None keeps the deadline that is set, if any."""
    return nullcontext() if limit is None else _set(_Deadline(limit, time.monotonic() + limit, time.monotonic))


def usual(duration: float, online: bool = False) -> AbstractContextManager[None]:
    """Context manager that sets the usual deadline for a recording of so many seconds, unless one is set."""
    if _deadline.get() is not None:
        return nullcontext()
    limit = max(LEAST_S, duration if online else SHARE * duration)
    return _set(_Deadline(limit, time.monotonic() + limit, time.monotonic, usual=True))


def of_processor() -> AbstractContextManager[None]:
    """Context manager that counts the usual limit as computing time of this thread: a busy machine ends no solution.

    A limit that was set stays one of elapsed time.
    """
    deadline = _deadline.get()
    if deadline is None or not deadline.usual:
        return nullcontext()
    return _set(replace(deadline, until=time.thread_time() + deadline.limit, clock=time.thread_time))


def renewed() -> AbstractContextManager[None]:
    """Context manager that begins a calibration's default time limit anew; a limit that the user set goes on.

    For the search for causes: the solution of a model that does not fit takes most of the first.
    """
    deadline = _deadline.get()
    if deadline is None or not deadline.usual:
        return nullcontext()
    return _set(replace(deadline, until=deadline.clock() + deadline.limit))


def passed(what: str = "") -> bool:
    """Whether the deadline has passed; if so, note `what` as stopped for that."""
    deadline = _deadline.get()
    if deadline is None or deadline.clock() < deadline.until:
        return False
    if what and what not in deadline.stopped:
        deadline.stopped.append(what)
    return True


def until_passed(items: Iterable[Item], name: Callable[[Item], str], least: int = 0) -> Iterator[Item]:
    """Yield items until the deadline has passed, but at least the first `least`.

    `name` says where it stopped, from the first that is not taken.
    """
    for number, item in enumerate(items):
        if number >= least and passed() and passed(name(item)):
            return
        yield item


def sentence() -> str:
    """Return a phrase that the time limit stopped an iteration; empty without a limit."""
    deadline = _deadline.get()
    return "" if deadline is None else f"stopped by the time limit of {deadline.limit:.3g} s"


def stopped() -> str:
    """Return a sentence about all that the time limit stopped; empty if nothing."""
    deadline = _deadline.get()
    if deadline is None or not deadline.stopped:
        return ""
    what = " and ".join(deadline.stopped)
    return f"The time limit of {deadline.limit:.3g} s stopped {what}; --time-limit gives more time."
