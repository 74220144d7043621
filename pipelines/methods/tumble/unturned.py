"""Means over readings between which the device hardly rotated, one attitude each.

Single samples of a rest scatter like those of a slightly rotating device, and the ellipsoid's normal there follows the
direction of least scatter: an estimate from single samples fits their noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.ellipsoid import entries, excess, sagitta
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.tumble.model import TURNED, Sensor, relative_scatter
from alidade.pipelines.methods.tumble.published import FEWEST
from alidade.pipelines.recording.topics import IMU, MAG
from alidade.pipelines.settings import Config

# A mean may lie inside the ellipsoid, which is allowed for, by this many times its own sigma ...
_OFF = 1.0
# ... and those of its parts no farther apart, as a square in such units, than outliers do.
_NEAR = 6.0
# Noise of a sample over the radius of the ellipsoid. Through a cloud of Gaussian noise that is the mean length in it,
# about which lengths scatter by (3 pi / 8 - 1)^.5 = .42 of it; half of that, which no sensor has, is no ellipsoid.
_CLOUD = 0.21
_TOPICS = {"accel": IMU, "mag": MAG}


def unturned(sensor: Sensor) -> Sensor:
    """Replace a sensor's readings by means of neighbours, `excess` corrected for their depth in the ellipsoid.

    Rests are means already. Without a stated noise the sensor stays as it is: the scatter may be motion.
    """
    if sensor.rested or sensor.noise.source == "default":
        return sensor
    raw, sample_scatter = sensor.scaled, sensor.sample_scatter
    first = _beginnings(raw, sample_scatter)
    number = np.diff(np.append(first, len(raw)))

    def mean(values: Array) -> Array:
        return np.asarray((np.add.reduceat(values, first).T / number).T)

    means = mean(raw)
    apart = raw - np.repeat(means, number, axis=0)
    scatter = mean(apart[:, :, None] * apart[:, None, :])
    scatter -= (sample_scatter**2 * (1.0 - 1.0 / number))[:, None, None] * np.eye(3)
    numbers = sensor.start @ entries(sensor.symmetric).T
    return replace(
        sensor,
        time=mean(sensor.time),
        raw=sensor.radius * means,
        sigma=sensor.sigma[first] / np.sqrt(number),
        excess=excess(means, sample_scatter / np.sqrt(number), numbers) - sagitta(means, scatter, numbers),
        drivers=None if sensor.drivers is None else mean(sensor.drivers),
    )


def check_turned(sensor: Sensor, config: Config) -> None:
    """Raise InputError if readings, or their means by `unturned`, cover too few attitudes for a parameter."""
    few = not sensor.rested and len(sensor.raw) < FEWEST
    # Counts may have any offset: those of a device that rests are a cloud of noise, and so is their ellipsoid.
    still = relative_scatter(sensor.raw) < TURNED and (sensor.is_si or sensor.sample_scatter > _CLOUD)
    if few or still:
        raise InputError(
            f"topic {config.topic(_TOPICS[sensor.name])}: the device did not turn, or hardly, beyond the noise of its "
            f"readings; turn it slowly through all attitudes, {FEWEST} at the very least, and record again"
        )


def _beginnings(raw: Array, sigma: float) -> NDArray[np.intp]:
    """Index of the first sample of each mean; neighbours are merged while their scatter allows.

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
