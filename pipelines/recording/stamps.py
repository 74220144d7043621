"""How stamps came about, as far as they show it: taken on arrival, or counted instead of measured.

Samples that a driver gets several at a time, and stamps as they arrive, have their stamps in bunches. Stamps that are
exactly an interval apart while the log times beside them jitter were made by counting samples, or by a clock that also
triggers them. Where log times are as even as the stamps (simulated, or written later) nothing can be told.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]

# A sample follows another of its bunch within this part of the usual interval, which shows over so many samples.
_WITHIN, _ACROSS = 0.1, 100
# Fewer in bunches are a recorder's hiccup.
_MOST_BUNCHED = 0.01
# An interval is even to so many ns: Unix time as a float has no more, neither in s nor in ns.
_EXACT_NS = 500
# So much of the stamps, and at most so much of the log times beside them.
_MOST_EVEN, _FEW_EVEN = 0.9, 0.5
# Fewer messages show nothing.
_FEWEST = 50


def stamp_notes(topic: str, t_ns: Stamps, log_ns: Stamps) -> tuple[str, ...]:
    """Sentences about the stamps of a topic, from them and the log times, ns (N,); none where nothing can be told."""
    if len(t_ns) < _FEWEST:
        return ()
    steps, logged = _steps(t_ns), _steps(log_ns)
    found = []
    if (share := _bunched(steps)) > _MOST_BUNCHED:
        found.append(
            f"topic {topic}: {100.0 * share:.0f} % of stamps in bursts (interval below 10 % of the median): stamped on "
            "arrival, not on measurement"
        )
    if (share := _even(steps)) > _MOST_EVEN and _even(logged) < _FEW_EVEN:
        found.append(
            f"topic {topic}: {100.0 * share:.0f} % of the stamps are exactly {np.median(steps) * 1e-6:.6g} ms apart "
            f"while log times jitter by {jitter_ns(logged) * 1e-6:.2g} ms (sigma): if they were counted and not "
            "measured, samples that were lost and a rate that drifts do not show in them"
        )
    return tuple(found)


def jitter_ns(steps: Stamps) -> float:
    """Sigma of the single times, ns, from the steps between them (N,): robust, 0 where there are none."""
    return 1.4826 / np.sqrt(2.0) * float(np.median(np.abs(steps - np.median(steps)))) if len(steps) else 0.0


def _steps(times: Stamps) -> Stamps:
    return np.asarray(np.diff(np.sort(times)), dtype=np.int64)


def _bunched(steps: Stamps) -> float:
    """The share of steps within bunches; those of zero are duplicates, and counted as such."""
    across = min(_ACROSS, len(steps))
    time = np.concatenate([[0], np.cumsum(steps)])
    usual = float(np.median(time[across:] - time[:-across])) / across
    return float(np.mean((steps > 0) & (steps < _WITHIN * usual)))


def _even(steps: Stamps) -> float:
    """The share of steps that are the usual one."""
    return float(np.mean(np.abs(steps - np.median(steps)) <= _EXACT_NS))
