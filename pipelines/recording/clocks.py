"""Clocks that were set during a recording: stamps that step, told from messages that are late and from gaps.

Three things show it. Times that run twice: after a step back, whole stretches lie between samples taken before it;
messages that are merely late fill a hole. Stamps that step while log times run on: the sensor's clock was set. And a
pause no recording makes. A step forward of stamps and log times together looks like a gap, and is read as one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError

Stamps = NDArray[np.int64]

# A step is at least so large, s, and more than so much of the usual interval.
_SMALLEST, _SHARE = 0.02, 0.5
# So many messages on either side have to agree on it.
_AROUND = 20
# So many messages in order, and most of them between others, are a time that runs twice.
_FEWEST = 3
# No sensor pauses so long within a session, s.
_PAUSE = 3600.0


class Step(NamedTuple):
    """A step of a clock: by how much, s, after which time, ns, and what stepped."""

    size: float
    after_ns: int
    what: str


def check_clock(topic: str, t_ns: Stamps, log_ns: Stamps, epoch_ns: int) -> None:
    """Raise InputError if the clock was set between these stamps and log times, ns, in the order of the file."""
    step = find_step(t_ns, log_ns)
    if step is not None:
        way = "back" if step.size < 0.0 else "forward"
        raise InputError(
            f"topic {topic}: {step.what} jump {way} by {abs(step.size):.3f} s after "
            f"{(step.after_ns - epoch_ns) * 1e-9:.3f} s (clock adjusted). Split the recording there, or record again "
            "with the clock free-running"
        )


def find_step(t_ns: Stamps, log_ns: Stamps) -> Step | None:
    """The first step of the clock, from stamps and log times in the order of the file; None if there is none."""
    if len(t_ns) < 2 * _FEWEST:
        return None
    twice = _runs_twice(log_ns)
    if twice is not None:
        return Step(twice[1], int(log_ns[twice[0]]), "the log times")
    if not _is_sorted(log_ns):
        order = np.argsort(log_ns, kind="stable")
        t_ns, log_ns = t_ns[order], log_ns[order]
    twice = _runs_twice(t_ns)
    if twice is not None:
        return Step(twice[1], int(t_ns[twice[0]]), "the stamps")
    sorted_ns = t_ns if _is_sorted(t_ns) else np.sort(t_ns)
    pause = np.diff(sorted_ns)
    i = int(np.argmax(pause))
    if pause[i] * 1e-9 > _PAUSE:
        return Step(float(pause[i]) * 1e-9, int(sorted_ns[i]), "the stamps")
    return _against_log(t_ns, log_ns)


def _is_sorted(times: Stamps) -> bool:
    return bool((times[1:] >= times[:-1]).all())


def _runs_twice(times: Stamps) -> tuple[int, float] | None:
    """Index of the last time before a step back, and its size, s."""
    if _is_sorted(times):
        return None
    late = times < np.maximum.accumulate(times)
    if np.count_nonzero(late) < _FEWEST:
        return None
    edges = np.flatnonzero(np.diff(late.astype(np.int8), prepend=0, append=0))
    everything = np.sort(times)
    for start, stop in edges.reshape(-1, 2).tolist():
        run = times[start:stop]
        if len(run) < _FEWEST or np.mean(np.diff(run) > 0) < 0.9:
            continue
        # How many times of others lie within the run, and how many of its own are nobody else's.
        within = np.searchsorted(everything, run.max(), "right") - np.searchsorted(everything, run.min()) - len(run)
        copies = np.searchsorted(everything, run, "right") - np.searchsorted(everything, run)
        if within >= 0.5 * len(run) and np.mean(copies > 1) < 0.5:
            return start - 1, float(run[0] - times[start - 1] - np.median(np.abs(np.diff(run)))) * 1e-9
    return None


def _against_log(t_ns: Stamps, log_ns: Stamps) -> Step | None:
    """A step of the stamps that the log times do not make, and that lasts."""
    ahead = t_ns - log_ns
    if ahead.max() - ahead.min() <= _SMALLEST * 1e9:
        return None
    jumps = np.flatnonzero(np.abs(np.diff(ahead)) > _SMALLEST * 1e9)
    if not len(jumps):
        return None
    usual = float(np.median(np.diff(t_ns)))
    for i in jumps.tolist():
        by_stamp, by_log = (float(times[i + 1] - times[i]) - usual for times in (t_ns, log_ns))
        jump = by_stamp - by_log
        if abs(jump) < _SHARE * usual or abs(by_log) > 0.5 * abs(jump) or abs(by_stamp) < 0.5 * abs(jump):
            continue
        before, after = ahead[max(0, i + 1 - _AROUND) : i + 1], ahead[i + 1 : i + 1 + _AROUND]
        if min(len(before), len(after)) < _FEWEST:
            continue
        lasting = float(np.median(after) - np.median(before))
        if ((t_ns > t_ns[i]) & (t_ns < t_ns[i + 1])).any():
            continue  # messages that are late fill the hole
        runs_on = np.median(np.diff(t_ns[i + 1 : i + 1 + _AROUND])) > 0.5 * usual
        if runs_on and abs(lasting - jump) < 0.5 * abs(jump):
            return Step(jump * 1e-9, int(t_ns[i]), "the stamps")
    return None
