"""Faults of a topic's stamps: clocks that were set, stamps on arrival, stamps counted instead of measured.

Three things show a clock that was set during a recording. Times that run twice: after a step back, whole runs of
samples lie between samples taken before it, while messages that are merely late fill a hole. Stamps that step while log
times run on: the sensor's clock was set. And a pause no recording makes. A step forward of both stamps and log times
looks like a gap, and is read as one.

Samples that a driver gets several at a time, and stamps as they arrive, have their stamps in bursts. Stamps that are
exactly an interval apart while the log times beside them jitter were made by counting samples, or by a clock that also
triggers them. Where log times are as even as the stamps (simulated, or written later) nothing can be concluded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from alidade.factors.array import Stamps
from alidade.pipelines.errors import InputError

# Smallest step of a clock, s, and as a share of the usual interval.
MIN_CLOCK_STEP_S, _MIN_STEP_SHARE = 0.02, 0.5
# Messages on either side that have to agree on a step.
_AROUND = 20
# Messages in order, most of them between others, that are a time that runs twice.
_MIN_RUN = 3
# No sensor pauses so long within a session, s.
MAX_PAUSE_S = 3600.0
# A sample within this share of the usual interval after another is of its burst; the usual interval is that over so
# many samples.
_BURST_SHARE, _INTERVAL_SAMPLES = 0.1, 100
# A smaller share in bursts is a recorder's hiccup.
_MAX_HICCUPS = 0.01
# Tolerance of an even interval, ns: Unix time as a float resolves no more, neither in s nor in ns.
_EVEN_NS = 500
# Share of even intervals of counted stamps, and the largest one of the log times beside them.
_MIN_EVEN_STAMPS, _MAX_EVEN_LOGS = 0.9, 0.5
# Fewer messages show nothing.
_MIN_MESSAGES = 50


class Step(NamedTuple):
    """Step of a clock: size, s, last time before the step, ns, and which times step."""

    size: float
    after_ns: int
    what: str


def check_clock(topic: str, t_ns: Stamps, log_ns: Stamps, epoch_ns: int) -> None:
    """Raise InputError if the clock that made stamps or log times, ns, in file order, was set meanwhile."""
    step = find_clock_step(t_ns, log_ns)
    if step is not None:
        way = "back" if step.size < 0.0 else "forward"
        raise InputError(
            f"topic {topic}: {step.what} jump {way} by {abs(step.size):.3f} s after "
            f"{(step.after_ns - epoch_ns) * 1e-9:.3f} s (clock adjusted). Split the recording there, or record again "
            "with the clock free-running"
        )


def find_clock_step(t_ns: Stamps, log_ns: Stamps) -> Step | None:
    """Return the first clock step in stamps and log times, ns, in the order of the file; None if there is none."""
    if len(t_ns) < 2 * _MIN_RUN:
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
    if pause[i] * 1e-9 > MAX_PAUSE_S:
        return Step(float(pause[i]) * 1e-9, int(sorted_ns[i]), "the stamps")
    return _against_log(t_ns, log_ns)


def _is_sorted(times: Stamps) -> bool:
    return bool((times[1:] >= times[:-1]).all())


def _runs_twice(times: Stamps) -> tuple[int, float] | None:
    """Return the index of the last time before a backward step, and the step's size, s; None without a step."""
    if _is_sorted(times):
        return None
    late = times < np.maximum.accumulate(times)
    if np.count_nonzero(late) < _MIN_RUN:
        return None
    edges = np.flatnonzero(np.diff(late.astype(np.int8), prepend=0, append=0))
    everything = np.sort(times)
    for start, stop in edges.reshape(-1, 2).tolist():
        run = times[start:stop]
        if len(run) < _MIN_RUN or np.mean(np.diff(run) > 0) < 0.9:
            continue
        # How many times of others lie within the run, and how many of its own are nobody else's.
        within = np.searchsorted(everything, run.max(), "right") - np.searchsorted(everything, run.min()) - len(run)
        copies = np.searchsorted(everything, run, "right") - np.searchsorted(everything, run)
        if within >= 0.5 * len(run) and np.mean(copies > 1) < 0.5:
            return start - 1, float(run[0] - times[start - 1] - np.median(np.abs(np.diff(run)))) * 1e-9
    return None


def _against_log(t_ns: Stamps, log_ns: Stamps) -> Step | None:
    """Return a lasting step, against the log times, of the clock that stamps a topic; None if there is none."""
    ahead = t_ns - log_ns
    if ahead.max() - ahead.min() <= MIN_CLOCK_STEP_S * 1e9:
        return None
    jumps = np.flatnonzero(np.abs(np.diff(ahead)) > MIN_CLOCK_STEP_S * 1e9)
    if not len(jumps):
        return None
    usual = float(np.median(np.diff(t_ns)))
    for i in jumps.tolist():
        by_stamp, by_log = (float(times[i + 1] - times[i]) - usual for times in (t_ns, log_ns))
        jump = by_stamp - by_log
        if abs(jump) < _MIN_STEP_SHARE * usual or abs(by_log) > 0.5 * abs(jump) or abs(by_stamp) < 0.5 * abs(jump):
            continue
        before, after = ahead[max(0, i + 1 - _AROUND) : i + 1], ahead[i + 1 : i + 1 + _AROUND]
        if min(len(before), len(after)) < _MIN_RUN:
            continue
        lasting = float(np.median(after) - np.median(before))
        if ((t_ns > t_ns[i]) & (t_ns < t_ns[i + 1])).any():
            continue  # messages that are late fill the hole
        runs_on = np.median(np.diff(t_ns[i + 1 : i + 1 + _AROUND])) > 0.5 * usual
        if runs_on and abs(lasting - jump) < 0.5 * abs(jump):
            return Step(jump * 1e-9, int(t_ns[i]), "the stamps")
    return None


def stamp_notes(topic: str, t_ns: Stamps, log_ns: Stamps) -> tuple[str, ...]:
    """Return sentences about faults of a topic's stamps, seen against its log times, (N,) ns each; none if sound."""
    if len(t_ns) < _MIN_MESSAGES:
        return ()
    steps, logged = _steps(t_ns), _steps(log_ns)
    found = []
    if (share := _burst_share(steps)) > _MAX_HICCUPS:
        found.append(
            f"topic {topic}: {100.0 * share:.0f} % of stamps in bursts (interval below 10 % of the median): stamped on "
            "arrival, not on measurement"
        )
    if (share := _even_share(steps)) > _MIN_EVEN_STAMPS and _even_share(logged) < _MAX_EVEN_LOGS:
        found.append(
            f"topic {topic}: {100.0 * share:.0f} % of the stamps are exactly {np.median(steps) * 1e-6:.6g} ms apart "
            f"while log times jitter by {jitter_ns(logged) * 1e-6:.2g} ms (sigma): if they were counted and not "
            "measured, samples that were lost and a rate that drifts do not show in them"
        )
    return tuple(found)


def jitter_ns(steps: Stamps) -> float:
    """Return a robust sigma of times, ns, from the steps between them (N,); 0 without steps."""
    return 1.4826 / np.sqrt(2.0) * float(np.median(np.abs(steps - np.median(steps)))) if len(steps) else 0.0


def _steps(times: Stamps) -> Stamps:
    return np.asarray(np.diff(np.sort(times)), dtype=np.int64)


def _burst_share(steps: Stamps) -> float:
    """Share of steps (N,) within bursts; steps of zero belong to duplicates and are in none."""
    across = min(_INTERVAL_SAMPLES, len(steps))
    time = np.concatenate([[0], np.cumsum(steps)])
    usual = float(np.median(time[across:] - time[:-across])) / across
    return float(np.mean((steps > 0) & (steps < _BURST_SHARE * usual)))


def _even_share(steps: Stamps) -> float:
    """Share of steps (N,) that equal the median step within _EVEN_NS."""
    return float(np.mean(np.abs(steps - np.median(steps)) <= _EVEN_NS))
