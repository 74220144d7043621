"""What drivers write in place of a measurement: the one place that knows it.

A sensor that is not there reads zero, one value, or NaN, whatever its covariance says; one that reads something
plausible is there, though a driver wrote -1 over it. A covariance that no sensor has says nothing: zero, -1, too small
for any, or so large that the reading would be none (1e6, 1e9, the largest number). A value repeated until there is a
new one was measured once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording.checks import count
from alidade.pipelines.recording.plausibility import implausible

Array = NDArray[np.float64]

# Sigmas of a sample, in SI, beyond which a reading says nothing at all: of a gyro, of an accelerometer (gravity), of a
# magnetometer (twice the earth's field) and of an attitude (a radian).
MOST_SIGMA = {"gyro": 0.5, "accel": 9.8, "mag": 1e-4, "attitude": 1.0}
HELD = ": repeats the reading before, used once"
_LARGEST = 1e100
# Readings that repeat the one before in more than so much of the rows were held; so many have to tell.
_HELD, _FEWEST = 0.4, 100


def is_there(kind: str, values: Array, covariance: Array) -> bool:
    """Whether a sensor measured what a message holds (N, 3), or a driver filled it in.

    Args:
        kind: accel or gyro.
        values: as recorded.
        covariance: (N, 3, 3) as recorded; one that begins with -1 says that there is no such sensor.
    """
    finite = values[np.isfinite(values).all(axis=1)]
    if not finite.any():
        return False
    if not (covariance[:, 0, 0] == -1.0).any():
        return True
    # Said to be absent, at least in some rows, as in the first: believed of what never moves or cannot be.
    return bool(np.ptp(finite, axis=0).all()) and not (kind == "accel" and implausible(kind, finite))


def believed(topic: str, kind: str, covariance: Array, least: float, dropped: dict[str, int]) -> Array:
    """Covariances (N, 3, 3), zero in place of those that say nothing, which are counted in `dropped`.

    Args:
        topic: for what is counted.
        kind: a key of MOST_SIGMA.
        covariance: of a sample each.
        least: variance below which no sensor is.
        dropped: reason -> samples, added to.
    """
    # Those that never change are one in memory.
    alike = len(covariance) if len(covariance) and covariance.strides[0] == 0 else 1
    own = covariance[:1] if alike > 1 else covariance
    # Some write the largest number there is.
    diagonal = np.clip(np.diagonal(own, axis1=1, axis2=2), -_LARGEST, _LARGEST)
    absent = own[:, 0, 0] == -1.0
    variance = diagonal.sum(axis=1) / 3.0
    tiny = ~absent & (variance > 0.0) & (variance < least)
    huge = ~absent & ~(np.abs(diagonal) < MOST_SIGMA[kind] ** 2).all(axis=1)
    for mask, what in ((absent, "of -1"), (tiny, "too small for any sensor"), (huge, "too large for any sensor")):
        count(dropped, f"{topic}: covariance {what}, not believed (kept)", alike * int(np.count_nonzero(mask)))
    unknown = absent | tiny | huge
    if not unknown.any():
        return covariance
    return np.broadcast_to(np.where(unknown[:, None, None], 0.0, own), covariance.shape)


def density(topic: str, kind: str, t: Array, covariance: Array, least: float, dropped: dict[str, int]) -> float | None:
    """Noise density, per sqrt(Hz), from the covariances (N, 3, 3) of samples: sigma/sqrt(rate); None if unknown.

    Args:
        topic: for what is counted.
        kind: a key of MOST_SIGMA.
        t: (N,) s.
        covariance: as recorded.
        least: density below which no sensor is.
        dropped: reason -> samples, added to: what `believed` leaves out.
    """
    step = float(np.median(np.diff(t)))
    covariance = believed(topic, kind, covariance, least**2 / step, dropped)
    variances = np.trace(covariance[:1] if covariance.strides[0] == 0 else covariance, axis1=1, axis2=2) / 3.0
    known = variances[variances > 0.0]
    return float(np.sqrt(np.mean(known) * step)) if len(known) else None


def measured_once(topic: str, values: Array, dropped: dict[str, int]) -> NDArray[np.intp]:
    """Rows of values (N, k), sorted by time, without those that repeat the row before where a driver holds them."""
    everything = np.arange(len(values))
    if len(values) < _FEWEST:
        return everything
    repeats = np.append(False, (np.diff(values, axis=0) == 0.0).all(axis=1))
    # At rest a coarse sensor repeats itself as well, one value throughout, or not each as often as the others.
    runs = np.diff(np.flatnonzero(np.append(~repeats, True)))
    if repeats.mean() < _HELD or len(runs) < 2 or np.mean(np.abs(runs - np.median(runs)) <= 1) < 0.9:
        return everything
    count(dropped, f"{topic}{HELD}", int(repeats.sum()))
    return np.flatnonzero(~repeats)
