"""Checks of measured series, their values, stamps and clocks, used by every method's reader; they raise InputError.

Three things show a clock that was set during a recording. Times that run twice: after a step back, whole runs of
samples lie between samples taken before it, while messages that are merely late fill a hole. Stamps that step while log
times run on: the sensor's clock was set. And a pause no recording makes. A step forward of both stamps and log times
looks like a gap, and is read as one.

Samples that a driver gets several at a time, and stamps as they arrive, have their stamps in bursts. Stamps that are
exactly an interval apart while the log times beside them jitter were made by counting samples, or by a clock that also
triggers them. Where log times are as even as the stamps (simulated, or written later) nothing can be concluded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array, Stamps
from alidade.pipelines.errors import InputError

# A gyro that saturates above this is rare; 2000 deg/s read as rad/s is far beyond.
MAX_RATE_RAD_S = 35.0
# Quaternions further from unit length are not rounding but another quantity.
MAX_NORM_ERROR = 1e-3
# The best sensors there are have more noise, rad/s/sqrt(Hz), m/s^2/sqrt(Hz) and T/sqrt(Hz). Drivers that know nothing
# write a variance of 1e-12, say.
LEAST_GYRO, LEAST_ACCEL, LEAST_MAG = 2e-7, 1e-6, 1e-12
# Least number of steps from which the unit of stamps is recognised, and the shortest of a sensor: of 40 kHz, s.
_FEWEST_STEPS, _SHORTEST_STEP_S = 10, 2.5e-5
# Longest usual step of a gyro, and of another sensor, s.
SLOWEST_GYRO_S, SLOWEST_S = 0.5, 5.0
# The unit that stamps are in whose step has to be multiplied so.
_MEANT = {1e-3: "ms", 1e-6: "us", 1e-9: "ns", 1e3: "s or ms", 1e6: "s", 1e9: "s"}
# Messages overtake each other by at most so many usual steps; sorted, so many of their steps are within so much of it.
_OVERTAKING_STEPS, _EVEN_SHARE, _EVEN = 20.0, 0.9, 0.5
_ADVICE = {"out of order": ": sort the recording by header stamps", "duplicate": ", written with all their digits"}
# With so many stamps twice, of different readings, two devices are likelier than a recorder's mistake.
_TWO_DEVICES = 0.2
_MIXED = "; are two devices on one topic? choose one by `frame:` under `topics`, of a table by `where:` under `columns`"
# What was done to many messages, and is noted beside being counted.
COPIED, OVERTAKEN = ": the same message once more, left out", ": messages overtook each other, sorted by stamp"
# A few stamps out of place are a recorder's hiccup, more are a broken time base.
MAX_BAD_STAMPS = 0.01

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


def clean(
    topic: str,
    t_ns: NDArray[np.int64],
    epoch_ns: int,
    values: Array,
    dropped: dict[str, int],
    least: int = 2,
    slowest_s: float = SLOWEST_S,
) -> tuple[Array, NDArray[np.int64]]:
    """Return strictly increasing times, s from epoch_ns, of the usable samples, and the samples' indexes in the series.

    Samples with a NaN or infinite value (rows of `values`) are dropped, and so are all but the first of several with
    the same stamp; stamps out of order are sorted. What was done is counted in `dropped`.

    Args:
        topic: for what is said.
        t_ns: (N,) stamps in the order of the file.
        epoch_ns: zero of the times.
        values: (N, ...) what was measured.
        dropped: reason -> samples, added to.
        least: samples needed; of a topic that one message of will do the rate is not looked at.
        slowest_s: the longest usual step that such a sensor may have, s.

    Raises:
        InputError: more than 1 % of the stamps are those of other, different samples, or out of order by more than
            messages that overtake each other; the usual step is that of another unit of time; fewer than `least`
            samples are left.
    """
    keep = np.flatnonzero(np.isfinite(values.reshape(len(t_ns), -1)).all(axis=1))
    count(dropped, f"{topic}: not a finite number", len(t_ns) - len(keep))
    if not len(keep):
        raise InputError(f"topic {topic}: every one of the {len(t_ns)} messages has a NaN or infinite value")
    in_file = t_ns[keep]
    late = in_file < np.maximum.accumulate(in_file)
    backward = int(np.count_nonzero(late))
    keep = keep[np.argsort(in_file, kind="stable")]
    copies = _copies(t_ns[keep], take_rows(values, keep))
    count(dropped, f"{topic}{COPIED}", int(np.count_nonzero(copies)))
    keep = keep[~copies]
    stamps = t_ns[keep]
    first = np.diff(stamps, prepend=np.iinfo(np.int64).min // 2) > 0
    duplicate = int(np.count_nonzero(~first))
    overtaken = backward and _is_overtaking(in_file, stamps[first])
    for what, number, at_ns in (
        ("out of order", 0 if overtaken else backward, in_file[np.argmax(late)]),
        ("duplicate", duplicate, stamps[np.argmin(first)]),
    ):
        if number > MAX_BAD_STAMPS * len(in_file):
            mixed = "" if number < _TWO_DEVICES * len(in_file) or what != "duplicate" else _MIXED
            raise InputError(
                f"topic {topic}: {number} of {len(in_file)} stamps are {what} (the first at "
                f"{float(at_ns - epoch_ns) * 1e-9:.6f} s from the start); the stamps have to be those of the "
                f"measurements{_ADVICE[what]}{mixed}"
            )
    count(dropped, f"{topic}: stamp out of order (sorted, kept)", backward)
    if overtaken and backward > MAX_BAD_STAMPS * len(in_file):
        count(dropped, f"{topic}{OVERTAKEN}", backward)
    count(dropped, f"{topic}: duplicate stamp", duplicate)
    keep = keep[first]
    if len(keep) < least:
        raise InputError(f"topic {topic}: {len(keep)} usable messages, at least {least} are needed")
    if least > 1:
        check_time_unit(f"topic {topic}", t_ns[keep], slowest_s)
    return seconds(t_ns[keep], epoch_ns), keep


def check_time_unit(name: str, t_ns: NDArray[np.int64], slowest_s: float) -> None:
    """Raise InputError where the median step between stamps, ns, is plausible for a sensor only in another unit."""
    factor = likely_time_unit(t_ns, slowest_s)
    if factor is not None:
        step = float(np.median(np.diff(t_ns))) * 1e-9
        raise InputError(
            f"{name}: samples are {step:.3g} s apart (median); is the unit of time {_MEANT[factor]}? Stamps have to be "
            f"in s, multiplied by {factor:g}"
        )


def likely_time_unit(t_ns: NDArray[np.int64], slowest_s: float) -> float | None:
    """Return the factor (1e-3, 1e3, ...) that makes the median step of stamps, ns, plausible; None if none is needed.

    Stamps (N,) may be out of order; `slowest_s` is the longest usual step of such a sensor, s.
    """
    if len(t_ns) < _FEWEST_STEPS:
        return None
    step = float(np.median(np.abs(np.diff(t_ns.astype(float))))) * 1e-9
    if step > slowest_s:
        return next((factor for factor in (1e-3, 1e-6, 1e-9) if step * factor <= slowest_s), None)
    if 0.0 < step < _SHORTEST_STEP_S:
        return next((factor for factor in (1e3, 1e6, 1e9) if step * factor >= _SHORTEST_STEP_S), None)
    return None


def take_rows(values: Array, rows: NDArray[np.int64]) -> Array:
    """Select rows of an array, without a copy where all rows are selected or all rows are one in memory."""
    if values.strides[0] == 0:
        return np.broadcast_to(values[0], (len(rows), *values.shape[1:]))
    everything = len(rows) == len(values) and bool((rows[1:] > rows[:-1]).all())
    return values if everything else values[rows]


def seconds(t_ns: Stamps, epoch_ns: int) -> Array:
    """Stamps as s from epoch_ns, correctly rounded over a hundred days."""
    return np.asarray((t_ns - epoch_ns) / 1e9)


def nanoseconds(t: Array, epoch_ns: int) -> NDArray[np.int64]:
    """Times in s as Unix ns, the inverse of `seconds`."""
    return np.rint(t * 1e9).astype(np.int64) + epoch_ns


def check_gyro(topic: str, t: Array, gyro: Array) -> None:
    """Raise InputError if rates, shape (N, 3), are too high to be rad/s."""
    if said := too_fast(topic, t, gyro):
        raise InputError(said)


def too_fast(topic: str, t: Array, gyro: Array) -> str:
    """Sentence about rates (N, 3) that are too high to be rad/s; empty without fault."""
    rate = np.linalg.norm(gyro, axis=1)
    worst = int(np.argmax(rate))
    if rate[worst] <= MAX_RATE_RAD_S:
        return ""
    return (
        f"topic {topic}: rate of {rate[worst]:.4g} at {t[worst]:.6f} s, beyond {MAX_RATE_RAD_S:g} rad/s; "
        "is the gyro in deg/s? It has to be in rad/s, or `units: {gyro: deg/s}` beside the columns of a table"
    )


def tracked(topic: str, wxyz: Array, dropped: dict[str, int]) -> Array:
    """Return quaternions (N, 4), NaN where all components are zero (the tracker lost the body); count these rows."""
    lost = np.asarray(~wxyz.any(axis=1))
    if lost.all() or not lost.any():
        return wxyz
    count(dropped, f"{topic}: a quaternion of zeros, as of a body that was not seen", int(lost.sum()))
    return np.where(lost[:, None], np.nan, wxyz)


def unit_quaternions(topic: str, t: Array, wxyz: Array) -> Array:
    """The quaternions, shape (N, 4), at exactly unit length. Raises InputError beyond 1e-3, at zero norm and at NaN."""
    norm = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(~(np.abs(norm - 1.0) <= MAX_NORM_ERROR))
    if len(bad):
        i = bad[0]
        what = "is zero" if norm[i] == 0.0 else f"has norm {norm[i]:.6g}"
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(
            f"topic {topic}: the quaternion at {t[i]:.6f} s {what}{more}; an attitude is a unit quaternion"
        )
    # Rounding is left alone, so that what was written is what is read.
    return np.where(np.abs(norm - 1.0)[:, None] > 1e-12, wxyz / norm[:, None], wxyz)


def check_overlap(spans: Mapping[str, Array]) -> None:
    """Raise InputError where the times of the topics, name -> t, do not overlap."""
    latest = max(spans, key=lambda name: spans[name][0])
    earliest = min(spans, key=lambda name: spans[name][-1])
    if spans[latest][0] >= spans[earliest][-1]:
        described = ", ".join(f"{name} {t[0]:.3f} to {t[-1]:.3f} s" for name, t in spans.items())
        raise InputError(f"no time is covered by all of: {described}; are the clocks the same?")


def count(dropped: dict[str, int], reason: str, number: int) -> None:
    """Add a number of samples to the entry of a reason in the tally `dropped`; zero adds no entry."""
    if number:
        dropped[reason] = dropped.get(reason, 0) + number


def _copies(stamps: NDArray[np.int64], values: Array) -> NDArray[np.bool_]:
    """Mask (N,) of samples, sorted by stamp, whose stamp and numbers equal those of the preceding sample."""
    out = np.zeros(len(stamps), dtype=bool)
    again = np.flatnonzero(np.diff(stamps) == 0) + 1
    rows = values.reshape(len(stamps), -1)
    out[again] = (rows[again] == rows[again - 1]).all(axis=1)
    return out


def _is_overtaking(in_file: NDArray[np.int64], stamps: NDArray[np.int64]) -> bool:
    """Whether stamps are out of order because messages overtook each other: slightly late, and even once sorted."""
    steps = np.diff(stamps)
    if not len(steps):
        return False
    usual = float(np.median(steps))
    late = float((np.maximum.accumulate(in_file) - in_file).max())
    return late <= _OVERTAKING_STEPS * usual and bool(np.mean(np.abs(steps - usual) <= _EVEN * usual) >= _EVEN_SHARE)


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
