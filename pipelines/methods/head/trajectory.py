"""Attitudes of the helmet at any time: those at the vision frames, carried by the gyros.

With P the attitude of the helmet by its corrected gyro alone, and Q that of the platform, C_k = Q_k bRv_k P_k^-1 stays
as it is but for errors. Between two frames it is interpolated, and bRv(t) = Q^-1 C P: what the gyro, carried on from
either frame, misses the other by is distributed evenly over the time between them. Of attitudes known at both ends, and
a gyro with white noise, that is the smoother's own answer; a constant error of the bias cancels.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.factors import so3
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.problem import Array, Attitudes
from alidade.pipelines.methods import formula, temperature
from alidade.pipelines.methods.head.formulas import formulas
from alidade.pipelines.methods.head.recording import HeadData


def at_gyro_rate(data: HeadData, attitudes: Attitudes, values: Mapping[str, float]) -> Attitudes:
    """bRv at each sample of the helmet's gyro from the first of the attitudes to the last; see `carried`."""
    if not len(attitudes.time):
        return attitudes
    at = data.head_t[(data.head_t >= attitudes.time.min()) & (data.head_t <= attitudes.time.max())]
    return Attitudes(at, carried(data, attitudes, values, at))


def carried(data: HeadData, attitudes: Attitudes, values: Mapping[str, float], at: Array) -> Array:
    """Attitudes bRv (n, 4) at times on the gyro's clock, carried by the gyros from those before and after.

    Args:
        data: the recording.
        attitudes: bRv that are known, one at least, within the gyros' records.
        values: parameters by name, of which the gyros' errors are applied.
        at: (n,) s; before the first and after the last attitude they are carried from that one alone.
    """
    time, first = np.unique(attitudes.time, return_index=True)
    helmet, platform = helmet_gyro(data, values), _platform_gyro(data, values)
    both = np.concatenate([time, at])
    P = helmet.attitude(both)
    Q = so3.identity(len(both)) if platform is None else platform.attitude(both)
    C = so3.compose(Q[: len(time)], attitudes.wxyz[first], so3.inverse(P[: len(time)]))
    if len(time) > 1:
        C = so3.interpolate(time, C, np.clip(at, time[0], time[-1]))
    return so3.compose(so3.inverse(Q[len(time) :]), np.broadcast_to(C, (len(at), 4)), P[len(time) :])


def helmet_gyro(data: HeadData, values: Mapping[str, float]) -> GyroPath:
    """The helmet's gyro less its errors, as calibration.yaml has it."""
    measured: dict[str, Array | None] = {"gyro": data.head_gyro, "accel": data.head_force}
    if data.temperature is not None:
        measured["temperature"] = data.temperature.first + data.temperature.above(data.temperature.first, data.head_t)
    values = {**temperature.constants(temperature.reference(data.temperature)), **values}
    return GyroPath(data.head_t, _rate("w_iv", values, measured))


def _platform_gyro(data: HeadData, values: Mapping[str, float]) -> GyroPath | None:
    """The platform's gyro less its errors; None at rest."""
    if data.platform_t is None or data.platform_gyro is None:
        return None
    known = any(each.name == "w_ib" for each in formulas(values))
    rate = _rate("w_ib", values, {"platform_gyro": data.platform_gyro}) if known else data.platform_gyro
    return GyroPath(data.platform_t, rate)


def _rate(name: str, values: Mapping[str, float], measured: Mapping[str, Array | None]) -> Array:
    """A rate (n, 3) by its formula, rad/s."""
    own = next(each for each in formulas(values) if each.name == name)
    return formula.apply([own], values, {each: measured[each] for each in own.measured})[name]
