"""Validation of the head method: attitudes that the gyros carry on for a second, against vision and the truth.

From each vision frame k the attitude is carried to the frame l about 1 s later, bRv_l = dB^T bRv_k dV, with
bRv_k = cRb^T cRh_k vRh^T, dV and dB the rotations of helmet and platform by their gyros between the two pictures. Its
error against vision is Log((cRb bRv_l vRh)^T cRh_l), in h, and against the truth Log(bRv_l^T bRv_true), in v. Before
compensation bias and time offset are zero and the mounts the identity. A wrong bias shows in full after 1 s, a wrong
mount by what the head or the platform turns, a wrong time offset by what their rates change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.settings import Config

# How long the gyros carry the attitude, s, and how far from that frames may lie.
_SPAN, _SLACK = 1.0, 0.25
# A window that neither way explains, this many times worse than is usual, ends or begins with a vision outlier.
_OUTLYING = 5.0


@dataclass(frozen=True)
class _Calibration:
    """The parameters as they are applied."""

    bias: Array
    vRh: Array
    cRb: Array
    time_offset: float

    @classmethod
    def of(cls, values: Mapping[str, float]) -> _Calibration:
        """From parameter values; those not there are zero."""

        def vector(name: str) -> Array:
            return np.array([values.get(f"{name}_{axis}", 0.0) for axis in "xyz"])

        return cls(
            vector("gyro_bias"),
            so3.exp(vector("helmet_mount")),
            so3.exp(vector("camera_mount")),
            values.get("time_offset", 0.0),
        )


def validate(data: HeadData, config: Config, values: Mapping[str, float]) -> tuple[Validation, ...]:
    """Errors of attitudes carried on by the gyros, against vision and, where it is known, against the truth.

    Args:
        data: the session.
        config: of the session.
        values: calibrated parameters by name, those of calibration.yaml.

    Raises:
        InputError: no two vision frames about a second apart within the gyros' record.
    """
    ways = (_Calibration.of({}), _Calibration.of(values))
    start, stop = _windows(data, ways[1].time_offset)
    carried = [_carried(data, way, start, stop) for way in ways]
    seen = data.vision_wxyz[stop]
    by_vision = [_error(so3.compose(way.cRb, bRv, way.vRh), seen) for way, bRv in zip(ways, carried, strict=True)]
    time = data.vision_t[stop]
    out = [_validation("against vision", time, by_vision, _vision_noise(data, config, start, stop))]
    if data.truth_t is not None and data.truth_wxyz is not None:
        at = [time + way.time_offset for way in ways]
        inside = (np.minimum(*at) >= data.truth_t[0]) & (np.maximum(*at) <= data.truth_t[-1])
        truth = [so3.interpolate(data.truth_t, data.truth_wxyz, t[inside]) for t in at]
        by_truth = [_error(bRv[inside], true) for bRv, true in zip(carried, truth, strict=True)]
        if inside.any():
            out.append(_validation("against the truth", time[inside], by_truth))
    return tuple(out)


def _windows(data: HeadData, time_offset: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Vision frames from which and to which attitudes are carried, all of them within the gyros' record."""
    t = data.vision_t
    start = np.arange(len(t))
    after = np.clip(np.searchsorted(t, t + _SPAN), 1, len(t) - 1)
    stop = np.where(t[after] - t - _SPAN < t + _SPAN - t[after - 1], after, after - 1)
    gyros = [g for g in (data.head_t, data.platform_t) if g is not None]
    first = max(g[0] for g in gyros) - min(time_offset, 0.0)
    last = min(g[-1] for g in gyros) - max(time_offset, 0.0)
    use = (np.abs(t[stop] - t - _SPAN) <= _SLACK) & (t + _SPAN <= t[-1]) & (t >= first) & (t[stop] <= last)
    if not use.any():
        raise InputError("vision: no two frames about 1 s apart within the gyros' record; validation needs some")
    return start[use], stop[use]


def _carried(data: HeadData, way: _Calibration, start: NDArray[np.intp], stop: NDArray[np.intp]) -> Array:
    """bRv at the frames `stop`, (n, 4), from vision at the frames `start` and the gyros in between."""
    t0, t1 = data.vision_t[start] + way.time_offset, data.vision_t[stop] + way.time_offset
    bRv = so3.compose(so3.inverse(way.cRb), data.vision_wxyz[start], so3.inverse(way.vRh))
    bRv = so3.multiply(bRv, GyroPath(data.head_t, data.head_gyro, way.bias).increments(t0, t1).wxyz)
    if data.platform_t is None or data.platform_gyro is None:
        return bRv
    dB = GyroPath(data.platform_t, data.platform_gyro).increments(t0, t1).wxyz
    return so3.multiply(so3.inverse(dB), bRv)


def _error(predicted: Array, measured: Array) -> Array:
    return so3.log(so3.multiply(so3.inverse(predicted), measured))


def _validation(against: str, time: Array, errors: Sequence[Array], note: str = "") -> Validation:
    """Without the windows that vision outliers spoil, which are the same before and after."""
    lengths = np.minimum(*(np.linalg.norm(e, axis=1) for e in errors))
    good = lengths <= _OUTLYING * np.median(lengths)
    spoilt = int((~good).sum())
    notes = [note, f"{spoilt} of {len(good)} windows left out for vision outliers" if spoilt else ""]
    before, after = (e[good] for e in errors)
    name = f"attitude after 1 s on gyros, {against}"
    return Validation(name, "rad", time[good], before, after, "; ".join(filter(None, notes)))


def _vision_noise(data: HeadData, config: Config, start: NDArray[np.intp], stop: NDArray[np.intp]) -> str:
    """What the noise of the two vision frames alone makes of the error."""
    if config.noise.vision_attitude is not None:
        variance = 6.0 * config.noise.vision_attitude**2
    elif data.vision_cov is not None:
        trace = np.trace(data.vision_cov, axis1=1, axis2=2)
        variance = float((trace[start] + trace[stop]).mean())
    else:
        return ""
    return f"noise of the two vision frames makes up {np.rad2deg(np.sqrt(variance)):.2g} deg RMS"
