"""Checks of measured series that every method's reader needs. What is wrong and can be told is an InputError."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import InputError

Array = NDArray[np.float64]

# A gyro that saturates above this is rare; 2000 deg/s read as rad/s is far beyond.
MAX_RATE_RAD_S = 35.0
# Quaternions further from unit length are not rounding but another quantity.
MAX_NORM_ERROR = 1e-3
# A few stamps out of place are a recorder's hiccup, more are a broken time base.
MAX_BAD_STAMPS = 0.01


def clean(
    topic: str, t_ns: NDArray[np.int64], epoch_ns: int, values: Array, dropped: dict[str, int], least: int = 2
) -> tuple[Array, NDArray[np.int64]]:
    """Times in s from epoch_ns, strictly increasing, and which samples they belong to (indexes into the series).

    Samples with a NaN or infinite value (rows of `values`) are dropped, and so are all but the first of several with
    the same stamp; stamps out of order are sorted. What was done is counted in `dropped`. Raises InputError when stamps
    are bad in more than 1 % of the samples, or fewer than `least` samples are left.
    """
    keep = np.flatnonzero(np.isfinite(values.reshape(len(t_ns), -1)).all(axis=1))
    count(dropped, f"{topic}: not a finite number", len(t_ns) - len(keep))
    if not len(keep):
        raise InputError(f"topic {topic}: every one of the {len(t_ns)} messages has a NaN or infinite value")
    stamps = t_ns[keep]
    backward = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps)))
    keep = keep[np.argsort(stamps, kind="stable")]
    first = np.diff(t_ns[keep], prepend=np.iinfo(np.int64).min // 2) > 0
    duplicate = int(np.count_nonzero(~first))
    for what, number in (("out of order", backward), ("duplicate", duplicate)):
        if number > MAX_BAD_STAMPS * len(stamps):
            at = _first_bad(stamps, epoch_ns, what)
            raise InputError(
                f"topic {topic}: {number} of {len(stamps)} stamps are {what} (the first at {at:.6f} s from the start); "
                "the stamps have to be those of the measurements"
            )
    count(dropped, f"{topic}: stamp out of order (sorted, kept)", backward)
    count(dropped, f"{topic}: duplicate stamp", duplicate)
    keep = keep[first]
    if len(keep) < least:
        raise InputError(f"topic {topic}: {len(keep)} usable messages, at least {least} are needed")
    return seconds(t_ns[keep], epoch_ns), keep


def seconds(t_ns: NDArray[np.int64], epoch_ns: int) -> Array:
    """Stamps as s from epoch_ns, correctly rounded over a hundred days."""
    return np.asarray((t_ns - epoch_ns) / 1e9)


def nanoseconds(t: Array, epoch_ns: int) -> NDArray[np.int64]:
    """The inverse of `seconds`."""
    return np.rint(t * 1e9).astype(np.int64) + epoch_ns


def check_gyro(topic: str, t: Array, gyro: Array) -> None:
    """Raise InputError if rates, shape (N, 3), are too high to be rad/s."""
    rate = np.linalg.norm(gyro, axis=1)
    worst = int(np.argmax(rate))
    if rate[worst] > MAX_RATE_RAD_S:
        raise InputError(
            f"topic {topic}: rate of {rate[worst]:.4g} at {t[worst]:.6f} s, beyond {MAX_RATE_RAD_S:g} rad/s; "
            "is the gyro in deg/s? angular_velocity has to be in rad/s"
        )


def unit_quaternions(topic: str, t: Array, wxyz: Array) -> Array:
    """The quaternions, shape (N, 4), at exactly unit length. Raises InputError beyond 1e-3, and at zero norm."""
    norm = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > MAX_NORM_ERROR)
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
    """Raise InputError if the times of the topics, name -> t, have no stretch in common."""
    latest = max(spans, key=lambda name: spans[name][0])
    earliest = min(spans, key=lambda name: spans[name][-1])
    if spans[latest][0] >= spans[earliest][-1]:
        described = ", ".join(f"{name} {t[0]:.3f} to {t[-1]:.3f} s" for name, t in spans.items())
        raise InputError(f"no stretch of time is covered by all of: {described}; are the clocks the same?")


def gyro_density(t: Array, covariance: Array) -> float | None:
    """Noise density, rad/s/sqrt(Hz), from the covariances (N, 3, 3) of samples: sigma/sqrt(rate); None if unknown.

    Unknown is what the messages say with zero or -1.
    """
    variance = float(np.trace(covariance.mean(axis=0))) / 3.0
    if not np.isfinite(variance) or variance <= 0.0:
        return None
    return float(np.sqrt(variance * np.median(np.diff(t))))


def count(dropped: dict[str, int], reason: str, number: int) -> None:
    """Add to a tally; nothing for zero."""
    if number:
        dropped[reason] = dropped.get(reason, 0) + number


def _first_bad(stamps: NDArray[np.int64], epoch_ns: int, what: str) -> float:
    if what == "duplicate":
        order = np.argsort(stamps, kind="stable")
        i: Any = order[1 + np.argmax(np.diff(stamps[order]) == 0)]
    else:
        i = np.argmax(stamps < np.maximum.accumulate(stamps))
    return float(stamps[i] - epoch_ns) * 1e-9
