"""The temperature of a sensor, as methods read it from a sensor_msgs/Temperature topic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.checks import clean, count
from alidade.pipelines.recording.recording import Recording

Array = NDArray[np.float64]

# No sensor works where it is colder or warmer, degrees Celsius; what kelvin are for most of them.
_COLDEST, _WARMEST, _ZERO_CELSIUS = -100.0, 200.0, 273.15
# Temperatures change slowly: a straight line between messages, or the nearest one, serves over this time, s.
_LONGEST_GAP = 30.0


@dataclass(frozen=True, eq=False)
class Temperature:
    """Temperatures (P,), degrees Celsius, at times t (P,), s, increasing, P >= 1."""

    t: Array
    celsius: Array

    @property
    def first(self) -> float:
        """The first one, degrees Celsius: at it a bias is the bias."""
        return float(self.celsius[0])

    def above(self, reference: float, at: ArrayLike) -> Array:
        """By how much (n,), K, it is above another, degrees Celsius, at times (n,), s: linear between messages."""
        return np.asarray(np.interp(np.asarray(at, dtype=float), self.t, self.celsius) - reference)


def read_temperature(recording: Recording, topic: str, sensor_t: Array, dropped: dict[str, int]) -> Temperature:
    """The temperature of a sensor that has samples at sensor_t (N,), s from the session's start.

    Messages that cannot be used are counted in `dropped`. Raises InputError as alidade.pipelines.recording.checks does,
    when a temperature is none of a sensor in degrees Celsius, and when there is none for long while the sensor has
    samples.
    """
    found = recording.temperature(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", found.stamped_by_log)
    t, keep = clean(topic, found.t_ns, recording.epoch_ns, found.celsius, dropped, least=1)
    celsius = found.celsius[keep]
    bad = np.flatnonzero((celsius < _COLDEST) | (celsius > _WARMEST))
    if len(bad):
        value = celsius[bad[0]]
        kelvin = _COLDEST < value - _ZERO_CELSIUS < _WARMEST
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(
            f"topic {topic}: {value:.6g} at {t[bad[0]]:.6f} s{more}{'; is it in kelvin?' if kelvin else ''} "
            f"The temperature of a sensor in degrees Celsius is needed, {_COLDEST:g} to {_WARMEST:g}"
        )
    span = sensor_t[[0, -1]]
    seen = np.concatenate([span[:1], np.clip(t, *span), span[1:]])
    widest = int(np.argmax(np.diff(seen)))
    if seen[widest + 1] - seen[widest] > _LONGEST_GAP:
        raise InputError(
            f"topic {topic}: no temperature from {seen[widest]:.1f} to {seen[widest + 1]:.1f} s; there has to be "
            f"one at least every {_LONGEST_GAP:g} s while the sensor measures"
        )
    return Temperature(t, celsius)
