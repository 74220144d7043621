"""Means over readings between which the device hardly turned: one attitude each, and not as many as samples.

Taken one by one, samples of a rest scatter about it as those of a device do that turns a little, and the ellipsoid's
normal there follows the direction in which they happen to scatter least. What many samples tell so is their noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors.ellipsoid import entries, excess, sagitta
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.tumble.model import Sensor
from alidade.pipelines.methods.tumble.published import FEWEST
from alidade.pipelines.recording.topics import IMU, MAG
from alidade.pipelines.settings import Config

# A mean may lie inside the ellipsoid, which is allowed for, by this many times its own sigma ...
_OFF = 1.0
# ... and those of its parts no farther apart, as a square in such units, than outliers do.
_NEAR = 6.0
# A device whose readings scatter by less than this share of them did not turn: a degree, which is more than noise. A
# magnetometer in T with ten times the field for its offset scatters by more when it turns; counts may have any offset.
_SAME = 0.02
_TOPICS = {"accel": IMU, "mag": MAG}


def unturned(sensor: Sensor) -> Sensor:
    """The sensor with means for readings, how far these lie inside the ellipsoid in their excess.

    Rests are means already; and where nobody states the noise, what samples scatter by may be motion.
    """
    if sensor.rested or sensor.noise.source == "default":
        return sensor
    raw, believed = sensor.scaled, sensor.believed
    first = _beginnings(raw, believed)
    number = np.diff(np.append(first, len(raw)))

    def mean(values: Array) -> Array:
        return np.asarray((np.add.reduceat(values, first).T / number).T)

    means = mean(raw)
    apart = raw - np.repeat(means, number, axis=0)
    scatter = mean(apart[:, :, None] * apart[:, None, :])
    scatter -= (believed**2 * (1.0 - 1.0 / number))[:, None, None] * np.eye(3)
    numbers = sensor.start @ entries(sensor.symmetric).T
    return replace(
        sensor,
        time=mean(sensor.time),
        raw=sensor.radius * means,
        sigma=sensor.sigma[first] / np.sqrt(number),
        excess=excess(means, believed / np.sqrt(number), numbers) - sagitta(means, scatter, numbers),
        drivers=None if sensor.drivers is None else mean(sensor.drivers),
    )


def check_turned(sensor: Sensor, config: Config) -> None:
    """Raise InputError if readings, or the means of `unturned`, show too few attitudes for any of the numbers."""
    scatter = float(np.sqrt(sensor.raw.var(axis=0).sum()))
    size = float(np.median(np.linalg.norm(sensor.raw, axis=1)))
    if len(sensor.raw) < FEWEST or (sensor.is_si and scatter < _SAME * size):
        raise InputError(
            f"topic {config.topic(_TOPICS[sensor.name])}: the device did not turn, or hardly, beyond the noise of its "
            f"readings; turn it slowly through all attitudes, {FEWEST} at the very least, and record again"
        )


def _beginnings(raw: Array, sigma: float) -> NDArray[np.intp]:
    """The first sample of each mean: neighbours become one as long as there are any that may.

    Of points of a sphere of radius 1, with a scatter V, the mean lies V / 2 inside.
    """
    first, number = np.arange(len(raw)), np.ones(len(raw))
    means, scatter = raw.copy(), np.zeros(len(raw))
    begin, idle = 0, 0
    while idle < 2:
        a = np.arange(begin, len(first) - 1, 2)
        together = number[a] + number[a + 1]
        share = number[a + 1] / together
        apart = ((means[a + 1] - means[a]) ** 2).sum(axis=1)
        squares = scatter[a] + scatter[a + 1] + number[a] * share * apart
        turned = squares / together - 3.0 * sigma**2 * (1.0 - 1.0 / together)
        fewest = np.minimum(number[a], number[a + 1])
        one = (0.5 * turned < _OFF * sigma / np.sqrt(together)) & (apart < _NEAR * sigma / np.sqrt(fewest))
        into, gone = a[one], a[one] + 1
        means[into] += share[one, None] * (means[gone] - means[into])
        scatter[into], number[into] = squares[one], together[one]
        first = np.delete(first, gone)
        number, means, scatter = (np.delete(each, gone, axis=0) for each in (number, means, scatter))
        begin, idle = 1 - begin, 0 if len(gone) else idle + 1
    return first
