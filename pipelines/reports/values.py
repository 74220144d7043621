"""Values of a calibration by sensor: matrices, biases, joint covariances.

K, bias = calibration.matrix("mag"), calibration.bias("mag")      # nominal = K (raw - bias)
P = calibration.covariance_of(["time_offset", "gyro_bias_x"])
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, overload

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.methods.formula import Formula, Value, apply, results
from alidade.pipelines.methods.temperature import FIRST

# Of a sigma, for derivatives.
_STEP = 0.1


class WithSigma(NamedTuple):
    """A result with its standard deviation: of each component, SI; of a rotation about the axes of its parent, rad."""

    value: Array
    sigma: Array


@dataclass(frozen=True)
class Application:
    """Formulas, values and config with which a calibration is applied.

    Attributes:
        formulas: of the parameters that are applied; whole: of all parameters.
        values: parameter -> value that is applied.
        constants: the other names in the formulas; parameters without a value count as zero.
    """

    formulas: Sequence[Formula]
    whole: Sequence[Formula]
    values: Mapping[str, float]
    constants: Mapping[str, float]

    def __call__(self, **measured: Array) -> dict[str, Array]:
        """Compute the formulas from measured arrays, at the first temperature."""
        first = {"temperature": self.constants[FIRST]} if FIRST in self.constants else {}
        found = results(self.formulas, {**self.constants, **self.values}, {**measured, **first})
        return {name: value.array for name, value in found.items()}


class SensorValues:
    """Base of calibrations that have parameters by name; derives matrices, biases and results from these."""

    @property
    @abstractmethod
    def values(self) -> Mapping[str, float]:
        """Value of each parameter, SI."""

    @abstractmethod
    def _joint(self) -> tuple[Sequence[str], Array]:
        """Return names and joint covariance (n, n) of the parameters, SI. Raises InputError when there is none."""

    @abstractmethod
    def application(self) -> Application:
        """Return formulas, values and config to apply the calibration with. Raises InputError if unknown."""

    @overload
    def apply(self, *, sigma: Literal[False] = False, **measured: Any) -> dict[str, Array]: ...

    @overload
    def apply(self, *, sigma: Literal[True], **measured: Any) -> dict[str, WithSigma]: ...

    def apply(self, *, sigma: bool = False, **measured: Any) -> dict[str, Array] | dict[str, WithSigma]:
        """The formulas of calibration.yaml, computed: everything that follows from what is measured.

            calibration.apply(gyro=w)["w_iv"]
            rate, deviation = calibration.apply(gyro=w, sigma=True)["w_iv"]

        Formulas leave out nuisance parameters that the recording does not determine: what would be measured for these
        alone is not looked at, and the values applied are the best ones without them.

        Args:
            sigma: return each result with the root mean square of the error that the calibration leaves in it, first
                order, from the joint covariance. What is left out counts where the measurements that it needs are
                given.
            measured: by the names in the formulas: numbers, vectors (..., 3), quaternions w, x, y, z (..., 4); SI.

        Raises:
            InputError: something is given that no formula measures; of a saved calibration also: the formulas of the
                file are not those of its parameters and config, as it was made with another config or by the published
                solver, which does not know all of them; or, for sigmas, result.json is not beside it.
        """
        known = self.application()
        needed, possible = ({n for f in each for n in f.inputs} for each in (known.formulas, known.whole))
        given = {name: value for name, value in measured.items() if name in needed or name not in possible}
        found = apply(known.formulas, {**known.constants, **known.values}, given)
        return self._with_sigmas(known, found, measured) if sigma else found

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

    def _with_sigmas(
        self, known: Application, found: Mapping[str, Array], measured: Mapping[str, Any]
    ) -> dict[str, WithSigma]:
        """Return results with sigmas: their spread about these values for parameters distributed as the posterior."""
        names, P = self._joint()
        scale = np.where(np.diag(P) > 0.0, np.sqrt(np.diag(P)), 1.0)
        shares, directions = np.linalg.eigh(P / np.outer(scale, scale))
        root = scale[:, None] * directions * np.sqrt(np.maximum(shares, 0.0))
        x = np.array([self.values[name] for name in names])

        def at(values: Array) -> dict[str, Value]:
            space = {**known.constants, **dict(zip(names, values.tolist(), strict=True))}
            return {**results(known.formulas, space, measured), **results(known.whole, space, measured)}

        best = at(x)
        square = {name: difference(Value(best[name].kind, array), best[name]) ** 2 for name, array in found.items()}
        for step in _STEP * root.T:
            ahead, behind = at(x + step), at(x - step)
            for name in found:
                square[name] = square[name] + (difference(ahead[name], behind[name]) / (2.0 * _STEP)) ** 2
        return {name: WithSigma(array, np.sqrt(square[name])) for name, array in found.items()}


def difference(one: Value, other: Value) -> Array:
    """Difference of two values; of rotations, the rotation vector from the second to the first in the parent's axes."""
    if one.kind == "rotation":
        return so3.log(so3.multiply(one.array, so3.inverse(other.array)))
    return np.asarray(one.array - other.array)
