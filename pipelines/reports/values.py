"""What a calibration says of single sensors: matrices, biases, joint covariances.

K, bias = calibration.matrix("mag"), calibration.bias("mag")      # nominal = K (raw - bias)
P = calibration.covariance_of(["time_offset", "gyro_bias_x"])
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.estimation.problem import Array


class SensorValues:
    """Values by sensor, of whatever has parameters by name."""

    @property
    @abstractmethod
    def values(self) -> Mapping[str, float]:
        """Parameter -> value, SI."""

    @abstractmethod
    def _joint(self) -> tuple[Sequence[str], Array]:
        """Names and joint covariance (n, n). Raises InputError when there is none."""

    def matrix(self, sensor: str) -> Array:
        """K (3, 3) of "accel", "gyro", "mag" or "platform": nominal = K (raw - bias), along the body's axes.

        Raises:
            InputError: the calibration has no such sensor.
        """
        return self._model(sensor)[0]

    def bias(self, sensor: str) -> Array:
        """The sensor's reading at zero (3,), in the unit recorded: nominal = K (raw - bias), b of K raw + b is -K bias.

        Raises:
            InputError: the calibration has no such sensor.
        """
        return self._model(sensor)[1]

    def covariance_of(self, names: Sequence[str]) -> Array:
        """Joint covariance (n, n) of parameters in the order given, SI.

        Raises:
            InputError: the calibration has no such parameter, or no joint covariance.
        """
        order, covariance = self._joint()
        for name in names:
            if name not in order:
                raise InputError(f"the calibration has no parameter {name}{nearest(name, list(order))}")
        rows = [list(order).index(name) for name in names]
        return np.asarray(covariance[np.ix_(rows, rows)])

    def _model(self, sensor: str) -> tuple[Array, Array]:
        from alidade.pipelines.methods.triads import sensor_model

        try:
            return sensor_model(sensor, self.values)
        except KeyError:
            known = {name.rsplit("_", 1)[0] for name in self.values if name.endswith(("_k11", "_bias_x"))}
            sensors = sorted(stem.removesuffix("_bias") for stem in known)
            there = f"; it has {', '.join(sensors)}" if sensors else ""
            raise InputError(f"the calibration has no sensor {sensor!r}{there}") from None
